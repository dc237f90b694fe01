"""Errors of a result against the true motion, modulo what no method can know.

Not knowable, and removed before anything is compared: the mirror solution ``ΣRΣ`` (``fig:reflection`` of
Elbau et al. 2020, Inverse Problems 36), the offset of T, and the orientation of the object at the start, a
constant left factor of R.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.errors import ConfigError, InputError
from trapcli.result.motion import Array, Motion

SIGMA = np.diag([1.0, 1.0, -1.0])


@dataclass(frozen=True)
class ErrorStatistics:
    """Absolute errors of one quantity over the frames where it is known.

    Attributes
    ----------
    unit:
        Of `mean`, `median` and `max`, which are NaN where no frame could be compared.
    count:
        Frames compared.
    within_1_sigma, within_2_sigma:
        Share of errors below one and two of the stated 1-σ errors (0.68 and 0.95 for true ones); NaN where
        none are stated.
    """

    unit: str
    count: int
    mean: float
    median: float
    max: float
    within_1_sigma: float
    within_2_sigma: float


@dataclass(frozen=True)
class Comparison:
    """What `compare` finds.

    Attributes
    ----------
    errors:
        By name: ``T`` (length of the error of (T1, T2), equal at the first frame compared),
        ``T_offset_removed`` (the same after its mean is taken away), ``phi`` (modulo 2π), ``omega_3``,
        ``alpha``, ``alpha_relative``, ``R`` (angle, equal at the first frame compared), ``R_aligned`` (angle
        after the best constant rotation of the object).
    common, compared:
        Frames in both files (and not trimmed), and those among them that are valid in both.
    mirrored:
        Whether the result is the mirror solution of the truth.
    notes:
        What could not be compared, one sentence each.
    """

    errors: dict[str, ErrorStatistics]
    common: int
    compared: int
    mirrored: bool
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Matched:
    """A result and its truth on the same frames, in the same units and gauge.

    Attributes
    ----------
    result:
        Its K common frames.
    truth:
        The same frames in the result's units and mirror solution, with its T and R at the first usable frame.
    usable:
        ``(K,)`` True where both are valid.
    mirrored, notes:
        As in `Comparison`.
    """

    result: Motion
    truth: Motion
    usable: NDArray[np.bool_]
    mirrored: bool
    notes: tuple[str, ...]


def compare(result: Motion, truth: Motion, *, trim: int = 0) -> Comparison:
    """Compare `result` with `truth` over the frames that both know.

    Parameters
    ----------
    trim:
        Leave out this many of the first and of the last common frames.

    Raises
    ------
    InputError
        Where the two have no frame in common.
    ConfigError
        Where `trim` leaves none.
    """
    matched = match(result, truth, trim=trim)
    a, b, usable = matched.result, matched.truth, matched.usable
    shift = a.T - b.T
    centred = shift - _mean(shift[usable])
    delta_phi = wrap(a.phi - b.phi)
    delta_alpha = a.alpha - b.alpha
    relative = np.divide(delta_alpha, b.alpha, out=np.full(len(a), np.nan), where=b.alpha > 0)
    aligned = align(a.R, b.R, usable)
    rate, unknown = f"rad/{a.time_unit}", np.full(len(a), np.nan)

    def statistics(unit: str, error: Array, sigma: Array, scale: float = 1.0) -> ErrorStatistics:
        return _statistics(unit, error[usable], sigma[usable], scale)

    errors = {
        "T": statistics(a.length_unit, shift, a.T_errors),
        "T_offset_removed": statistics(a.length_unit, centred, a.T_errors),
        "phi": statistics("rad", delta_phi, a.phi_errors),
        "omega_3": statistics(rate, a.omega_3 - b.omega_3, a.omega_3_errors),
        "alpha": statistics(rate, delta_alpha, a.alpha_errors),
        "alpha_relative": statistics("%", relative, unknown, 100.0),
        "R": statistics("deg", rotation_difference(a.R, b.R), a.R_errors, 180 / np.pi),
        "R_aligned": statistics("deg", rotation_difference(a.R, aligned), a.R_errors, 180 / np.pi),
    }
    return Comparison(errors, len(a), int(usable.sum()), matched.mirrored, matched.notes)


def match(result: Motion, truth: Motion, *, trim: int = 0) -> Matched:
    """Bring `truth` to the frames, units and mirror solution of `result`; raises as `compare` does."""
    if trim < 0:
        raise ConfigError(f"--trim {trim}: must not be negative")
    _, in_result, in_truth = np.intersect1d(result.frame, truth.frame, return_indices=True)
    if not len(in_result):
        raise InputError(
            "result and truth have no frame in common; is this the truth of the stack that was estimated?"
        )
    if 2 * trim >= len(in_result):
        raise ConfigError(f"--trim {trim}: leaves none of the {len(in_result)} common frames")
    kept = slice(trim, len(in_result) - trim)
    a, b = take(result, in_result[kept]), take(truth, in_truth[kept])
    b, notes = _convert_units(a, b)
    usable = (a.valid > 0) & (b.valid > 0)
    mirrored = _is_mirrored(a, b, usable)
    b = _fix_gauge(a, mirror(b) if mirrored else b, usable)
    return Matched(a, b, usable, mirrored, notes)


def take(motion: Motion, rows: NDArray[np.integer]) -> Motion:
    """Keep some frames of a motion; what isn't a series stays."""
    series = {
        field.name: getattr(motion, field.name)[rows]
        for field in dataclasses.fields(motion)
        if isinstance(getattr(motion, field.name), np.ndarray)
    }
    return dataclasses.replace(motion, **series)


def mirror(motion: Motion) -> Motion:
    """Return the mirror solution ``ΣRΣ``, which has the same projections: φ turns by π, α and ω₃ stay."""
    return dataclasses.replace(motion, phi=motion.phi + np.pi, R=SIGMA @ motion.R @ SIGMA)


def wrap(angle: Array) -> Array:
    """Return `angle` [rad] modulo 2π in [−π, π)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def align(R: Array, R_true: Array, usable: NDArray[np.bool_]) -> Array:
    """Return ``Q R_true`` with the constant rotation Q that brings it closest to `R` in least squares."""
    known = usable & _finite(R) & _finite(R_true)
    if not known.any():
        return R_true
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", R[known], R_true[known]))
    Q = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    aligned: Array = Q @ R_true
    return aligned


def rotation_difference(R: Array, R_true: Array) -> Array:
    """Return ``(N, 3)`` rotation vectors d [rad] in lab coordinates, ``R_true = R exp([d]×)``."""
    difference = np.full((len(R), 3), np.nan)
    known = _finite(R) & _finite(R_true)
    if known.any():
        relative = R[known].transpose(0, 2, 1) @ R_true[known]
        difference[known] = Rotation.from_matrix(relative).as_rotvec()
    return difference


def _convert_units(result: Motion, truth: Motion) -> tuple[Motion, tuple[str, ...]]:
    """Express `truth` in the units of `result` where the frames themselves tell the factor."""
    notes = []
    time, factor = truth.time, 1.0
    if truth.time_unit != result.time_unit:
        factor = _time_factor(result, truth)
        time = result.time
        notes.append(f"the truth was converted from {truth.time_unit} to {result.time_unit}")
    T, center = truth.T, truth.center
    if truth.length_unit != result.length_unit:
        T, center = np.full_like(T, np.nan), np.full_like(center, np.nan)
        notes.append(
            f"T is not compared: in {result.length_unit} here, in {truth.length_unit} in the truth; "
            "estimate again with --pixel-size and --pixel-unit"
        )
    converted = dataclasses.replace(
        truth,
        time=time,
        omega_3=truth.omega_3 * factor,
        alpha=truth.alpha * factor,
        T=T,
        center=center,
        time_unit=result.time_unit,
        length_unit=result.length_unit,
    )
    return converted, tuple(notes)


def _time_factor(result: Motion, truth: Motion) -> float:
    """Return the time units of `truth` per time unit of `result`, which the common frames tell."""
    units = f"times are in {result.time_unit} and in {truth.time_unit}"
    duration, true_duration = np.ptp(result.time), np.ptp(truth.time)
    if not duration > 0 or not true_duration > 0:
        raise InputError(
            f"{units}, with too few common frames to convert; estimate again with --frame-interval"
        )
    factor = float(true_duration / duration)
    difference = truth.time - truth.time[0] - factor * (result.time - result.time[0])
    if np.abs(difference).max() > 0.01 * np.median(np.diff(truth.time)):
        raise InputError(f"{units} and not proportional; estimate again with --frame-interval")
    return factor


def _fix_gauge(a: Motion, b: Motion, usable: NDArray[np.bool_]) -> Motion:
    """Give `b` the T and the R of `a` at the first usable frame."""
    known = usable & np.isfinite(a.T + b.T).all(axis=1)
    if known.any():
        first = int(np.argmax(known))
        b = dataclasses.replace(b, T=b.T + (a.T[first] - b.T[first]))
    known = usable & _finite(a.R) & _finite(b.R)
    if known.any():
        first = int(np.argmax(known))
        b = dataclasses.replace(b, R=a.R[first] @ b.R[first].T @ b.R)
    return b


def _is_mirrored(a: Motion, b: Motion, usable: NDArray[np.bool_]) -> bool:
    """Choose the mirror solution as a whole: by R, and by φ where no R is known."""

    def misfit(truth: Motion) -> float:
        angle = np.linalg.norm(rotation_difference(a.R, align(a.R, truth.R, usable)), axis=1)
        if not np.isfinite(angle[usable]).any():
            angle = np.abs(wrap(a.phi - truth.phi))
        known = angle[usable & np.isfinite(angle)]
        return float(known.mean()) if len(known) else 0.0

    return misfit(mirror(b)) < misfit(b)


def _statistics(unit: str, error: Array, sigma: Array, scale: float) -> ErrorStatistics:
    error, sigma = (values[:, None] if values.ndim == 1 else values for values in (error, sigma))
    known = np.isfinite(error).all(axis=1)
    size = scale * np.linalg.norm(error[known], axis=1)
    stated = np.isfinite(error) & np.isfinite(sigma) & (sigma > 0)
    ratio = np.abs(error[stated]) / sigma[stated]
    return ErrorStatistics(
        unit=unit,
        count=int(known.sum()),
        mean=float(size.mean()) if len(size) else np.nan,
        median=float(np.median(size)) if len(size) else np.nan,
        max=float(size.max()) if len(size) else np.nan,
        within_1_sigma=float((ratio <= 1).mean()) if len(ratio) else np.nan,
        within_2_sigma=float((ratio <= 2).mean()) if len(ratio) else np.nan,
    )


def _mean(values: Array) -> Array:
    known = values[np.isfinite(values).all(axis=1)]
    return known.mean(axis=0) if len(known) else np.zeros(values.shape[1])


def _finite(R: Array) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(R).all(axis=(1, 2)))
