"""The empty field of a stack whose particle never leaves its place.

A frame is I(t, x) = f(t) I₀(x) exp(−J(t, x)). Outside of the particle J is 0, so there log I − log f is
log I₀, seen in many frames: a smooth surface is fitted to all of it and carried on under the particle. What
is sharp in I₀ (dust, dirt) stays in place while the particle's projection moves and turns, which tells the
two apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy import ndimage

from trapcli.preprocess.specks import Standing, find_specks

Array = NDArray[np.float64]
Stack = NDArray[np.float32]
Bools = NDArray[np.bool_]

_BORDER = 0.04  # width of the border, as a share of the shorter edge
_DEGREES = (2, 4, 6)  # of the surface; the one that best foretells the field beside the particle is taken
_PATCH = 5  # edge of the mean in which the particle must stand out [pixels]
_LOOK = 2  # first round in which specks under the particle are looked for
_DEPTHS = (0.1, 0.05, 0.02, 0.02)  # least depth of the particle in each round, as a share of its peak
_CLEAR = 0.8  # the same in standard deviations of a pixel: 4 of the mean over a patch
_ALWAYS = 0.9  # share of the frames in which dust is seen
_SMALL = 0.1  # its area as a share of the particle's
_MARGIN = 0.04  # width of the doubtful ring around the particle, as a share of the shorter edge
_DIRECT = (
    0.25  # least share of frames in which a pixel that is measured directly lies outside of the particle
)
_SIGNIFICANT = 4.0  # standard deviations
_QUIET = 0.95  # share of frames in which a pixel that tells the brightness lies outside of the particle
_LEAST_QUIET = 0.02  # share of such pixels below which the border has to do
_FOOTPRINT = 1e-3  # depth down to which a speck counts
_TILTED = 0.003  # least tilt of the light, from the middle to the edge of a frame, that is taken out
_TYPICAL_PIXELS = 4096  # that tell what misfit is common among those
_MOST_PIXELS = 65536  # of a surface, and of a frame's brightness: enough for both


@dataclass(frozen=True)
class Light:
    """How bright each frame is, told by pixels that the particle leaves free.

    Attributes
    ----------
    pixels:
        ``(P,)`` those pixels, as positions in the flattened frame.
    basis:
        ``(P, B)`` values there of 1, or of 1, x1 and x2.
    surface:
        ``(B, H·W)`` the same in all pixels.
    """

    pixels: NDArray[np.intp]
    basis: Array
    surface: Array

    @classmethod
    def over(cls, free: Bools, *, tilted: bool = False) -> Light:
        """Use the pixels of a ``(H, W)`` mask; the border where they are too few."""
        if free.mean() < _LEAST_QUIET:
            free = border(free.shape)
        pixels = np.flatnonzero(free)
        pixels = pixels[:: -(-len(pixels) // _MOST_PIXELS)]
        x2, x1 = (axis.ravel() for axis in np.meshgrid(*map(_unit, free.shape), indexing="ij"))
        surface = np.stack([np.ones(free.size), x1, x2][: 3 if tilted else 1])
        return cls(pixels, surface[:, pixels].T, surface)

    def fit(self, log_ratio: NDArray[np.floating]) -> Array:
        """Return the ``(B,)`` coefficients of the light in ``(H, W)`` log(I / I₀); NaN where not known."""
        values = log_ratio.ravel()[self.pixels].astype(float)
        keep = np.isfinite(values)
        coefficients = np.full(self.basis.shape[1], np.nan)
        if np.count_nonzero(keep) < 3 * self.basis.shape[1]:
            return coefficients
        values, basis = (values, self.basis) if keep.all() else (values[keep], self.basis[keep])
        some = slice(None, None, max(1, len(values) // _TYPICAL_PIXELS))
        misfit = values - np.median(values[some])
        for _ in range(2):
            near = np.abs(misfit) <= 3 * 1.4826 * np.median(np.abs(misfit[some])) + 1e-12
            if self.basis.shape[1] == 1:
                coefficients = np.array([near.astype(float) @ values / np.count_nonzero(near)])
            else:
                coefficients = np.linalg.lstsq(basis[near], values[near], rcond=None)[0]
            misfit = values - (coefficients if len(coefficients) == 1 else basis @ coefficients)
        return coefficients

    def of(self, coefficients: Array, shape: tuple[int, ...]) -> Array:
        """Return the light in all pixels, or what is added to all alike."""
        if len(coefficients) == 1:
            return coefficients
        return np.asarray((coefficients @ self.surface).reshape(shape))

    def even(self, logs: Stack, field: Array) -> Stack:
        """Return ``(K, H, W)`` log(I / I₀) without each frame's light; all NaN where nothing tells it."""
        evened, single = np.empty_like(logs), field.astype(np.float32)
        for image, log in zip(evened, logs, strict=True):
            np.subtract(log, single, out=image)
            image -= self.of(self.fit(image), image.shape).astype(np.float32)
        return evened


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
        ``(H, W)`` share of the frames in which a pixel lies outside of the particle.
    degree, specks:
        Of the surface; number of specks found under the particle.
    """

    log_light: Array
    light: Light
    outside: Array
    degree: int
    specks: int


def border(shape: tuple[int, ...]) -> Bools:
    """Return the mask of a frame's border."""
    width = max(2, round(_BORDER * min(shape)))
    mask = np.ones(shape, bool)
    mask[width:-width, width:-width] = False
    return mask


def median_field(logs: Stack) -> Array:
    """Return the median in time of ``(K, H, W)`` log I, made equally bright at the border."""
    return _middle(Light.over(border(logs.shape[1:])).even(logs, np.zeros(logs.shape[1:])))


def fit_empty_field(logs: Stack) -> EmptyField:
    """Find the field without the particle in frames that all show it.

    Parameters
    ----------
    logs:
        ``(K, H, W)`` log I of frames spread over the stack; NaN where a pixel tells nothing.

    Returns
    -------
    EmptyField
        Where the particle is never away the field is a polynomial in log I₀ plus the specks that stay in
        place; elsewhere it is measured as far as the noise allows.
    """
    edge = border(logs.shape[1:])
    light = Light.over(edge)
    common = _middle(light.even(logs, np.zeros(logs.shape[1:])))
    field = _surface(common, edge & np.isfinite(common), 2)
    noise = _noise(logs, edge)
    degree, pattern, specks = 2, np.zeros(field.shape), 0
    outside = np.ones(logs.shape, bool)
    for step, depth in enumerate(_DEPTHS):
        residual = light.even(logs, field + pattern)
        outside = _outside(residual, noise, depth)
        quiet = outside.mean(axis=0) >= _QUIET
        tilted = _is_tilted(logs, field + pattern, quiet, noise)
        light = Light.over(quiet, tilted=tilted)
        mean, count = _mean_outside(light.even(logs, field + pattern), outside)
        mean += field + pattern
        degree = _degree(mean, count)
        field = _surface(mean, count, degree)
        pattern, specks = _pattern(
            light.even(logs, field),
            mean - field,
            count,
            noise,
            look=step >= _LOOK,
        )
    return EmptyField(field + pattern, light, outside.mean(axis=0), degree, specks)


def _unit(size: int) -> Array:
    return np.linspace(-1.0, 1.0, size)


def _middle(stack: NDArray[np.floating]) -> Array:
    """Return the median in time of each pixel that tells anything, row by row to save memory."""
    middle = np.full(stack.shape[1:], np.nan)
    for row in range(stack.shape[1]):
        values = stack[:, row].astype(np.float32)
        told = np.isfinite(values)
        if told.all():
            middle[row] = np.median(values, axis=0)
        else:
            some = told.any(axis=0)
            middle[row, some] = np.nanmedian(values[:, some], axis=0)
    return middle


def _noise(logs: Stack, edge: Bools) -> float:
    """Return the standard deviation of a pixel, from differences of neighbours at the border."""
    both = edge[:, 1:] & edge[:, :-1]
    differences = np.diff(logs, axis=2)[:, both]
    differences = differences[np.isfinite(differences)]
    if not len(differences):
        return 0.0
    return float(1.4826 * np.median(np.abs(differences - np.median(differences))) / np.sqrt(2))


def _outside(residual: Stack, noise: float, depth: float) -> Bools:
    """Tell which pixels of each frame the particle leaves free, with a margin around it."""
    smooth = np.empty_like(residual)
    for image, raw in zip(smooth, residual, strict=True):
        ndimage.uniform_filter(np.nan_to_num(raw), _PATCH, output=image)
    np.abs(smooth, out=smooth)
    peak = float(np.median([np.quantile(image, 0.999) for image in smooth]))
    inside = smooth > max(_CLEAR * noise, depth * peak)
    inside &= ~_stuck(inside)
    reach = 2 * max(2, round(_MARGIN * min(residual.shape[1:]))) + 1
    for image in inside:
        image[:] = ndimage.maximum_filter(image, reach)
    return ~inside & np.isfinite(residual)


def _stuck(inside: Bools) -> Bools:
    """Tell what is in all frames and small beside the particle: dust, which would hide what it covers."""
    labels, _ = ndimage.label(inside.mean(axis=0) > _ALWAYS)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    small = (sizes > 0) & (sizes < _SMALL * np.median(inside.sum(axis=(1, 2))))
    return np.asarray(small[labels])


def _mean_outside(residual: Stack, outside: Bools) -> tuple[Array, Array]:
    """Return the mean over the frames in which a pixel is free, and their number."""
    count = outside.sum(axis=0, dtype=float)
    total = np.zeros(count.shape)
    for image, free in zip(residual, outside, strict=True):
        np.add(total, image, out=total, where=free)
    return total / np.maximum(count, 1), count


def _surface(values: Array, weights: NDArray[np.generic], degree: int) -> Array:
    """Fit a polynomial surface to ``(H, W)`` values, without what does not belong to it."""
    stride = max(1, round(np.sqrt(values.size / _MOST_PIXELS)))
    axes = [chebyshev.chebvander(_unit(size), degree) for size in values.shape]
    orders = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    rows, columns = np.nonzero(np.asarray(weights, dtype=float)[::stride, ::stride] > 0)
    if len(rows) < 3 * len(orders):
        return np.full(values.shape, float(np.nanmedian(values)))
    rows, columns = rows * stride, columns * stride
    basis = np.stack([axes[0][rows, i] * axes[1][columns, j] for i, j in orders], axis=1)
    told, root = values[rows, columns], np.sqrt(np.asarray(weights, dtype=float)[rows, columns])
    robust = np.ones(len(told))
    for _ in range(6):
        scale = root * robust
        coefficients = np.linalg.lstsq(basis * scale[:, None], told * scale, rcond=None)[0]
        misfit = (told - basis @ coefficients) * root
        limit = 4.685 * 1.4826 * np.median(np.abs(misfit)) + 1e-12
        robust = np.clip(1 - (misfit / limit) ** 2, 0, None)
    square = np.zeros((degree + 1, degree + 1))
    square[tuple(np.transpose(orders))] = coefficients
    return np.asarray(axes[0] @ square @ axes[1].T)


def _degree(mean: Array, count: Array) -> int:
    """Return the degree whose fit to the field away from the particle best foretells the field beside it."""
    free = count >= _DIRECT * count.max()
    if free.all():
        return _DEGREES[1]
    distance = ndimage.distance_transform_edt(free)
    beside = free & (distance <= np.quantile(distance[free], 0.25))
    errors = []
    for degree in _DEGREES:
        misfit = np.abs(mean - _surface(mean, np.where(free & ~beside, count, 0), degree))[beside]
        errors.append(float(np.sqrt(np.mean(np.minimum(misfit, 3 * np.median(misfit)) ** 2))))
    return _DEGREES[int(np.argmin(errors))]


def _pattern(residual: Stack, direct: Array, count: Array, noise: float, look: bool) -> tuple[Array, int]:
    """Return what the surface lacks: what is measured outside of the particle, and specks under it."""
    measured = count >= _DIRECT * len(residual)
    scatter = noise / np.sqrt(np.maximum(count, 1))
    clear = measured & (np.abs(direct) > _SIGNIFICANT * scatter)
    excess = np.median(np.abs(direct[measured & ~clear])) if (measured & ~clear).any() else 0.0
    spread = max(
        (1.4826 * excess) ** 2 - float(np.median(scatter[measured]) if measured.any() else 0) ** 2, 0
    )
    trust = np.where(clear, 1.0, spread / np.maximum(spread + scatter**2, 1e-300))
    pattern = np.where(measured, trust * direct, 0.0)
    if not look:
        return pattern, 0
    specks, number = find_specks(Standing.of(residual, noise), measured)
    # a pixel that looks free when the particle happens to make up for a speck deceives
    fitted = (np.abs(specks) > _FOOTPRINT) & (count < _QUIET * len(residual))
    return np.where(measured & ~fitted, pattern, specks), number


def _is_tilted(logs: Stack, field: Array, quiet: Bools, noise: float) -> bool:
    """Tell whether the light tilts from frame to frame, by more than the noise makes of a steady one."""
    light = Light.over(quiet, tilted=True)
    tilts = np.array([light.fit(image - field)[1:] for image in logs])
    tilts = tilts[np.isfinite(tilts).all(axis=1)]
    if len(tilts) < 8:
        return False
    spread = 1.4826 * np.median(np.abs(tilts - np.median(tilts, axis=0)), axis=0)
    error = noise * np.sqrt(np.diag(np.linalg.pinv(light.basis.T @ light.basis)))[1:]
    return bool((spread > np.maximum(_SIGNIFICANT * error, _TILTED)).any())
