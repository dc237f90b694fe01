"""Direction φ and height ω₃ of the angular velocity from the first-order equation (``propD1``).

On the polar grid D¹J̃(μv)⟦μv⊥⟧ = ∂φJ̃, so ``eqRecSymmetryFirstOrder`` reads ∂tJ̃ = ω₃ ∂φJ̃ on the line of
direction φ. The paper's function Φ, by brute force, says which lines come into question; least squares in
(φ, ω₃), weighted by the noise, finds the best of them between the scanned angles.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.angular import RingErrors, on_grid, on_lines

Array = NDArray[np.float64]

SCAN = 4
"""Angles at which Φ is evaluated, in units of the map's own."""

_CANDIDATES = 3  # minima of the misfit that are followed up, beside that of Φ
_FEW, _MANY = 4, 20  # steps of least squares for all candidates and for the best
_CONVERGED = 1e-13  # [rad]
_AS_GOOD = 9.0  # a χ² larger by less than this can't be told from the least (3 standard deviations)
_STANDS_OUT = 4.0  # power in units of the noise's
_EPSILON = 25.0  # the paper's ε in units of the noise's variance
_EXACT = 1e-6  # misfits below this share of ∂tJ̃ count as none, however small the noise
_ROUND = 1e-6  # ∂φJ̃ below this share of μ · radius · J̃ is no structure, however small the noise
_TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class FirstOrder:
    """Solutions of the first-order equation in n frames.

    Attributes
    ----------
    phi, omega_3:
        ``(n,)`` direction in [0, π) [rad] and height [rad / time].
    covariance:
        ``(n, 2, 2)`` of (φ, ω₃), as it follows from `RingErrors`.
    misfit:
        ``(n,)`` χ² per degree of freedom.
    residual:
        ``(n,)`` ‖∂tJ̃ − ω₃ ∂φJ̃‖ / ‖∂tJ̃‖ on the line.
    ambiguous:
        ``(n,)`` frames where another line is as good within the noise.
    open_share:
        ``(n,)`` share of all directions that the noise does not exclude.
    common_height, common_error:
        ``(n,)`` the one ω₃ that suits all lines best, as if α were 0, and its 1-σ error [rad / time].
    excess:
        ``(n,)`` mean square of what `common_height` leaves on all lines, in units of the noise's: about 1
        where nothing speaks for α > 0.
    structured:
        ``(n,)`` frames in which ∂φJ̃ stands out, so that a turn about the optical axis would be seen.
    pace:
        ``(n,)`` ‖∂tJ̃‖ / ‖μ · radius · J̃‖, about how fast the object turns [rad / time].
    """

    phi: Array
    omega_3: Array
    covariance: Array
    misfit: Array
    residual: Array
    ambiguous: NDArray[np.bool_]
    open_share: Array
    common_height: Array
    common_error: Array
    excess: Array
    structured: NDArray[np.bool_]
    pace: Array


def landscape(slope: NDArray[Any], rate: NDArray[Any], epsilon: float) -> tuple[Array, Array]:
    """Return the paper's Φ and ω̃₃ for lines of given directions (section Numerics of Elbau et al. 2020).

    Parameters
    ----------
    slope, rate:
        ``(..., M, L)`` ∂φJ̃ and ∂tJ̃ on L lines.
    epsilon:
        The ε that keeps points where both vanish from deciding.

    Returns
    -------
    phi_function, omega_3:
        ``(..., L)`` Φ and the least-squares ω̃₃ of each line.
    """
    energy = np.sum(np.abs(slope) ** 2, axis=-2)
    omega_3 = np.sum((np.conj(slope) * rate).real, axis=-2) / np.maximum(energy, _TINY)
    expected = omega_3[..., None, :] * slope
    misfit = np.abs(rate - expected) ** 2 / (np.abs(expected) ** 2 + epsilon + _TINY)
    return misfit.max(axis=-2), omega_3


def solve(value: NDArray[Any], rate: NDArray[Any], errors: RingErrors) -> tuple[FirstOrder, Array]:
    """Solve the first-order equation for φ and ω₃ (``propD1``; Elbau et al. 2020, Inverse Problems 36).

    Parameters
    ----------
    value, rate:
        ``(n, M, L)`` J̃ and ∂tJ̃ on the polar grid.
    errors:
        Their errors.

    Returns
    -------
    solution:
        The line of least misfit in each frame.
    phi_function:
        ``(n, SCAN · L)`` Φ on [0, π).
    """
    size = value.shape[-1]
    angles = np.arange(SCAN * size) * np.pi / (SCAN * size)
    slopes, rates = on_grid(value, angles, 1), on_grid(rate, angles, 0)
    phi_function, _ = landscape(slopes, rates, _EPSILON * float(np.max(errors.rate)) ** 2)
    misfits, heights = _scan_misfit(slopes, rates, errors)
    starts = np.concatenate([_minima(phi_function, 1), _minima(misfits, _CANDIDATES)], axis=1)
    line = _Lines(angles[starts], np.take_along_axis(heights, starts, axis=1))
    line = _refine(value, rate, errors, line, _FEW)
    best = np.argmin(line.chi2, axis=1)[:, None]
    final = _refine(value, rate, errors, line.pick(best), _MANY)
    phi, omega_3, chi2 = final.phi[:, 0], final.omega_3[:, 0], final.chi2[:, 0]
    misfit = chi2 / max(2 * errors.share * value.shape[1] - 2, 1.0)
    everything = np.einsum("m,nmk->nk", _weights(errors, np.zeros(1))[0], np.abs(rates) ** 2)
    limit = (chi2 + _AS_GOOD * np.maximum(misfit, 1.0) + _EXACT**2 * everything.max(axis=1))[:, None]
    apart = np.abs((line.phi - phi[:, None] + np.pi / 2) % np.pi - np.pi / 2) > np.pi / size
    common, common_error, excess = _common_height(slopes, rates, errors)
    solution = FirstOrder(
        phi=phi % np.pi,
        omega_3=omega_3,
        covariance=_inverse(final.normal[:, 0]),
        misfit=misfit,
        residual=_relative_residual(value, rate, phi, omega_3),
        ambiguous=(apart & (line.chi2 < limit)).any(axis=1),
        open_share=np.mean(misfits < limit, axis=1),
        common_height=common,
        common_error=common_error,
        excess=excess,
        structured=_structured(slopes, value, errors),
        pace=_pace(value, rate, errors),
    )
    return solution, phi_function


@dataclass
class _Lines:
    """C lines in each of n frames: (φ, ω₃), χ², −½ its gradient, the Gauss–Newton matrix."""

    phi: Array
    omega_3: Array
    chi2: Array = field(default_factory=lambda: np.empty(0))
    gradient: Array = field(default_factory=lambda: np.empty(0))
    normal: Array = field(default_factory=lambda: np.empty(0))

    def pick(self, which: NDArray[np.intp]) -> _Lines:
        """Return ``(n, K)`` of the C lines."""
        return _Lines(
            np.take_along_axis(self.phi, which, axis=1), np.take_along_axis(self.omega_3, which, axis=1)
        )


def _weights(errors: RingErrors, omega_3: Array) -> Array:
    """Return ``(..., M)`` weights of |∂tJ̃ − ω₃ ∂φJ̃|² that make their sum χ²."""
    slope = errors.value * errors.gain(1)
    weights: Array = 2 * errors.share / (errors.rate**2 + omega_3[..., None] ** 2 * slope**2)
    return weights


def _scan_misfit(slopes: NDArray[Any], rates: NDArray[Any], errors: RingErrors) -> tuple[Array, Array]:
    """Return χ² of each scanned line and the ω₃ that minimises it, ``(n, K)`` each."""
    heights = np.zeros((len(slopes), slopes.shape[-1]))
    for _ in range(2):
        weights = np.moveaxis(_weights(errors, heights), -1, -2)
        energy = np.sum(weights * np.abs(slopes) ** 2, axis=1)
        heights = np.sum(weights * (np.conj(slopes) * rates).real, axis=1) / np.maximum(energy, _TINY)
    weights = np.moveaxis(_weights(errors, heights), -1, -2)
    return np.sum(weights * np.abs(rates - heights[:, None] * slopes) ** 2, axis=1), heights


def _common_height(
    slopes: NDArray[Any], rates: NDArray[Any], errors: RingErrors
) -> tuple[Array, Array, Array]:
    """Return the one ω₃ that suits all lines best, its error, and the power left over the noise's."""
    weights = _weights(errors, np.zeros(1))[0][:, None]
    energy = np.sum(weights * np.abs(slopes) ** 2, axis=(1, 2))
    height = np.sum(weights * (np.conj(slopes) * rates).real, axis=(1, 2)) / np.maximum(energy, _TINY)
    weights = np.moveaxis(_weights(errors, height[:, None]), -1, -2) / (2 * errors.share)
    left = np.mean(weights * np.abs(rates - height[:, None, None] * slopes) ** 2, axis=(1, 2))
    left = np.maximum(left - _EXACT**2 * np.mean(weights * np.abs(rates) ** 2, axis=(1, 2)), 0.0)
    # neighbouring lines are correlated: about μ · radius of them are independent
    lines = np.clip(errors.mu.mean() * errors.radius, 1.0, slopes.shape[-1])
    return height, np.sqrt(slopes.shape[-1] / lines / np.maximum(energy, _TINY)), left


def _structured(slopes: NDArray[Any], value: NDArray[Any], errors: RingErrors) -> NDArray[np.bool_]:
    power = np.mean(np.abs(slopes) ** 2, axis=2)
    over_noise = np.mean(power / (errors.value * errors.gain(1)) ** 2, axis=1)
    level = np.max((errors.mu * errors.radius) ** 2 * np.mean(np.abs(value) ** 2, axis=2), axis=1)
    return np.asarray((over_noise > _STANDS_OUT) & (power.max(axis=1) > _ROUND**2 * level))


def _pace(value: NDArray[Any], rate: NDArray[Any], errors: RingErrors) -> Array:
    reach = (errors.mu * errors.radius)[:, None] * value
    pace: Array = np.linalg.norm(rate, axis=(1, 2)) / np.linalg.norm(reach, axis=(1, 2))
    return pace


def _minima(values: Array, count: int) -> NDArray[np.intp]:
    """Return the places of the lowest local minima of ``(n, K)`` periodic functions, ``(n, count)``."""
    lowest = (values <= np.roll(values, 1, axis=1)) & (values <= np.roll(values, -1, axis=1))
    return np.argsort(np.where(lowest, values, np.inf), axis=1)[:, :count]


def _refine(
    value: NDArray[Any], rate: NDArray[Any], errors: RingErrors, line: _Lines, iterations: int
) -> _Lines:
    """Minimise χ² in (φ, ω₃) from each start (Levenberg and Marquardt)."""
    weights = _weights(errors, line.omega_3)
    farthest = np.pi / 4 / value.shape[-1]
    damping = np.full(line.phi.shape, 1e-3)
    line = _evaluate(value, rate, weights, line.phi, line.omega_3)
    for _ in range(iterations):
        damped = line.normal.copy()
        damped[..., [0, 1], [0, 1]] *= 1 + damping[..., None]
        step = (_inverse(damped) @ line.gradient[..., None])[..., 0]
        step[..., 0] = np.clip(step[..., 0], -farthest, farthest)
        trial = _evaluate(value, rate, weights, line.phi + step[..., 0], line.omega_3 + step[..., 1])
        better = trial.chi2 <= line.chi2
        for name in ("phi", "omega_3", "chi2", "gradient", "normal"):
            old, new = getattr(line, name), getattr(trial, name)
            setattr(line, name, np.where(better.reshape(better.shape + (1,) * (old.ndim - 2)), new, old))
        damping = np.where(better, damping * 0.01, damping * 10 + 1e-6)
        if np.abs(step[..., 0]).max() < _CONVERGED:
            break
    return line


def _evaluate(value: NDArray[Any], rate: NDArray[Any], weights: Array, phi: Array, omega_3: Array) -> _Lines:
    slopes = on_lines(value, phi, (1, 2))
    rates = on_lines(rate, phi, (0, 1))
    height = omega_3[..., None]
    residual = rates[..., 0] - height * slopes[..., 0]
    columns = np.stack([rates[..., 1] - height * slopes[..., 1], -slopes[..., 0]], axis=-1)
    weighted = np.conj(columns) * weights[..., None]
    gradient = -np.einsum("ncmi,ncm->nci", weighted, residual).real
    normal = np.einsum("ncmi,ncmj->ncij", weighted, columns).real
    return _Lines(phi, omega_3, np.sum(weights * np.abs(residual) ** 2, axis=-1), gradient, normal)


def _inverse(matrix: Array) -> Array:
    """Invert ``(..., 2, 2)`` symmetric matrices; singular ones become large, not an error."""
    a, b, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    determinant = np.maximum(a * d - b * b, 1e-14 * a * d + _TINY)
    return np.stack([np.stack([d, -b], -1), np.stack([-b, a], -1)], -2) / determinant[..., None, None]


def _relative_residual(value: NDArray[Any], rate: NDArray[Any], phi: Array, omega_3: Array) -> Array:
    slope = on_lines(value, phi[:, None], (1,))[:, 0, :, 0]
    change = on_lines(rate, phi[:, None], (0,))[:, 0, :, 0]
    misfit = np.linalg.norm(change - omega_3[:, None] * slope, axis=-1)
    return np.asarray(misfit / np.maximum(np.linalg.norm(change, axis=-1), _TINY))
