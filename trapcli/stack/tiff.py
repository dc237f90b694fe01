"""TIFF stacks; the only module that knows tifffile."""

from __future__ import annotations

import itertools
import json
import math
import uuid
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import DTypeLike, NDArray

from trapcli.atomic import atomic_path
from trapcli.config import InputConfig
from trapcli.errors import InputError
from trapcli.stack.axes import frame_planes
from trapcli.stack.frames import StackInfo, single_frames
from trapcli.stack.ifd import Chain, Page, read_chain
from trapcli.stack.metadata import (
    OME_LENGTH_UNITS,
    Calibration,
    escape_ascii,
    imagej_calibration,
    ome_calibration,
    ome_sizes,
)
from trapcli.stack.planes import PlaneReader, Segments
from trapcli.stack.source import PARTIAL_HINT, Source, check_frame_bytes, check_frame_count, guard

CLASSIC_TIFF_LIMIT = 3_900_000_000
"""Bytes of pixels above which a BigTIFF is written; offsets in a classic TIFF end at 4 GiB."""

_LOSSY = (6, 7, 33004, 33007, 34892)
_PERHAPS_LOSSY = (22610, 33003, 33005, 34712, 34887, 34934, 48124, 50001, 50002, 52546)

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
        and shape[2] > 1  # tifffile takes a last axis of 1 for colours
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


def write_volume_tiff(
    path: Path | str, values: NDArray[Any], *, voxel_size: float, unit: str, overwrite: bool = False
) -> None:
    """Write a volume of cubic voxels as OME-TIFF, its slices along the first axis.

    Parameters
    ----------
    values:
        ``(n3, n2, n1)``, ``[x3, x2, x1]``.
    voxel_size, unit:
        Edge of a voxel; ``pixel`` where the unit is not known.

    Raises
    ------
    OutputError
        Where `path` exists (without `overwrite`) or can't be written.
    """
    arguments = _ome_arguments(values.shape, None, voxel_size, unit if unit != "pixel" else None)
    metadata = arguments["metadata"] | {"axes": "ZYX"}
    for name in ("PhysicalSizeZ", "PhysicalSizeZUnit"):
        metadata[name] = metadata[name.replace("Z", "X", 1)]
    large = values.nbytes >= CLASSIC_TIFF_LIMIT
    with (
        atomic_path(path, overwrite) as temporary,
        tifffile.TiffWriter(temporary, bigtiff=large, imagej=False, ome=True) as tiff,
    ):
        tiff.write(values, photometric="minisblack", metadata=metadata)


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


@dataclass(frozen=True)
class _Layout:
    """The planes of a stack in stored order, their axes, and the page that says how all are stored."""

    page: tifffile.TiffPage
    axes: str
    sizes: tuple[int, ...]
    planes: list[Segments]
    warnings: tuple[str, ...] = ()


def open_tiff(path: Path, name: str, config: InputConfig) -> Source:
    """Open a TIFF stack: plain, ImageJ, OME, BigTIFF, and the dialects of microscopes that tifffile knows.

    Parameters
    ----------
    name:
        What messages call the input.
    config:
        Its `time_axis`, `channel` and `allow_partial` are used here.

    Raises
    ------
    InputError
        Where the file is truncated, damaged or of a kind that isn't read, or no axis is clearly time.
    """
    with guard(name):
        chains = _Chains(name)
        chain = chains.chain(path)
        if chain.fault and not config.allow_partial:
            raise InputError(f"{name}: truncated or damaged: {chain.fault}; {PARTIAL_HINT}")
        if not chain.pages:
            raise InputError(f"{name}: truncated or damaged, and no frame of it can be read: {chain.fault}")
    with guard(name, strict=not config.allow_partial) as log, tifffile.TiffFile(path) as tiff:
        layout = _whole_or_part(name, tiff, chains, config.allow_partial)
        table, doubts = frame_planes(
            name, layout.axes, layout.sizes, time_axis=config.time_axis, channel=config.channel
        )
        reader = PlaneReader(name, layout.page, layout.planes)
        info = _info(name, tiff, layout.page, (*layout.warnings, *doubts, *log.warnings))
        info = replace(info, files=tuple(file for file in chains.files if not file.samefile(path)))
    frames, channels = table.shape
    if channels > 1 and reader.samples > 1:
        raise InputError(f"{name}: has colours and {channels} channels; save the wanted channel alone")

    def read(index: NDArray[np.int64], channel: int | None) -> Iterator[NDArray[Any]]:
        with reader.session() as plane:
            for positions in table[index]:
                if channels == 1:
                    pixels = plane(positions[0])
                    yield pixels if channel is None else pixels[..., channel]
                elif channel is not None:
                    yield plane(positions[channel])
                else:
                    yield np.stack([plane(position).copy() for position in positions], axis=-1)

    shape = (frames, reader.height, reader.width)
    return Source(name, shape, reader.dtype, max(channels, reader.samples), info, read)


class _Chains:
    """The page directories of the files of a stack, each read once."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._chains: dict[Path, Chain] = {}
        self._pages: dict[tuple[Path, int], Page] = {}

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(self._chains)

    def chain(self, path: Path) -> Chain:
        if path not in self._chains:
            with path.open("rb") as file:
                self._chains[path] = read_chain(file)
            self._pages |= {(path, page.offset): page for page in self._chains[path].pages}
        return self._chains[path]

    def page(self, path: Path, offset: int) -> Page:
        chain = self.chain(path)
        if (path, offset) not in self._pages:
            reason = chain.fault or f"no page starts at {offset}"
            raise InputError(f"{self._name}: {path.name} is truncated or damaged: {reason}; {PARTIAL_HINT}")
        return self._pages[path, offset]


def _whole_or_part(name: str, tiff: tifffile.TiffFile, chains: _Chains, allow_partial: bool) -> _Layout:
    chain = chains.chain(Path(tiff.filehandle.path))
    if allow_partial and chain.fault:
        return _salvaged(name, tiff, chain)
    try:
        with guard(name):
            return _layout(name, tiff, chains)
    except InputError:
        if not allow_partial:
            raise
        return _salvaged(name, tiff, chain)


def _layout(name: str, tiff: tifffile.TiffFile, chains: _Chains) -> _Layout:
    """Take what tifffile makes of the file, after checking it against what is there."""
    path = Path(tiff.filehandle.path)
    chain = chains.chain(path)
    series = _only_series(name, tiff, chain)
    page = series.keyframe
    _check_page(name, page)
    axes, sizes = _plane_axes(name, series)
    count = math.prod(sizes)
    check_frame_count(name, count)
    start = series.dataoffset
    if start is None:
        planes = _listed_planes(name, series, chains)
    else:
        planes = _adjacent_planes(path, start, page.nbytes, count, chain.size)
        end = start + count * page.nbytes
        within = [other for other in chain.pages if len(other.offsets) and start <= other.offsets[0] < end]
        _check_alike(name, chains.page(path, page.offset), within)
    declared = max(count, _declared_images(tiff, page))
    if len(planes) < declared:
        shortage = f"it declares {declared} frames and has {len(planes)}"
        raise InputError(f"{name}: truncated: {shortage}; {PARTIAL_HINT}")
    surplus = len(chain.pages) - count
    warnings = (f"it has {surplus} pages more than its description counts, which aren't read",)
    return _Layout(page, axes, sizes, planes, warnings if surplus > 0 else ())


def _only_series(name: str, tiff: tifffile.TiffFile, chain: Chain) -> tifffile.TiffPageSeries:
    try:
        found = tiff.series
    except RuntimeError:  # pages of different widths where all should be alike
        _check_alike(name, chain.pages[0], chain.pages)
        raise
    if len(found) != 1:
        kinds = ", ".join("x".join(map(str, series.shape)) for series in found[:4]) or "none"
        raise InputError(f"{name}: its pages change size or type ({kinds}); save the wanted ones alone")
    return found[0]


def _salvaged(name: str, tiff: tifffile.TiffFile, chain: Chain) -> _Layout:
    """Take the leading frames that are whole."""
    page = tiff.pages.first
    _check_page(name, page)
    sizes = [size for size in _declared_sizes(tiff, page) if size > 1]
    if len(sizes) > 1:
        axes = " x ".join(map(str, sizes))
        raise InputError(f"{name}: truncated, and no part of a stack with several axes ({axes}) can be read")
    declared = sizes[0] if sizes else 1
    check_frame_count(name, declared)
    path = Path(tiff.filehandle.path)
    alike = list(itertools.takewhile(lambda other: other.layout == chain.pages[0].layout, chain.pages))
    if page.is_final and declared > 1 and _are_adjacent(alike, page.nbytes, declared):
        planes = _adjacent_planes(path, page.dataoffsets[0], page.nbytes, declared, chain.size)
    else:
        planes = [Segments(path, other.offsets, other.counts) for other in alike]
    whole = f"{declared} frames" if declared > 1 else "an unknown number of frames"
    warning = f"it is truncated or damaged: {len(planes)} of {whole} can be read"
    return _Layout(page, "T", (len(planes),), planes, (warning,))


def _are_adjacent(pages: list[Page], length: int, declared: int) -> bool:
    """Whether the pixels of all declared frames follow each other, with no directory in between."""
    start = int(pages[0].offsets[0])
    end = start + declared * length
    if pages[-1].following == 0 and len(pages) > 1:  # nothing is cut off: the directories count the frames
        return False
    directories = (*(page.offset for page in pages), pages[-1].following)
    return not any(start < directory < end for directory in directories) and all(
        page.offsets[0] == start + k * length for k, page in enumerate(pages)
    )


def _check_page(name: str, page: tifffile.TiffPage) -> None:
    """Refuse what couldn't be held in memory or decoded, before anything tries."""
    if page.dtype is None or page.compression not in list(tifffile.COMPRESSION):
        raise InputError(
            f"{name}: pixels of {page.bitspersample} bits with compression {page.compression} can't be read; "
            "save it again without compression"
        )
    check_frame_bytes(name, page.nbytes)
    check_frame_bytes(name, math.prod(page.chunks) * page.dtype.itemsize)


def _check_alike(name: str, first: Page, others: Iterable[Page]) -> None:
    for other in others:
        if other.layout != first.layout:
            raise InputError(
                f"{name}: the page at byte {other.offset} has another size, type or storage than the first; "
                "save all pages alike"
            )


def _plane_axes(name: str, series: tifffile.TiffPageSeries) -> tuple[str, tuple[int, ...]]:
    """Letters and lengths of the axes that count planes."""
    axes, shape, page = series.get_axes(False), series.get_shape(False), series.keyframe
    inner = axes.find("Y")
    if page.shaped[0] > 1:  # one plane for each colour
        inner -= 1
    if inner < 0 or math.prod(shape[inner:]) != page.size:
        raise InputError(f"{name}: its axes {axes} don't fit its pages; save it as a plain stack")
    return axes[:inner], tuple(shape[:inner])


def _adjacent_planes(path: Path, start: int, length: int, count: int, size: int) -> list[Segments]:
    """Planes without gaps between them, as many of `count` as the file of `size` bytes has."""
    present = min(count, (size - start) // length)
    return [Segments(path, np.array([start + k * length]), np.array([length])) for k in range(present)]


def _listed_planes(name: str, series: tifffile.TiffPageSeries, chains: _Chains) -> list[Segments]:
    """Planes with a page directory each, which may be in several files."""
    planes = []
    first = None
    for page in series:
        if page is None:
            continue
        path = Path(page.parent.filehandle.path)
        if page.offset <= 0 or series.kind == "lsm":  # in no directory, or one that tifffile has mended
            offsets, counts = np.array(page.dataoffsets, np.int64), np.array(page.databytecounts, np.int64)
            planes.append(Segments(path, offsets, counts))
            continue
        found = chains.page(path, page.offset)
        first = first or found
        _check_alike(name, first, [found])
        planes.append(Segments(path, found.offsets, found.counts))
    return planes


def _declared_images(tiff: tifffile.TiffFile, page: tifffile.TiffPage) -> int:
    """Number of planes in an ImageJ description, 0 where there is none; others are part of the shape."""
    metadata = tiff.imagej_metadata
    if not metadata or page.samplesperpixel > 1:  # some programs count colours
        return 0
    images = metadata.get("images", 0)
    return images if isinstance(images, int) else 0


def _declared_sizes(tiff: tifffile.TiffFile, page: tifffile.TiffPage) -> list[int]:
    """Lengths of the axes that a description declares."""
    if tiff.ome_metadata:
        return ome_sizes(tiff.ome_metadata)
    if metadata := tiff.imagej_metadata:
        sizes = [metadata.get(key, 1) for key in ("frames", "slices", "channels")]
        return sizes if max(sizes) > 1 else [metadata.get("images", 1)]
    if page.shaped_description:
        return [math.prod(json.loads(page.shaped_description)["shape"]) // page.size]
    return []


def _info(
    name: str, tiff: tifffile.TiffFile, page: tifffile.TiffPage, warnings: tuple[str, ...]
) -> StackInfo:
    calibration = Calibration()
    kind = ""
    if tiff.ome_metadata:
        kind, calibration = "OME-", ome_calibration(tiff.ome_metadata)
    elif metadata := tiff.imagej_metadata:
        resolution = (_ratio(page, "XResolution"), _ratio(page, "YResolution"))
        kind = "ImageJ "
        calibration = imagej_calibration(metadata, resolution, int(page.resolutionunit))
    codec = "" if page.compression == 1 else f", {tifffile.COMPRESSION(page.compression).name}"
    lossy = page.compression in _LOSSY
    if lossy or page.compression in _PERHAPS_LOSSY:
        verb = "has" if lossy else "may have"
        warnings = (*warnings, f"its compression {verb} changed the pixel values")
    if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        warnings = (*warnings, "its values are marked as 0 = white, and are read as they are")
    if page.photometric == tifffile.PHOTOMETRIC.PALETTE:
        warnings = (*warnings, "its colour table is ignored: the values are read as they are")
    bits = page.bitspersample if isinstance(page.bitspersample, int) else None
    return StackInfo(
        source=name,
        format=f"{kind}{'BigTIFF' if tiff.is_bigtiff else 'TIFF'}{codec}",
        frame_interval=calibration.frame_interval,
        pixel_size=calibration.pixel_size,
        pixel_unit=calibration.pixel_unit,
        bits=calibration.bits or bits,
        lossy=lossy,
        warnings=(*warnings, *calibration.warnings),
    )


def _ratio(page: tifffile.TiffPage, tag: str) -> float:
    value = page.tags.valueof(tag, default=(0, 1))
    return value[0] / value[1] if isinstance(value, tuple) and len(value) == 2 and value[1] else 0.0
