"""φ, ω₃ and α of every frame from the reduced map: both equations of the paper, with errors and flags."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from trapcli.motion import first_order, third_order
from trapcli.motion.ambiguity import unwrap_directions
from trapcli.motion.centers import Progress
from trapcli.motion.first_order import FirstOrder
from trapcli.motion.map_derivatives import MapDerivatives, choose_map_derivatives
from trapcli.motion.third_order import LineDerivatives, ThirdOrder
from trapcli.motion.time_derivatives import choose_filters
from trapcli.motion.types import ReducedMap
from trapcli.result.motion import Flag, Landscape

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Record = TypeVar("Record", FirstOrder, LineDerivatives)

AT_REST = 1e-9
"""Turn per frame below which nothing turns, however small the noise [rad]."""

_CHUNK = 128  # frames solved at once
_LANDSCAPES = 6  # frames whose Φ is kept
_NO_TILT = 2.0  # `FirstOrder.excess` up to which nothing speaks for α > 0
_OPEN = 0.5  # share of directions that are as good, beyond which φ is not determined at all
_SIGNIFICANT = 3.0  # standard deviations for ω₃ + σ
_ALPHA_SIGNIFICANT = 2.0  # and for α²
_SAME = 1e-6  # |ω₃ + σ| as a share of the rates up to which they are the same, however small the errors


@dataclass(frozen=True)
class RotationRates:
    """Angular velocity of N frames; NaN where it can't be judged.

    Attributes
    ----------
    phi, omega_3, alpha (+ _errors):
        ``(N,)`` [rad], [rad / time], [rad / time].
    flags:
        ``(N,)`` `Flag` bits.
    residual:
        ``(N,)`` relative misfit of the first-order equation.
    untilted:
        ``(N,)`` frames that turn about the optical axis alone, or not at all, as far as can be seen.
    window:
        Frames over which the rates were averaged.
    landscape:
        Φ at a few frames.
    """

    phi: Array
    omega_3: Array
    alpha: Array
    phi_errors: Array
    omega_3_errors: Array
    alpha_errors: Array
    flags: NDArray[np.uint16]
    residual: Array
    untilted: Bools
    window: int
    landscape: Landscape | None


def rotation_rates(
    reduced: ReducedMap,
    *,
    window: int = 0,
    frame: NDArray[np.int64] | None = None,
    progress: Progress | None = None,
) -> RotationRates:
    """Recover φ, ω₃ and α of every frame (``propD1``, ``propD3``; Elbau et al. 2020, Inverse Problems 36).

    Parameters
    ----------
    reduced:
        The map of N frames, evenly spaced in time.
    window:
        Width of the time windows [frames]; 0 chooses it from the data.
    frame:
        ``(N,)`` index of the frames in the input (default: 0 … N−1).
    progress:
        Called as ``progress("rotation", done, N)``.
    """
    frame = np.arange(len(reduced.time)) if frame is None else frame
    derivatives = choose_map_derivatives(reduced, window=window)
    first, line, landscape = _solve_lines(reduced, derivatives, frame, progress)
    heights = _Heights.judge(first, derivatives)
    third, silent = _solve_third_order(line, heights, derivatives, window)
    known = heights.tilted & ~silent & (third.alpha_squared > _ALPHA_SIGNIFICANT * third.errors)
    alpha = np.sqrt(np.where(known, third.alpha_squared, np.nan))
    flags = np.zeros(len(frame), np.uint16)
    flags[heights.ambiguous] |= np.uint16(Flag.AMBIGUOUS_PHI)
    flags[heights.untilted | (heights.tilted & ~silent & ~known)] |= np.uint16(Flag.ALPHA_ZERO)
    flags[silent] |= np.uint16(Flag.THIRD_ORDER_SILENT)
    return RotationRates(
        phi=heights.phi,
        omega_3=np.where(heights.untilted, first.common_height, heights.omega_3),
        alpha=alpha,
        phi_errors=heights.phi_errors,
        omega_3_errors=np.where(
            heights.untilted, first.common_error * heights.inflation, heights.omega_3_errors
        ),
        alpha_errors=third.errors / (2 * alpha),
        flags=flags,
        residual=first.residual,
        untilted=heights.untilted,
        window=len(derivatives.rate_kernel(len(frame))),
        landscape=landscape,
    )


@dataclass(frozen=True)
class _Heights:
    """What the first-order equation says of each frame once it has been judged."""

    phi: Array
    omega_3: Array
    phi_errors: Array
    omega_3_errors: Array
    tilted: Bools
    untilted: Bools
    ambiguous: Bools
    inflation: Array

    @classmethod
    def judge(cls, first: FirstOrder, derivatives: MapDerivatives) -> _Heights:
        inflation = derivatives.inflation(len(first.phi), 1)
        at_rest = first.pace * derivatives.step < AT_REST
        untilted = first.structured & ((first.excess < _NO_TILT * inflation**2) | at_rest)
        tilted = first.structured & ~untilted & (first.open_share < _OPEN)
        # errors are larger near the ends, and wherever the equation is not met within them
        scale = np.sqrt(np.maximum(first.misfit, inflation**2))
        errors = np.sqrt(np.diagonal(first.covariance, axis1=1, axis2=2)) * scale[:, None]
        errors[~tilted] = np.nan
        return cls(
            phi=unwrap_directions(np.where(tilted, first.phi, np.nan), tilted & ~first.ambiguous),
            omega_3=np.where(tilted, first.omega_3, np.nan),
            phi_errors=errors[:, 0],
            omega_3_errors=errors[:, 1],
            tilted=tilted,
            untilted=untilted,
            ambiguous=np.isfinite(first.phi) & ~untilted & (first.ambiguous | ~tilted),
            inflation=inflation,
        )


def _solve_lines(
    reduced: ReducedMap, derivatives: MapDerivatives, frame: NDArray[np.int64], progress: Progress | None
) -> tuple[FirstOrder, LineDerivatives, Landscape | None]:
    """Solve the first-order equation of all frames and evaluate the derivatives on the lines found."""
    n = len(frame)
    places: list[NDArray[np.intp]] = []
    solutions: list[FirstOrder] = []
    lines: list[LineDerivatives] = []
    kept: dict[int, Array] = {}
    # the paper shows Φ at the second frame
    shown = {1, *np.linspace(0, n - 1, _LANDSCAPES).round().astype(int)[1:].tolist()}
    for start in range(0, n, _CHUNK):
        frames = range(start, min(start + _CHUNK, n))
        pieces = derivatives.apply(reduced, frames)
        known = np.logical_and.reduce([np.isfinite(piece[:, 0, 0]) for piece in pieces])
        if known.any():
            value, rate, acceleration = (piece[known] for piece in pieces)
            places.append(start + np.flatnonzero(known))
            solution, phi_function = first_order.solve(value, rate, derivatives.errors)
            solutions.append(solution)
            lines.append(LineDerivatives.on_line(value, rate, acceleration, solution.phi))
            kept.update({p: f for p, f in zip(places[-1].tolist(), phi_function, strict=True) if p in shown})
        if progress is not None:
            progress("rotation", frames.stop, n)
    return (
        _spread(FirstOrder, solutions, places, n),
        _spread(LineDerivatives, lines, places, n),
        _landscape(kept, frame),
    )


def _landscape(kept: dict[int, Array], frame: NDArray[np.int64]) -> Landscape | None:
    if not kept:
        return None
    places = sorted(kept)
    values = np.array([kept[place] for place in places])
    angles = np.arange(values.shape[1]) * np.pi / values.shape[1]
    return Landscape(phi=angles, frame=frame[places], values=values)


def _spread(cls: type[Record], parts: list[Record], places: list[NDArray[np.intp]], n: int) -> Record:
    """Join solutions of some frames into one of all `n`, with NaN or False where there is none."""
    columns = {}
    for column in fields(cls):
        joined: NDArray[Any] = np.concatenate([getattr(part, column.name) for part in parts])
        whole = np.full((n, *joined.shape[1:]), False if joined.dtype == bool else np.nan, joined.dtype)
        whole[np.concatenate(places)] = joined
        columns[column.name] = whole
    return cls(**columns)


def _solve_third_order(
    line: LineDerivatives, heights: _Heights, derivatives: MapDerivatives, window: int
) -> tuple[ThirdOrder, Bools]:
    """Return α² of every frame and where the equation says nothing about it."""
    n = len(heights.phi)
    kernel = derivatives.rate_kernel(n)
    sigma, sigma_error = _series_rate(heights.phi, heights.phi_errors, kernel, derivatives.step, window)
    change, change_error = _series_rate(
        heights.omega_3, heights.omega_3_errors, kernel, derivatives.step, window
    )
    third = third_order.solve(
        line,
        heights.omega_3,
        sigma,
        change,
        derivatives.errors,
        sigma_error=sigma_error,
        omega_3_rate_error=change_error,
        inflation=derivatives.inflation(n, 2),
    )
    # ω₃ = −σ: the printed equation reads 0 = 0, the paper's example
    speed = np.abs(heights.omega_3) + np.abs(sigma) + np.sqrt(np.maximum(third.alpha_squared, 0.0))
    within = np.maximum(_SIGNIFICANT * np.hypot(heights.omega_3_errors, sigma_error), _SAME * speed)
    same = np.abs(heights.omega_3 + sigma) < within
    # neighbours decide: single frames may pass or fail by chance
    return third, heights.tilted & (uniform_filter1d(same.astype(float), len(kernel), mode="nearest") > 0.5)


def _series_rate(series: Array, errors: Array, kernel: Array, step: float, width: int) -> tuple[Array, Array]:
    """Return the time derivative of an estimated series and its errors.

    The series' noise is not white: it comes through the `kernel` of the derivative it was found with.
    """
    known = np.isfinite(series)
    if not known.any():
        return np.full(len(series), np.nan), np.full(len(series), np.nan)
    noise = float(np.median(errors[known]))
    (rate,) = choose_filters(series[:, None], (1,), noise=noise, correlation=kernel, width=width)
    gains = rate.gains(len(series), kernel)
    return rate.apply(series, step), np.where(known, errors * gains, np.nan) / step
