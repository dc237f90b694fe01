"""The chain of page directories in a TIFF, read with distrust.

A reader that follows the chain as far as it goes takes a truncated file for a short one. This one says
whether the chain is whole, whether all pixels lie inside the file, and whether two pages are stored alike.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

# size, and NumPy type of those that hold counts and offsets
_TYPE_SIZES = {
    1: 1,
    2: 1,
    3: 2,
    4: 4,
    5: 8,
    6: 1,
    7: 1,
    8: 2,
    9: 4,
    10: 8,
    11: 4,
    12: 8,
    13: 4,
    16: 8,
    17: 8,
    18: 8,
}
_INTEGERS = {1: "u1", 3: "u2", 4: "u4", 13: "u4", 16: "u8", 18: "u8"}

_OFFSETS, _COUNTS = (273, 324), (279, 325)
_DESCRIPTION = 270
# size, type, compression, meaning of values, fill order, samples, strips, planes, predictor, tiles, …
_LAYOUT = (256, 257, 258, 259, 262, 266, 277, 278, 284, 317, 322, 323, 338, 339, 347, 530, 32997, 32998)
_NEEDED = frozenset((*_OFFSETS, *_COUNTS, *_LAYOUT, _DESCRIPTION))


@dataclass(frozen=True, slots=True)
class Page:
    """One page directory.

    Attributes
    ----------
    offset, following:
        Where it stands in the file, and where the next one should; 0 after the last.
    layout:
        The tags that say how pixels are stored, as bytes; equal for pages that are decoded alike.
    offsets, counts:
        Where the segments (strips or tiles) of its pixels begin [bytes], and their lengths.
    """

    offset: int
    following: int
    layout: tuple[tuple[int, bytes], ...]
    offsets: NDArray[np.int64]
    counts: NDArray[np.int64]


@dataclass(frozen=True)
class Chain:
    """The pages of a TIFF up to the first fault; `fault` is empty where there is none."""

    pages: tuple[Page, ...]
    fault: str
    size: int


class _Fault(Exception):
    """What is wrong with the chain."""


def read_chain(file: BinaryIO) -> Chain:
    """Follow the chain of page directories through a seekable file.

    Raises
    ------
    OSError
        Where reading fails.
    """
    size = os.fstat(file.fileno()).st_size
    pages: list[Page] = []
    try:
        for page in _Reader(file, size).pages():
            pages.append(page)
    except _Fault as fault:
        return Chain(tuple(pages), str(fault), size)
    return Chain(tuple(pages), "" if pages else "it has a header and no image", size)


class _Reader:
    """Reads page directories of a classic TIFF or BigTIFF, either byte order."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file = file
        self._size = size
        self._layouts: dict[tuple[tuple[int, bytes], ...], tuple[tuple[int, bytes], ...]] = {}
        header = self._read(0, 8)
        self._order = "<" if header[:2] == b"II" else ">"
        self._big = self._unpack("H", header[2:4]) == 43
        if self._big:
            self._first = self._unpack("Q", self._read(8, 8))
            self._count, self._tag, self._pointer, self._inline = "Q", "HHQ8s", "Q", 8
        else:
            self._first = self._unpack("I", header[4:])
            self._count, self._tag, self._pointer, self._inline = "H", "HHI4s", "I", 4

    def pages(self) -> Iterator[Page]:
        seen: set[int] = set()
        offset = self._first
        while offset:
            if offset in seen:
                raise _Fault(f"after page {len(seen)}, its page directory loops")
            seen.add(offset)
            try:
                page = self._page(offset)
            except _Fault as fault:
                raise _Fault(f"page {len(seen)} {fault}") from None
            yield page
            offset = page.following

    def _page(self, offset: int) -> Page:
        start = offset + struct.calcsize("<" + self._count)
        count = self._unpack(self._count, self._read(offset, start - offset))
        tag_size = struct.calcsize("<" + self._tag)
        pointer_size = struct.calcsize("<" + self._pointer)
        if count > 4096:
            raise _Fault(f"has a directory of {count} entries")
        content = self._read(start, count * tag_size + pointer_size)
        following = self._unpack(self._pointer, content[-pointer_size:])
        layout = []
        offsets = counts = np.empty(0, np.int64)
        for code, kind, number, value in struct.iter_unpack(self._order + self._tag, content[:-pointer_size]):
            if code not in _NEEDED:
                continue
            data = self._value(kind, number, value)
            if code in _OFFSETS:
                offsets = self._integers(kind, data)
            elif code in _COUNTS:
                counts = self._integers(kind, data)
            elif code != _DESCRIPTION:
                layout.append((code, data))
        self._check_segments(offsets, counts)
        # pages share one tuple: there may be a million of them
        shared = self._layouts.setdefault(tuple(layout), tuple(layout))
        return Page(offset, following, shared, offsets, counts)

    def _check_segments(self, offsets: NDArray[np.int64], counts: NDArray[np.int64]) -> None:
        if len(counts) and len(counts) != len(offsets):
            raise _Fault(f"has {len(offsets)} segments of pixels and {len(counts)} lengths")
        ends = offsets + counts if len(counts) else offsets
        # sums of 64 bits may have wrapped around, so the smallest is looked at too
        if min(a.min(initial=0) for a in (offsets, counts, ends)) < 0 or ends.max(initial=0) > self._size:
            raise _Fault(f"has pixels beyond the end of the file ({self._size} bytes)")

    def _value(self, kind: int, number: int, value: bytes) -> bytes:
        length = _TYPE_SIZES.get(kind, 1) * number
        if length <= self._inline:
            return value[:length]
        return self._read(self._unpack(self._pointer, value), length)

    def _integers(self, kind: int, data: bytes) -> NDArray[np.int64]:
        if kind not in _INTEGERS:
            raise _Fault("has offsets that are no integers")
        # a value of 2**63 or more becomes negative, which is found beyond the end of the file
        return np.frombuffer(data, self._order + _INTEGERS[kind]).astype(np.int64)

    def _read(self, offset: int, length: int) -> bytes:
        if offset + length > self._size:
            raise _Fault(f"needs bytes up to {offset + length}, but the file ends at {self._size}")
        self._file.seek(offset)
        return self._file.read(length)

    def _unpack(self, code: str, data: bytes) -> int:
        value: Any = struct.unpack(self._order + code, data)[0]
        return int(value)
