"""From lines to directions: φ as a continuous function of time, in one of the two mirror solutions.

The first-order equation knows the line of direction φ, not which way it points: φ and φ + π solve it alike,
which is the mirror ambiguity R ↔ ΣRΣ of the paper. Continuity in time leaves one choice for the whole
series.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MEMORY = 9  # reliable frames whose median the next one is compared with


def unwrap_directions(phi: Array, reliable: NDArray[np.bool_]) -> Array:
    """Make line directions continuous, in [0, π) at the first reliable frame.

    Parameters
    ----------
    phi:
        ``(N,)`` directions modulo π [rad]; NaN where not known.
    reliable:
        ``(N,)`` frames that decide; the others follow.

    Returns
    -------
    ndarray
        ``(N,)`` φ, NaN where `phi` is.
    """
    result = np.full(len(phi), np.nan)
    recent: list[float] = []
    known = np.flatnonzero(np.isfinite(phi))
    decisive = known[reliable[known]] if reliable[known].any() else known
    if len(decisive):
        recent.append(float(phi[decisive[0]] % np.pi))
    for n in known:
        result[n] = _nearest(float(phi[n]), float(np.median(recent)))
        if reliable[n]:
            recent = [*recent[1 - _MEMORY :], result[n]]
    return result


def _nearest(phi: float, target: float) -> float:
    """Return the angle equal to `phi` modulo π that is nearest to `target`."""
    return target + (phi - target + np.pi / 2) % np.pi - np.pi / 2
