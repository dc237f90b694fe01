"""Stacks in datasets: HDF5, and Zarr where its package is installed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from h5py import h5d
from numpy.typing import NDArray

from trapcli.config import InputConfig
from trapcli.errors import InputError
from trapcli.stack.frames import StackInfo
from trapcli.stack.source import Source, check_frame_bytes, guard

_HELD_BYTES = 64 << 20
_MAX_LINKS = 16


def open_hdf5(path: Path, name: str, config: InputConfig) -> Source:
    """Open the dataset ``config.dataset`` of an HDF5 file, or the only stack in it.

    Raises
    ------
    InputError
        Where there is no such stack, it lies outside the file, or the file doesn't hold all that it declares.
    """

    @contextmanager
    def array() -> Iterator[h5py.Dataset]:
        with h5py.File(path, "r", locking=False) as file:
            yield _resolve(file, place, name)

    with guard(name):
        with h5py.File(path, "r", locking=False) as file:
            place = config.dataset or _only_stack(file, name)
        with array() as dataset:
            _check_stored(dataset, path, name)
            chunk = dataset.chunks
        return _source(name, f"HDF5 dataset {place}", array, chunk)


def is_zarr(folder: Path) -> bool:
    """Whether `folder` is a Zarr store."""
    return any((folder / marker).exists() for marker in ("zarr.json", ".zarray", ".zgroup"))


def open_zarr(path: Path, name: str, config: InputConfig) -> Source:
    """Open the array ``config.dataset`` of a Zarr store, or the store itself.

    Raises
    ------
    InputError
        Where the package zarr isn't installed, or there is no such stack.
    """
    try:
        import zarr
    except ImportError:
        raise InputError(f"{name}: is a Zarr store; install its package first: pip install zarr") from None
    with guard(name):
        node = zarr.open(str(path), mode="r", path=config.dataset.strip("/"))
        if not hasattr(node, "shape"):
            names = ", ".join(sorted(node.array_keys())) or "none"
            raise InputError(f"{name}: is a group; choose one of its arrays ({names}) with {name}::/ARRAY")

        @contextmanager
        def array() -> Iterator[Any]:
            yield node

        check_frame_bytes(name, math.prod(node.chunks) * node.dtype.itemsize)
        source = _source(name, "Zarr array", array, node.chunks)
        missing = node.nchunks - node.nchunks_initialized
        if not missing:
            return source
        warning = f"{missing} of its {node.nchunks} chunks are missing and read as the fill value"
        return dataclasses.replace(source, info=dataclasses.replace(source.info, warnings=(warning,)))


def _source(
    name: str,
    kind: str,
    array: Callable[[], AbstractContextManager[Any]],
    chunk: tuple[int, ...] | None,
) -> Source:
    """Take an array of N × H × W, or H × W, or either with three or four colours last."""
    with array() as opened:
        stored, dtype = tuple(int(size) for size in opened.shape), np.dtype(opened.dtype)
    colours = stored[-1] if len(stored) == 4 and stored[-1] in (3, 4) else 1
    axes = len(stored) - (colours > 1)
    lead = (0,) * max(0, axes - 3)
    if axes < 2 or any(size != 1 for size in stored[: len(lead)]):
        raise InputError(f"{name}: {kind} has the shape {stored}; frames x rows x columns is needed")
    shape = (stored[-3 - (colours > 1)] if axes > 2 else 1, stored[axes - 2], stored[axes - 1])
    held_frames = _HELD_BYTES // max(1, math.prod(shape[1:]) * colours * dtype.itemsize)
    step = max(1, min(chunk[len(lead)] if chunk and axes > 2 else 1, held_frames))

    def read(index: NDArray[np.int64], channel: int | None) -> Iterator[NDArray[Any]]:
        with array() as opened:
            held_from, held = -1, np.empty(0)
            for position in index:
                start = position - position % step
                if start != held_from:  # a chunk is decompressed once
                    where = (*lead, slice(start, start + step)) if axes > 2 else ...
                    held_from, held = start, np.asarray(opened[where])
                    held = held if axes > 2 else held[None]
                frame = held[position - start]
                yield frame if colours == 1 else frame[..., :3] if channel is None else frame[..., channel]

    info = StackInfo(source=name, format=kind, bits=8 * dtype.itemsize)
    return Source(name, shape, dtype.newbyteorder("="), min(colours, 3), info, read)


def _only_stack(file: h5py.File, name: str) -> str:
    if file.attrs.get("format") == "trap-motion":
        raise InputError(f"{name}: is a result of trap-motion, no stack")
    found: list[str] = []

    def visit(path: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset) and len(node.shape or ()) in (3, 4) and node.dtype.kind in "biuf":
            found.append(f"/{path}")

    file.visititems(visit)  # follows no link out of the file
    if len(found) == 1:
        return found[0]
    names = ", ".join(found[:5]) + (", …" if len(found) > 5 else "")
    what = (
        f"holds several stacks ({names}); choose one with"
        if found
        else "holds no stack of frames; name one with"
    )
    raise InputError(f"{name}: {what} {name}::/PATH")


def _resolve(file: h5py.File, place: str, name: str) -> h5py.Dataset:
    """Find a dataset without leaving the file: a link to another one could be to any file of this machine."""
    node: Any = file
    parts = place.split("/")[::-1]
    links = 0
    while parts:
        part = parts.pop()
        if not part:
            continue
        link = node.get(part, getlink=True) if isinstance(node, h5py.Group) else None
        if link is None:
            raise InputError(f"{name}: has no dataset {place}")
        if isinstance(link, h5py.SoftLink):
            links += 1
            if links > _MAX_LINKS:
                raise InputError(f"{name}: the links on the way to {place} don't end")
            parts += link.path.split("/")[::-1]
            node = file if link.path.startswith("/") else node
            continue
        if isinstance(link, h5py.ExternalLink):
            raise InputError(
                f"{name}: {place} is in another file, which isn't followed; give {link.filename}"
            )
        node = node[part]
    if not isinstance(node, h5py.Dataset):
        raise InputError(f"{name}: {place} is no dataset")
    return node


def _check_stored(dataset: h5py.Dataset, path: Path, name: str) -> None:
    """Refuse pixels that aren't in this file, be it that they are elsewhere or nowhere."""
    if dataset.is_virtual or dataset.external:
        raise InputError(f"{name}: {dataset.name} keeps its pixels in other files, which aren't followed")
    shape, item = dataset.shape or (0,), dataset.dtype.itemsize
    layout = dataset.id.get_create_plist().get_layout()
    if layout == h5d.CHUNKED:
        check_frame_bytes(name, math.prod(dataset.chunks) * item)
        declared = math.prod(-(-size // chunk) for size, chunk in zip(shape, dataset.chunks, strict=True))
        present = dataset.id.get_num_chunks()
    else:
        declared, present = math.prod(shape) * item, dataset.id.get_storage_size()
        present = min(present, path.stat().st_size)
    if present < declared:
        unit = "chunks" if layout == h5d.CHUNKED else "bytes"
        raise InputError(
            f"{name}: {dataset.name} declares {declared} {unit} and has {present}: never written in full"
        )
