"""Cylindrical radius α of the angular velocity from the third-order equation (``propD3``).

The printed equation ``eq:RecSymmetryThirdOrder``, A₀ + A₀₂ α² + A₁ μ α'/α = 0, needs tensors of derivatives
in k. In polar coordinates, with D¹⟦μv⊥⟧ = ∂φJ̃, μ²D²⟦v⊥,v⊥⟧ = ∂φφJ̃ + μ∂μJ̃, D²⟦v,v⊥⟧ = ∂μ(∂φJ̃/μ) and
μ³D³⟦v⊥,v⊥,v⊥⟧ = ∂φφφJ̃ + 3μ ∂μφJ̃ − 2∂φJ̃, the radial derivatives in A₁ cancel, and those in A₀ add up to a
multiple of ∂μ(∂tJ̃ − ω₃∂φJ̃), which the first-order equation makes vanish on the line. What is left,
divided by the common factor (ω₃ + σ)/2, is

    ∂ttφJ̃ − ω₃' ∂φφJ̃ − (3ω₃ − σ)/2 ∂tφφJ̃ + ω₃(ω₃ − σ)/2 ∂φφφJ̃  +  α² ∂φJ̃  −  (α'/α) (∂tφJ̃ − ω₃ ∂φφJ̃)
    =  0

for all μ: a linear system for α² and α'/α that takes no derivative along the line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.angular import RingErrors, on_lines

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LineDerivatives:
    """Derivatives of J̃ on one line in each of n frames, ``(n, M)`` complex.

    Attributes
    ----------
    slope, curvature, third:
        ∂φJ̃, ∂φφJ̃, ∂φφφJ̃.
    rate_slope, rate_curvature:
        ∂tφJ̃, ∂tφφJ̃.
    acceleration_slope:
        ∂ttφJ̃.
    """

    slope: NDArray[Any]
    curvature: NDArray[Any]
    third: NDArray[Any]
    rate_slope: NDArray[Any]
    rate_curvature: NDArray[Any]
    acceleration_slope: NDArray[Any]

    @classmethod
    def on_line(
        cls, value: NDArray[Any], rate: NDArray[Any], acceleration: NDArray[Any], phi: Array
    ) -> LineDerivatives:
        """Evaluate ``(n, M, L)`` J̃, ∂tJ̃ and ∂ttJ̃ on the lines of ``(n,)`` directions φ [rad]."""
        values = on_lines(value, phi[:, None], (1, 2, 3))[:, 0]
        rates = on_lines(rate, phi[:, None], (1, 2))[:, 0]
        accelerations = on_lines(acceleration, phi[:, None], (1,))[:, 0]
        return cls(
            slope=values[..., 0],
            curvature=values[..., 1],
            third=values[..., 2],
            rate_slope=rates[..., 0],
            rate_curvature=rates[..., 1],
            acceleration_slope=accelerations[..., 0],
        )


@dataclass(frozen=True)
class ThirdOrder:
    """Solutions of the third-order equation in n frames.

    Attributes
    ----------
    alpha_squared, errors:
        ``(n,)`` α² and its 1-σ error [(rad / time)²].
    log_rate:
        ``(n,)`` α'/α [1 / time].
    """

    alpha_squared: Array
    errors: Array
    log_rate: Array


def coefficients(
    line: LineDerivatives, omega_3: Array, sigma: Array, omega_3_rate: Array
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return A₀, A₀₂ and μA₁ of ``propD3``, each divided by (ω₃ + σ)/2, as ``(n, M)``.

    Parameters
    ----------
    line:
        Derivatives on the line of direction φ.
    omega_3, sigma, omega_3_rate:
        ``(n,)`` ω₃, σ = φ' [rad / time] and ω₃' [rad / time²].
    """
    height, turn, change = omega_3[:, None], sigma[:, None], omega_3_rate[:, None]
    constant = (
        line.acceleration_slope
        - change * line.curvature
        - (3 * height - turn) / 2 * line.rate_curvature
        + height * (height - turn) / 2 * line.third
    )
    return constant, line.slope, height * line.curvature - line.rate_slope


def solve(
    line: LineDerivatives,
    omega_3: Array,
    sigma: Array,
    omega_3_rate: Array,
    errors: RingErrors,
    *,
    sigma_error: Array,
    omega_3_rate_error: Array,
    inflation: Array,
) -> ThirdOrder:
    """Solve the third-order equation for α² and α'/α by least squares over μ (``propD3``; Elbau et al. 2020).

    Parameters
    ----------
    line:
        Derivatives on the line of direction φ.
    omega_3, sigma, omega_3_rate:
        ``(n,)`` ω₃, σ = φ' [rad / time] and ω₃' [rad / time²].
    errors:
        Errors of the map, ring by ring.
    sigma_error, omega_3_rate_error:
        ``(n,)`` 1-σ errors of σ and ω₃'.
    inflation:
        ``(n,)`` errors of ∂ttJ̃ in units of `errors`; more than 1 near the ends.
    """
    constant, by_square, by_log_rate = coefficients(line, omega_3, sigma, omega_3_rate)
    matrix = np.stack([by_square, by_log_rate], axis=-1)
    weighted = np.conj(matrix) * _weights(errors, omega_3, sigma, omega_3_rate)[..., None]
    normal = np.einsum("nmi,nmj->nij", weighted, matrix).real
    inverse = np.linalg.pinv(normal, rcond=1e-13, hermitian=True)
    # how the solution answers to a right-hand side: also to those that errors of σ and ω₃' add
    solution = -np.einsum("nij,nmj,nm->ni", inverse, weighted, constant).real
    by_sigma = np.einsum("nij,nmj,nm->ni", inverse, weighted, _per_sigma(line, omega_3)).real
    by_change = np.einsum("nij,nmj,nm->ni", inverse, weighted, line.curvature).real
    residual = constant + np.einsum("nmi,ni->nm", matrix, solution)
    chi2 = np.einsum("nm,nm->n", _weights(errors, omega_3, sigma, omega_3_rate), np.abs(residual) ** 2)
    misfit = chi2 / max(2 * errors.share * len(errors.mu) - 2, 1.0)
    variance = inverse[:, 0, 0] * np.maximum(misfit, inflation**2)
    variance += (by_sigma[:, 0] * sigma_error) ** 2 + (by_change[:, 0] * omega_3_rate_error) ** 2
    return ThirdOrder(solution[:, 0], np.sqrt(variance), solution[:, 1])


def _per_sigma(line: LineDerivatives, omega_3: Array) -> NDArray[Any]:
    """Return the derivative of the constant term with respect to σ."""
    return np.asarray(line.rate_curvature - omega_3[:, None] * line.third) / 2


def _weights(errors: RingErrors, omega_3: Array, sigma: Array, omega_3_rate: Array) -> Array:
    """Return ``(n, M)`` weights of the squared equation error that make their sum χ²."""
    height, turn, change = omega_3[:, None], sigma[:, None], omega_3_rate[:, None]
    variance = (
        (errors.acceleration * errors.gain(1)) ** 2
        + ((3 * height - turn) / 2 * errors.rate * errors.gain(2)) ** 2
        + (height * (height - turn) / 2 * errors.value * errors.gain(3)) ** 2
        + (change * errors.value * errors.gain(2)) ** 2
    )
    weights: Array = 2 * errors.share / variance
    return weights
