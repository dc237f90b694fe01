"""Frames on coarser cells: pixels averaged b × b, as fine as the object's low band needs.

Averaging multiplies the Fourier transform by a known factor, which `transfer` gives and whoever reads the
cells divides out; what it folds into the band lies far beyond it, where little of the object is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_PER_RADIUS = 64
"""Least cells in the object's radius: noise stays white to 1 %, and aliases of a ball are 2e-6 of it."""


@dataclass(frozen=True)
class Cells:
    """How pixels are averaged.

    Attributes
    ----------
    shape:
        ``(H, W)`` of a frame [pixels].
    binning:
        Edge of a cell [pixels]; what is left over at the right and the lower edge of a frame is dropped.
    """

    shape: tuple[int, ...]
    binning: int = 1

    @classmethod
    def for_radius(cls, shape: tuple[int, ...], radius: float) -> Cells:
        """Choose cells for an object of `radius` [pixels]."""
        return cls(shape, max(1, min(int(radius / _PER_RADIUS), *shape)))

    def average(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return the ``(H // b, W // b)`` means of a frame; the frame itself where a cell is a pixel."""
        b = self.binning
        if b == 1:
            return image
        height, width = (size // b for size in self.shape)
        dtype = np.float64 if image.dtype == np.float64 else np.float32
        rows = image[: height * b, : width * b].reshape(height, b, width * b)
        columns = np.add.reduce(rows, axis=1, dtype=dtype).reshape(-1, b)
        means: NDArray[Any] = columns @ np.full(b, 1 / b**2, dtype)
        return means.reshape(height, width)

    def to_pixels(self, place: Array) -> Array:
        """Turn ``(..., 2)`` cells from the one in the middle of the averaged frame into pixels."""
        b = self.binning
        middle = [size // b // 2 * b + (b - 1) / 2 - size // 2 for size in reversed(self.shape)]
        return np.asarray(place * b + np.array(middle))


def transfer(k: Array, binning: int, pixel_size: float) -> Array:
    """Return the mean of exp(−ikx) over the pixels of one cell about its middle."""
    offsets = (np.arange(binning) - (binning - 1) / 2) * pixel_size
    return np.asarray(np.mean(np.cos(np.multiply.outer(k, offsets)), axis=-1))


def cut_square(image: NDArray[Any], center: NDArray[np.int_], half: int, level: float = 0.0) -> Array:
    """Copy the square of 2 `half` + 1 cells about a cell, without the level of the empty field.

    Parameters
    ----------
    image:
        ``(H, W)``; outside of it there is nothing.
    center:
        (x1, x2) from the cell ``(H // 2, W // 2)``.
    """
    height, width = image.shape
    top, left = center[1] + height // 2 - half, center[0] + width // 2 - half
    size = 2 * half + 1
    square = np.zeros((size, size))
    rows = slice(max(top, 0), min(top + size, height))
    columns = slice(max(left, 0), min(left + size, width))
    np.subtract(
        image[rows, columns],
        level,
        out=square[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left],
    )
    return square
