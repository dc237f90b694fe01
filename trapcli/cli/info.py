"""``trap-motion info``: what a video stack is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from trapcli.cli.options import Console, console_options, json_option, print_json, print_text

if TYPE_CHECKING:
    from trapcli.stack import Frames


@click.command()
@click.argument("stack", metavar="INPUT")
@click.option("--channel", type=int, help="Channel of a colour or multi-channel input, counted from 0.")
@click.option("--time-axis", help="Axis that is time where there are several, for example T, Z or TZ.")
@click.option("--dataset", help="Dataset of an HDF5 or Zarr input, for example /entry/data.")
@click.option("--allow-partial", is_flag=True, help="Look at the readable frames of a truncated file.")
@json_option
@console_options
def command(stack: str, as_json: bool, console: Console, **options: Any) -> None:
    """Say what INPUT is: frames, size, type, pixel size, frame interval, and what to beware of.

    INPUT is a TIFF, a video (AVI, MP4, MOV, MKV), a folder or a quoted pattern of TIFFs, file.h5::/dataset,
    or - for a TIFF on standard input.
    """
    from trapcli.config import InputConfig
    from trapcli.stack import open_stack

    given = {key: value for key, value in options.items() if value is not None}
    frames = open_stack(stack, InputConfig(**given))
    if as_json:
        print_json(_as_dict(stack, frames))
    else:
        print_text(_in_words(stack, frames))


def _as_dict(stack: str, frames: Frames) -> dict[str, Any]:
    count, height, width = frames.shape
    info = frames.info
    return {
        "input": stack,
        "format": info.format,
        "frames": count,
        "height": height,
        "width": width,
        "type": str(frames.dtype),
        "bits": info.bits,
        "frame_interval": info.frame_interval,
        "time_unit": info.time_unit if info.frame_interval else None,
        "pixel_size": info.pixel_size,
        "pixel_unit": info.pixel_unit,
        "lossy": info.lossy,
        "warnings": list(info.warnings),
    }


def _in_words(stack: str, frames: Frames) -> str:
    count, height, width = frames.shape
    info = frames.info
    interval = size = "not in the file"
    if info.frame_interval:
        interval = (
            f"{info.frame_interval:g} {info.time_unit} ({1 / info.frame_interval:g} per {info.time_unit})"
        )
    if info.pixel_size:
        size = f"{info.pixel_size:g} {info.pixel_unit or '(of an unknown unit)'}"
    bits = f", {info.bits} bits used" if info.bits and info.bits != 8 * frames.dtype.itemsize else ""
    lines = [
        ("input", stack),
        ("format", info.format + (" (lossy)" if info.lossy else "")),
        ("frames", str(count)),
        ("size", f"{height} rows x {width} columns"),
        ("type", f"{frames.dtype}{bits}"),
        ("frame interval", interval),
        ("pixel size", size),
        *(("warning", warning) for warning in info.warnings),
    ]
    return "\n".join(f"{name + ':':<16}{' '.join(value.split())}" for name, value in lines)
