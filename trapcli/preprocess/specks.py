"""Specks that stay in place under a particle that never leaves it.

The mean in time of log I under the particle is log I₀ minus the particle's mean projection, which motion
makes smooth but not flat. Its covariance is told by how the projections vary in time: whatever stays in place
drops out of that. A speck is a round spot of lower transmission, 1 − d exp(−r² / 2 s²): the one that best
explains the mean, given this covariance, is fitted, then the next. What drifts with the particle is none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, ndimage, optimize

Array = NDArray[np.float64]
Stack = NDArray[np.float32]
Bools = NDArray[np.bool_]

_CLEARLY_DARK = 0.1  # share of a frame's peak that belongs to the particle
_PARTS = 8  # of the stack, in which a speck must be found
_INDEPENDENT = 20  # projections that differ enough for their mean to have less variance by this factor
_SHARP = (0.7, 3.0)  # widths of the two means between which a speck shows [pixels]
_ROUND = 0.3  # least ratio of a speck's curvatures
_SEEN = 4.0  # standard errors by which a candidate stands out
_SURE = 6.0  # standard errors of the depth of a speck
_FAINTEST = 0.005  # depth of a speck
_STEADY = ((3.4, 12.0), (2.4, 40.0), (1.0, 60.0), (-1.0, 100.0))
"""Standard errors by which a speck is nearer to its place than to drifting with the particle, at least;
those by which its depth must then stand out of how it varies between parts of the stack."""

_STEADIEST = ((8.0, 40.0),)
"""The same of a speck that may be the particle itself."""

_SIZES = (0.9, 1.7, 2.8)  # widths from which a fit starts [pixels]
_LEAST_SIZE, _MOST_SIZE = 0.4, 5.0
_DEEPEST = 0.98
_NEAR = 14  # half the edge of the window in which a speck is fitted [pixels]
_TOGETHER = 10  # distance at which two specks are fitted together [pixels]
_REACH = _NEAR + _TOGETHER  # from what is hidden, up to which specks are looked for [pixels]
MARGIN = _REACH + _NEAR
"""Distance from what is hidden up to which pixels tell of its specks [pixels]."""

_OTHERS = 6.0  # radius in which pixels belong to another candidate [pixels]
_APART = 1.0  # least distance of two specks [pixels]
_MOVES = 2.0  # farthest that a fit moves a candidate [pixels]
_ROUNDS = 3  # of looking for more
_NOTHING = 1e-30  # square of a spot that isn't there
_MOST_AT_ONCE = 60  # candidates of a round
_MOST = 0.4  # share of what absorbs, and is no other speck, from which on one may be the particle itself


@dataclass(frozen=True)
class Standing:
    """What stays in place in frames without their smooth background.

    Attributes
    ----------
    image:
        ``(H, W)`` mean in time.
    error:
        Standard deviation of its noise.
    frames:
        ``(K, H, W)`` log(I / I₀), all of them.
    drift:
        ``(K, 2)`` by how much the particle is away from its mean place (rows, columns) [pixels].
    measured:
        ``(H, W)`` log(I / I₀) where it is known from frames that the particle leaves free there, else NaN.
    often:
        ``(H, W)`` share of the frames that do.
    """

    image: Array
    error: float
    frames: Stack
    drift: Array
    measured: Array
    often: Array

    @classmethod
    def of(
        cls, frames: Stack, noise: float, measured: Array | None = None, often: Array | None = None
    ) -> Self:
        """Summarise ``(K, H, W)`` log(I / I₀) with pixel noise of a standard deviation `noise`."""
        shape = frames.shape[1:]
        measured = np.full(shape, np.nan) if measured is None else measured
        often = np.ones(shape) if often is None else often
        return cls(_mean(frames), noise / np.sqrt(len(frames)), frames, _drift(frames), measured, often)

    @property
    def hidden(self) -> Bools:
        """``(H, W)`` where the particle may always be."""
        return np.isnan(self.measured)

    @property
    def best(self) -> Array:
        """``(H, W)`` what is measured, and else the mean in time."""
        return np.where(self.hidden, self.image, self.measured)

    def seen(self, rows: slice, columns: slice) -> Stack:
        """Return some pixels of all frames; what is measured is alike in all."""
        frames, measured = np.nan_to_num(self.frames[:, rows, columns]), self.measured[rows, columns]
        return np.where(np.isnan(measured), frames, measured.astype(np.float32))

    @cached_property
    def changes(self) -> Array:
        """``(H, W)`` variance of what is sharp in the mean, told by how parts of the stack differ."""
        parts = np.array_split(self.frames, min(_PARTS, len(self.frames)))
        total, squares = np.zeros((2, *self.image.shape))
        for part in parts:
            sharp = _sharp(_mean(part))
            total += sharp
            squares += sharp**2
        squares -= total**2 / len(parts)
        variance = np.maximum(squares, 0) / (len(parts) - 1)
        return np.asarray(ndimage.gaussian_filter(variance, _SHARP[1]) / len(parts))


def find_specks(standing: Standing, free: Bools) -> list[Array]:
    """Return the specks (row, column, size, depth) that are near what is not `free`, and those in it.

    Parameters
    ----------
    free:
        ``(H, W)`` where no specks are needed: the image itself is the background.
    """
    shape = standing.image.shape
    specks: list[Array] = []
    if free.all():
        return specks
    reach = ndimage.binary_dilation(~free, iterations=_REACH)
    refused = np.zeros(shape, bool)
    for _ in range(_ROUNDS):
        found = False
        places = _candidates(standing, render(specks, shape), reach & ~refused)
        for place in places:
            if _is_near(specks, place, _APART):
                continue
            if _add(specks, standing, place, places):
                found = True
            else:
                rows, columns = _window(place, shape, 2)
                refused[rows, columns] = True
        if not found:
            break
    return specks


def fit_again(standing: Standing, specks: list[Array]) -> list[Array]:
    """Return specks fitted to what is measured now; those that can't be fitted stay as they are."""
    places = np.array([speck[:2] for speck in specks])
    again: list[Array] = []
    for speck in specks:
        fitted = _add(again, standing, speck[:2], places)
        if not fitted and not _is_near(again, speck[:2], _APART):
            again.append(speck)
    return again


def _is_near(specks: list[Array], place: Array, distance: float) -> bool:
    """Tell whether any of several specks is less than a distance away from a place."""
    return any(np.hypot(*(speck[:2] - place)) < distance for speck in specks)


def _add(specks: list[Array], standing: Standing, place: Array, places: Array) -> bool:
    """Add a speck at `place`, one of several, and fit those near it again; tell whether there is one."""
    near = [k for k, speck in enumerate(specks) if np.hypot(*(speck[:2] - place)) < _TOGETHER]
    fitted = _fit(standing, place, specks, near, places)
    if fitted is None:
        return False
    for k, speck in zip(near, fitted[1:], strict=True):
        specks[k] = speck
    specks.append(fitted[0])
    return True


def covered(specks: list[Array], free: Bools) -> int:
    """Return how many of them are not in `free`."""
    return sum(not free[_pixel(speck, free.shape)] for speck in specks)


def _pixel(place: Array, shape: tuple[int, ...]) -> tuple[int, int]:
    row, column = np.clip(np.rint(place[:2]).astype(int), 0, np.array(shape) - 1)
    return int(row), int(column)


def _drift(frames: Stack) -> Array:
    """Return how the centroid of what attenuates moves."""
    places = []
    for image in frames:
        dark = np.clip(-np.nan_to_num(image), 0, None)
        dark[dark < _CLEARLY_DARK * dark.max()] = 0
        places.append(ndimage.center_of_mass(dark) if dark.any() else (np.nan, np.nan))
    known = np.isfinite(places).all(axis=1)
    if not known.any():
        return np.zeros((len(frames), 2))
    drift = np.array(places) - np.median(np.array(places)[known], axis=0)
    return np.asarray(np.nan_to_num(drift))


def render(specks: list[Array], shape: tuple[int, ...]) -> Array:
    """Return log of the transmission of specks (row, column, size, depth)."""
    image = np.zeros(shape)
    for row, column, size, depth in specks:
        rows, columns = _window(np.array([row, column]), shape, int(np.ceil(6 * size)))
        x2, x1 = np.ogrid[rows, columns]
        image[rows, columns] += _profile(x2, x1, row, column, size, depth)
    return image


def _mean(stack: Stack) -> Array:
    """Return the mean in time of what is known; 0 where nothing is."""
    total, count = np.zeros((2, *stack.shape[1:]))
    for image in stack:
        known = np.isfinite(image)
        np.add(total, image, out=total, where=known)
        count += known
    return np.asarray(total / np.maximum(count, 1))


def _profile(
    x2: NDArray[np.generic], x1: NDArray[np.generic], row: float, column: float, size: float, depth: float
) -> Array:
    r2 = (x2 - row) ** 2 + (x1 - column) ** 2  # type: ignore[operator]
    return np.asarray(np.log1p(-depth * np.exp(-r2 / (2 * size**2))))


def _slopes(
    x2: NDArray[np.generic], x1: NDArray[np.generic], row: float, column: float, size: float, depth: float
) -> Array:
    """Return the ``(P, 4)`` derivatives of the profile."""
    down, right = x2 - row, x1 - column  # type: ignore[operator]
    r2 = down**2 + right**2
    spot = np.exp(-r2 / (2 * size**2))
    by_spot = -depth / (1 - depth * spot) * spot / size**2
    return np.stack(
        [by_spot * down, by_spot * right, by_spot * r2 / size, -spot / (1 - depth * spot)], axis=-1
    )


def _own(
    x2: NDArray[np.int64], x1: NDArray[np.int64], place: Array, places: Array, near: list[Array]
) -> Bools:
    """Return the pixels that belong to no other candidate."""
    own = np.ones(x2.shape, bool)
    here = np.min([np.hypot(x2 - row, x1 - column) for row, column, *_ in (place, *near)], axis=0)
    for other in places:
        if (other != place).any() and not any(np.hypot(*(speck[:2] - other)) < _MOVES for speck in near):
            there = np.hypot(x2 - other[0], x1 - other[1])
            own &= (there >= here) | (there > _OTHERS)
    return own


def _clarity(series: Array) -> float:
    """Return the mean of a series over its standard error, told by consecutive parts."""
    parts = np.array([part.mean() for part in np.array_split(series, min(_PARTS, len(series)))])
    return float(parts.mean() / (parts.std(ddof=1) / np.sqrt(len(parts)) + 1e-300))


def _window(place: Array, shape: tuple[int, ...], reach: int) -> tuple[slice, slice]:
    rows, columns = (
        slice(max(0, middle - reach), min(size, middle + reach + 1))
        for middle, size in zip(np.rint(place).astype(int), shape, strict=True)
    )
    return rows, columns


def _candidates(standing: Standing, known: Array, reach: Bools) -> Array:
    """Return the ``(C, 2)`` places where something sharp and round stays, the clearest first."""
    sharp = _sharp(standing.image - known)
    clear = np.abs(sharp) / np.sqrt(standing.changes + standing.error**2 / 4 + 1e-12)
    top = np.abs(sharp) >= ndimage.maximum_filter(np.abs(sharp), 3)
    top &= reach & (clear > _SEEN) & (np.abs(sharp) > _FAINTEST / 2) & _is_compact(sharp)
    places = np.argwhere(top)
    return np.asarray(places[np.argsort(-clear[top])[:_MOST_AT_ONCE]], dtype=float)


def _sharp(image: Array) -> Array:
    narrow, wide = (ndimage.gaussian_filter(image, size) for size in _SHARP)
    return np.asarray(narrow - wide)


def _is_compact(image: Array) -> Bools:
    """Tell where an image curves alike in all directions, as a speck does and the particle's edge doesn't."""
    along, across, mixed = (ndimage.gaussian_filter(image, 1.0, order) for order in ((2, 0), (0, 2), (1, 1)))
    mean, deviation = (along + across) / 2, np.hypot((along - across) / 2, mixed)
    return np.asarray(np.abs(mean) - deviation > _ROUND * (np.abs(mean) + deviation))


@dataclass(frozen=True)
class _Window:
    """Some pixels of the frames, whitened."""

    rows: slice
    columns: slice
    keep: Bools
    root: Array

    @cached_property
    def places(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        x2, x1 = np.mgrid[self.rows, self.columns]
        return x2[self.keep], x1[self.keep]

    def white(self, pixels: NDArray[Any]) -> Array:
        return np.asarray(linalg.solve_triangular(self.root, pixels, lower=True, check_finite=False))

    def of(self, image: Array) -> Array:
        """Return ``(P,)`` whitened pixels of an image."""
        return self.white(image[self.rows, self.columns][self.keep])

    def profiles(self, specks: Array) -> Array:
        """Return ``(P,)`` whitened pixels of ``(S, 4)`` specks."""
        total = np.zeros(np.count_nonzero(self.keep))
        for speck in specks:
            total += _profile(*self.places, *speck)
        return self.white(total)

    def fit(self, start: Array, target: Array) -> optimize.OptimizeResult:
        """Fit specks, ``(S, 4)`` at the start, to whitened pixels."""
        lower, upper = start - _MOVES, start + _MOVES
        lower[:, 2:], upper[:, 2:] = (_LEAST_SIZE, -_DEEPEST), (_MOST_SIZE, _DEEPEST)

        def misfit(parameters: Array) -> Array:
            return target - self.profiles(parameters.reshape(-1, 4))

        def slopes(parameters: Array) -> Array:
            columns = [_slopes(*self.places, *speck) for speck in parameters.reshape(-1, 4)]
            return -self.white(np.concatenate(columns, axis=1))

        limits = lower.ravel(), upper.ravel()
        inside = np.clip(start.ravel(), *limits)
        return optimize.least_squares(misfit, inside, slopes, bounds=limits, xtol=1e-4, ftol=1e-5)


def _fit(
    standing: Standing, place: Array, specks: list[Array], near: list[int], places: Array, moves: int = 1
) -> list[Array] | None:
    """Return a speck at `place` and those `near` it, fitted together; None where there is none."""
    shape = standing.image.shape
    rows, columns = _window(place, shape, _NEAR)
    known = [specks[k] for k in near]
    x2, x1 = np.mgrid[rows, columns]
    keep = _own(x2, x1, place, places, known)
    covariance = _covariance(standing, rows, columns, keep)
    window = _Window(rows, columns, keep, covariance.root())
    others = render([speck for k, speck in enumerate(specks) if k not in near], shape)
    sign = np.sign(_sharp(standing.image - others)[_pixel(place, shape)])
    target = window.of(standing.best - others)
    starts = [np.array([[*place, size, -0.1 * sign], *known]) for size in _SIZES]
    found = min((window.fit(start, target) for start in starts), key=lambda result: float(result.cost))
    doubt = 2 * float(found.cost) / keep.sum()
    if doubt > 1 and not standing.hidden[rows, columns][keep].all():
        # the mean has more in it than changes tell, like the rim of a ball
        window = _Window(rows, columns, keep, covariance.root(doubt))
        found = window.fit(found.x.reshape(-1, 4), window.of(standing.best - others))
    frames = standing.seen(rows, columns) - others[rows, columns]
    series = window.white(frames[:, keep].T)
    # frames in which the particle is smooth here tell more
    left = series - window.profiles(found.x.reshape(-1, 4))[:, None]
    weights = 1 / np.maximum(np.mean(left**2, axis=0), 1e-300)
    found = window.fit(found.x.reshape(-1, 4), series @ weights / weights.sum())
    fitted = list(found.x.reshape(-1, 4))
    scatter = max(1.0, np.sqrt(2 * found.cost / keep.sum()))
    error = np.sqrt(np.linalg.pinv(found.jac.T @ found.jac)[3, 3]) * scatter
    size, depth = fitted[0][2:]
    moved = np.abs(fitted[0][:2] - place).max() > 0.99 * _MOVES
    further = np.rint(fitted[0][:2])
    if moved and moves > 0 and (further >= 0).all() and (further < shape).all():
        return _fit(standing, further, specks, near, places, moves - 1)
    doubled = any(np.hypot(*(fitted[0][:2] - other[:2])) < _APART for other in (*known, *fitted[1:]))
    if moved or doubled or abs(depth) < max(_FAINTEST, _SURE * error) or size > 0.95 * _MOST_SIZE:
        return None
    series = series - window.profiles(found.x.reshape(-1, 4)[1:])[:, None]
    along = [_profile(*window.places, *(fitted[0] + [*move, 0, 0])) for move in standing.drift]
    here = window.profiles(found.x.reshape(-1, 4)[:1])[:, None]
    left = np.abs(standing.image - others - render(known, shape)).sum()
    share = float(np.abs(render(fitted[:1], shape)).sum() / (left + _NOTHING))
    return fitted if _stays(series, here, window.white(np.array(along).T), share) else None


def _stays(series: Array, here: Array, along: Array, share: float) -> bool:
    """Tell whether a spot is always there and stays in place, rather than being carried by the particle.

    Parameters
    ----------
    series:
        ``(P, K)`` frames.
    here, along:
        ``(P, 1)`` and ``(P, K)`` the spot in its place and as it would drift with the particle.
    share:
        Of what absorbs and is no other speck that would be that spot.
    """
    shares = np.sum(here * series, axis=0) / np.sum(here**2)
    in_place = _in_place(series - shares.mean() * here, shares.mean() * (along - here))
    levels = _STEADIEST if share > _MOST else _STEADY
    return _clarity(shares) > next((least for bound, least in levels if in_place > bound), np.inf)


def _in_place(left: Array, carried: Array) -> float:
    """Return the standard errors by which a spot follows less than half of the particle's drift.

    Parameters
    ----------
    left:
        ``(P, K)`` frames without the spot in its place.
    carried:
        ``(P, K)`` what following all of the drift adds.
    """
    both = np.stack([np.sum(carried * left, axis=0), np.sum(carried**2, axis=0)])
    parts = np.array_split(both, min(_PARTS, both.shape[1]), axis=1)
    sums = np.array([part.sum(axis=1) for part in parts])
    product, square = sums.sum(axis=0)
    without = sums.sum(axis=0) - sums
    if not (without[:, 1] > _NOTHING).all():
        return 0.0
    # jackknife (Efron 1982, DOI 10.1137/1.9781611970319): parts with little drift tell little
    error = np.sqrt((len(parts) - 1) * np.var(without[:, 0] / without[:, 1]))
    return float((0.5 - product / square) / (error + _NOTHING))


@dataclass(frozen=True)
class _Covariance:
    """``(P, P)`` covariance of the mean projection, and of what else there is."""

    particle: Array
    others: Array

    def root(self, doubt: float = 1.0) -> Array:
        """Return the Cholesky factor of the whole, with `doubt` times the projection's."""
        whole = doubt * self.particle + self.others
        return np.asarray(linalg.cholesky(whole, lower=True, check_finite=False))


def _covariance(standing: Standing, rows: slice, columns: slice, keep: Bools) -> _Covariance:
    """Return the covariance of the mean projection, and that of its noise and any paraboloid."""
    frames = standing.seen(rows, columns)
    height, width = frames.shape[1:]
    hidden = standing.hidden[rows, columns]
    taper = np.multiply.outer(*(np.hanning(size + 2)[1:-1] for size in (height, width))) * hidden
    changes = (frames - frames.mean(axis=0)) * taper
    power = np.mean(np.abs(np.fft.fft2(changes, s=(2 * height, 2 * width))) ** 2, axis=0)
    by_lag = np.fft.ifft2(power).real / max(float(np.sum(taper**2)), 1.0)
    x2, x1 = (axis[keep] for axis in np.mgrid[:height, :width])
    covariance = by_lag[x2[:, None] - x2, x1[:, None] - x1] / _INDEPENDENT
    covariance *= np.multiply.outer(hidden[keep], hidden[keep])
    often = np.where(hidden, 1.0, standing.often[rows, columns])[keep]
    variance = standing.error**2 / often
    right, down = (x1 - x1.mean()) / width, (x2 - x2.mean()) / height
    smooth = np.stack([np.ones(len(x1)), right, down, right**2, down**2, right * down], axis=1)
    smooth *= hidden[keep][:, None]
    return _Covariance(covariance, smooth @ smooth.T + np.diag(variance + 1e-10))
