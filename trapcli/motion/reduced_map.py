"""The reduced attenuation map J̃ (``eqRecMapReduced``): Fourier transforms of the frames about their centres.

Everything after this needs J̃ on lines through the origin only, so it is sampled once on a polar grid and
the frames are not needed again. What is sampled follows from the data: the frames are cropped to the
object, the band ends where the spectrum meets the noise, and pixels finer than the band needs are binned.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import finufft
import numpy as np
from numpy.typing import NDArray

from trapcli.errors import InputError
from trapcli.motion.cells import transfer
from trapcli.motion.centers import TAPER, Centers, Progress, disc, spread
from trapcli.motion.types import ReducedMap
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]

MARGIN = 1.1
"""Radius that the sampling resolves, in radii of the object."""

FINEST = 100.0
"""Highest band times radius that is sampled: about the number of resolved cells across the object."""

_SURVEY = 12  # frames on which the grid is laid out
_SPECTRUM_END = (
    1e-6  # amplitude, as a share of the highest, below which even a clean spectrum carries nothing
)
_ABOVE_NOISE = 0.05  # power beyond the noise's that still counts once many frames are averaged
_SINGLE_PRECISION = (
    1e-5  # noise, as a share of the highest sample, that leaves nothing for double precision to keep
)
_ALIAS = 0.3  # amplitude of an alias in units of the noise
_BATCH = 32  # frames per transform
_MOST_LINES = 96  # that the low band may need
_NEGLIGIBLE = 1e-10  # share of the band's waves that may be lost


@dataclass(frozen=True)
class _Grid:
    """How frames become polar samples: crop, bin and disc in pixels, polar grid, precision."""

    crop: tuple[int, int]
    binning: int
    radius: float
    pixel_size: float
    mu: Array
    phi: Array
    single: bool


def reduce_frames(
    attenuation: Frames,
    centers: Centers,
    *,
    time: Array,
    pixel_size: float = 1.0,
    band: float = 0.0,
    progress: Progress | None = None,
) -> ReducedMap:
    """Sample the reduced attenuation map of all frames (``eqRecMapReduced``; Elbau et al. 2020).

    Parameters
    ----------
    attenuation:
        N attenuation projections.
    centers:
        Their centres, from `trapcli.motion.centers.estimate_centers` with the same pixel size.
    time:
        ``(N,)`` times.
    pixel_size:
        Edge of a pixel [length].
    band:
        Highest spatial frequency [rad / length]; 0 finds where the spectrum meets the noise.
    progress:
        Called as ``progress("reduced map", done, N)``.

    Returns
    -------
    ReducedMap
        Blank frames hold NaN.

    Raises
    ------
    InputError
        Where no frame holds an object.
    """
    if not np.isfinite(centers.center).any():
        raise InputError(f"{attenuation.info.source}: no frame shows an object; check the background")
    grid = _lay_out(attenuation, centers, pixel_size, band)
    transform = _PolarTransform(grid)
    samples = np.full((len(attenuation), len(grid.mu), len(grid.phi)), np.nan, transform.dtype)
    done = 0
    for block in attenuation.blocks():
        for first in range(0, len(block), _BATCH):
            images = block[first : first + _BATCH]
            place = slice(done, done + len(images))
            seen = np.isfinite(centers.center[place, 0])
            if seen.any():
                samples[place][seen] = transform(
                    images[seen], centers.center[place][seen], centers.level[place][seen]
                )
            done += len(images)
            if progress is not None:
                progress("reduced map", done, len(attenuation))
    noise = transform.noise_gain * centers.noise
    return ReducedMap(samples, grid.mu, grid.phi, time, noise, centers.radius)


class _PolarTransform:
    """Fourier transforms of batches of frames at the nodes of a polar grid, about their centres."""

    def __init__(self, grid: _Grid) -> None:
        self.grid = grid
        self.dtype = np.dtype(np.complex64 if grid.single else np.complex128)
        self._cells = tuple(-(-size // grid.binning) for size in grid.crop)
        cell = grid.binning * grid.pixel_size
        self._k1 = np.multiply.outer(grid.mu, np.cos(grid.phi))
        self._k2 = np.multiply.outer(grid.mu, np.sin(grid.phi))
        # what averaging over a cell has taken from each frequency, and the measure of the integral
        taken = transfer(self._k1, grid.binning, grid.pixel_size)
        taken *= transfer(self._k2, grid.binning, grid.pixel_size)
        self._factor = cell**2 / (2 * np.pi) / taken
        self._points = [
            (k * cell).ravel().astype(np.float32 if grid.single else np.float64) for k in (self._k2, self._k1)
        ]
        self._plans: dict[int, Any] = {}

    @property
    def noise_gain(self) -> float:
        """Standard deviation of a sample's noise for white pixel noise of unit standard deviation."""
        weights = disc(self.grid.crop, np.zeros(2), self.grid.radius)[0]
        return float(np.linalg.norm(weights)) * self.grid.pixel_size**2 / (2 * np.pi)

    def __call__(self, images: NDArray[Any], centers: Array, level: Array) -> NDArray[Any]:
        """Return ``(n, M, L)`` samples of ``(n, H, W)`` frames with their centres [length] and levels."""
        grid, (rows, columns) = self.grid, self._cells
        b = grid.binning
        cropped = np.zeros((len(images), rows * b, columns * b))
        middle = np.empty((len(images), 2))
        for n, image in enumerate(images):
            middle[n] = _cut(image, centers[n] / grid.pixel_size, level[n], grid, cropped[n])
        cells = cropped.reshape(len(images), rows, b, columns, b).mean(axis=(2, 4)) if b > 1 else cropped
        values = self._plan(len(images)).execute(np.ascontiguousarray(cells, dtype=self.dtype))
        shift = centers - middle * grid.pixel_size
        phase = np.exp(1j * (shift[:, 0, None, None] * self._k1 + shift[:, 1, None, None] * self._k2))
        polar: NDArray[Any] = values.reshape(len(images), *self._k1.shape) * (phase * self._factor)
        return polar

    def _plan(self, batch: int) -> Any:
        if batch not in self._plans:
            plan = finufft.Plan(
                2,
                self._cells,
                batch,
                eps=1e-6 if self.grid.single else 1e-14,
                isign=-1,
                dtype=self.dtype.name,
            )
            plan.setpts(*self._points)
            self._plans[batch] = plan
        return self._plans[batch]


class BandReader:
    """Reads the low band of N frames off squares around the object, for a polar grid of any kind.

    A square of cells, weighted with the object's disc, is projected onto functions that span all waves of the
    band on either axis. The few numbers that are left of a frame hold all its samples.

    Parameters
    ----------
    count:
        N.
    radius:
        Of the object [length].
    band:
        Highest spatial frequency [rad / length].
    pixel_size:
        Edge of a pixel [length].
    binning:
        Pixels along the edge of a cell of the squares.

    Attributes
    ----------
    half:
        A square has 2 `half` + 1 cells.
    """

    def __init__(self, count: int, radius: float, band: float, pixel_size: float, binning: int = 1) -> None:
        cell = binning * pixel_size
        self.half = int(np.ceil(TAPER * radius / cell)) + 1
        self._pixel_size, self._binning, self._radius = pixel_size, binning, radius
        self._offset = np.arange(-self.half, self.half + 1, dtype=np.float64) * cell
        self._mu = _rings(min(band, 0.9 * np.pi / cell), radius)
        self._basis = _spanning(self._offset, float(self._mu[-1]))
        self._projections = np.full((count, self._basis.shape[1] ** 2), np.nan)

    def read(self, n: int, square: Array, rest: Array) -> None:
        """Read frame `n` off the square about a cell.

        Parameters
        ----------
        rest:
            ``(2,)`` roughly the object's centre, from that cell [length].
        """
        weights, rows, columns = self._disc(rest)
        weighted = square[rows, columns] * weights
        self._projections[n] = (self._basis[rows].T @ (weighted @ self._basis[columns])).ravel()

    def _disc(self, center: Array) -> tuple[Array, slice, slice]:
        cell = self._binning * self._pixel_size
        return disc((2 * self.half + 1,) * 2, center / cell, self._radius / cell)

    def about(self, rest: Array, time: Array, noise: float) -> ReducedMap:
        """Return the reduced map about the centres (``eqRecMapReduced``).

        Parameters
        ----------
        rest:
            ``(N, 2)`` centres from the cells that the squares were about [length]; NaN in blank frames.
        time:
            ``(N,)``.
        noise:
            Standard deviation of the noise of one pixel.
        """
        area = (self._binning * self._pixel_size) ** 2 / (2 * np.pi)
        noise = area * float(np.linalg.norm(self._disc(np.zeros(2))[0])) * noise / self._binning
        seen = np.flatnonzero(np.isfinite(rest[:, 0]))
        lines = 16
        if len(seen):
            some = seen[spread(len(seen), _SURVEY)]
            survey = self._samples(some, rest[some], _angles(_MOST_LINES))
            lines = _lines(survey, max(0.01 * noise, 1e-15 * float(np.abs(survey).max())))
        phi = _angles(lines)
        samples = np.full((len(time), len(self._mu), lines), np.nan, complex)
        samples[seen] = self._samples(seen, rest[seen], phi)
        return ReducedMap(samples, self._mu, phi, time, noise, self._radius)

    def _samples(self, frames: NDArray[np.int_], rest: Array, phi: Array) -> NDArray[np.complex128]:
        k1, k2 = (np.multiply.outer(self._mu, axis) for axis in (np.cos(phi), np.sin(phi)))
        waves = [np.exp(-1j * np.outer(k, self._offset)) @ self._basis for k in (k1, k2)]
        both = (waves[1][:, :, None] * waves[0][:, None]).reshape(k1.size, -1)
        taken = transfer(k1, self._binning, self._pixel_size) * transfer(k2, self._binning, self._pixel_size)
        factor = (self._binning * self._pixel_size) ** 2 / (2 * np.pi) / taken
        values = self._projections[frames]
        polar = (values @ both.real.T + 1j * (values @ both.imag.T)).reshape(-1, *k1.shape)
        polar *= factor * np.exp(1j * (rest[:, 0, None, None] * k1 + rest[:, 1, None, None] * k2))
        return np.asarray(polar)


def _spanning(x: Array, highest: float) -> Array:
    """Return orthonormal functions on `x` that span exp(−ikx) for all |k| ≤ `highest`, ``(X, m)``."""
    turns = np.multiply.outer(x, np.linspace(0, highest, 2 * int(highest * np.abs(x).max()) + 8))
    functions, size, _ = np.linalg.svd(np.concatenate([np.cos(turns), np.sin(turns)], axis=1))
    return np.asarray(functions[:, : np.count_nonzero(size > _NEGLIGIBLE * size[0])])


def _cut(image: NDArray[Any], center: Array, level: float, grid: _Grid, target: Array) -> Array:
    """Copy the weighted surroundings of the object into `target`; return the place of its middle cell."""
    height, width = image.shape
    origin = np.array([width // 2, height // 2])
    size = np.array([grid.crop[1], grid.crop[0]])
    corner = np.clip(np.round(center).astype(int) + origin - size // 2, 0, [width, height] - size)
    (left, top), (columns, rows) = corner, size
    inside = image[top : top + rows, left : left + columns]
    # `disc` counts from the middle pixel of what it is given
    weights, row_slice, column_slice = disc(inside.shape, center + origin - corner - size // 2, grid.radius)
    target[row_slice, column_slice] = (inside[row_slice, column_slice] - level) * weights
    b = grid.binning
    cells = np.array([target.shape[1] // b // 2, target.shape[0] // b // 2])
    return np.asarray(corner + cells * b + (b - 1) / 2 - origin)


def _lay_out(attenuation: Frames, centers: Centers, pixel_size: float, band: float) -> _Grid:
    """Choose crop, band, binning, polar grid and precision from a few frames."""
    height, width = attenuation.shape[1:]
    radius = centers.radius / pixel_size
    reach = 2 * int(np.ceil(TAPER * radius) + 1)
    crop = min(reach, height), min(reach, width)
    wanted = np.flatnonzero(np.isfinite(centers.center[:, 0]))
    chosen = wanted[spread(len(wanted), _SURVEY)]
    finest = min(0.9 * np.pi / pixel_size, FINEST / centers.radius)
    whole = _Grid(
        crop, 1, radius, pixel_size, _rings(finest, centers.radius), _angles(int(FINEST * 1.6)), False
    )
    transform = _PolarTransform(whole)
    survey = np.concatenate(
        [
            transform(np.asarray(image)[None], centers.center[[n]], centers.level[[n]])
            for n, image in zip(chosen, attenuation.pick(chosen), strict=True)
        ]
    )
    noise = transform.noise_gain * centers.noise
    if band <= 0:
        band = _band(survey, whole.mu, noise)
    mu = _rings(min(band, 0.9 * np.pi / pixel_size), centers.radius)
    highest = float(np.abs(survey).max())
    lines = _lines(survey[:, whole.mu <= mu[-1]], max(0.01 * noise, 1e-15 * highest))
    binning = _binning(survey, whole.mu, mu[-1], noise, pixel_size)
    return _Grid(crop, binning, radius, pixel_size, mu, _angles(lines), noise > _SINGLE_PRECISION * highest)


def _binning(survey: NDArray[Any], mu: Array, band: float, noise: float, pixel_size: float) -> int:
    """Return the coarsest binning whose aliases stay below the noise."""
    amplitude = np.sqrt(np.maximum(np.mean(np.abs(survey) ** 2, axis=(0, 2)) - noise**2, 0.0))
    # what is below the noise of the survey may still be there
    envelope = np.maximum.accumulate(amplitude[::-1])[::-1] + _ALIAS * noise
    for b in range(int(np.pi / pixel_size / (2 * band)), 1, -1):
        alias = 2 * np.pi / (b * pixel_size) - band
        # averaging over a cell damps the alias by its share of the band
        leak = float(np.interp(alias, mu, envelope, right=envelope[-1])) * band / alias
        if leak < _ALIAS * noise:
            return b
    return 1


def _rings(band: float, radius: float) -> Array:
    """Return radii spaced so that an object of `radius` is just resolved along a line."""
    step = np.pi / (MARGIN * radius)
    return step * np.arange(1, max(4, int(np.ceil(band / step))) + 1, dtype=np.float64)


def _angles(count: int) -> Array:
    return np.arange(count) * np.pi / count


def _band(survey: NDArray[Any], mu: Array, noise: float) -> float:
    """Return the highest ring whose power stands out of the noise."""
    power = np.mean(np.abs(survey) ** 2, axis=(0, 2))
    independent = len(survey) * np.maximum(2 * np.arange(1, len(mu) + 1), 4)
    least = noise**2 * (1 + np.maximum(_ABOVE_NOISE, 4 / np.sqrt(independent)))
    seen = np.flatnonzero(power > np.maximum(least, _SPECTRUM_END**2 * power.max()))
    return float(mu[seen[-1]]) if len(seen) else float(mu[0])


def _lines(survey: NDArray[Any], negligible: float) -> int:
    """Return how many angles in [0, π) resolve the rings down to `negligible`."""
    turn = np.concatenate([survey, np.conj(survey)], axis=-1)
    spectrum = np.abs(np.fft.fft(turn, axis=-1)).max(axis=(0, 1)) / turn.shape[-1]
    size = survey.shape[-1]
    amplitude = np.maximum(spectrum[1:size], spectrum[:-size:-1])
    needed = np.flatnonzero(amplitude > negligible)
    return max(16, 2 * ((needed[-1] + 6) // 2)) if len(needed) else 16
