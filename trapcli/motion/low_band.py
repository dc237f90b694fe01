"""What the frames hold at low spatial frequencies: Fourier modes on a square around the object, and moments.

The joint estimate works on these alone. On the modes of a square that holds the object white pixel noise is
white again, with a known variance; the frames themselves are not needed any more.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.cells import cut_square, transfer
from trapcli.motion.centers import Centers, Progress
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SQUARE = 1.15
"""Half the edge of the square, in radii of the object."""

_DISC = 1.1  # radius of the disc that moments are taken in, in radii of the object
_POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))


@dataclass(frozen=True)
class LowBand:
    """Low-frequency content of N frames about their centres.

    Attributes
    ----------
    time:
        ``(N,)``.
    k:
        ``(K, 2)`` modes, k = 0 first, then half of the plane [rad / length]; the other half are conjugates.
    modes:
        ``(N, K)`` Fourier transforms, ``(2π)⁻¹ ∫ J exp(−i⟨k, x − C₂⟩) dx``.
    variance:
        ``E|noise|²`` of one mode.
    second, third:
        ``(N, 3)`` and ``(N, 4)`` moments of order 2 and 3 about C₂ in units of the median mass and the
        radius: x1², x1x2, x2² and x1³, x1²x2, x1x2², x2³.
    second_covariance, third_covariance:
        ``(3, 3)`` and ``(4, 4)``, from pixel noise.
    mass:
        ``(N,)`` integral of J over the disc.
    radius:
        Radius of the object [length].
    """

    time: Array
    k: Array
    modes: ComplexArray
    variance: float
    second: Array
    third: Array
    second_covariance: Array
    third_covariance: Array
    mass: Array
    radius: float

    def inside(self, band: float) -> NDArray[np.bool_]:
        """Tell which of the ``(K,)`` modes lie within `band` [rad / length]."""
        return np.asarray(np.hypot(self.k[:, 0], self.k[:, 1]) <= band * (1 + 1e-9))

    def select(self, index: NDArray[np.intp]) -> LowBand:
        """Return the content of some frames."""
        return replace(
            self,
            time=self.time[index],
            modes=self.modes[index],
            second=self.second[index],
            third=self.third[index],
            mass=self.mass[index],
        )

    def grouped(self, size: int) -> LowBand:
        """Return means over groups of `size` consecutive frames, or a few more, so that none is left out."""
        groups = max(1, len(self.time) // size)
        average = len(self.time) / groups

        def mean(series: NDArray[Any]) -> NDArray[Any]:
            return group_means(series, groups)

        return replace(
            self,
            time=mean(self.time),
            modes=mean(self.modes),
            variance=self.variance / average,
            second=mean(self.second),
            third=mean(self.third),
            second_covariance=self.second_covariance / average,
            third_covariance=self.third_covariance / average,
            mass=mean(self.mass),
        )

    def shifted(self, shift: Array) -> LowBand:
        """Return the modes after moving the centres by ``(N, 2)`` `shift` [length]."""
        return replace(self, modes=self.modes * np.exp(1j * shift @ self.k.T))


def read_low_band(
    attenuation: Frames,
    centers: Centers,
    *,
    time: Array,
    band: float,
    pixel_size: float = 1.0,
    progress: Progress | None = None,
) -> LowBand:
    """Read the low-frequency content of all frames in one pass.

    Parameters
    ----------
    attenuation:
        N attenuation projections.
    centers:
        Their centres, with the radius of the object; blank frames give NaN.
    time:
        ``(N,)`` times.
    band:
        Highest length of k [rad / length].
    pixel_size:
        Edge of a pixel [length].
    progress:
        Called as ``progress("low band", done, N)``.
    """
    reader = LowBandReader(len(attenuation), centers.radius, band, pixel_size)
    done = 0
    for block in attenuation.blocks():
        for image in block:
            center = centers.center[done] / pixel_size
            if np.isfinite(center).all():
                whole = np.round(center).astype(int)
                square = cut_square(image, whole, reader.half, centers.level[done])
                reader.read(done, square, (center - whole) * pixel_size)
            done += 1
        if progress is not None:
            progress("low band", done, len(attenuation))
    rest = centers.center - np.round(centers.center / pixel_size) * pixel_size
    return reader.about(rest, time, centers.noise)


class LowBandReader:
    """Reads the low-frequency content of N frames off squares around the object.

    Parameters
    ----------
    count:
        N.
    radius:
        Of the object [length].
    band:
        Highest length of k [rad / length].
    pixel_size:
        Edge of a pixel [length].
    binning:
        Pixels along the edge of a cell of the squares.

    Attributes
    ----------
    half:
        A square has 2 `half` + 1 cells; the last row and column are left out.
    """

    def __init__(self, count: int, radius: float, band: float, pixel_size: float, binning: int = 1) -> None:
        cell = binning * pixel_size
        self.half = int(np.ceil(SQUARE * radius / cell))
        self._cell, self._radius, self._binning = cell, radius, binning
        offset = np.arange(-self.half, self.half, dtype=np.float64) * cell
        edge = 2 * self.half * cell
        highest = int(band * edge / (2 * np.pi))
        frequency = 2 * np.pi / edge * np.arange(-highest, highest + 1)
        k1, k2 = np.meshgrid(frequency, frequency)
        kept = (np.hypot(k1, k2) <= band) & ((k2 > 0) | ((k2 == 0) & (k1 >= 0)))
        order = np.argsort(np.hypot(k1, k2)[kept], kind="stable")
        self._kept = np.flatnonzero(kept)[order]
        self.k = np.stack([k1.ravel()[self._kept], k2.ravel()[self._kept]], axis=1)
        # what averaging over a cell has taken from each mode, and the measure of the integral
        taken = transfer(self.k, binning, pixel_size).prod(axis=1)
        self._factor = cell**2 / (2 * np.pi) / taken
        self._wave = np.exp(-1j * np.outer(frequency, offset))
        self._parts = np.concatenate([self._wave.real, self._wave.imag])
        self._offset = offset
        self._powers = (offset / radius) ** np.arange(4)[:, None]
        self._modes = np.full((count, len(self.k)), np.nan, complex)
        self._moments = np.full((count, len(_POWERS)), np.nan)

    def read(self, n: int, square: Array, rest: Array) -> None:
        """Read frame `n` off the square about a cell.

        Parameters
        ----------
        rest:
            ``(2,)`` roughly the object's centre, from that cell [length].
        """
        inside = square[:-1, :-1]
        # the product with the frame is the large one, and it is real
        real, imaginary = np.split(self._parts @ inside, 2)
        self._modes[n] = ((real + 1j * imaginary) @ self._wave.T).ravel()[self._kept]
        powers = self._powers @ (inside * self._disc(rest)) @ self._powers.T
        self._moments[n] = [powers[b, a] for a, b in _POWERS]

    def _disc(self, center: Array) -> Array:
        """Return the disc inside which moments are taken, with an edge of two cells."""
        distance: Array = (self._offset - center[0]) ** 2 + ((self._offset - center[1]) ** 2)[:, None]
        np.sqrt(distance, out=distance)
        distance *= -1 / (2 * self._cell)
        distance += _DISC * self._radius / (2 * self._cell) + 0.5
        return np.clip(distance, 0.0, 1.0, out=distance)

    def about(self, rest: Array, time: Array, noise: float) -> LowBand:
        """Return what was read, about the centres.

        Parameters
        ----------
        rest:
            ``(N, 2)`` centres from the cells that the squares were about [length]; NaN in blank frames.
        time:
            ``(N,)``.
        noise:
            Standard deviation of the noise of one pixel.
        """
        modes = self._modes * (self._factor * np.exp(1j * rest @ self.k.T))
        spread = (self._binning**2 - 1) / 12 * (self._cell / self._binning / self._radius) ** 2
        moments = _central(_narrowed(self._moments, spread), rest / self._radius) * self._cell**2
        mass = moments[:, 0]
        seen = np.isfinite(mass)
        typical = float(np.median(mass[seen])) if seen.any() else np.nan
        cell_noise = noise / self._binning
        monomials = np.stack([np.outer(self._powers[b], self._powers[a]).ravel() for a, b in _POWERS])
        weights = monomials * self._disc(np.zeros(2)).ravel() * (self._cell**2 * cell_noise / typical)
        covariance = weights @ weights.T
        return LowBand(
            time=time,
            k=self.k,
            modes=modes,
            variance=float((self._factor[0] * cell_noise * 2 * self.half) ** 2),
            second=moments[:, 3:6] / typical,
            third=moments[:, 6:] / typical,
            second_covariance=covariance[3:6, 3:6],
            third_covariance=covariance[6:, 6:],
            mass=mass,
            radius=self._radius,
        )


def group_means(series: NDArray[Any], groups: int) -> NDArray[Any]:
    """Return ``(groups, ...)`` means over consecutive parts of ``(N, ...)``, as equal in length as can be."""
    start = np.arange(groups + 1) * len(series) // groups
    length = np.diff(start).reshape(-1, *[1] * (series.ndim - 1))
    return np.asarray(np.add.reduceat(series, start[:-1], axis=0) / length)


def _narrowed(moments: Array, spread: float) -> Array:
    """Return moments without what averaging over cells of variance `spread` has added (Sheppard)."""
    m00, m10, m01, m20, m11, m02, m30, m21, m12, m03 = moments.T
    s = spread
    narrow = (m20 - s * m00, m11, m02 - s * m00)
    third = (m30 - 3 * s * m10, m21 - s * m01, m12 - s * m10, m03 - 3 * s * m01)
    return np.stack([m00, m10, m01, *narrow, *third], axis=1)


def _central(moments: Array, shift: Array) -> Array:
    """Return ``(N, 10)`` moments about points that lie at ``(N, 2)`` `shift`."""
    about = np.zeros_like(moments)
    place = {power: n for n, power in enumerate(_POWERS)}
    x, y = -shift.T
    for (a, b), n in place.items():
        for i, j in itertools.product(range(a + 1), range(b + 1)):
            share = math.comb(a, i) * math.comb(b, j) * x ** (a - i) * y ** (b - j)
            about[:, n] += share * moments[:, place[i, j]]
    return about
