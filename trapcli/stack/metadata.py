"""Units and calibration as ImageJ and OME write them."""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

OME_LENGTH_UNITS = frozenset((
    "Ym", "Zm", "Em", "Pm", "Tm", "Gm", "Mm", "km", "hm", "dam", "m", "dm", "cm", "mm", "µm", "nm", "pm",
    "fm", "am", "zm", "ym", "Å", "thou", "li", "in", "ft", "yd", "mi", "ua", "ly", "pc", "pt", "pixel",
))  # fmt: skip
"""Length units of the OME schema, but for ``reference frame``, which stands for an unknown one."""


_TIME_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("µs", "us", "usec", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), 1e-9),
    **dict.fromkeys(("min", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hour", "hours"), 3600.0),
    **dict.fromkeys(("d", "day", "days"), 86400.0),
}


def escape_ascii(text: str) -> str:
    r"""Write characters beyond ASCII as ``\uXXXX``, as ImageJ does."""
    return "".join(c if c.isascii() else f"\\u{ord(c):04X}" for c in text)


def unescape(text: str) -> str:
    """Undo `escape_ascii`."""
    return re.sub(r"\\u([0-9A-Fa-f]{4})", lambda match: chr(int(match[1], 16)), text)


@dataclass(frozen=True)
class Calibration:
    """What a file's metadata say of time and length; None where they say nothing usable.

    Attributes
    ----------
    frame_interval:
        Seconds.
    pixel_size, pixel_unit:
        Edge of a square pixel; its unit may be unknown though the size is not.
    bits:
        Significant bits per pixel.
    warnings:
        One sentence each.
    """

    frame_interval: float | None = None
    pixel_size: float | None = None
    pixel_unit: str | None = None
    bits: int | None = None
    warnings: tuple[str, ...] = ()


def imagej_calibration(
    metadata: Mapping[str, Any], resolution: tuple[float, float] | None, resolution_unit: int
) -> Calibration:
    """Read the calibration of an ImageJ TIFF.

    Parameters
    ----------
    metadata:
        Key and value pairs of the image description.
    resolution, resolution_unit:
        Pixels per unit along x1 and x2, and the TIFF tag ResolutionUnit (1: none; 2 and 3: printing).
    """
    warnings: list[str] = []
    seconds = _seconds(metadata.get("finterval"), str(metadata.get("tunit", "s")), warnings)
    unit = _unit(unescape(str(metadata.get("unit", ""))))
    size = None
    # without a unit, or in inches, ImageJ has passed on what a camera or a program meant for printing
    known = unit not in ("", "pixel", "inch") or (
        not unit and resolution_unit == 1 and resolution != (1.0, 1.0)
    )
    if resolution and known:
        size = _square(tuple(1 / value if value else 0.0 for value in resolution), warnings)
    return Calibration(seconds, size, (unit or None) if size else None, None, tuple(warnings))


def ome_calibration(xml: str) -> Calibration:
    """Read the calibration of the first image in OME-XML.

    Raises
    ------
    xml.etree.ElementTree.ParseError
        Where `xml` isn't XML.
    """
    root = ElementTree.fromstring(xml)
    pixels = root.find(".//{*}Pixels")
    if pixels is None:
        return Calibration()
    warnings: list[str] = []
    seconds = _seconds(pixels.get("TimeIncrement"), pixels.get("TimeIncrementUnit", "s"), warnings)
    if seconds is None:
        seconds = _plane_interval(pixels, warnings)
    sizes = (_positive(pixels.get("PhysicalSizeX")), _positive(pixels.get("PhysicalSizeY")))
    # the schema's own default
    unit = _unit(pixels.get("PhysicalSizeXUnit", "µm"))
    if unit == "reference frame":
        own = root.find(".//{*}MapAnnotation[@Namespace='trap-motion']//{*}M[@K='pixel_unit']")
        unit = (own.text or "") if own is not None else ""
    size = _square(sizes, warnings) if unit != "pixel" and sizes[0] else None
    bits = _positive(pixels.get("SignificantBits"))
    return Calibration(
        seconds,
        size,
        (unit or None) if size else None,
        int(bits) if bits and bits <= 64 else None,
        tuple(warnings),
    )


def ome_sizes(xml: str) -> list[int]:
    """Return the declared numbers of times, slices and channels of the first image in OME-XML."""
    pixels = ElementTree.fromstring(xml).find(".//{*}Pixels")
    if pixels is None:
        return []
    channel = pixels.find("{*}Channel")
    samples = int(channel.get("SamplesPerPixel", "1")) if channel is not None else 1
    times, slices, channels = (int(pixels.get(f"Size{axis}", "1")) for axis in "TZC")
    return [times, slices, channels // max(1, samples)]


def _plane_interval(pixels: ElementTree.Element, warnings: list[str]) -> float | None:
    """Median time between the planes of the first channel and slice, where each plane has its time."""
    times: dict[int, float] = {}
    for plane in pixels.findall("{*}Plane"):
        if plane.get("TheC", "0") == plane.get("TheZ", "0") == "0" and plane.get("TheT", "").isdecimal():
            scale = _TIME_UNITS.get(plane.get("DeltaTUnit", "s"))
            try:
                times[int(plane.get("TheT", ""))] = float(plane.get("DeltaT", "nan")) * (scale or math.nan)
            except ValueError:
                return None
    steps = [times[t + 1] - times[t] for t in sorted(times) if t + 1 in times]
    if not steps or not all(math.isfinite(step) and step > 0 for step in steps):
        return None
    interval = statistics.median(steps)
    spread = (max(steps) - min(steps)) / interval
    if spread > 0.01:
        warnings.append(
            f"the times of its frames are uneven: intervals differ by {100 * spread:.0f} % of their median"
        )
    return interval


def _seconds(value: object, unit: str, warnings: list[str]) -> float | None:
    number = _positive(value)
    if number is None:
        return None
    scale = _TIME_UNITS.get(unescape(unit).strip().replace("μ", "µ"))
    if scale is None:
        warnings.append(
            f"its frame interval {value} has the unknown unit '{unit}' and isn't used; pass --frame-interval"
        )
        return None
    return number * scale


def _positive(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return None
    return number if 0 < number < math.inf else None


def _square(sizes: tuple[float | None, ...], warnings: list[str]) -> float | None:
    width = _positive(sizes[0])
    height = _positive(sizes[1]) or width
    if width is None or height is None:
        return None
    if abs(width - height) > 1e-3 * width:
        warnings.append(
            f"its pixels aren't square ({width:g} by {height:g}): scale the frames, or pass --pixel-size"
        )
        return None
    return width


def _unit(text: str) -> str:
    """One spelling for micrometres in words and for no unit; all else as written."""
    text = text.strip().replace("μ", "µ")  # Greek letter, micro sign
    if text.lower() in ("micron", "microns", "micrometer", "micrometre", "micrometers", "micrometres"):
        return "µm"
    return "pixel" if text.lower() in ("pixel", "pixels") else text
