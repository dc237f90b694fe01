"""``trap-motion plot``: the paper's figures for a result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from trapcli.cli.options import PATH, Console, console_options, overwrite_option, print_path, refuse_input

if TYPE_CHECKING:
    from trapcli.result.motion import Motion

PROJECTIONS = 4
"""Frames of the stack that are shown where none are chosen."""


@click.command()
@click.argument("result", type=PATH)
@click.option("-o", "--output", type=PATH, help="Figure: .png, .pdf or .svg.  [default: RESULT.png]")
@click.option("--truth", type=PATH, help="True motion, drawn over the result.")
@click.option(
    "--stack", metavar="INPUT", help="The stack itself, to show projections with the tracked centre."
)
@click.option(
    "--time-step",
    "steps",
    type=click.IntRange(min=0),
    multiple=True,
    metavar="N",
    help="Frame whose projection and Phi are shown; may be repeated.",
)
@click.option("--volume", type=PATH, help="Draw this volume of RESULT in place of the motion.")
@overwrite_option
@console_options
def command(
    result: Path,
    output: Path | None,
    truth: Path | None,
    stack: str | None,
    steps: tuple[int, ...],
    volume: Path | None,
    overwrite: bool,
    console: Console,
) -> None:
    """Draw translation, phi, omega_3 and alpha of RESULT on one page.

    With --truth the exact curves and the errors are added, with --stack some projections. The function Phi is
    shown where RESULT has it (--method paper). With --volume the figure shows slices, maximum projections,
    resolution and coverage of what reconstruct wrote, by default as VOLUME.png. The name of the figure goes
    to stdout.
    """
    from trapcli.atomic import atomic_path, check_output
    from trapcli.errors import ConfigError, InputError
    from trapcli.report import figures
    from trapcli.report.projections import choose, read_projections
    from trapcli.result.motion import Motion

    output = output or (volume or result).with_suffix(".png")
    suffix = output.suffix.lower()
    if suffix not in figures.FORMATS:
        raise ConfigError(f"{output}: no known kind of figure; end the name in {', '.join(figures.FORMATS)}")
    refuse_input(output, result, *(Path(path) for path in (truth, stack, volume) if path))
    check_output(output, overwrite)
    if volume:
        if truth or stack or steps:
            raise ConfigError(
                "--volume: leave out --truth, --stack and --time-step, which are for the motion"
            )
        _draw_volume(result, volume, output, overwrite)
        return
    motion = Motion.load(result)
    exact = Motion.load(truth) if truth else None
    shown = steps or motion.frame[choose(motion, PROJECTIONS)].tolist()
    projections = read_projections(stack, motion, shown) if stack else ()
    _note_missing(motion, steps, console)
    try:
        figure = figures.draw(motion, truth=exact, projections=projections, steps=steps, title=result.name)
    except InputError as error:
        raise InputError(f"{result} and {truth}: {error}") from None
    with atomic_path(output, overwrite) as temporary:
        figures.save(figure, temporary, suffix)
    print_path(output)


def _draw_volume(result: Path, volume: Path, output: Path, overwrite: bool) -> None:
    from trapcli.atomic import atomic_path
    from trapcli.reconstruction.volume_files import read_judgement, read_volume
    from trapcli.report import figures
    from trapcli.report.volume_page import draw_volume

    values, voxel_size, unit = read_volume(volume)
    judgement = read_judgement(result, volume)
    figure = draw_volume(values, voxel_size, unit, judgement=judgement, title=volume.name)
    with atomic_path(output, overwrite) as temporary:
        figures.save(figure, temporary, output.suffix.lower())
    print_path(output)


def _note_missing(motion: Motion, steps: Sequence[int], console: Console) -> None:
    kept = [] if motion.landscape is None else motion.landscape.frame.tolist()
    if kept and steps and not set(steps) & set(kept):
        console.note(f"Phi is not stored for these frames, but for {', '.join(map(str, kept))}")
