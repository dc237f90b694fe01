"""The paper's chain from attenuation to motion (its workflow figure): ``--method paper``.

Centres give the translation and the reduced map; its first time derivative gives φ and ω₃ (``propD1``), its second, in the
third-order equation, α (``propD3``); ω is integrated to R. Noise is met only by the windows of the time derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from trapcli.config import MotionConfig
from trapcli.errors import InputError
from trapcli.motion import first_order, third_order
from trapcli.motion.ambiguity import unwrap_directions
from trapcli.motion.angular import RingErrors
from trapcli.motion.centers import Centers, Progress, estimate_centers
from trapcli.motion.first_order import FirstOrder
from trapcli.motion.integrate import integrate_rotation, rotation_errors
from trapcli.motion.reduced_map import MARGIN, reduce_frames
from trapcli.motion.third_order import LineDerivatives, ThirdOrder
from trapcli.motion.time_derivatives import TimeFilter, choose_filters, difference_noise
from trapcli.motion.translation import translation
from trapcli.motion.types import ReducedMap
from trapcli.result.motion import Flag, Landscape, Motion
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Record = TypeVar("Record", FirstOrder, LineDerivatives)

_GROUPS = 4  # groups of rings that have windows of their own
_SERIES = 12  # series of a group on which its windows are chosen
_CHUNK = 128  # frames solved at once
_LANDSCAPES = 6  # frames whose Φ is kept
_WHITE = 2.0  # ratio of the noise's variance between pixels and between frames up to which it is white in time
_NO_TILT = 2.0  # `FirstOrder.excess` up to which nothing speaks for α > 0
_AT_REST = 1e-9  # turn per frame below which nothing turns, however small the noise [rad]
_OPEN = 0.5  # share of directions that are as good, beyond which φ is not determined at all
_SIGNIFICANT = 3.0  # standard deviations
_ALPHA_SIGNIFICANT = 2.0
_SAME = 1e-6  # |ω₃ + σ| as a share of the rates beyond which they differ, however small their errors
_SHORTEST_BRIDGE = 5  # frames
_FEWEST = 5  # frames


@dataclass(frozen=True)
class RotationRates:
    """Angular velocity of N frames with its errors and flags; NaN where it can't be judged.

    Attributes
    ----------
    phi, omega_3, alpha (+ _errors):
        ``(N,)`` [rad], [rad / time], [rad / time].
    flags:
        ``(N,)`` `Flag` bits.
    residual:
        ``(N,)`` relative misfit of the first-order equation.
    spinning:
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
    spinning: Bools
    window: int
    landscape: Landscape | None


def estimate_paper(
    attenuation: Frames,
    config: MotionConfig,
    *,
    time: Array,
    pixel_size: float = 1.0,
    progress: Progress | None = None,
) -> Motion:
    """Recover the motion by infinitesimal common lines (Elbau et al. 2020, Inverse Problems 36).

    Parameters
    ----------
    attenuation:
        N attenuation projections.
    config:
        `window` and `band` are used.
    time:
        ``(N,)`` evenly spaced times.
    pixel_size:
        Edge of a pixel [length].
    progress:
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    Motion
        In the units of `time` and `pixel_size`, which the caller names.

    Raises
    ------
    InputError
        Where fewer than 5 frames show an object.
    """
    centers = estimate_centers(attenuation, pixel_size=pixel_size, progress=progress)
    if np.isfinite(centers.center[:, 0]).sum() < _FEWEST:
        raise InputError(
            f"{attenuation.info.source}: too few frames show an object for time derivatives; "
            f"at least {_FEWEST} are needed"
        )
    reduced = reduce_frames(
        attenuation, centers, time=time, pixel_size=pixel_size, band=config.band, progress=progress
    )
    rates = rotation_rates(reduced, window=config.window, frame=attenuation.index, progress=progress)
    return _motion(centers, rates, time, attenuation.index)


def rotation_rates(
    reduced: ReducedMap,
    *,
    window: int = 0,
    frame: NDArray[np.int64] | None = None,
    progress: Progress | None = None,
) -> RotationRates:
    """Recover φ, ω₃ and α of every frame from the reduced map (``propD1``, ``propD3``).

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
    n = len(reduced.time)
    derivatives = _Derivatives.choose(reduced, window)
    first, line, landscape = _solve_lines(reduced, derivatives, frame, progress)
    step = _step(reduced.time)
    inflation = derivatives.inflation(n, 1)
    untilted = (first.excess < _NO_TILT * inflation**2) | (first.pace * step < _AT_REST)
    spinning = first.structured & untilted
    tilted = first.structured & ~spinning & (first.open_share < _OPEN)
    phi = unwrap_directions(np.where(tilted, first.phi, np.nan), tilted & ~first.ambiguous)
    omega_3 = np.where(tilted, first.omega_3, np.nan)
    scale = np.sqrt(np.maximum(first.misfit, inflation**2))
    phi_errors, omega_3_errors = (
        np.where(tilted, np.sqrt(first.covariance[:, i, i]) * scale, np.nan) for i in (0, 1)
    )
    sigma, sigma_error = _series_rate(phi, phi_errors, derivatives.kernel, step, window)
    change, change_error = _series_rate(omega_3, omega_3_errors, derivatives.kernel, step, window)
    third = third_order.solve(
        line,
        omega_3,
        sigma,
        change,
        derivatives.errors,
        sigma_error=sigma_error,
        omega_3_rate_error=change_error,
        inflation=derivatives.inflation(n, 2),
    )
    silent = _silent(omega_3, sigma, np.hypot(omega_3_errors, sigma_error), third)
    faint = tilted & ~silent & ~(third.alpha_squared > _ALPHA_SIGNIFICANT * third.errors)
    alpha = np.sqrt(np.where(tilted & ~silent & ~faint, third.alpha_squared, np.nan))
    flags = np.zeros(n, np.uint16)
    flags[(first.ambiguous & ~spinning) | (~spinning & ~tilted & np.isfinite(first.phi))] |= np.uint16(Flag.AMBIGUOUS_PHI)
    flags[spinning | faint] |= np.uint16(Flag.ALPHA_ZERO)
    flags[silent] |= np.uint16(Flag.THIRD_ORDER_SILENT)
    return RotationRates(
        phi=phi,
        omega_3=np.where(spinning, first.common_height, omega_3),
        alpha=alpha,
        phi_errors=phi_errors,
        omega_3_errors=np.where(spinning, first.common_error * inflation, omega_3_errors),
        alpha_errors=third.errors / (2 * alpha),
        flags=flags,
        residual=first.residual,
        spinning=spinning,
        window=len(derivatives.kernel),
        landscape=landscape,
    )


@dataclass(frozen=True)
class _Derivatives:
    """Filters for J̃, ∂tJ̃ and ∂ttJ̃, each for groups of rings, and the errors they leave far from the ends."""

    groups: list[slice]
    filters: list[tuple[TimeFilter, ...]]
    errors: RingErrors
    decisive: int
    """The group that says most about the motion."""
    kernel: Array
    """Weights of its filter for ∂tJ̃, far from the ends."""

    @classmethod
    def choose(cls, reduced: ReducedMap, window: int) -> _Derivatives:
        """Choose the windows of each group of rings."""
        n, rings, lines = reduced.samples.shape
        step = _step(reduced.time)
        edges = np.linspace(0, rings, min(_GROUPS, rings) + 1).round().astype(int)
        groups = [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]
        filters = []
        errors = np.empty((3, rings))
        energy = []
        lasting = np.empty((3, rings))
        for group in groups:
            series = reduced.samples[:, group].reshape(n, -1)
            series = series[:, :: max(1, series.shape[1] // _SERIES)]
            noise = difference_noise(reduced.samples[:, group, :: max(1, lines // 16)].reshape(n, -1))
            filters.append(choose_filters(series, (0, 1, 2), noise=noise, width=window))
            errors[:, group] = [[f.error / step**f.order] for f in filters[-1]]
            # what the pixels' noise has beyond the noise seen from frame to frame moves with the object
            slow = np.sqrt(max(reduced.noise**2 - _WHITE * noise**2, 0.0))
            pace = np.array([_rms(f.apply(series, 1.0)) for f in filters[-1]]) / step ** np.arange(3)
            lasting[:, group] = (slow * pace / max(pace[0], 1e-300))[:, None]
            energy.append(
                np.nanmean(np.abs(series - np.nanmean(series, axis=0)) ** 2) / filters[-1][1].error ** 2
            )
        # a filter that leaves no error at all (a series of zeros) must not have infinite weight
        errors = np.hypot(errors, lasting)
        errors = np.maximum(errors, np.finfo(float).eps * errors.max(axis=1, keepdims=True) + 1e-300)
        decisive = int(np.argmax(energy))
        _, kernel = next(iter(filters[decisive][1].rows(n, frames=range(n // 2, n // 2 + 1))))
        share = min(1.0, (reduced.mu[1] - reduced.mu[0]) * reduced.radius / np.pi)
        ring_errors = RingErrors(reduced.mu, MARGIN * reduced.radius, *errors, share=share)
        return cls(groups, filters, ring_errors, decisive, kernel)

    def inflation(self, n: int, order: int) -> Array:
        """Return the ``(n,)`` errors of a derivative in units of those far from the ends."""
        gains = self.filters[self.decisive][order].gains(n)
        ratio: Array = np.maximum(gains / gains[n // 2], 1.0)
        return ratio

    def apply(self, reduced: ReducedMap, valid: Bools, frames: range) -> list[NDArray[Any]]:
        """Return J̃, ∂tJ̃ and ∂ttJ̃ of some frames, ``(n, M, L)`` each."""
        step = _step(reduced.time)
        return [
            np.concatenate(
                [
                    filters[order].apply(reduced.samples[:, group], step, valid, frames)
                    for group, filters in zip(self.groups, self.filters, strict=True)
                ],
                axis=1,
            )
            for order in range(3)
        ]


def _solve_lines(
    reduced: ReducedMap, derivatives: _Derivatives, frame: NDArray[np.int64] | None, progress: Progress | None
) -> tuple[FirstOrder, LineDerivatives, Landscape | None]:
    """Solve the first-order equation of all frames and evaluate the derivatives on the lines found."""
    n = len(reduced.time)
    valid = np.isfinite(reduced.samples[:, 0, 0])
    places: list[NDArray[np.intp]] = []
    solutions: list[FirstOrder] = []
    lines: list[LineDerivatives] = []
    kept: dict[int, Array] = {}
    # the paper shows Φ at the second frame
    shown = {1, *np.linspace(0, n - 1, _LANDSCAPES).round().astype(int).tolist()[1:]}
    for start in range(0, n, _CHUNK):
        frames = range(start, min(start + _CHUNK, n))
        pieces = derivatives.apply(reduced, valid, frames)
        known = (
            np.logical_and.reduce([np.isfinite(piece[:, 0, 0]) for piece in pieces])
            & valid[frames.start : frames.stop]
        )
        if known.any():
            value, rate, acceleration = (piece[known] for piece in pieces)
            places.append(start + np.flatnonzero(known))
            solution, phi_function = first_order.solve(value, rate, derivatives.errors)
            solutions.append(solution)
            lines.append(LineDerivatives.on_line(value, rate, acceleration, solution.phi))
            kept.update({int(p): f for p, f in zip(places[-1], phi_function, strict=True) if int(p) in shown})
        if progress is not None:
            progress("rotation", frames.stop, n)
    landscape = _landscape(kept, np.arange(n) if frame is None else frame)
    return _spread(FirstOrder, solutions, places, n), _spread(LineDerivatives, lines, places, n), landscape


def _landscape(kept: dict[int, Array], frame: NDArray[np.int64]) -> Landscape | None:
    if not kept:
        return None
    places = sorted(kept)
    values = np.array([kept[place] for place in places])
    angles = np.arange(values.shape[1]) * np.pi / values.shape[1]
    return Landscape(phi=angles, frame=frame[places], values=values)


def _spread(cls: type[Record], parts: list[Record], places: list[NDArray[np.intp]], n: int) -> Record:
    """Join solutions of some frames into one of all `n`, with NaN or False where there is none."""
    columns = []
    for column in fields(cls):
        joined = np.concatenate([getattr(part, column.name) for part in parts])
        whole = np.full((n, *joined.shape[1:]), False if joined.dtype == bool else np.nan, joined.dtype)
        whole[np.concatenate(places)] = joined
        columns.append(whole)
    return cls(*columns)


def _series_rate(series: Array, errors: Array, kernel: Array, step: float, width: int) -> tuple[Array, Array]:
    """Return the time derivative of an estimated series and its errors.

    The series' noise is not white: it comes through the `kernel` of the derivative it was found with.
    """
    known = np.isfinite(series)
    unknown = np.full(len(series), np.nan)
    if not known.any():
        return unknown, unknown
    noise = float(np.median(errors[known]))
    (rate,) = choose_filters(series[:, None], (1,), noise=noise, correlation=kernel, width=width)
    gains = rate.gains(len(series), kernel)
    return rate.apply(series, step), np.where(known, errors * gains, np.nan) / step


def _silent(omega_3: Array, sigma: Array, error: Array, third: ThirdOrder) -> Bools:
    """Tell where ω₃ = −σ within the errors: the third-order equation then reads 0 = 0 (the paper's example)."""
    speed = np.abs(omega_3) + np.abs(sigma) + np.sqrt(np.maximum(third.alpha_squared, 0.0))
    return np.abs(omega_3 + sigma) < np.maximum(_SIGNIFICANT * error, _SAME * speed)


def _motion(centers: Centers, rates: RotationRates, time: Array, frame: NDArray[np.int64]) -> Motion:
    """Put translation and rotation together, judge each frame and the whole."""
    blank = ~np.isfinite(centers.center[:, 0])
    flags = rates.flags.copy()
    flags[blank] |= np.uint16(Flag.BLANK)
    flags[centers.clipped] |= np.uint16(Flag.CLIPPED)
    tilt = np.where(rates.spinning, 0.0, rates.alpha)
    # where nothing speaks for a tilt φ is not known, but not needed either
    direction = np.where(rates.spinning, 0.0, rates.phi)
    omega = np.stack([tilt * np.cos(direction), tilt * np.sin(direction), rates.omega_3], axis=-1)
    omega[flags & np.uint16(Flag.AMBIGUOUS_PHI) > 0] = np.nan
    least = np.maximum(_SIGNIFICANT * rates.omega_3_errors, _AT_REST / _step(time))
    moving = ~rates.spinning | (np.abs(rates.omega_3) > least)
    valid = np.isfinite(omega).all(axis=1) & moving & (flags & ~np.uint16(Flag.ALPHA_ZERO) == 0)
    identifiable = bool(valid.mean() >= _OPEN) if len(valid) else False
    T = translation(centers.center)
    return Motion(
        time=time,
        frame=frame,
        T=T,
        center=centers.center,
        phi=rates.phi,
        omega_3=rates.omega_3,
        alpha=rates.alpha,
        R=integrate_rotation(omega, time, bridge=max(_SHORTEST_BRIDGE, rates.window // 2)),
        T_errors=np.hypot(centers.errors, _first(centers.errors)),
        phi_errors=rates.phi_errors,
        omega_3_errors=rates.omega_3_errors,
        alpha_errors=rates.alpha_errors,
        R_errors=rotation_errors(omega, _covariance(rates, direction, tilt), time, rates.window / 2),
        valid=valid.astype(np.uint8),
        flags=flags,
        residual=rates.residual,
        identifiable=identifiable,
        verdict=_verdict(valid, flags, rates, blank),
        landscape=rates.landscape,
    )


def _first(series: Array) -> Array:
    """Return the first row without NaN; NaN where there is none."""
    known = np.flatnonzero(np.isfinite(series).all(axis=1))
    return series[known[0]] if len(known) else np.full(series.shape[1], np.nan)


def _covariance(rates: RotationRates, direction: Array, tilt: Array) -> Array:
    """Return the ``(N, 3, 3)`` covariance of ω from the errors of φ, α and ω₃."""
    v, across = (
        np.array([np.cos(direction), np.sin(direction)]),
        np.array([-np.sin(direction), np.cos(direction)]),
    )
    along = np.where(rates.spinning, 0.0, rates.alpha_errors) * v
    sideways = np.where(rates.spinning, 0.0, tilt * rates.phi_errors) * across
    covariance = np.zeros((len(direction), 3, 3))
    covariance[:, :2, :2] = np.einsum("in,jn->nij", along, along) + np.einsum(
        "in,jn->nij", sideways, sideways
    )
    covariance[:, 2, 2] = rates.omega_3_errors**2
    return covariance


def _verdict(valid: Bools, flags: NDArray[np.uint16], rates: RotationRates, blank: Bools) -> str:
    """Say in words how far the motion is known and what stands in the way."""
    seen = int((~blank).sum())
    still = rates.spinning & ~valid
    silent, open_phi, faint = (
        flags & bit > 0 for bit in (Flag.THIRD_ORDER_SILENT, Flag.AMBIGUOUS_PHI, Flag.ALPHA_ZERO)
    )
    reasons = [
        (
            open_phi,
            "the images fit many directions of the rotation: an object with a symmetry, or too much noise",
        ),
        (silent, "omega_3 = -sigma, where the third-order equation says nothing about alpha"),
        (still, "nothing turns: the object is still, or turns about its own axis of symmetry"),
        (faint & ~still & ~valid, "alpha does not stand out of its error"),
    ]
    told = [f"{text} ({int(which.sum())} frames)" for which, text in reasons if which.sum() > 0.05 * seen]
    summary = f"motion found in {int(valid.sum())} of {len(valid)} frames"
    return "; ".join([summary, *told])


def _rms(series: NDArray[Any]) -> float:
    return float(np.sqrt(np.nanmean(np.abs(series) ** 2)))


def _step(time: Array) -> float:
    return float(np.median(np.diff(time)))
