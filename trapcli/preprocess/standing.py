"""What stays in place under a particle that never leaves it, told apart once the motion is roughly known.

Dust that the particle always covers adds the same b(x) to all projections. In Fourier space, about the centre
C₂ (``eqRecMapReduced``),

    J̃(t, k) = û(R(t) Pᵀk) + b̂(k) exp(i⟨k, C₂(t)⟩) + noise,

linear in the object u and in b. The object is eliminated exactly; b is a sum of points, each with a prior
variance of its own that makes the data likeliest, so that few points remain where few are needed (Tipping
2001, Journal of Machine Learning Research 1; MacKay 1992, DOI 10.1162/neco.1992.4.3.415). What both could
explain, a pattern that is round about the rotation's axis, is left to the object: at the right motion it
explains the images as well. Then the motion is fitted to what is left, and so on, until the pattern stays.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.motion import triangular
from trapcli.motion.centers import Progress
from trapcli.motion.fourier_slices import conjugate_share
from trapcli.motion.low_band import SQUARE, LowBand, group_means
from trapcli.motion.object_model import Fit, ObjectModel
from trapcli.motion.path import Path, Spline
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_COARSE_BAND = 12.0  # band times radius while motions are compared
_BAND = 22.0  # the same while the motion is fitted again
_FINEST_BAND = 28.0  # the same in the end: that of the finest object model which judges the motion
_SPACING = 0.7  # of the points, in units of π / band
_REACH = 1.1  # of the points, in radii of the object
_GROUP = np.deg2rad(1.0)  # rotation over a group of frames that are averaged
_FEWEST_GROUPS = 30
_KNOTS = np.deg2rad(6.0)  # rotation per interval of the spline that bends the motion
_FEWEST_KNOTS = 12
_FROM_NEARBY = 2, 1, 0.1  # rounds; steps of fitting the motion in each; change of the pattern that ends them
_FROM_AFAR = 10, 3, 0.01  # the same where the motion may be far off
_ROUGHLY = 3, 3, 0.01  # the same to see which of several motions may be right
_LIKELY = 2  # of them that are looked into further
_VARIANCES = np.geomspace(1e-3, 1e7, 100)  # of the points, in units of what is told best
_SIFTINGS = 40  # of the points
_LEAST_TOLD = 1e-3  # share of a point's variance that the frames are taken to tell at least
_NEGLIGIBLE = 1e-6  # variance of a point, as a share of the typical, that is as good as none
_CONVINCING = 5.0  # natural logarithm of the odds at which there is a pattern


def find_standing_pattern(
    low: LowBand, center: Array, R: Array, model: ObjectModel | None = None
) -> StandingPattern | None:
    """Find what stays in place while the particle moves.

    Parameters
    ----------
    low:
        Modes of N attenuation projections about the centres.
    center, R:
        ``(N, 2)`` centres [length] and ``(N, 3, 3)`` rotations of the particle, roughly; NaN where not known.
    model:
        Of the object in them: how fine its lattice is, and what the object may be like, where that is known.

    Returns
    -------
    StandingPattern
        At the low spatial frequencies that tell the motion; None where nothing stays, or where the motion
        isn't known.
    """
    known = np.flatnonzero(np.isfinite(R[:, 0, 0]) & np.isfinite(center[:, 0]))
    if len(known) < _FEWEST_GROUPS:
        return None
    low, center, R = low.select(known), center[known], R[known]
    finest, path, spline = _along(low, center, Path(low.time, R, R[:, 0]))
    views, middle = finest.within(_BAND), np.median(center, axis=0)
    points = _Points.over(views.low, middle, _BAND)
    odds, values = _pattern(views, path, points, model)
    if odds < _CONVINCING:
        return None
    fit = _told_apart(views, path, spline, points, values, model)
    points = _Points.over(low, middle, _FINEST_BAND)
    _, values = _pattern(finest.shifted(fit.shift), fit.path, points, model)
    return StandingPattern(points, values)


def most_likely(low: LowBand, center: Array, paths: list[Path], progress: Progress | None = None) -> Path:
    """Return the one of several paths that explains the frames best together with a pattern that stays.

    Parameters
    ----------
    low:
        Modes of N attenuation projections about their centres.
    center:
        ``(N, 2)`` [length].
    paths:
        Roughly motions of the particle, at any times.
    progress:
        Called as ``progress("specks", done, total)``.

    Returns
    -------
    Path
        At the times of the N projections, bent to what it explains best.
    """
    middle = np.median(center, axis=0)

    def explained(path: Path, patience: tuple[int, int, float]) -> Fit:
        finest, along, spline = _along(low, center, path)
        views = finest.within(_COARSE_BAND)
        points = _Points.over(views.low, middle, _COARSE_BAND)
        _, values = _pattern(views, along, points, None)
        return _told_apart(views, along, spline, points, values, None, patience)

    def every(paths: list[Path], patience: tuple[int, int, float]) -> list[Fit]:
        fits = []
        for done, path in enumerate(paths):
            if progress is not None:
                progress("specks", done, len(paths))
            fits.append(explained(path, patience))
        return sorted(fits, key=lambda fit: fit.cost)

    roughly = every(paths, _ROUGHLY)
    best = every([fit.path.ascending() for fit in roughly[:_LIKELY]], _FROM_AFAR)[0]
    n = len(low.time)
    return Path(low.time, best.path.R[:n], best.path.omega[:n])


def _along(low: LowBand, center: Array, path: Path) -> tuple[_Views, Path, Spline]:
    """Return groups of frames in which a path turns little; the path at all times; what bends it."""
    time, n = low.time, len(low.time)
    turned = float(np.sum(np.linalg.norm(path.mean_omega(), axis=1) * np.diff(path.time)))
    size = max(1, min(int(_GROUP * n / turned), n // _FEWEST_GROUPS))
    views = _Views.of(low, center, size)
    intervals = min(max(_FEWEST_KNOTS, round(turned / _KNOTS)), len(views.low.time) // 3)
    spline = Spline(time[0], time[-1], intervals)
    return views, path.near(spline, np.concatenate([time, spline.grid, views.low.time])), spline


def _told_apart(
    views: _Views,
    path: Path,
    spline: Spline,
    points: _Points,
    values: Array,
    model: ObjectModel | None,
    patience: tuple[int, int, float] = _FROM_NEARBY,
) -> Fit:
    """Return the motion fitted to what a pattern of ``(P,)`` values leaves, told anew each time."""
    rounds, steps, settled = patience
    for left in reversed(range(rounds)):
        cleared = _like(model, views.without(points.waves @ values), points.band / views.low.radius)
        fit = cleared.fit(path, views.low.time, spline, steps=steps)
        if not left:
            break
        path, before = fit.path, values
        _, values = _pattern(views.shifted(fit.shift), path, points, model)
        change = np.linalg.norm(points.waves @ (values - before))
        if change < settled * np.linalg.norm(points.waves @ values):
            break
    return fit


def _like(model: ObjectModel | None, low: LowBand, band: float) -> ObjectModel:
    """Return a model of other frames and another band, with lattice and prior of one that is known."""
    if model is None:
        return ObjectModel(low, band)
    return ObjectModel(low, band, guard=model.guard, prior=model.prior)


@dataclass(frozen=True)
class StandingPattern:
    """Attenuation that is to be taken off every frame."""

    points: _Points
    values: Array

    def image(self, shape: tuple[int, ...], pixel_size: float) -> Array:
        """Return it in frames of H and W pixels, ``(H, W)``."""
        return self.points.image(self.values, shape, pixel_size)

    def modes(self, center: Array) -> ComplexArray:
        """Return its ``(N, K)`` low modes about ``(N, 2)`` centres [length]."""
        return np.asarray(np.exp(1j * center @ self.points.k.T) * (self.points.waves @ self.values))


def without(frames: Frames, pattern: Array) -> Frames:
    """Return frames less an ``(H, W)`` image, and say so in `StackInfo.warnings`."""
    taken = pattern.astype(frames.dtype)

    def read_blocks(size: int) -> Iterator[NDArray[Any]]:
        return (block - taken for block in frames.read_blocks(size))

    def read_some(positions: NDArray[np.integer[Any]]) -> Iterator[NDArray[Any]]:
        return (image - taken for image in frames.pick(positions))

    said = (
        "something that is no part of the particle stays in place under it, like dust; up to "
        f"{np.abs(pattern).max():.2g} of attenuation is taken off; a file of the empty field tells more"
    )
    info = replace(frames.info, warnings=(*frames.info.warnings, said))
    return replace(frames, read_blocks=read_blocks, read_some=read_some, info=info)


@dataclass(frozen=True)
class _Views:
    """Low band of G groups of frames, and the ``(G, K)`` modes there of a point in the frame's middle."""

    low: LowBand
    phase: ComplexArray

    @classmethod
    def of(cls, low: LowBand, center: Array, size: int) -> _Views:
        """Average groups of `size` frames."""
        grouped = low.grouped(size)
        return cls(grouped, group_means(np.exp(1j * center @ low.k.T), len(grouped.time)))

    def within(self, band: float) -> _Views:
        """Leave out modes beyond `band` over the object's radius."""
        kept = self.low.inside(band / self.low.radius)
        low = replace(self.low, k=self.low.k[kept], modes=self.low.modes[:, kept])
        return _Views(low, self.phase[:, kept])

    def shifted(self, shift: Array) -> _Views:
        """Move the centres by ``(G, 2)`` `shift`."""
        return _Views(self.low.shifted(shift), self.phase * np.exp(1j * shift @ self.low.k.T))

    def without(self, pattern: ComplexArray) -> LowBand:
        """Return the low band without a pattern of ``(K,)`` modes."""
        return replace(self.low, modes=self.low.modes - self.phase * pattern)


@dataclass(frozen=True)
class _Points:
    """Where there may be a pattern.

    Attributes
    ----------
    place:
        ``(P, 2)``, from the frame's middle [length].
    radius:
        Of the object [length].
    band:
        Highest spatial frequency that tells them apart, times the radius.
    k:
        ``(K, 2)`` modes.
    waves:
        ``(K, P)`` modes of points of unit value.
    """

    place: Array
    radius: float
    band: float
    k: Array
    waves: ComplexArray

    @classmethod
    def over(cls, low: LowBand, middle: Array, band: float) -> _Points:
        """Lay points, as close as `band` over the radius can tell them apart, over the disc of the object."""
        spacing, reach = _SPACING * np.pi * low.radius / band, _REACH * low.radius
        axis = np.arange(-int(reach / spacing), int(reach / spacing) + 1) * spacing
        square = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        place = square[np.hypot(*square.T) <= reach] + middle
        return cls(place, low.radius, band, low.k, np.exp(-1j * low.k @ place.T) * spacing**2 / (2 * np.pi))

    def image(self, values: Array, shape: tuple[int, ...], pixel_size: float) -> Array:
        """Return the ``(H, W)`` image that has the modes of points of these values, and no others."""
        x1, x2 = ((np.arange(size) - size // 2) * pixel_size for size in reversed(shape))
        across, down = np.exp(1j * np.outer(self.k[:, 0], x1)), np.exp(1j * np.outer(self.k[:, 1], x2))
        cell = float(self.k[1] @ self.k[1]) / (2 * np.pi)
        modes = cell * conjugate_share(self.k) * (self.waves @ values)
        image = ((modes[:, None] * down).T @ across).real
        # the modes are those of a square, beyond which the image repeats
        middle = self.place.mean(axis=0)
        near = np.hypot(x1 - middle[0], (x2 - middle[1])[:, None]) <= SQUARE * self.radius
        return np.asarray(np.where(near, image, 0.0))


def _pattern(views: _Views, path: Path, points: _Points, model: ObjectModel | None) -> tuple[float, Array]:
    """Return the logarithm of the odds that there is a pattern, and the ``(P,)`` values of its points."""
    told = _without_object(views, path.R[-len(views.phase) :], points, model)
    # where the motion or the model is wrong, what is left over is no pattern for that alone
    misfit = (told.square - told.likeliest().gain) / told.degrees
    told = told.doubted(max(1.0, misfit))
    likeliest = told.likeliest()
    return likeliest.odds, told.sifted(likeliest.variance)


@dataclass(frozen=True)
class _Likeliest:
    """The variance of all points that makes the data likeliest, its gain in misfit, and ln of its odds."""

    variance: float
    gain: float
    odds: float


@dataclass(frozen=True)
class _Told:
    """What the frames tell of the points: ``x curvature x − 2 pull x + square`` is the misfit.

    The object is eliminated; `degrees` is the misfit that noise gives.
    """

    curvature: Array
    pull: Array
    square: float
    degrees: float

    def doubted(self, misfit: float) -> _Told:
        """Return the same with the noise raised by a misfit."""
        return replace(self, curvature=self.curvature / misfit, pull=self.pull / misfit)

    def likeliest(self) -> _Likeliest:
        """Return the variance that suits all points alike."""
        bend, turn = np.linalg.eigh(self.curvature)
        bend, pull = np.maximum(bend, 0.0), turn.T @ self.pull

        def tried(variance: float) -> _Likeliest:
            gain = float(np.sum(pull**2 * variance / (1 + variance * bend)))
            return _Likeliest(variance, gain, 0.5 * (gain - float(np.sum(np.log1p(variance * bend)))))

        return max((tried(v) for v in _VARIANCES / bend.max()), key=lambda one: one.odds)

    def sifted(self, variance: float) -> Array:
        """Return the values of the points, each with the variance that suits it (MacKay's fixed point)."""
        variances = np.full(len(self.pull), variance)
        for _ in range(_SIFTINGS):
            values, errors = self._given(variances)
            surplus = np.maximum(1 - errors / variances, _LEAST_TOLD)
            variances = np.maximum(values**2 / surplus, _NEGLIGIBLE * variance)
        return self._given(variances)[0]

    def _given(self, variances: Array) -> tuple[Array, Array]:
        """Return values and squared errors of points with prior variances."""
        root = np.sqrt(variances)
        scaled = root[:, None] * self.curvature * root + np.eye(len(root))
        half = triangular.inverse_factor(scaled.T) * root
        return half.T @ (half @ self.pull), np.sum(half**2, axis=0)


def _without_object(views: _Views, R: Array, points: _Points, known: ObjectModel | None) -> _Told:
    """Eliminate the object."""
    low = views.low
    model = _like(known, low, points.band / low.radius)
    seen = model.views(R)
    root = np.sqrt(conjugate_share(low.k) / low.variance)
    phase, modes = root * views.phase, root * low.modes
    own = np.concatenate([points.waves.real, points.waves.imag])
    mixed = seen.lessened(model.alone(seen, phase) @ own)
    right = seen.lessened(model.right(seen, modes))
    power = np.tile(np.sum(np.abs(phase) ** 2, axis=0), 2)
    product = np.sum(phase.conj() * modes, axis=0)
    curvature = own.T @ (power[:, None] * own) - mixed.T @ mixed
    pull = own.T @ np.concatenate([product.real, product.imag]) - mixed.T @ right
    square = float(np.sum(np.abs(modes) ** 2))
    degrees = max(model.data_count - len(model.position) - 2 * len(R), 1.0)
    return _Told(curvature, pull, square - float(right @ right), degrees)
