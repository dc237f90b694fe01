"""Reading the pixels of one plane after another from TIFF strips and tiles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from trapcli.errors import InputError
from trapcli.stack.source import PARTIAL_HINT

_ALPHA = (1, 2)

ReadPlane = Callable[[int], NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Segments:
    """Where the pixels of one plane are: the strips or tiles in a file [bytes]."""

    path: Path
    offsets: NDArray[np.int64]
    counts: NDArray[np.int64]


class PlaneReader:
    """Reads planes that are all stored alike.

    Attributes
    ----------
    height, width, samples:
        Size of a plane; its values per pixel without transparency.
    dtype:
        Type of the pixels, native byte order.

    Raises
    ------
    InputError
        Where a plane has no pixels, or fewer than its size needs.
    """

    def __init__(self, name: str, page: Any, planes: list[Segments]) -> None:
        """`page` is a page as tifffile describes it, which stands for all; its file must be open now only."""
        separate, depth, self.height, self.width, contiguous = page.shaped
        if depth != 1:
            raise InputError(f"{name}: its pages hold volumes; save it as a stack of plane pages")
        samples = separate * contiguous
        self.samples = max(1, samples - sum(extra in _ALPHA for extra in page.extrasamples))
        self.dtype: np.dtype[Any] = np.dtype(page.dtype)
        self._name = name
        self._page = page
        self._decode = page.decode
        self._stored = self.dtype.newbyteorder(page.parent.byteorder)
        self._planes = [self._checked(position, plane) for position, plane in enumerate(planes)]

    def _checked(self, position: int, plane: Segments) -> Segments:
        """Refuse a plane without all its pixels; take a plane without gaps for one segment."""
        offsets, counts, page = plane.offsets, plane.counts, self._page
        if len(counts) == 0 and len(offsets) == 1 and page.is_final:
            counts = np.array([page.nbytes])
        if len(offsets) == 0 or len(counts) != len(offsets) or min(counts.min(), offsets.min() - 7) < 1:
            raise InputError(f"{self._name}: page {position} has no pixels; {PARTIAL_HINT}")
        adjacent = (offsets[:-1] + counts[:-1] == offsets[1:]).all() and counts.sum() >= page.nbytes
        if page.is_final and adjacent:
            return Segments(plane.path, offsets[:1], np.array([page.nbytes]))
        if len(offsets) < math.prod(page.chunked):
            raise InputError(f"{self._name}: page {position} has only a part of its pixels; {PARTIAL_HINT}")
        return plane

    @contextmanager
    def session(self) -> Iterator[ReadPlane]:
        """Give a function that reads the plane at a position, ``(H, W)`` or ``(H, W, samples)``.

        The next call may overwrite what it returns.
        """
        with ExitStack() as stack:
            files: dict[Path, BinaryIO] = {}
            buffer = np.empty(self._page.shaped, self._stored)

            def read(position: int) -> NDArray[Any]:
                plane = self._planes[position]
                if plane.path not in files:
                    files[plane.path] = stack.enter_context(plane.path.open("rb"))
                if self._page.is_final and len(plane.offsets) == 1:
                    self._read_directly(files[plane.path], plane, buffer)
                    return self._arranged(buffer)
                return self._arranged(self._decoded(files[plane.path], plane))

            yield read

    def _read_directly(self, file: BinaryIO, plane: Segments, buffer: NDArray[Any]) -> None:
        file.seek(int(plane.offsets[0]))
        if file.readinto(buffer.data.cast("B")) != buffer.nbytes:  # type: ignore[attr-defined]
            raise InputError(f"{self._name}: ends early; {PARTIAL_HINT}")

    def _decoded(self, file: BinaryIO, plane: Segments) -> NDArray[Any]:
        page = self._page
        pixels = np.zeros(page.shaped, self.dtype)
        for index, (offset, count) in enumerate(zip(plane.offsets, plane.counts, strict=True)):
            file.seek(int(offset))
            data = file.read(int(count))
            segment, (s, d, h, w, _), shape = self._decode(data, index, jpegtables=page.jpegtables)
            target = pixels[s, d : d + shape[0], h : h + shape[1], w : w + shape[2]]
            target[...] = segment[: page.imagedepth - d, : page.imagelength - h, : page.imagewidth - w]
        return pixels

    def _arranged(self, pixels: NDArray[Any]) -> NDArray[Any]:
        if self.samples == 1:
            return pixels[0, 0, :, :, 0]
        if len(pixels) > 1:  # one plane for each colour
            return np.moveaxis(pixels[: self.samples, 0, :, :, 0], 0, -1)
        return pixels[0, 0, :, :, : self.samples]
