"""``trap-motion simulate``: a stack whose true motion is known."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from trapcli.cli.options import (
    PATH,
    Console,
    Progress,
    config_option,
    console_options,
    overwrite_option,
    resolve_config,
)
from trapcli.errors import ConfigError
from trapcli.simulation.config import (
    ATTENUATION_TYPES,
    CAMERA_BITS,
    MOTIONS,
    PHANTOMS,
    PRESETS,
    SimulateConfig,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from trapcli.stack.frames import Frames

MOTIONS_WITH = {
    "turns": ("single-axis", "degenerate-third"),
    "azimuth": ("single-axis", "degenerate-third"),
    "tilt": ("single-axis",),
    "total_angle": ("tumbling", "paper-special", "degenerate-third"),
}
"""The kinds of motion that have each parameter."""


def _size(_context: click.Context, _option: click.Parameter, value: str | None) -> tuple[int, int] | None:
    """Read ``N`` or ``WIDTHxHEIGHT`` as (width, height)."""
    if value is None:
        return None
    match = re.fullmatch(r"(\d{1,6})(?:x(\d{1,6}))?", value, re.ASCII)
    if not match:
        raise click.BadParameter(f"{value!r} is no size; give for example 128 or 256x192")
    return int(match[1]), int(match[2] or match[1])


@click.command()
@click.option("-o", "--output", type=PATH, default="sim.tif", show_default=True, help="Stack: .tif or .avi.")
@click.option("--truth", type=PATH, help="True motion.  [default: truth.h5 beside the stack]")
@click.option("--background-out", type=PATH, help="Also write the camera's empty field, float32 TIFF.")
@click.option("--preset", type=click.Choice(list(PRESETS)), help="A ready scene, see above.")
@config_option
@click.option("--phantom", type=click.Choice(PHANTOMS), help="The object.")
@click.option("--motion", type=click.Choice(MOTIONS), help="Its motion.")
@click.option("-n", "--frames-count", type=int, metavar="N", help="Number of frames.")
@click.option("--size", callback=_size, metavar="N|WxH", help="Columns and rows of a frame.")
@click.option("--spacing", type=float, metavar="P", help="Edge of a pixel.")
@click.option("--pixel-unit", metavar="U", help="Unit of all lengths.")
@click.option("--frame-interval", type=float, metavar="S", help="Seconds between frames.")
@click.option("--turns", type=float, help="Turns about a single axis.")
@click.option("--azimuth", type=float, metavar="DEG", help="Angle of that axis in the image.")
@click.option("--tilt", type=float, metavar="DEG", help="Angle of that axis out of the image plane.")
@click.option("--total-angle", type=float, metavar="DEG", help="Angle a tumbling turns in all.")
@click.option("--dtype", type=click.Choice(ATTENUATION_TYPES), help="Pixel type of attenuation.")
@click.option("--noise", type=float, metavar="SHARE", help="White noise, as a share of the peak attenuation.")
@click.option("--camera", is_flag=True, help="Raw intensities of a camera instead of attenuation.")
@click.option(
    "--bits", type=click.Choice([str(b) for b in CAMERA_BITS]), help="Bits per pixel; implies --camera."
)
@click.option("--seed", type=int, metavar="N", help="Seed of everything random.")
@overwrite_option
@console_options
def command(
    output: Path,
    truth: Path | None,
    background_out: Path | None,
    preset: str | None,
    config: Path | None,
    overwrite: bool,
    console: Console,
    **options: Any,
) -> None:
    """Render a stack and its true motion.

    Without options: the paper's object and motion in 200 frames of 128 x 128, as sim.tif and truth.h5.

    \b
    Presets:
      paper        the paper's full 1000 frames of 1024 x 1024 (4 GB)
      single-axis  blobs about one axis in the image plane, 1.2 turns of uneven speed, 1 % noise
      tumbling     a grain that tumbles by 240 degrees, 1 % noise
      camera       the same grain as raw 12-bit images

    The written paths go to stdout. configs/simulate-*.toml explain all settings for --config.
    """  # noqa: D301
    if preset and config:
        raise ConfigError("--preset and --config exclude each other; copy the preset's file and change that")
    paths = _outputs(output, truth, background_out, overwrite)
    resolved = _resolve(preset, config, options)

    from dataclasses import replace

    from trapcli.config import to_toml
    from trapcli.result import provenance
    from trapcli.simulation.render import Scene
    from trapcli.stack.tiff import write_tiff

    scene = Scene.from_config(resolved)
    background = scene.background() if background_out else None
    with console.progress() as progress:
        _write_stack(output, scene.frames(), progress, overwrite)
    if background_out and background is not None:
        stack = resolved.stack
        write_tiff(
            background_out,
            [background[None]],
            shape=(1, *background.shape),
            dtype=background.dtype,
            pixel_size=stack.pixel_size,
            pixel_unit=stack.pixel_unit,
            overwrite=overwrite,
        )
    motion = scene.truth()
    origin = provenance.collect(
        command_line=shlex.join(["trap-motion", *sys.argv[1:]]), configuration=to_toml(resolved)
    )
    replace(motion, provenance=motion.provenance | origin).save(paths[1], overwrite=overwrite)
    for path in paths:
        click.echo(os.fsencode(path))


def _outputs(output: Path, truth: Path | None, background: Path | None, overwrite: bool) -> list[Path]:
    """Check all outputs before any work is done; return them, the stack first, then the truth."""
    from trapcli.atomic import check_output

    if output.suffix.lower() not in (".tif", ".tiff", ".avi"):
        raise ConfigError(f"{output}: can't tell the kind of file; end the name in .tif or .avi")
    paths = [output, truth or output.with_name("truth.h5"), *([background] if background else [])]
    if len({check_output(path, overwrite) for path in paths}) < len(paths):
        raise ConfigError(f"{output}: two outputs have the same name; change one")
    return paths


def _resolve(preset: str | None, file: Path | None, options: dict[str, Any]) -> SimulateConfig:
    """Options beat the preset or the file, which beat the default."""
    from trapcli.config import merge

    width, height = options["size"] or (None, None)
    camera = options["camera"] or options["bits"] is not None
    tables = {
        "stack": {
            "frames": options["frames_count"],
            "width": width,
            "height": height,
            "pixel_size": options["spacing"],
            "pixel_unit": options["pixel_unit"],
            "frame_interval": options["frame_interval"],
        },
        "phantom": {"kind": options["phantom"]},
        "motion": {"kind": options["motion"], **{name: options[name] for name in MOTIONS_WITH}},
        "camera": {
            "output": "camera" if camera else None,
            "dtype": options["dtype"],
            # the white noise of a preset is for attenuation
            "noise": 0.0 if camera and options["noise"] is None else options["noise"],
            "bits": options["bits"] and int(options["bits"]),
        },
    }
    given: dict[str, Any] = {
        table: {name: value for name, value in values.items() if value is not None}
        for table, values in tables.items()
    }
    if options["seed"] is not None:
        given["seed"] = options["seed"]
    resolved = resolve_config(SimulateConfig, file, merge(PRESETS[preset] if preset else {}, given))
    for name, kinds in MOTIONS_WITH.items():
        if options[name] is not None and resolved.motion.kind not in kinds:
            option = "--" + name.replace("_", "-")
            raise ConfigError(f"{option}: is for --motion {' or '.join(kinds)}, not {resolved.motion.kind}")
    if options["dtype"] and resolved.camera.output == "camera":
        raise ConfigError("--dtype: is for attenuation; a camera's type follows from --bits")
    return resolved


def _write_stack(path: Path, frames: Frames, progress: Progress | None, overwrite: bool) -> None:
    from trapcli.stack.tiff import write_tiff

    info = frames.info
    blocks = _with_progress(frames, progress)
    if path.suffix.lower() != ".avi":
        write_tiff(
            path,
            blocks,
            shape=frames.shape,
            dtype=frames.dtype,
            frame_interval=info.frame_interval,
            pixel_size=info.pixel_size,
            pixel_unit=info.pixel_unit,
            overwrite=overwrite,
        )
        return
    if frames.dtype.kind != "u":
        raise ConfigError(
            f"{path}: AVI holds no {frames.dtype}; pass --dtype uint8 or --camera, or write a .tif"
        )

    from trapcli.stack.video import write_avi

    bits = 8 * frames.dtype.itemsize
    # programs that read AVI at all read raw 8-bit grey values; 16 bits exist in FFV1 only
    write_avi(
        path,
        blocks,
        shape=frames.shape,
        codec="raw" if bits == 8 else "ffv1",
        fps=1.0 / (info.frame_interval or 1.0),
        bits=bits,
        overwrite=overwrite,
    )


def _with_progress(frames: Frames, progress: Progress | None) -> Iterator[NDArray[Any]]:
    done = 0
    for block in frames.blocks(4):
        yield block
        done += len(block)
        if progress:
            progress("rendering", done, len(frames))
