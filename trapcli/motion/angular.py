"""Values and derivatives of the reduced map between its grid angles, spectrally.

On a ring of radius μ the map is a trigonometric polynomial in φ: half a turn of samples is all there is,
since J̃(−k) is the conjugate of J̃(k). So the real part repeats after π and the imaginary part changes its
sign.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


# mean of |∂φ^q exp(−i⟨k, x⟩)|² over a disc, for q = 0 … 3, as polynomials in (|k| · radius)²
_DISC_POWERS = ((1.0,), (0.0, 1 / 4), (0.0, 1 / 4, 1 / 8), (0.0, 1 / 4, 5 / 8, 5 / 64))


@dataclass(frozen=True)
class RingErrors:
    """Standard deviations of the map and its time derivatives, ring by ring.

    Attributes
    ----------
    mu:
        ``(M,)`` radii of the rings [rad / length].
    radius:
        Radius of the disc that the pixels and their noise come from [length].
    value, rate, acceleration:
        ``(M,)`` of J̃, ∂tJ̃ and ∂ttJ̃.
    share:
        Share of the rings that are independent.
    """

    mu: Array
    radius: float
    value: Array
    rate: Array
    acceleration: Array
    share: float = 1.0

    def gain(self, order: int) -> Array:
        """Return ``(M,)`` by how much ∂φ^order raises the noise of pixels in a disc."""
        power = np.polynomial.polynomial.polyval((self.mu * self.radius) ** 2, np.array(_DISC_POWERS[order]))
        return np.asarray(np.sqrt(power))


def interpolation_weights(phi: Array, size: int, orders: tuple[int, ...]) -> tuple[Array, Array]:
    """Return what to multiply the grid values of a ring with to get values and derivatives at other angles.

    Parameters
    ----------
    phi:
        ``(...)`` angles [rad].
    size:
        L, the number of grid angles in [0, π).
    orders:
        Q orders of ∂φ; 0 is the value.

    Returns
    -------
    even, odd:
        ``(..., L, Q)`` weights for the real and for the imaginary part.
    """
    frequency = np.arange(size + 1)
    grid = np.arange(size) * np.pi / size
    # each ±n pair once, doubled; the highest is shared between +L and −L
    share = np.where((frequency == 0) | (frequency == size), 1.0, 2.0) / size
    turn = np.exp(1j * np.multiply.outer(phi, frequency))
    back = np.exp(-1j * np.multiply.outer(frequency, grid))
    weights = []
    for parity in (0, 1):
        chosen = frequency % 2 == parity
        powers = [share[chosen] * (1j * frequency[chosen]) ** q for q in orders]
        weights.append(np.stack([((turn[..., chosen] * p) @ back[chosen]).real for p in powers], axis=-1))
    return weights[0], weights[1]


def on_lines(samples: NDArray[Any], phi: Array, orders: tuple[int, ...]) -> NDArray[np.complex128]:
    """Return ∂φ^q J̃ on lines of any direction.

    Parameters
    ----------
    samples:
        ``(n, M, L)`` polar samples of n frames.
    phi:
        ``(n, C)`` directions of C lines in each frame [rad].
    orders:
        Q orders q.

    Returns
    -------
    ndarray
        ``(n, C, M, Q)``.
    """
    n, rings, size = samples.shape
    even, odd = (np.moveaxis(w, 2, 1).reshape(n, size, -1) for w in interpolation_weights(phi, size, orders))
    values = samples.real @ even + 1j * (samples.imag @ odd)
    return np.moveaxis(values.reshape(n, rings, phi.shape[1], len(orders)), 2, 1)


def on_grid(samples: NDArray[Any], phi: Array, order: int) -> NDArray[np.complex128]:
    """Return ∂φ^order J̃ of ``(..., L)`` polar samples at ``(K,)`` angles, the same in all frames."""
    even, odd = interpolation_weights(phi, samples.shape[-1], (order,))
    value: NDArray[np.complex128] = samples.real @ even[..., 0].T + 1j * (samples.imag @ odd[..., 0].T)
    return value
