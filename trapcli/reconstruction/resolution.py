"""How fine a detail the volume shows: Fourier shell correlation of two half-sets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from trapcli.threads import processors

Array = NDArray[np.float64]

HALF = 0.5
SEVENTH = 0.143
"""Halves that correlate by 0.143 make a whole that correlates with the truth by 0.5 (Rosenthal and Henderson
2003, DOI 10.1016/j.jmb.2003.07.013)."""


@dataclass(frozen=True)
class Resolution:
    """Fourier shell correlation.

    Attributes
    ----------
    frequency:
        ``(S,)`` of each shell [1 / length].
    correlation:
        ``(S,)`` of two volumes, each from half of the frames.
    half, seventh:
        Resolution, the length at which the correlation falls below 0.5 and 0.143 [length]; two voxels where
        it never does.
    voxel_size:
        Edge of a voxel [length].
    """

    frequency: Array
    correlation: Array
    half: float
    seventh: float
    voxel_size: float

    @property
    def limited_by_voxels(self) -> bool:
        """Whether finer voxels would show more."""
        return self.seventh <= 2 * self.voxel_size


def shell_correlation(first: NDArray[Any], second: NDArray[Any]) -> Array:
    """Return the correlation of two ``(n, n, n)`` volumes on shells of 0, 1, … n // 2 periods across."""
    n = len(first)
    a, b = (scipy.fft.fftn(volume, workers=processors()) for volume in (first, second))
    axis = scipy.fft.fftfreq(n, 1 / n)
    shell = np.round(np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)).astype(int).ravel()

    def total(values: NDArray[Any]) -> Array:
        return np.asarray(np.bincount(shell, values.ravel().astype(float))[: n // 2 + 1], float)

    power = np.sqrt(total(np.abs(a) ** 2) * total(np.abs(b) ** 2))
    return total((a * b.conj()).real) / np.where(power > 0, power, np.inf)


def resolve(first: NDArray[Any], second: NDArray[Any], voxel_size: float) -> Resolution:
    """Compare two volumes of voxels of edge `voxel_size` [length]."""
    correlation = shell_correlation(first, second)
    frequency = np.arange(len(correlation)) / (len(first) * voxel_size)
    half, seventh = (crossing(frequency, correlation, level) for level in (HALF, SEVENTH))
    return Resolution(frequency, correlation, half, seventh, voxel_size)


def crossing(frequency: Array, correlation: Array, level: float) -> float:
    """Return the length at which a correlation first falls below a level; the shortest where it doesn't."""
    below = np.flatnonzero(correlation[1:] < level) + 1
    if not len(below):
        return float(1 / frequency[-1])
    at = below[0]
    drop = correlation[at - 1] - correlation[at]
    share = (correlation[at - 1] - level) / drop if correlation[at - 1] > level else 0.0
    return float(1 / (frequency[at - 1] + share * (frequency[at] - frequency[at - 1]) or frequency[1]))
