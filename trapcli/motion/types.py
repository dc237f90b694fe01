"""The one data type between the front end (frames) and the rotation stage: the reduced attenuation map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complexfloating]

UNKNOWN_ROTATION = float(np.deg2rad(20.0))
"""Error of R, 1 σ, beyond which a frame's orientation is not known [rad]."""


@dataclass(frozen=True)
class ReducedMap:
    """Reduced attenuation map J̃ on a polar grid (``eqRecMapReduced``).

    ``samples[n, i, j] = F₂[J](t_n, μ_i v(φ_j)) · exp(i⟨μ_i v(φ_j), C₂(t_n)⟩)`` with
    ``F₂[f](k) = (2π)⁻¹ ∫ f(x) exp(−i⟨k, x⟩) dx``; J̃(−k) is the complex conjugate of J̃(k), so half a
    turn of φ is all.

    Attributes
    ----------
    samples:
        ``(N, M, L)`` complex.
    mu:
        ``(M,)`` ascending, positive, evenly spaced from ``mu[0] = Δμ`` [rad / length].
    phi:
        ``(L,)`` evenly spaced in [0, π) [rad].
    time:
        ``(N,)`` [s, or frames].
    noise:
        Standard deviation of the noise of one (complex) sample, ``sqrt(E|n|²)``; same unit as `samples`.
    radius:
        Radius of the object's support [length]; samples closer than about π / radius are correlated.
    """

    samples: ComplexArray
    mu: Array
    phi: Array
    time: Array
    noise: float
    radius: float
