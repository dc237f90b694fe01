"""``trap-motion align``: attenuation frames with the object in the middle."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from trapcli.cli.options import (
    PATH,
    Console,
    Progress,
    console_options,
    overwrite_option,
    preparing_options,
    print_path,
    refuse_input,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trapcli.stack.frames import Frames


@click.command()
@click.argument("stack")
@click.argument("result", type=PATH)
@click.option("-o", "--output", type=PATH, help="Frames: .tif or .mrcs.  [default: RESULT-aligned.tif]")
@click.option(
    "--box", type=click.IntRange(8, 1 << 14), metavar="N", help="Edge of the square frames in pixels."
)
@click.option(
    "--upright",
    is_flag=True,
    help="Also turn the frames until the axis of rotation runs down the middle column, for programs that "
    "know but one axis.",
)
@preparing_options
@overwrite_option
@console_options
def command(
    stack: str,
    result: Path,
    output: Path | None,
    box: int | None,
    upright: bool,
    overwrite: bool,
    console: Console,
    **changes: Any,
) -> None:
    """Write the attenuation frames of STACK with the translation in RESULT taken out.

    The frames are square, with the object's centre in pixel N//2 of rows and columns and the empty field at
    0, one for each frame of RESULT; those without a known centre hold NaN. The written path goes to stdout.
    """
    from trapcli.atomic import check_output
    from trapcli.errors import ConfigError
    from trapcli.reconstruction.alignment import align
    from trapcli.reconstruction.prepare import Changes, prepare
    from trapcli.reconstruction.single_axis import require_single_axis

    output = output or result.with_name(f"{result.stem}-aligned.tif")
    if output.suffix.lower() not in (".tif", ".tiff", ".mrcs"):
        raise ConfigError(f"{output}: no known kind of stack; end the name in .tif or .mrcs")
    refuse_input(output, result, Path(stack))
    check_output(output, overwrite)
    prepared = prepare(stack, result, Changes(**changes))
    turn = 0.0
    if upright:
        import math

        try:
            turn = math.pi / 2 - require_single_axis(prepared.motion.R).azimuth
        except ConfigError as error:
            raise ConfigError(f"--upright: {error}") from None
    center = prepared.motion.center / prepared.pixel_size
    frames = align(prepared.frames, center, edge=box or 0, turn=turn)
    with console.progress() as progress:
        _write(output, frames, prepared.pixel_size, prepared.motion.length_unit, progress, overwrite)
    for warning in frames.info.warnings:
        console.warn(f"{stack}: {warning}")
    print_path(output)


def _write(
    path: Path, frames: Frames, pixel_size: float, unit: str, progress: Progress | None, overwrite: bool
) -> None:
    blocks = _with_progress(frames, progress)
    if path.suffix.lower() == ".mrcs":
        from trapcli.reconstruction.volume_files import write_mrc_stack

        write_mrc_stack(path, blocks, frames.shape, pixel_size, unit, overwrite=overwrite)
        return
    from trapcli.stack.tiff import write_tiff

    write_tiff(
        path,
        blocks,
        shape=frames.shape,
        dtype=frames.dtype,
        frame_interval=frames.info.frame_interval,
        pixel_size=None if unit == "pixel" else pixel_size,
        pixel_unit=None if unit == "pixel" else unit,
        overwrite=overwrite,
    )


def _with_progress(frames: Frames, progress: Progress | None) -> Iterator[NDArray[Any]]:
    done = 0
    for block in frames.blocks():
        yield block
        done += len(block)
        if progress:
            progress("aligning", done, len(frames))
