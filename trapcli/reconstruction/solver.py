"""Penalised least squares for the volume: normal equations once from the frames, then no frame any more.

The object is a Gaussian field inside a ball whose power at each spatial frequency is what the frames show
beyond their noise. Its most likely form solves ``(H + 1 / s) a = b`` with the frames' normal operator H and
power s: Tikhonov's regularisation with a weight that the noise decides at every frequency. Preconditioned
conjugate gradients stop when a step gains less than the noise hides. Positivity and total variation need
accelerated projected gradients (Beck and Teboulle 2009, DOI 10.1137/080716542).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from trapcli.motion.fourier_slices import (
    NormalOperator,
    back_project,
    circulant_density,
    slice_points,
)
from trapcli.reconstruction.slices import SliceReader
from trapcli.threads import processors

Array = NDArray[np.float64]
Lattice = NDArray[np.float32]
Progress = Callable[[str, int, int], None]

_STEPS = 60
_NOT_TOLD = 0.02  # gain of a step, in standard deviations of the misfit, that ends the iteration
_LEAST_POWER = 3.0  # standard errors of the noise's power that the object's is given at least
_LEAST_PRIOR = 1e-6  # of the highest density: what single precision can tell
_PROJECTED_STEPS = 100
_FEWEST_STEPS = 5
_SMALL_CHANGE = 5e-4  # of a volume in one step, that ends them
_POWER_STEPS = 8
_SAFE = 1.1
_INDEPENDENT = 0.2  # share of the gradients that count: neighbours are alike, and most of the ball is empty
_CORNER = 0.1  # gradient, in units of the mean, below which the total variation is rounded


@dataclass(frozen=True)
class Sums:
    """All that the frames of a set say about the volume.

    Attributes
    ----------
    kernel:
        ``(2n, 2n, 2n)`` of `NormalOperator`.
    right:
        ``(n, n, n)`` back projection of the whitened modes.
    count:
        Number of frames.
    """

    kernel: Lattice
    right: Lattice
    count: int

    def __add__(self, other: Sums) -> Sums:
        """Return the sums over both sets."""
        return Sums(self.kernel + other.kernel, self.right + other.right, self.count + other.count)


def accumulate(reader: SliceReader, progress: Progress | None = None) -> tuple[Sums, Sums, Array]:
    """Read all frames once.

    Returns
    -------
    even, odd:
        Sums over the used frames of even and of odd number.
    power:
        ``(n // 2 + 1,)`` mean power of the modes in rings of whole numbers of periods across the volume, in
        units of the noise's; NaN where there are none.
    """
    n = reader.voxels
    kernels = [np.zeros((2 * n,) * 3, np.float32) for _ in range(2)]
    rights = [np.zeros((n,) * 3, np.float32) for _ in range(2)]
    counts = [0, 0]
    ring = np.round(np.linalg.norm(reader.k, axis=1) * n / (2 * np.pi)).astype(int)
    power, weight = np.zeros(n // 2 + 1), np.zeros(n // 2 + 1)
    done = 0
    for block in reader.blocks():
        for half in range(2):
            chosen = (np.arange(len(block.frame)) + done) % 2 == half
            if not chosen.any():
                continue
            points = slice_points(block.R[chosen], reader.k)
            shares = block.weight[chosen, None] * reader.share
            kernels[half] += back_project(
                points, (reader.scale**2 * shares).ravel().astype(np.complex64), 2 * n
            )
            weighted = reader.scale * shares * block.modes[chosen]
            rights[half] += back_project(points, weighted.ravel().astype(np.complex64), n)
            counts[half] += int(chosen.sum())
        squares = np.sum(block.weight[:, None] * np.abs(block.modes) ** 2, axis=0)
        power += np.bincount(ring, squares * reader.share, len(power))
        weight += np.bincount(ring, reader.share * block.weight.sum(), len(power))
        done += len(block.frame)
        if progress is not None:
            progress("reading", done, reader.count)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = power / weight
        error = np.sqrt(2 / weight)
    # a frequency whose power is lost in the noise keeps a little, so that it may still appear
    beyond = np.where(weight > 0, np.maximum(mean - 1.0, _LEAST_POWER * error), np.nan)
    return Sums(kernels[0], rights[0], counts[0]), Sums(kernels[1], rights[1], counts[1]), beyond


def ball(n: int, radius: float) -> NDArray[np.bool_]:
    """Return the ``(n, n, n)`` voxels not farther than `radius` voxels from the middle one."""
    square = (np.arange(n) - n // 2) ** 2
    return np.asarray(square[:, None, None] + square[:, None] + square <= radius**2)


class Solver:
    """The volume of one set of frames.

    Parameters
    ----------
    sums:
        Of the frames.
    power:
        Of the object, see `accumulate`.
    scale:
        Of the reader.
    support:
        ``(n, n, n)`` where the object may be.
    modes:
        Number of real data of all frames, whose misfit's scatter decides when to stop.
    """

    def __init__(
        self, sums: Sums, power: Array, scale: float, support: NDArray[np.bool_], modes: float
    ) -> None:
        self.right = np.where(support, sums.right, np.float32(0))
        self.support = support
        self._normal = NormalOperator(sums.kernel)
        density = circulant_density(sums.kernel)
        self._precision = _prior_precision(power, scale, support, density)
        self._density = density
        self._least_gain = _NOT_TOLD * np.sqrt(2 * modes)

    def curved(self, lattice: Lattice) -> Lattice:
        """Return ``(H + 1 / s) lattice`` inside the support."""
        return np.asarray(
            np.where(self.support, self._normal(lattice) + _filtered(lattice, self._precision), 0), np.float32
        )

    def solve(self, start: Lattice | None = None, *, progress: Progress | None = None) -> Lattice:
        """Return the most likely volume, without constraints, by preconditioned conjugate gradients."""
        volume = np.zeros_like(self.right) if start is None else start
        rest = self.right if start is None else self.right - self.curved(start)
        inverse = 1 / (self._density + self._precision)
        direction, old = np.zeros_like(rest), np.inf
        for step in range(_STEPS):
            better = np.where(self.support, _filtered(rest, inverse), np.float32(0))
            slope = _dot(rest, better)
            direction = better + np.float32(slope / old) * direction
            old = slope
            image = self.curved(direction)
            bend = _dot(direction, image)
            # in single precision what is hardly seen may seem to bend the wrong way
            if not bend > 0 or not slope > 0:
                break
            length = slope / bend
            volume = volume + np.float32(length) * direction
            rest = rest - np.float32(length) * image
            if progress is not None:
                progress("solving", step + 1, _STEPS)
            if 0.5 * length * slope < self._least_gain:
                break
        return volume

    def solve_constrained(
        self, start: Lattice, *, positive: bool, edges: bool, progress: Progress | None = None
    ) -> Lattice:
        """Return the most likely volume among those allowed, by accelerated projected gradients.

        Parameters
        ----------
        start:
            The volume of `solve`.
        positive:
            Whether values below 0 are impossible.
        edges:
            Whether to expect sharp edges and flat parts (total variation) rather than a Gaussian field.
        """
        variation = _Variation.of(start, self.support) if edges else None
        highest = self._highest_curvature() + (variation.curvature if variation else 0.0)

        def slope(volume: Lattice) -> Lattice:
            if variation is None:
                return self.curved(volume) - self.right
            seen = np.where(self.support, self._normal(volume), np.float32(0)) - self.right
            return seen + np.where(self.support, variation.slope(volume), np.float32(0))

        volume = ahead = np.maximum(start, 0) if positive else start
        pace = 1.0
        for step in range(_PROJECTED_STEPS):
            downhill = slope(ahead)
            moved = ahead - downhill / np.float32(highest)
            if positive:
                np.maximum(moved, 0, out=moved)
            change = moved - volume
            # restarted where the speed carries uphill (O'Donoghue and Candès 2015)
            uphill = _dot(ahead - moved, change) > 0
            faster = 0.5 * (1 + np.sqrt(1 + 4 * pace**2))
            ahead = moved if uphill else moved + np.float32((pace - 1) / faster) * change
            pace = 1.0 if uphill else faster
            volume = moved
            if progress is not None:
                progress("constraining", step + 1, _PROJECTED_STEPS)
            if (
                step >= _FEWEST_STEPS
                and not uphill
                and _dot(change, change) < _SMALL_CHANGE**2 * _dot(volume, volume)
            ):
                break
        return volume

    def _highest_curvature(self) -> float:
        """Return a little more than the largest eigenvalue of ``H + 1 / s``, by the power method."""
        vector, largest = self.right, 1.0
        for _ in range(_POWER_STEPS):
            vector = np.asarray(vector / np.float32(np.sqrt(_dot(vector, vector)) or 1.0))
            image = self.curved(vector)
            largest, vector = float(np.sqrt(_dot(image, image))), image
        return _SAFE * largest


@dataclass(frozen=True)
class _Variation:
    """Total variation ``weight Σ |∇a|``, rounded below gradients of `corner`."""

    weight: float
    corner: float

    @classmethod
    def of(cls, volume: Lattice, support: NDArray[np.bool_]) -> _Variation:
        """Return the weight that gradients as large as those of a volume ask for."""
        lengths = np.sqrt(np.sum(_gradient(volume) ** 2, axis=0))[support]
        mean = float(lengths.mean()) or 1.0
        # p(g) ∝ exp(−weight |g|) in three dimensions has the mean 3 / weight
        return cls(3 * _INDEPENDENT / mean, _CORNER * mean)

    @property
    def curvature(self) -> float:
        """Highest curvature."""
        return 12 * self.weight / self.corner

    def slope(self, volume: Lattice) -> Lattice:
        """Return the derivative by each voxel."""
        gradient = _gradient(volume)
        length = np.maximum(np.sqrt(np.sum(gradient**2, axis=0)), np.float32(self.corner))
        gradient *= np.float32(self.weight) / length
        slope = np.zeros_like(volume)
        for axis in range(3):
            slope += np.roll(gradient[axis], 1, axis) - gradient[axis]
        return slope


def _gradient(volume: Lattice) -> Lattice:
    return np.stack([np.roll(volume, -1, axis) - volume for axis in range(3)])


def _filtered(lattice: Lattice, spectrum: NDArray[Any]) -> Lattice:
    workers = processors()
    transform = scipy.fft.rfftn(lattice, workers=workers)
    transform *= spectrum
    return np.asarray(scipy.fft.irfftn(transform, lattice.shape, workers=workers, overwrite_x=True))


def _dot(a: Lattice, b: Lattice) -> float:
    return float(np.einsum("ijk,ijk->", a, b, dtype=np.float64))


def radial_frequency(n: int) -> Array:
    """Return the length of each frequency of ``scipy.fft.rfftn`` [periods across the volume]."""
    full, half = scipy.fft.fftfreq(n, 1 / n), scipy.fft.rfftfreq(n, 1 / n)
    return np.asarray(np.sqrt(full[:, None, None] ** 2 + full[:, None] ** 2 + half**2))


def _prior_precision(
    power: Array, scale: float, support: NDArray[np.bool_], density: NDArray[Any]
) -> NDArray[np.float32]:
    """Return 1 / s at the frequencies of ``rfftn``."""
    n = len(support)
    known = np.flatnonzero(np.isfinite(power))
    # beyond the last ring nothing is seen
    at = np.minimum(radial_frequency(n), known[-1])
    s = np.exp(np.interp(at, known, np.log(power[known]))) / (scale**2 * support.sum())
    return np.asarray(np.maximum(1 / s, _LEAST_PRIOR * density.max()), np.float32)
