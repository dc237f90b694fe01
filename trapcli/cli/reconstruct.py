"""``trap-motion reconstruct``: the object that a stack shows, from its motion."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from trapcli.cli.options import (
    PATH,
    Console,
    command_line,
    console_options,
    json_option,
    overwrite_option,
    preparing_options,
    print_json,
    print_path,
    refuse_input,
)

if TYPE_CHECKING:
    from trapcli.reconstruction.volume import Reconstruction

DONE, NOT_TRUSTWORTHY = 0, 4


@click.command()
@click.argument("stack")
@click.argument("result", type=PATH)
@click.option(
    "-o", "--output", type=PATH, help="Volume: .tif (OME), .mrc or .h5.  [default: RESULT-volume.tif]"
)
@click.option(
    "--voxels",
    type=int,
    default=0,
    metavar="N",
    help="Along an edge of the volume.  [default: as fine as the pixels, at most 160]",
)
@click.option("--signed", is_flag=True, help="Attenuation may be negative, as in phase images.")
@click.option("--sharp", is_flag=True, help="Expect sharp edges between even parts (total variation).")
@preparing_options
@overwrite_option
@json_option
@console_options
def command(
    stack: str,
    result: Path,
    output: Path | None,
    voxels: int,
    signed: bool,
    sharp: bool,
    overwrite: bool,
    as_json: bool,
    console: Console,
    **changes: Any,
) -> int:
    """Compute the object that STACK shows, with the motion in RESULT.

    The volume holds attenuation per unit length, x1 fastest, in the orientation of the first frame, the
    object's centre in the middle. Frames are prepared as the estimate prepared them. How well the volume
    projects onto each frame, its resolution and what the motion shows of the object are added to RESULT as
    /motion/reconstruction. The path of the volume goes to stdout.
    """
    from trapcli.atomic import check_output
    from trapcli.reconstruction.prepare import Changes, prepare
    from trapcli.reconstruction.volume import reconstruct
    from trapcli.reconstruction.volume_files import check_ending, record, write_volume
    from trapcli.result import provenance

    output = output or result.with_name(f"{result.stem}-volume.tif")
    check_ending(output)
    refuse_input(output, result, Path(stack))
    check_output(output, overwrite)
    check_output(result, overwrite=True)  # figures about the volume are added to it
    prepared = prepare(stack, result, Changes(**changes))
    for warning in prepared.frames.info.warnings:
        console.warn(f"{stack}: {warning}")
    with console.progress() as progress:
        volume = reconstruct(
            prepared.frames,
            prepared.motion,
            pixel_size=prepared.pixel_size,
            voxels=voxels,
            positive=not signed,
            edges=sharp,
            progress=progress,
        )
    origin = provenance.collect(command_line=command_line())
    write_volume(output, volume, provenance=origin, overwrite=overwrite)
    record(result, volume, output)
    for warning in volume.warnings:
        console.warn(f"{output}: {warning}")
    if as_json:
        print_json(_summary(volume, output))
    else:
        print_path(output)
    console.detail(f"{output}: {_sentence(volume)}")
    return DONE if prepared.motion.identifiable else NOT_TRUSTWORTHY


def _sentence(volume: Reconstruction) -> str:
    resolution, unit = volume.resolution, volume.length_unit
    finer = " (that of the voxels)" if resolution.limited_by_voxels else ""
    return (
        f"resolution {resolution.seventh:.3g} {unit}{finer} where half-sets correlate by 0.143, "
        f"{resolution.half:.3g} {unit} by 0.5; {100 * volume.coverage.share:.0f} % of Fourier space seen"
    )


def _summary(volume: Reconstruction, output: Path) -> dict[str, Any]:
    import math

    import numpy as np

    def median(values: Any) -> float:
        return float(np.nanmedian(values))

    return {
        "output": str(output),
        "voxels": len(volume.values),
        "voxel_size": volume.voxel_size,
        "length_unit": volume.length_unit,
        "frames": int(np.isfinite(volume.residual).sum()),
        "resolution_0.143": volume.resolution.seventh,
        "resolution_0.5": volume.resolution.half,
        "limited_by_voxels": volume.resolution.limited_by_voxels,
        "coverage": volume.coverage.share,
        "missing_cone_degrees": math.degrees(volume.coverage.missing_angle),
        "median_residual": median(volume.residual),
        "median_misfit": median(volume.misfit),
        "median_held_out": median(volume.held_out),
        "warnings": list(volume.warnings),
    }
