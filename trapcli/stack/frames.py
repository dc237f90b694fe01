"""`Frames`: a video stack that is read block by block, whatever file it comes from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class StackInfo:
    """What a file says of itself.

    Attributes
    ----------
    source:
        The paths or the name the frames come from, in words.
    format:
        For example ``"ImageJ TIFF, LZW"`` or ``"AVI, MJPG"``.
    frame_interval:
        Time between frames in `time_unit`, or None where the file doesn't say.
    pixel_size:
        Edge of a (square) pixel in `pixel_unit`, or None where the file doesn't say.
    bits:
        Significant bits per pixel where known (12 for 12-in-16-bit data), else the type's.
    lossy:
        True where the codec has changed the pixel values.
    warnings:
        What the user should know before trusting these frames, one sentence each.
    notes:
        What was done to the frames since they were read, one sentence each.
    files:
        The files the frames come from; a folder stands for all that is in it.
    """

    source: str = "array"
    format: str = "array"
    frame_interval: float | None = None
    time_unit: str = "s"
    pixel_size: float | None = None
    pixel_unit: str | None = None
    bits: int | None = None
    lossy: bool = False
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Frames:
    """N frames of H × W pixels, read in order and block by block; never all at once.

    Attributes
    ----------
    shape:
        ``(N, H, W)``.
    dtype:
        Type of the pixels as stored, native byte order.
    index:
        ``(N,)`` position of each frame in the input (after `--frames START:STOP:STEP` not 0…N−1).
    info:
        What the file says of itself.
    read_blocks:
        ``read_blocks(size)`` starts a new pass and yields consecutive ``(n, H, W)`` blocks, n ≤ size. Passes
        may be repeated. Raises `InputError` where fewer than N frames can be delivered.
    read_some:
        ``read_some(positions)`` yields the ``(H, W)`` frames at ascending positions without reading the
        others; None where that can't be done.
    """

    shape: tuple[int, int, int]
    dtype: np.dtype[np.generic]
    index: NDArray[np.int64]
    info: StackInfo
    read_blocks: Callable[[int], Iterator[NDArray[np.generic]]] = field(repr=False)
    read_some: Callable[[NDArray[np.integer[Any]]], Iterator[NDArray[np.generic]]] | None = field(
        default=None, repr=False
    )

    def __len__(self) -> int:
        return self.shape[0]

    def blocks(self, size: int | None = None) -> Iterator[NDArray[np.generic]]:
        """Yield the frames in order as ``(n, H, W)`` blocks of at most `size` frames (default: 16 MiB)."""
        if size is None:
            frame_bytes = self.shape[1] * self.shape[2] * self.dtype.itemsize
            size = max(1, min(len(self), (16 << 20) // max(1, frame_bytes)))
        return self.read_blocks(size)

    def pick(self, positions: NDArray[np.integer[Any]]) -> Iterator[NDArray[np.generic]]:
        """Yield the ``(H, W)`` frames at ascending positions 0 … N−1."""
        if self.read_some is not None:
            yield from self.read_some(positions)
            return
        done = 0
        for block in self.blocks():
            yield from block[positions[(positions >= done) & (positions < done + len(block))] - done]
            done += len(block)

    def to_array(self) -> NDArray[np.generic]:
        """Return all frames as one ``(N, H, W)`` array (for small stacks and tests)."""
        return np.concatenate(list(self.blocks()))

    @classmethod
    def from_array(cls, frames: NDArray[np.generic], info: StackInfo | None = None) -> Frames:
        """Wrap an ``(N, H, W)`` array."""

        def read_blocks(size: int) -> Iterator[NDArray[np.generic]]:
            for start in range(0, len(frames), size):
                yield frames[start : start + size]

        def read_some(positions: NDArray[np.integer[Any]]) -> Iterator[NDArray[np.generic]]:
            return (frames[position] for position in positions)

        n, height, width = frames.shape
        info = info or StackInfo()
        return cls((n, height, width), frames.dtype, np.arange(n), info, read_blocks, read_some)


def single_frames(
    blocks: Iterable[NDArray[Any]], shape: tuple[int, int, int], dtype: np.dtype[Any]
) -> Iterator[NDArray[Any]]:
    """Yield the frames of `blocks` one by one, and insist on N of them."""
    count = 0
    for block in blocks:
        if block.shape[1:] != shape[1:] or block.dtype != dtype:
            raise ValueError(f"block of {block.shape}, {block.dtype} in a stack of {shape}, {dtype}")
        yield from block
        count += len(block)
    if count != shape[0]:
        raise ValueError(f"{count} frames in a stack of {shape[0]}")
