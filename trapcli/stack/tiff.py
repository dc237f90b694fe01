"""TIFF stacks; the only module that knows tifffile."""

from __future__ import annotations

import uuid
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import DTypeLike, NDArray

from trapcli.atomic import atomic_path
from trapcli.stack.frames import single_frames
from trapcli.stack.metadata import OME_LENGTH_UNITS, escape_ascii

CLASSIC_TIFF_LIMIT = 3_900_000_000
"""Bytes of pixels above which a BigTIFF is written; offsets in a classic TIFF end at 4 GiB."""

# TIFF stores a resolution as a ratio of two 32-bit integers, which is exact enough only in between
_RATIONAL_PIXEL_SIZES = (1e-4, 1e4)


def write_tiff(
    path: Path | str,
    blocks: Iterable[NDArray[Any]],
    *,
    shape: tuple[int, int, int],
    dtype: DTypeLike,
    frame_interval: float | None = None,
    pixel_size: float | None = None,
    pixel_unit: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write a grey-value stack block by block.

    An ImageJ TIFF where that can hold the data (uint8, uint16, float32, below 3.9 GB), else an OME-TIFF, as
    BigTIFF where it must. Both carry the frame interval and the pixel size, and `open_stack` reads them back.

    Parameters
    ----------
    blocks:
        ``(n, H, W)`` arrays of type `dtype`, N frames in all.
    shape:
        ``(N, H, W)``.
    frame_interval:
        Seconds between frames, or None where unknown.
    pixel_size, pixel_unit:
        Edge of a pixel, and the unit in words; None where unknown.

    Raises
    ------
    OutputError
        Where `path` exists (without `overwrite`) or can't be written.
    ValueError
        Where the blocks don't add up to `shape` and `dtype`.
    """
    dtype = np.dtype(dtype).newbyteorder("=")
    size = shape[0] * shape[1] * shape[2] * dtype.itemsize
    imagej = (
        dtype in (np.uint8, np.uint16, np.float32)
        and size < CLASSIC_TIFF_LIMIT
        and (pixel_size is None or _RATIONAL_PIXEL_SIZES[0] < pixel_size < _RATIONAL_PIXEL_SIZES[1])
    )
    describe = _imagej_arguments if imagej else _ome_arguments
    with (
        atomic_path(path, overwrite) as temporary,
        tifffile.TiffWriter(
            temporary, bigtiff=size >= CLASSIC_TIFF_LIMIT, imagej=imagej, ome=not imagej
        ) as tiff,
    ):
        tiff.write(
            single_frames(blocks, shape, dtype),
            shape=shape,
            dtype=dtype,
            photometric="minisblack",
            **describe(shape, frame_interval, pixel_size, pixel_unit),
        )


def _imagej_arguments(
    _shape: tuple[int, int, int],
    frame_interval: float | None,
    pixel_size: float | None,
    pixel_unit: str | None,
) -> dict[str, Any]:
    metadata: dict[str, Any] = {"axes": "TYX"}
    if frame_interval is not None:
        metadata["finterval"] = repr(float(frame_interval))
    if pixel_unit is not None:
        metadata["unit"] = escape_ascii(pixel_unit)
    arguments: dict[str, Any] = {"metadata": metadata}
    if pixel_size is not None:
        arguments |= {"resolution": (1 / pixel_size, 1 / pixel_size), "resolutionunit": "NONE"}
    return arguments


def _ome_arguments(
    shape: tuple[int, int, int],
    frame_interval: float | None,
    pixel_size: float | None,
    pixel_unit: str | None,
) -> dict[str, Any]:
    metadata: dict[str, Any] = {"axes": "TYX"}
    if frame_interval is not None:
        metadata |= {"TimeIncrement": repr(float(frame_interval)), "TimeIncrementUnit": "s"}
    if pixel_size is not None:
        # OME knows a fixed list of units and takes micrometres where none is given
        known = pixel_unit in OME_LENGTH_UNITS
        unit = pixel_unit if known else "reference frame"
        for axis in "XY":
            metadata |= {f"PhysicalSize{axis}": repr(float(pixel_size)), f"PhysicalSize{axis}Unit": unit}
        if pixel_unit is not None and not known:
            metadata["MapAnnotation"] = {"Namespace": "trap-motion", "pixel_unit": pixel_unit}
    # the same data give the same bytes
    metadata["UUID"] = str(uuid.uuid5(uuid.NAMESPACE_OID, f"{shape} {metadata}"))
    return {"metadata": metadata}
