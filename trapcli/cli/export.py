"""``trap-motion export``: a result as a table, or as the geometry of a reconstruction in other programs."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from trapcli.cli.options import PATH, Console, console_options, overwrite_option, print_path, refuse_input

if TYPE_CHECKING:
    from trapcli.reconstruction.geometry import Detector
    from trapcli.result.motion import Motion

FORMATS = ("csv", "json", "npz", "relion", "astra", "tigre", "odtbrain")
OF_FRAMES = ("relion", "astra")
"""Formats that tell where the object is in which frames."""


@click.command()
@click.argument("result", type=PATH)
@click.option("--format", "kind", type=click.Choice(FORMATS), default="csv", show_default=True)
@click.option(
    "-o", "--output", type=PATH, default="-", show_default=True, help="File to write; - for stdout."
)
@click.option(
    "--stack", metavar="INPUT", help="relion, astra: the geometry of these frames, as estimated from."
)
@click.option("--aligned", type=PATH, metavar="FILE", help="relion, astra: that of what align wrote there.")
@click.option("--pixel-size", type=float, metavar="P", help="Edge of a pixel in the result's unit.")
@overwrite_option
@console_options
def command(
    result: Path,
    kind: str,
    output: Path,
    stack: str | None,
    aligned: Path | None,
    pixel_size: float | None,
    overwrite: bool,
    console: Console,
) -> None:
    """Write RESULT as a table, or as the geometry of a reconstruction.

    \b
    csv       one row per frame, for spreadsheets and pandas.read_csv; unknown values are empty cells
    json      the same with the units of all columns; unknown values are null
    npz       all series as NumPy arrays
    relion    STAR file: orientations and shifts; with --stack or --aligned
    astra     rows of parallel3d_vec; with --stack or --aligned
    tigre     one angle a frame, for what align --upright writes, where the motion is about one axis
    odtbrain  the same with ODTbrain's sign

    The geometries leave out frames without a valid motion; docs/reconstruction.md has their formulas.
    """  # noqa: D301
    from trapcli.atomic import atomic_path
    from trapcli.errors import ConfigError, InputError
    from trapcli.result.motion import Motion

    if (kind in OF_FRAMES) != bool(stack or aligned) or (stack and aligned):
        raise ConfigError(
            f"--format {kind}: needs either --stack or --aligned, the frames that it is for"
            if kind in OF_FRAMES
            else f"--format {kind}: is the same for all frames; leave out --stack and --aligned"
        )
    if kind == "npz" and output == Path("-") and sys.stdout.isatty():
        raise ConfigError("--format npz: is no text to read; name a file with -o")
    refuse_input(output, result, *(Path(path) for path in (stack, aligned) if path))
    motion = Motion.load(result)
    try:
        detector = _detector(result, motion, stack, aligned, pixel_size) if kind in OF_FRAMES else None
        blocks = _blocks(kind, motion, detector)
        first = [next(blocks)]  # what is wrong shows before anything is written
    except ConfigError as error:
        raise ConfigError(f"--format {kind}: {error}") from None
    except InputError as error:
        raise InputError(f"{result}: {error}") from None
    if output == Path("-"):
        for block in _chained(first, blocks):
            click.echo(block, nl=False)
        return
    with atomic_path(output, overwrite) as temporary, temporary.open("wb") as file:
        for block in _chained(first, blocks):
            file.write(block)
    print_path(output)
    console.detail(f"{len(motion)} frames written")


def _chained(first: Iterable[bytes], rest: Iterable[bytes]) -> Iterator[bytes]:
    yield from first
    yield from rest


def _blocks(kind: str, motion: Motion, detector: Detector | None) -> Iterator[bytes]:
    from trapcli.reconstruction import geometry
    from trapcli.result.table import csv_blocks, json_blocks

    if kind == "npz":
        yield geometry.npz(motion)
        return
    if detector is not None:
        of_frames = geometry.relion_blocks if kind == "relion" else geometry.astra_blocks
        texts = of_frames(motion, detector)
    elif kind == "tigre":
        texts = geometry.angle_blocks(motion, sign=1, program="TIGRE")
    elif kind == "odtbrain":
        texts = geometry.angle_blocks(motion, sign=-1, program="ODTbrain")
    else:
        texts = csv_blocks(motion) if kind == "csv" else json_blocks(motion)
    for text in texts:
        yield text.encode()


def _detector(
    result: Path, motion: Motion, stack: str | None, aligned: Path | None, pixel_size: float | None
) -> Detector:
    import numpy as np

    from trapcli.reconstruction.geometry import Detector
    from trapcli.reconstruction.prepare import Changes, open_frames
    from trapcli.reconstruction.volume_files import stack_shape

    if stack:
        frames, size = open_frames(stack, result, motion, Changes(pixel_size=pixel_size))
        shape = (frames.shape[1], frames.shape[2])
        return Detector(stack, shape, size, motion.length_unit, motion.center / size)
    assert aligned is not None
    count, height, width, size_there = stack_shape(aligned, motion.length_unit)
    if count != len(motion):
        from trapcli.errors import InputError

        raise InputError(
            f"{aligned} has {count} frames where there are {len(motion)}; they don't belong together"
        )
    center = np.where(np.isfinite(motion.center), 0.0, np.nan)
    return Detector(str(aligned), (height, width), pixel_size or size_there, motion.length_unit, center)
