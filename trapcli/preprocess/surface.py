"""The empty field of a stack whose particle never leaves its place.

A frame is I(t, x) = f(t) I₀(x) exp(−J(t, x)). Outside of the particle J is 0, so there log I − log f is
log I₀, seen in many frames: a smooth surface is fitted to all of it and carried on under the particle. What
is sharp in I₀ (dust, dirt) stays in place while the particle's projection moves and turns, which tells the
two apart.

Where the particle is, how bright each frame and how the light falls off, a coarse look tells as well: pixels
are averaged to cells for that. Only what is sharp is looked for pixel by pixel.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Self

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy import ndimage

from trapcli.motion.cells import Cells
from trapcli.preprocess.counts import Sample
from trapcli.preprocess.specks import MARGIN, Standing, covered, find_specks, fit_again, render

Array = NDArray[np.float64]
Stack = NDArray[np.float32]
Real = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]

_COARSE = 128  # least cells across a frame, where it has as many pixels
_BORDER = 0.04  # width of the border, as a share of the shorter edge
_DEGREES = (2, 4, 6)  # of the surface; the one that best foretells the field beside the particle is taken
_PATCH = 5  # edge of the mean in which the particle must stand out [cells]
_DEPTHS = (0.1, 0.05, 0.02, 0.02)  # least depth of the particle in each round, as a share of its peak
_CLEAR = 0.8  # the same in standard deviations of a cell: 4 of the mean over a patch
_ALWAYS = 0.9  # share of the frames in which dust is seen
_SMALL = 0.1  # its area as a share of the particle's
_HALF = 0.5  # the same at most where it stays as it is
_STILL = 2.5  # scatter in time, in units of the empty field's, up to which it does
_NEVER = 1.5  # the same where nothing ever covers it
_RIM = 0.95  # share of its cells that do
_ALONE = 0.8, 0.95  # quantiles in time that dust is like while nothing covers it
_MISFIT = 0.3  # of dust that is roughly known, as a share of its depth
_MARGIN = 0.04  # width of the doubtful ring around the particle, as a share of the shorter edge
_DIRECT = (
    0.25  # least share of frames in which a pixel that is measured directly lies outside of the particle
)
_SELDOM = 0.05  # the same where dust is roughly known
_SIGNIFICANT = 4.0  # standard deviations
_QUIET = 0.95  # share of frames in which a cell that tells the brightness lies outside of the particle
_LEAST_QUIET = 0.02  # share of such cells below which the border has to do
_FOOTPRINT = 1e-3  # depth down to which a speck counts
_TILTED = 0.003  # least tilt of the light, from the middle to the edge of a frame, that is taken out
_TYPICAL_CELLS = 2048  # that tell what misfit is common among those
_MOST_CELLS = 16384  # that a surface is fitted to
_DIFFERENCES = 1 << 18  # of neighbours in time that tell the noise
_NOISE_FRAMES = 4  # that tell the noise of pixels
_TINY = 1e-30  # variance that is none
_SPECK_BYTES = 64 << 20  # of frames in which specks are looked for


@dataclass(frozen=True)
class Light:
    """How bright each frame is, told by cells that the particle leaves free.

    Attributes
    ----------
    cells:
        How pixels are averaged.
    places:
        ``(P,)`` those cells, as positions in the flattened image.
    basis:
        ``(P, B)`` values there of 1, or of 1, x1 and x2.
    """

    cells: Cells
    places: NDArray[np.intp]
    basis: Array

    @classmethod
    def over(cls, free: Bools, cells: Cells, *, tilted: bool = False) -> Light:
        """Use the cells of an ``(h, w)`` mask; the border where they are too few."""
        if free.mean() < _LEAST_QUIET:
            free = border(free.shape)
        places = np.flatnonzero(free)
        x2, x1 = (axis.ravel()[places] for axis in np.meshgrid(*axes(cells), indexing="ij"))
        return cls(cells, places, np.stack([np.ones(len(places)), x1, x2][: 3 if tilted else 1], axis=1))

    @property
    def tilted(self) -> bool:
        """Whether the light may tilt from frame to frame."""
        return bool(self.basis.shape[1] > 1)

    def fit(self, log_ratio: NDArray[Any]) -> Array:
        """Return the ``(B,)`` coefficients of the light in ``(h, w)`` log(I / I₀); NaN where not known."""
        values = log_ratio.ravel()[self.places].astype(float)
        keep = np.isfinite(values)
        coefficients = np.full(self.basis.shape[1], np.nan)
        if np.count_nonzero(keep) < 3 * self.basis.shape[1]:
            return coefficients
        values, basis = (values, self.basis) if keep.all() else (values[keep], self.basis[keep])
        some = slice(None, None, max(1, len(values) // _TYPICAL_CELLS))
        misfit = values - _median(values[some])
        for _ in range(2):
            near = np.abs(misfit) <= 3 * 1.4826 * _median(np.abs(misfit[some])) + 1e-12
            if self.tilted:
                weighted = basis * near[:, None]
                # the basis is close to orthogonal
                coefficients = np.linalg.lstsq(weighted.T @ basis, weighted.T @ values, rcond=None)[0]
            else:
                coefficients = np.array([near.astype(float) @ values / np.count_nonzero(near)])
            misfit = values - basis @ coefficients
        return coefficients

    def take_off(self, image: NDArray[Any], coefficients: Array, cells: Cells) -> None:
        """Take the light off an image, in pixels or cells of any size."""
        if not self.tilted:
            image -= image.dtype.type(coefficients[0])
            return
        x2, x1 = axes(cells)
        image -= (coefficients[0] + coefficients[1] * x1).astype(image.dtype)
        image -= (coefficients[2] * x2[:, None]).astype(image.dtype)

    def even(self, ratios: Stack) -> tuple[Stack, Array]:
        """Return ``(K, h, w)`` log(I / I₀) without each frame's light, and its ``(K, B)`` coefficients."""
        coefficients = np.array([self.fit(image) for image in ratios])
        evened = ratios.copy()
        for image, light in zip(evened, coefficients, strict=True):
            self.take_off(image, light, self.cells)
        return evened, coefficients


@dataclass(frozen=True)
class EmptyField:
    """The field without the particle.

    Attributes
    ----------
    log_light:
        ``(H, W)`` log I₀.
    light:
        Tells the brightness of a frame.
    outside:
        ``(h, w)`` share of the frames in which a cell lies outside of the particle.
    depth:
        Of the particle.
    degree, specks:
        Of the surface; number of specks found under the particle.
    """

    log_light: NDArray[np.float32]
    light: Light
    outside: Array
    depth: float
    degree: int
    specks: int


def coarse(shape: tuple[int, ...]) -> Cells:
    """Return the cells in which the light and the particle's place are looked for."""
    return Cells(shape, max(1, 2 * (min(shape) // (2 * _COARSE))))


def border(shape: tuple[int, ...]) -> Bools:
    """Return the mask of a frame's border."""
    width = max(2, round(_BORDER * min(shape)))
    mask = np.ones(shape, bool)
    mask[width:-width, width:-width] = False
    return mask


def averaged(image: NDArray[Any], cells: Cells) -> NDArray[Any]:
    """Return the means over cells of what is known; NaN where nothing is."""
    means = cells.average(image)
    if cells.binning == 1 or np.isfinite(means).all():
        return means
    known = np.isfinite(image)
    shares = cells.average(known.astype(means.dtype))
    sums = cells.average(np.where(known, image, 0))
    return np.asarray(np.divide(sums, shares, out=np.full_like(means, np.nan), where=shares > 0))


def median_field(sample: Sample) -> Stack:
    """Return the ``(H, W)`` median in time of log I, made equally bright at the border."""
    cells = coarse(sample.images.shape[1:])
    light = Light.over(border(grid(cells)), cells)
    levels = np.array([light.fit(averaged(image, cells))[0] for image in sample.logs()], np.float32)
    field = np.empty(sample.images.shape[1:], np.float32)
    for rows, logs in sample.bands():
        logs -= levels[:, None, None]
        field[rows] = _middle(logs)
    return field


def fit_empty_field(sample: Sample) -> EmptyField:
    """Find the field without the particle in frames that all show it.

    Returns
    -------
    EmptyField
        Where the particle is never away the field is a polynomial in log I₀ plus the specks that stay in
        place; elsewhere it is measured as far as the noise allows.
    """
    cells = coarse(sample.images.shape[1:])
    logs = np.array([averaged(image, cells) for image in sample.logs()], np.float32)
    edge = border(logs.shape[1:])
    light, noise = Light.over(edge, cells), _noise(logs, edge)
    common = np.full(edge.shape, np.nan)
    common[edge] = _middle(light.even(logs)[0][:, edge])
    known = _fit_surface(common, np.isfinite(common), 2, cells).over(cells)
    for depth in _DEPTHS:
        look = _Look.at(logs, known, light, noise, depth, cells)
        known, light = look.known, look.light
    field = look.field_of(sample)
    if field.specks:
        # dust that is roughly known no longer passes for the particle, which may leave it free at times
        dust = np.abs(averaged(field.pattern, cells))
        known = averaged(field.surface + field.pattern, cells)
        look = _Look.at(logs, known, light, noise, _DEPTHS[-1], cells, dust)
        field = look.field_of(sample, field.specks)
    told = [image[np.isfinite(image)] for image in look.evened if np.isfinite(image).any()]
    return EmptyField(
        log_light=field.surface + field.pattern,
        light=look.light,
        outside=look.outside.mean(axis=0),
        depth=float(np.median([np.quantile(-values, 0.999) for values in told])),
        degree=look.degree,
        specks=field.covered,
    )


@dataclass(frozen=True)
class _Look:
    """What frames in cells tell of the field, given roughly what it is.

    Attributes
    ----------
    light, levels:
        Tells the brightness of a frame, and what it tells.
    outside:
        ``(K, h, w)`` cells that the particle leaves free.
    evened:
        ``(K, h, w)`` log I / I₀, equally bright.
    surface, degree:
        Fitted to what is free.
    known:
        ``(h, w)`` log I₀: that surface, and what is measured beside it.
    """

    light: Light
    levels: Array
    outside: Bools
    evened: Stack
    surface: _Surface
    degree: int
    known: Array

    @classmethod
    def at(
        cls,
        logs: Stack,
        known: Array,
        light: Light,
        noise: float,
        depth: float,
        cells: Cells,
        dust: NDArray[Any] | None = None,
    ) -> Self:
        """Look at ``(K, h, w)`` log I, before a field that is roughly `known`, as deep as `dust` makes it."""
        ratios = logs - known.astype(np.float32)
        outside = _outside(light.even(ratios)[0], noise, depth, dust)
        quiet = outside.mean(axis=0) >= _QUIET
        light = Light.over(quiet, cells, tilted=_is_tilted(ratios, quiet, noise, cells))
        evened, levels = light.even(ratios)
        direct, count = _mean_outside(evened, outside, known.shape)
        mean = known + direct
        degree = _degree(mean, count, cells)
        surface = _fit_surface(mean, count, degree, cells)
        field = surface.over(cells)
        known = field + _measured(mean - field, count, len(logs), noise)[0]
        return cls(light, levels, outside, evened, surface, degree, known)

    def field_of(self, sample: Sample, specks: list[Array] | None = None) -> _Field:
        """Return the field in pixels; with `specks` that are roughly known, or else any that there are."""
        surface = self.surface.over(Cells(self.light.cells.shape)).astype(np.float32)
        return _Field.of(_Residuals(sample, surface, self.light, self.levels), self.outside, specks)


@dataclass(frozen=True)
class _Surface:
    """A polynomial in both directions, as Chebyshev coefficients."""

    coefficients: Array

    def over(self, cells: Cells) -> Array:
        """Return the values in the middle of all cells."""
        rows, columns = (chebyshev.chebvander(x, len(self.coefficients) - 1) for x in axes(cells))
        return np.asarray(rows @ self.coefficients @ columns.T)


@dataclass(frozen=True)
class _Residuals:
    """What the frames of a sample show beyond a smooth field, pixel by pixel."""

    sample: Sample
    field: Stack
    light: Light
    levels: Array

    def __iter__(self) -> Iterator[Stack]:
        pixels = Cells(self.field.shape)
        for logs, level in zip(self.sample.logs(), self.levels, strict=True):
            logs -= self.field
            self.light.take_off(logs, level, pixels)
            yield logs


@dataclass(frozen=True)
class _Field:
    """The field pixel by pixel.

    Attributes
    ----------
    surface, pattern:
        ``(H, W)`` what is smooth, and what that lacks: what is measured beside the particle, and specks.
    specks, covered:
        Specks, and how many of them are under the particle.
    """

    surface: Stack
    pattern: Stack
    specks: list[Array]
    covered: int

    @classmethod
    def of(cls, residuals: _Residuals, outside: Bools, known: list[Array] | None) -> Self:
        """Measure what the particle leaves free; find the specks elsewhere, or fit those `known` again."""
        cells, count_of_frames = residuals.light.cells, len(outside)
        free = (_in_pixels(image, cells) for image in outside)
        hidden = _in_pixels(outside.mean(axis=0) < _DIRECT, cells)
        rows, columns = _around(hidden)
        height, width = hidden[rows, columns].shape
        step = max(1, -(-4 * count_of_frames * height * width // _SPECK_BYTES))
        kept = np.empty((-(-count_of_frames // step), height, width), np.float32)

        def keeping() -> Iterator[Stack]:
            for n, image in enumerate(residuals):
                if n % step == 0:
                    kept[n // step] = image[rows, columns]
                yield image

        direct, count = _mean_outside(keeping(), free, hidden.shape)
        noise = _noise_of_pixels(residuals)
        least = _DIRECT if known is None else _SELDOM
        pattern, measured = _measured(direct, count, count_of_frames, noise, least)
        if not hidden.any():
            return cls(residuals.field, pattern, [], 0)
        corner = np.array([rows.start, columns.start, 0, 0])
        believed, direct, count = measured[rows, columns], direct[rows, columns], count[rows, columns]
        if known is None:
            specks = find_specks(Standing.of(kept, noise), believed)
        else:
            often = count / count_of_frames
            standing = Standing.of(kept, noise, np.where(believed, direct, np.nan), often)
            specks = fit_again(standing, [speck - corner for speck in known])
        under, fitted = covered(specks, believed), render(specks, believed.shape)
        if known is None:
            # a pixel that looks free when the particle happens to make up for a speck deceives
            believed &= (np.abs(fitted) <= _FOOTPRINT) | (count >= _QUIET * count_of_frames)
        # what few frames measure is told better by the specks than by nothing
        more, _ = _measured(direct - fitted, count, count_of_frames, noise, least)
        pattern[rows, columns] = fitted + np.where(believed, more, 0)
        return cls(residuals.field, pattern, [speck + corner for speck in specks], under)


def grid(cells: Cells) -> tuple[int, ...]:
    """Return how many rows and columns of cells there are."""
    return tuple(size // cells.binning for size in cells.shape)


def axes(cells: Cells) -> list[Array]:
    """Return where the rows and the columns of cells lie, -1 … 1 from edge to edge of the frame."""
    b = cells.binning
    return [2 * (b * np.arange(size // b) + (b - 1) / 2) / max(size - 1, 1) - 1.0 for size in cells.shape]


def _in_pixels(values: NDArray[Any], cells: Cells) -> NDArray[Any]:
    """Return values of cells in all pixels; those that no cell holds are like their neighbours."""
    b = cells.binning
    rows, columns = (np.minimum(np.arange(size) // b, size // b - 1) for size in cells.shape)
    return np.asarray(values[:, columns][rows])


def _median(values: Array) -> float:
    """Return the upper median, without what makes `numpy.median` slow on few values."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _middle(stack: Stack) -> Array:
    """Return the median in time of each pixel that tells anything."""
    values: NDArray[Any] = np.ascontiguousarray(np.moveaxis(stack, 0, -1))
    told = np.isfinite(values)
    if told.all():
        return np.asarray(np.median(values, axis=-1, overwrite_input=True))
    some = told.any(axis=-1)
    middle = np.full(some.shape, np.nan)
    middle[some] = np.nanmedian(np.where(told, values, np.nan)[some], axis=-1)
    return middle


def _noise(logs: Stack, edge: Bools) -> float:
    """Return the standard deviation of the noise, from how neighbours at the border change in time.

    Neither a field that stays nor a smooth light that varies counts.
    """
    both = edge[:, 1:] & edge[:, :-1]
    some = logs[: max(2, _DIFFERENCES // max(1, int(both.sum())))]
    changes = np.diff(np.diff(some, axis=0), axis=2)[:, both]
    changes = changes[np.isfinite(changes)]
    return float(1.4826 * np.median(np.abs(changes)) / 2) if len(changes) else 0.0


def _outside(residual: Stack, noise: float, depth: float, dust: NDArray[Any] | None = None) -> Bools:
    """Tell which cells of each frame the particle leaves free, with a margin around it."""
    smooth = np.empty_like(residual)
    for image, raw in zip(smooth, residual, strict=True):
        ndimage.uniform_filter(np.nan_to_num(raw), _PATCH, output=image)
    peak = float(np.median([np.quantile(np.abs(image), 0.999) for image in smooth]))
    least = max(_CLEAR * noise, depth * peak)
    inside = np.abs(smooth) > least
    free = smooth[:, ~inside.any(axis=0)]
    usual = float(np.median(_scatter(free[:, :: max(1, free.shape[1] // _TYPICAL_CELLS)])))
    stuck = _stuck(inside, smooth, usual)
    if dust is not None:
        stuck |= _left_free(smooth, dust, least, usual)
    # where there is dust, what is darker than that alone is particle
    alone = np.quantile(smooth[:, stuck], _ALONE[0], axis=0)
    inside[:, stuck] = np.abs(smooth[:, stuck] - alone) > least
    reach = 2 * max(2, round(_MARGIN * min(residual.shape[1:]))) + 1
    for image in inside:
        image[:] = ndimage.maximum_filter(image, reach)
    return ~inside & np.isfinite(residual)


def _stuck(inside: Bools, smooth: Stack, usual: float) -> Bools:
    """Tell where there is dust, which is in all frames.

    It is small beside the particle, or it scatters no more than is `usual` while something else does.
    """
    labels, count = ndimage.label(inside.mean(axis=0) > _ALWAYS)
    sizes = np.bincount(labels.ravel())
    whole = float(np.median(inside.sum(axis=(1, 2))))
    stuck = sizes < _SMALL * whole
    # what little the particle always covers may be smaller than dust, but that it turns shows at its rim
    still = np.zeros(count + 1, bool)
    for label in range(1, count + 1):
        rim = ndimage.binary_dilation(labels == label, iterations=_PATCH // 2)
        still[label] = np.quantile(_scatter(smooth[:, rim]), _RIM) < _STILL * usual
    if (~still[1:] & ~stuck[1:]).any():
        stuck |= still & (sizes < _HALF * whole)
    stuck[0] = False
    return np.asarray(ndimage.binary_dilation(stuck[labels], iterations=_PATCH // 2))


def _left_free(smooth: Stack, dust: NDArray[Any], least: float, usual: float) -> Bools:
    """Tell where the particle at times leaves free dust that is roughly known: light, and still then.

    What is still all the time may be less well known: nothing covers it.
    """
    deep = ndimage.maximum_filter(dust, _PATCH)
    near: Bools = deep > least
    alone, lightest = np.quantile(smooth[:, near], _ALONE, axis=0)
    left = (np.abs(alone) < _MISFIT * deep[near]) & (lightest - alone < _STILL * usual)
    left |= (np.abs(alone) < deep[near]) & (_scatter(smooth[:, near]) < _NEVER * usual)
    near[near] = left
    return near


def _scatter(series: Stack) -> Array:
    """Return the standard deviations in time of ``(K, P)`` cells, told by the more usual half."""
    if not series.size:
        return np.full(max(1, series.shape[1]), np.inf)
    return np.asarray(1.4826 * np.median(np.abs(series - np.median(series, axis=0)), axis=0))


def _mean_outside(
    residual: Iterable[Stack], outside: Iterable[Bools], shape: tuple[int, ...]
) -> tuple[Stack, Stack]:
    """Return the mean over the frames in which a pixel is free and known, and their number."""
    total, count, weighted = np.zeros((3, *shape), np.float32)
    for image, free in zip(residual, outside, strict=True):
        if np.isfinite(image).all():
            np.multiply(image, free, out=weighted)
            total += weighted
            count += free
        else:
            told = free & np.isfinite(image)
            total += np.where(told, image, 0)
            count += told
    total /= np.maximum(count, 1)
    return total, count


def _fit_surface(values: Array, weights: NDArray[np.generic], degree: int, cells: Cells) -> _Surface:
    """Fit a polynomial surface to ``(h, w)`` values, without what does not belong to it."""
    stride = max(1, round(np.sqrt(values.size / _MOST_CELLS)))
    rising = [chebyshev.chebvander(axis, degree) for axis in axes(cells)]
    orders = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    square = np.zeros((degree + 1, degree + 1))
    rows, columns = np.nonzero(np.asarray(weights, dtype=float)[::stride, ::stride] > 0)
    if len(rows) < 3 * len(orders):
        square[0, 0] = float(np.nanmedian(values))
        return _Surface(square)
    rows, columns = rows * stride, columns * stride
    root = np.sqrt(np.asarray(weights, dtype=float)[rows, columns])
    basis = np.stack([rising[0][rows, i] * rising[1][columns, j] for i, j in orders], axis=1)
    directions, triangle = np.linalg.qr(basis * root[:, None])
    told = values[rows, columns] * root
    robust = np.ones(len(told))
    for _ in range(6):
        weighted = directions * (robust**2)[:, None]
        # of orthogonal columns the normal equations lose nothing
        found = np.linalg.lstsq(weighted.T @ directions, weighted.T @ told, rcond=None)[0]
        misfit = told - directions @ found
        limit = 4.685 * 1.4826 * np.median(np.abs(misfit)) + 1e-12
        robust = np.clip(1 - (misfit / limit) ** 2, 0, None)
    square[tuple(np.transpose(orders))] = np.linalg.lstsq(triangle, found, rcond=None)[0]
    return _Surface(square)


def _degree(mean: Array, count: Real, cells: Cells) -> int:
    """Return the degree whose fit to the field away from the particle best foretells the field beside it."""
    free = count >= _DIRECT * count.max()
    if free.all():
        return _DEGREES[1]
    distance = ndimage.distance_transform_edt(free)
    beside = free & (distance <= np.quantile(distance[free], 0.25))
    errors = []
    for degree in _DEGREES:
        surface = _fit_surface(mean, np.where(free & ~beside, count, 0), degree, cells).over(cells)
        misfit = np.abs(mean - surface)[beside]
        errors.append(float(np.sqrt(np.mean(np.minimum(misfit, 3 * np.median(misfit)) ** 2))))
    return _DEGREES[int(np.argmin(errors))]


def _measured(
    direct: Real, count: Real, frames: int, noise: float, least: float = _DIRECT
) -> tuple[Real, Bools]:
    """Return what the surface lacks where that is measured outside of the particle, and where it is."""
    measured = np.asarray(count >= max(least * frames, 1))
    scatter = noise / np.sqrt(np.maximum(count, 1))
    clear = measured & (np.abs(direct) > _SIGNIFICANT * scatter)
    faint = measured & ~clear
    excess = 1.4826 * float(np.median(np.abs(direct[faint]))) if faint.any() else 0.0
    usual = float(np.median(scatter[measured])) if measured.any() else 0.0
    spread = max(excess**2 - usual**2, 0.0)
    trust = np.where(clear, 1, spread / np.maximum(spread + scatter**2, _TINY))
    return np.where(measured, trust * direct, 0), measured


def _around(hidden: Bools) -> tuple[slice, slice]:
    """Return the rows and columns of what is hidden, and what is needed around it."""
    spans = []
    for axis in (1, 0):
        found = np.flatnonzero(hidden.any(axis=axis))
        first, last = (int(found[0]), int(found[-1])) if len(found) else (0, -1)
        spans.append(slice(max(0, first - MARGIN), last + 1 + MARGIN))
    return spans[0], spans[1]


def _noise_of_pixels(residuals: _Residuals) -> float:
    """Return the standard deviation of a pixel's noise, from the upper and the lower border."""
    edge = border(residuals.field.shape)
    rows = edge.all(axis=1)
    return _noise(np.array([image[rows] for image in islice(residuals, _NOISE_FRAMES)]), edge[rows])


def _is_tilted(ratios: Stack, quiet: Bools, noise: float, cells: Cells) -> bool:
    """Tell whether the light tilts from frame to frame, by more than the noise makes of a steady one."""
    light = Light.over(quiet, cells, tilted=True)
    tilts = np.array([light.fit(image)[1:] for image in ratios[:: len(ratios) // 32 or 1]])
    tilts = tilts[np.isfinite(tilts).all(axis=1)]
    if len(tilts) < 8:
        return False
    spread = 1.4826 * np.median(np.abs(tilts - np.median(tilts, axis=0)), axis=0)
    error = noise * np.sqrt(np.diag(np.linalg.pinv(light.basis.T @ light.basis)))[1:]
    return bool((spread > np.maximum(_SIGNIFICANT * error, _TILTED)).any())
