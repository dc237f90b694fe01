"""What the frames hold at low spatial frequencies: Fourier modes on a square around the object, and moments.

The joint estimate works on these alone. On the modes of a square that holds the object white pixel noise is
white again, with a known variance; the frames themselves are not needed any more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.centers import Centers, Progress
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SQUARE = 1.15
"""Half the edge of the square, in radii of the object."""


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
        """Return means over groups of `size` consecutive frames; a last, shorter group is left out."""
        groups = len(self.time) // size

        def mean(series: NDArray[Any]) -> NDArray[Any]:
            return np.asarray(series[: groups * size].reshape(groups, size, *series.shape[1:]).mean(axis=1))

        return replace(
            self,
            time=mean(self.time),
            modes=mean(self.modes),
            variance=self.variance / size,
            second=mean(self.second),
            third=mean(self.third),
            second_covariance=self.second_covariance / size,
            third_covariance=self.third_covariance / size,
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
    half = int(np.ceil(SQUARE * centers.radius / pixel_size))
    offset = np.arange(-half, half, dtype=np.float64) * pixel_size
    edge = 2 * half * pixel_size
    frequency = (
        2 * np.pi / edge * np.arange(-int(band * edge / (2 * np.pi)), int(band * edge / (2 * np.pi)) + 1)
    )
    wave = np.exp(-1j * np.outer(frequency, offset))
    k1, k2 = np.meshgrid(frequency, frequency)
    kept = (np.hypot(k1, k2) <= band) & ((k2 > 0) | ((k2 == 0) & (k1 >= 0)))
    k = np.stack([k1[kept], k2[kept]], axis=1)
    order = np.argsort(np.hypot(k[:, 0], k[:, 1]), kind="stable")
    measure = pixel_size**2 / (2 * np.pi)

    n = len(attenuation)
    modes = np.full((n, len(k)), np.nan, complex)
    second, third, mass = np.full((n, 3), np.nan), np.full((n, 4), np.nan), np.full(n, np.nan)
    done = 0
    for block in attenuation.blocks():
        for image in block:
            center = centers.center[done] / pixel_size
            if np.isfinite(center).all():
                whole = np.round(center).astype(int)
                square = _cut(image, whole, half) - _cut_level(image.shape, centers.level[done], whole, half)
                rest = (center - whole) * pixel_size
                spectrum = (wave @ square @ wave.T)[kept]
                modes[done] = measure * spectrum * np.exp(1j * k @ rest)
                second[done], third[done], mass[done] = _moments(
                    square, offset, rest, centers.radius, pixel_size
                )
            done += 1
        if progress is not None:
            progress("low band", done, n)
    typical = float(np.nanmedian(mass))
    second_covariance, third_covariance = _moment_covariances(offset, centers.radius, pixel_size)
    unit = (centers.noise / typical) ** 2
    return LowBand(
        time=time,
        k=k[order],
        modes=modes[:, order],
        variance=(measure * centers.noise * 2 * half) ** 2,
        second=second / typical,
        third=third / typical,
        second_covariance=second_covariance * unit,
        third_covariance=third_covariance * unit,
        mass=mass,
        radius=centers.radius,
    )


def _cut(image: NDArray[np.generic], center: NDArray[np.int_], half: int) -> Array:
    """Copy the square about `center` [pixels from the middle pixel]; outside the frame there is nothing."""
    height, width = image.shape
    top, left = center[1] + height // 2 - half, center[0] + width // 2 - half
    square = np.zeros((2 * half, 2 * half))
    rows = slice(max(top, 0), min(top + 2 * half, height))
    columns = slice(max(left, 0), min(left + 2 * half, width))
    square[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = image[
        rows, columns
    ]
    return square


def _cut_level(shape: tuple[int, ...], level: float, center: NDArray[np.int_], half: int) -> Array | float:
    """Return the level of the empty field, 0 where the square lies outside the frame."""
    return _cut(np.full(shape, level), center, half) if level else 0.0


def _monomials(offset: Array, rest: Array, radius: float) -> tuple[Array, list[Array]]:
    """Return the weight of the disc and the monomials of order 2 and 3 about the centre, in radii."""
    x1, x2 = np.meshgrid((offset - rest[0]) / radius, (offset - rest[1]) / radius)
    pixel = (offset[1] - offset[0]) / radius
    weight = np.clip((1.1 - np.hypot(x1, x2)) / (2 * pixel) + 0.5, 0.0, 1.0)
    return weight, [x1**2, x1 * x2, x2**2, x1**3, x1**2 * x2, x1 * x2**2, x2**3]


def _moments(
    square: Array, offset: Array, rest: Array, radius: float, pixel_size: float
) -> tuple[Array, Array, float]:
    weight, monomials = _monomials(offset, rest, radius)
    weighted = (square * weight).ravel() * pixel_size**2
    values = np.array([m.ravel() @ weighted for m in monomials])
    return values[:3], values[3:], float(weighted.sum())


def _moment_covariances(offset: Array, radius: float, pixel_size: float) -> tuple[Array, Array]:
    weight, monomials = _monomials(offset, np.zeros(2), radius)
    columns = np.stack([(m * weight).ravel() for m in monomials], axis=1) * pixel_size**2
    covariance = columns.T @ columns
    return covariance[:3, :3], covariance[3:, 3:]
