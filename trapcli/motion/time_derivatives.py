"""Time derivatives of noisy series by local polynomials, with windows chosen from the data.

A derivative at a frame is that of the least-squares polynomial through a window of frames around it
(Savitzky and Golay). Short windows of high degree are finite differences and suit exact data; long windows
suit noisy data. Which one is best is measured: the variance follows from the noise and the weights, the
squared bias from what a polynomial of higher degree sees differently in the same window.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WIDTHS = (3, 5, 7, 9, 11, 13, 17, 21, 27, 35, 45, 57, 73, 93, 119, 153, 195, 249, 319, 407, 521)
"""Widths of the windows that are tried [frames]."""

ROOMS = (0, 1, 2, 4, 8, 16, 32, 64, 128, 256)
"""Distances to the nearer end of the series for which windows are chosen separately [frames]."""

MAX_DEGREE = 10
"""Highest degree that is tried."""

_SAMPLES = 512  # windows, over all series and places, on which the bias is measured
_BIAS_DECIDES = 4.0  # squared bias over variance beyond which a degree is not tried with wider windows
_WIDENED = 1.5  # how far a window may widen to make up for missing frames
_BLOCK = 64  # frames per matrix product


@dataclass(frozen=True)
class Window:
    """A local polynomial of `degree` through `width` frames."""

    degree: int
    width: int


@dataclass(frozen=True)
class TimeFilter:
    """A derivative of given order in time, as windows for each distance from the ends.

    Attributes
    ----------
    order:
        Order of the derivative; 0 smooths.
    rooms:
        Ascending distances from the nearer end, the first 0 [frames].
    windows:
        The window for frames at least that far from the ends.
    error:
        Root mean square error, noise and bias together, far from the ends [per frame^order].
    """

    order: int
    rooms: tuple[int, ...]
    windows: tuple[Window, ...]
    error: float

    def window(self, room: int) -> Window:
        """Return the window for a frame `room` frames away from the nearer end."""
        return self.windows[int(np.searchsorted(self.rooms, room, side="right")) - 1]

    def rows(
        self, n: int, valid: NDArray[np.bool_] | None = None, frames: range | None = None
    ) -> Iterator[tuple[int, Array]]:
        """Yield where the window of each frame starts and its weights.

        Parameters
        ----------
        n:
            Length of the series.
        valid:
            ``(n,)`` frames that may be used (default: all); where too few are, the weights are empty.
        frames:
            Frames to yield (default: all).
        """
        known = np.arange(n) if valid is None else np.flatnonzero(valid)
        for frame in range(n) if frames is None else frames:
            window = self.window(min(frame, n - 1 - frame))
            width = min(window.width, n)
            degree = min(window.degree, width - 1)
            start = min(max(frame - width // 2, 0), n - width)
            if degree < self.order:
                yield start, np.empty(0)
            elif valid is None or valid[start : start + width].all():
                yield start, _weights(start - frame, width, degree, self.order)
            else:
                yield _gapped_weights(frame, known, width, degree, self.order)

    def apply(
        self,
        series: NDArray[Any],
        step: float,
        valid: NDArray[np.bool_] | None = None,
        frames: range | None = None,
    ) -> NDArray[Any]:
        """Return the derivative of a series along its first axis.

        Parameters
        ----------
        series:
            ``(n, ...)`` real or complex.
        step:
            Time between frames.
        valid:
            ``(n,)`` frames that may be used (default: those without NaN).
        frames:
            Consecutive frames where the derivative is wanted (default: all).

        Returns
        -------
        ndarray
            One entry for each of `frames`; NaN where too few frames of its window are valid.
        """
        n = len(series)
        wanted = range(n) if frames is None else frames
        if valid is None:
            valid = np.isfinite(series.reshape(n, -1)).all(axis=1)
        rows = list(self.rows(n, None if valid.all() else valid, wanted))
        result = np.full((len(wanted), *series.shape[1:]), np.nan, series.dtype)
        for first in range(0, len(rows), _BLOCK):
            block = rows[first : first + _BLOCK]
            known = [len(weights) > 0 for _, weights in block]
            if any(known):
                low = min(start for start, _ in block)
                high = max(start + len(weights) for start, weights in block)
                matrix = np.zeros((len(block), high - low), series.real.dtype)
                for i, (start, weights) in enumerate(block):
                    matrix[i, start - low : start - low + len(weights)] = weights
                result[first : first + _BLOCK][known] = _product(
                    matrix[known], series[low:high], valid[low:high]
                )
        return result / step**self.order

    def gains(self, n: int, correlation: Array | None = None) -> Array:
        """Return the ``(n,)`` errors [per frame^order] that noise of unit standard deviation causes.

        Parameters
        ----------
        correlation:
            ``(K,)`` weights of the filter that white noise has passed before (default: white noise).
        """
        kernel = _unit_kernel(correlation)
        return np.array([np.sqrt(_gain(w, kernel)) if len(w) else np.nan for _, w in self.rows(n)])


def choose_filters(
    series: NDArray[Any],
    orders: Sequence[int],
    *,
    noise: float | None = None,
    correlation: Array | None = None,
    width: int = 0,
) -> tuple[TimeFilter, ...]:
    """Choose for each order of derivative the windows of least mean square error.

    Parameters
    ----------
    series:
        ``(n, K)`` K series that share their windows; frames with NaN are passed over.
    orders:
        Orders of the derivatives.
    noise:
        Standard deviation of one sample's noise (default: measured by `difference_noise`).
    correlation:
        Weights of the filter that white noise has passed before it came into the series.
    width:
        Fixes the width of all windows [frames]; 0 chooses it too.

    Returns
    -------
    tuple of TimeFilter
        Ends get windows of their own, judged by how such one-sided windows do elsewhere in the series.
    """
    noise = difference_noise(series) if noise is None else noise
    trial = _Trial(series, noise, _unit_kernel(correlation), width and width | 1)
    filters = []
    for order in orders:
        central, error = trial.best(order, (len(series),))
        rooms = [room for room in ROOMS if room < central.width // 2]
        # a window serves all frames up to the next room
        windows = [trial.best(order, (room, max(room, 2 * room - 1)))[0] for room in rooms]
        filters.append(TimeFilter(order, (*rooms, central.width // 2), (*windows, central), error))
    return tuple(filters)


def difference_noise(series: NDArray[Any]) -> float:
    """Return the standard deviation of the white noise in an ``(n, K)`` series, from its differences in time.

    A signal that is smooth in time cancels in differences of high order while white noise does not;
    whatever order leaves least (at unit gain for white noise) is nearest to the noise alone.
    """
    least = np.inf
    difference = series
    for order in range(2, 21, 2):
        difference = np.diff(difference, 2, axis=0)
        power = np.mean(np.abs(difference) ** 2, axis=1) / comb(2 * order, order)
        power = power[np.isfinite(power)]
        if len(power):
            least = min(least, float(np.median(power)))
    return float(np.sqrt(least)) if np.isfinite(least) else 0.0


@dataclass
class _Trial:
    """Tries windows on a series; pieces of the series are cut once for all orders."""

    series: NDArray[Any]
    noise: float
    kernel: Array | None
    fixed_width: int
    _cut: dict[int, NDArray[Any]] = field(default_factory=dict)

    def best(self, order: int, rooms: tuple[int, ...]) -> tuple[Window, float]:
        """Return the window of least mean square error for frames with such rooms, and that error."""
        n = len(self.series)
        best, least = Window(order, min(n, order + 1 + order % 2)), np.inf
        closed: set[int] = set()
        for width in [w for w in WIDTHS if w <= n] if self.fixed_width == 0 else [min(self.fixed_width, n)]:
            before = sorted({min(room, width // 2) for room in rooms})
            central = before == [width // 2]
            # in a centred window the next higher degree of the other parity has the same weights
            degrees = [
                d
                for d in range(order, min(MAX_DEGREE, width - 1) + 1, 2 if central else 1)
                if d not in closed
            ]
            figures = np.array([self._figures(order, width, degrees, b, central) for b in before])
            for degree, (variance, power, expected) in zip(degrees, figures.mean(axis=0).T, strict=True):
                bias = max(0.0, power - expected)
                if bias + variance < least:
                    best, least = Window(degree, width), bias + variance
                # in wider windows both degrees may fail alike, which would look like a small bias
                if bias > _BIAS_DECIDES * max(variance, expected):
                    closed.add(degree)
        return best, float(np.sqrt(least))

    def _figures(self, order: int, width: int, degrees: list[int], before: int, central: bool) -> Array:
        """Return ``(3, D)``: variance, and power seen and expected of the difference from a higher degree."""
        # where the window is lopsided the bias begins with the very next degree
        further = 2 if 4 * before >= width else 1
        weights = [_weights(-before, width, degree, order) for degree in degrees]
        differences = [
            _against_higher_degree(w, before, d + further, order)
            for w, d in zip(weights, degrees, strict=True)
        ]
        variance, expected = (
            [self.noise**2 * _gain(f, self.kernel) for f in bank] for bank in (weights, differences)
        )
        return np.array([variance, self._mean_squares(differences, one_sided=not central), expected])

    def _mean_squares(self, filters: list[Array], one_sided: bool) -> list[float]:
        """Return the mean square of what each filter gives; infinite for filters longer than the series.

        One-sided filters are needed at the ends, forwards and backwards: what they give there counts if it
        is more.
        """
        powers = [np.inf] * len(filters)
        for length in {len(f) for f in filters if len(f) <= len(self.series)}:
            same = [i for i, f in enumerate(filters) if len(f) == length]
            bank = np.stack([filters[i] for i in same])
            pieces = self._segments(length)
            if not pieces.size:
                continue
            outcome = [_mean_power(bank, pieces)]
            if one_sided:
                outcome[0] = (outcome[0] + _mean_power(bank[:, ::-1], pieces)) / 2
                first, last = pieces[:, :1], pieces[:, -1:]
                outcome.append((_mean_power(bank, first) + _mean_power(bank[:, ::-1], last)) / 2)
            for i, value in zip(same, np.max(outcome, axis=0), strict=True):
                powers[i] = float(value)
        return powers

    def _segments(self, width: int) -> NDArray[Any]:
        """Return ``(width, P, K)`` pieces spread over the series from end to end, those without NaN."""
        if width not in self._cut:
            n, k = self.series.shape
            starts = np.unique(np.linspace(0, n - width, max(16, _SAMPLES // k)).astype(int))
            pieces = self.series[starts + np.arange(width)[:, None]]
            self._cut[width] = np.ascontiguousarray(pieces[:, np.isfinite(pieces).all(axis=(0, 2))])
        return self._cut[width]


def _against_higher_degree(weights: Array, before: int, higher: int, order: int) -> Array:
    """Return the weights of a higher degree, in a wider window if it needs one, less `weights`."""
    width = len(weights)
    wider = max(width, higher + 1)
    start = -before
    if wider > width and 2 * before + 1 == width:
        wider += 1 - wider % 2
        start = -(wider // 2)
    difference = _weights(start, wider, higher, order).copy()
    difference[-before - start : -before - start + width] -= weights
    return difference


def _mean_power(bank: Array, pieces: NDArray[Any]) -> Array:
    """Return the mean square of the outcome of D filters, ``(D, width)``, on ``(width, P, K)`` pieces."""
    power: Array = np.mean(np.abs(bank @ pieces.reshape(len(pieces), -1)) ** 2, axis=1)
    return power


def _product(matrix: Array, series: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[Any]:
    """Multiply a real matrix with a series of which the frames that are not valid count as 0."""
    flat = np.ascontiguousarray(series).reshape(len(series), -1)
    if not valid.all():
        flat = np.where(valid[:, None], flat, 0)
    product = matrix @ flat.view(matrix.dtype)
    return product.view(flat.dtype).reshape(len(matrix), *series.shape[1:])


def _unit_kernel(correlation: Array | None) -> Array | None:
    return None if correlation is None else correlation / np.linalg.norm(correlation)


def _gain(weights: Array, kernel: Array | None) -> float:
    """Return the variance after a filter of noise that was white, of unit variance, before the kernel."""
    effective = weights if kernel is None else np.convolve(weights, kernel)
    return float(effective @ effective)


@lru_cache(maxsize=8192)
def _weights(start: int, width: int, degree: int, order: int) -> Array:
    """Return what `fit_weights` does for a window without gaps; windows of a width share a factorisation."""
    q, r = _orthogonal(width, degree)
    weights: Array = q @ np.linalg.solve(r.T, _derivative_at_zero(start, start + width - 1, degree, order))
    weights.flags.writeable = False
    return weights


@lru_cache(maxsize=1024)
def _orthogonal(width: int, degree: int) -> tuple[Array, Array]:
    return np.linalg.qr(_basis(np.arange(width), degree))


def _basis(offsets: NDArray[np.int64], degree: int) -> Array:
    """Return Legendre polynomials on the window, which keep the fit well conditioned at any degree."""
    middle, half = _interval(offsets[0], offsets[-1])
    basis: Array = np.polynomial.legendre.legvander((offsets - middle) / half, degree)
    return basis


def _derivative_at_zero(first: int, last: int, degree: int, order: int) -> Array:
    middle, half = _interval(first, last)
    value = np.polynomial.legendre.legval(-middle / half, _legendre_derivatives(degree, order))
    return np.asarray(value / half**order)


@lru_cache(maxsize=128)
def _legendre_derivatives(degree: int, order: int) -> Array:
    return np.asarray(np.polynomial.legendre.legder(np.eye(degree + 1), order))


def _interval(first: int, last: int) -> tuple[float, float]:
    return (last + first) / 2, max((last - first) / 2, 1.0)


def _gapped_weights(
    frame: int, known: NDArray[np.intp], width: int, degree: int, order: int
) -> tuple[int, Array]:
    """Return start and weights of a window of the `width` known frames around `frame`."""
    place = int(np.searchsorted(known, frame))
    first = min(max(place - width // 2, 0), max(len(known) - width, 0))
    chosen = known[first : first + width]
    found = place < len(known) and known[place] == frame
    if not found or len(chosen) <= degree or chosen[-1] - chosen[0] > _WIDENED * width:
        return frame, np.empty(0)
    weights = np.zeros(chosen[-1] - chosen[0] + 1)
    weights[chosen - chosen[0]] = fit_weights(chosen - frame, degree, order)
    return int(chosen[0]), weights


def fit_weights(offsets: NDArray[np.int64], degree: int, order: int) -> Array:
    """Return the weights that give a derivative of the least-squares polynomial at offset 0.

    Parameters
    ----------
    offsets:
        ``(K,)`` ascending positions of the frames relative to where the derivative is wanted, K > `degree`.
    degree:
        Degree of the polynomial.
    order:
        Order of the derivative, at most `degree`.

    Returns
    -------
    ndarray
        ``(K,)`` weights; the derivative is per frame to the power `order`.
    """
    q, r = np.linalg.qr(_basis(offsets, degree))
    at_zero = _derivative_at_zero(int(offsets[0]), int(offsets[-1]), degree, order)
    weights: Array = q @ np.linalg.solve(r.T, at_zero)
    return weights
