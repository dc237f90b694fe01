"""Time derivatives of the whole reduced map: windows for each group of rings and the errors they leave."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.angular import RingErrors
from trapcli.motion.reduced_map import MARGIN
from trapcli.motion.time_derivatives import TimeFilter, choose_filters, difference_noise
from trapcli.motion.types import ReducedMap

Array = NDArray[np.float64]

ORDERS = (0, 1, 2)
"""J̃ itself, smoothed, and its first two time derivatives."""

_GROUPS = 4  # groups of rings that have windows of their own: the map changes faster at high μ
_SERIES = 12  # series of a group on which its windows are chosen
_WHITE = 2.0  # noise between pixels over noise between frames (variances) up to which it is white in time
_LEAST = 1e-150  # smallest error, whose square is still a number


@dataclass(frozen=True)
class MapDerivatives:
    """How to differentiate a reduced map in time.

    Attributes
    ----------
    step:
        Time between frames.
    groups:
        Rings that share their windows.
    filters:
        For each group the filters for J̃, ∂tJ̃ and ∂ttJ̃.
    errors:
        What errors they leave far from the ends.
    decisive:
        The group that shows the motion best.
    """

    step: float
    groups: list[slice]
    filters: list[tuple[TimeFilter, ...]]
    errors: RingErrors
    decisive: int

    def apply(self, reduced: ReducedMap, frames: range) -> list[NDArray[Any]]:
        """Return J̃, ∂tJ̃ and ∂ttJ̃ of some frames, ``(n, M, L)`` each; NaN where too few frames are known."""
        valid = np.isfinite(reduced.samples[:, 0, 0])
        return [
            np.concatenate(
                [
                    filters[order].apply(reduced.samples[:, group], self.step, valid, frames)
                    for group, filters in zip(self.groups, self.filters, strict=True)
                ],
                axis=1,
            )
            for order in ORDERS
        ]

    def inflation(self, n: int, order: int) -> Array:
        """Return the ``(n,)`` errors of a derivative in units of those far from the ends."""
        gains = self.filters[self.decisive][order].gains(n)
        ratio: Array = np.maximum(gains / gains[n // 2], 1.0)
        return ratio

    def rate_kernel(self, n: int) -> Array:
        """Return the weights that make ∂tJ̃ in the middle of `n` frames."""
        middle = range(n // 2, n // 2 + 1)
        _, weights = next(self.filters[self.decisive][1].rows(n, frames=middle))
        return weights


def choose_map_derivatives(reduced: ReducedMap, *, window: int = 0) -> MapDerivatives:
    """Choose the windows for the time derivatives of a reduced map from the map itself.

    Parameters
    ----------
    reduced:
        The map of N frames, evenly spaced in time; NaN in blank frames.
    window:
        Fixes the width of all windows [frames]; 0 chooses it too.
    """
    n, rings, lines = reduced.samples.shape
    step = float(np.median(np.diff(reduced.time)))
    edges = np.linspace(0, rings, min(_GROUPS, rings) + 1).round().astype(int)
    groups = [slice(a, b) for a, b in pairwise(edges)]
    filters, clarity = [], []
    errors = np.empty((len(ORDERS), rings))
    for group in groups:
        series = reduced.samples[:, group].reshape(n, -1)
        noise = difference_noise(series[:, :: max(1, lines // 16)])
        series = series[:, :: max(1, series.shape[1] // _SERIES)]
        filters.append(choose_filters(series, ORDERS, noise=noise, width=window))
        errors[:, group] = _errors(series, filters[-1], noise, reduced.noise, step)[:, None]
        change = series - np.nanmean(series, axis=0)
        clarity.append(_rms(change) / max(filters[-1][1].error, np.finfo(float).tiny))
    # an error of 0, in a series of zeros, must not have infinite weight
    errors = np.maximum(errors, np.finfo(float).eps * errors.max(axis=1, keepdims=True) + _LEAST)
    share = min(1.0, float(reduced.mu[1] - reduced.mu[0]) * reduced.radius / np.pi)
    ring_errors = RingErrors(
        reduced.mu,
        MARGIN * reduced.radius,
        value=errors[0],
        rate=errors[1],
        acceleration=errors[2],
        share=share,
    )
    return MapDerivatives(step, groups, filters, ring_errors, int(np.argmax(clarity)))


def _errors(
    series: NDArray[Any], filters: tuple[TimeFilter, ...], noise: float, pixel_noise: float, step: float
) -> Array:
    """Return the ``(3,)`` errors of J̃, ∂tJ̃ and ∂ttJ̃ of a group of rings."""
    errors = np.array([f.error for f in filters])
    # noise between pixels beyond that between frames lasts: it is of the object and changes at its pace
    lasting = np.sqrt(max(pixel_noise**2 - _WHITE * noise**2, 0.0))
    pace = np.array([_rms(f.apply(series, 1.0)) for f in filters])
    errors = np.hypot(errors, lasting * pace / max(pace[0], _LEAST))
    per_time: Array = errors / step ** np.arange(len(ORDERS))
    return per_time


def _rms(series: NDArray[Any]) -> float:
    return float(np.sqrt(np.nanmean(np.abs(series) ** 2)))
