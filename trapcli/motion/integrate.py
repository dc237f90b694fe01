"""Rotations R(t) from samples of the angular velocity: Rᵀ R' = [ω]× (``eqDefOmega``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# nodes of the two-point Gauss rule on [0, 1]
_GAUSS = (0.5 - np.sqrt(3) / 6, 0.5 + np.sqrt(3) / 6)
_BRIDGED = 0.5  # error of an interpolated ω in units of ω


def integrate_rotation(omega: Array, time: Array, *, bridge: int = 0) -> Array:
    """Integrate R(t) on SO(3) from R = 1 at the first frame, by Magnus steps of fourth order.

    Parameters
    ----------
    omega:
        ``(N, 3)`` angular velocity [rad / time]; NaN where not known.
    time:
        ``(N,)`` ascending times, not necessarily evenly spaced.
    bridge:
        Longest gap of unknown frames that is interpolated.

    Returns
    -------
    ndarray
        ``(N, 3, 3)`` rotations, lab to object coordinates; NaN from the first gap on that is too long.
    """
    n = len(time)
    R = np.full((n, 3, 3), np.nan)
    if n:
        R[0] = np.eye(3)
    reach = _reach(_known(omega), bridge)
    if reach < 2:
        return R
    filled = _filled(omega[:reach], time[:reach])
    h = np.diff(time[:reach])[:, None]
    velocity = CubicSpline(time[:reach], filled)
    first, second = (velocity(time[: reach - 1] + node * h[:, 0]) for node in _GAUSS)
    # R' = R [ω]× : the commutator enters with the opposite sign from Y' = A Y
    turns = h / 2 * (first + second) + np.sqrt(3) / 12 * h**2 * np.cross(first, second)
    steps = Rotation.from_rotvec(turns).as_matrix()
    for i, step in enumerate(steps):
        R[i + 1] = R[i] @ step
    # rounding accumulates over many frames: one Newton step back to the group
    known = R[:reach]
    R[:reach] = known @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(known, 1, 2) @ known)
    return R


def rotation_errors(omega: Array, covariance: Array, time: Array, correlation: float) -> Array:
    """Propagate errors of ω to R.

    Parameters
    ----------
    omega:
        ``(N, 3)`` angular velocity [rad / time].
    covariance:
        ``(N, 3, 3)`` of its errors, NaN where not known.
    time:
        ``(N,)`` times.
    correlation:
        Frames over which errors of ω are alike.

    Returns
    -------
    ndarray
        ``(N, 3)`` 1-σ errors of R as a rotation vector in lab coordinates [rad].
    """
    n = len(time)
    errors = np.full((n, 3), np.nan)
    known = _known(covariance) & _known(omega)
    if not known.any():
        return errors
    if n:
        errors[0] = 0.0
    filled = _filled(np.where(known[:, None], omega, np.nan), time)
    # what is bridged may be off by much of the rate itself
    guessed = np.eye(3) * (_BRIDGED * np.median(np.linalg.norm(filled, axis=1))) ** 2
    total = np.zeros((3, 3))
    # an error δ of R, as R exp([δ]×), obeys δ' = δ × ω + δω
    h = np.diff(time)
    carried = Rotation.from_rotvec(-filled[:-1] * h[:, None]).as_matrix()
    for i in range(n - 1):
        added = covariance[i] if known[i] else guessed
        total = carried[i] @ total @ carried[i].T + correlation * h[i] ** 2 * added
        errors[i + 1] = np.sqrt(np.diagonal(total))
    return errors


def _known(series: Array) -> NDArray[np.bool_]:
    return np.array([np.isfinite(entry).all() for entry in series], bool)


def _reach(known: NDArray[np.bool_], bridge: int) -> int:
    """Return how many frames can be integrated before a gap longer than `bridge`."""
    found = np.flatnonzero(known)
    if not len(found):
        return 0
    gaps = np.diff(np.concatenate([[-1], found])) - 1
    broken = np.flatnonzero(gaps > bridge)
    if len(broken):
        return int(found[broken[0] - 1]) + 1 if broken[0] else 0
    rest = len(known) - 1 - found[-1]
    return len(known) if rest <= bridge else int(found[-1]) + 1


def _filled(series: Array, time: Array) -> Array:
    """Interpolate unknown frames linearly; the ends are continued by the nearest known frame."""
    known = _known(series)
    return interpolated(time, time[known], series[known])


def interpolated(time: Array, known: Array, series: Array) -> Array:
    """Return an ``(M, D)`` series given at ``(M,)`` times `known`, linearly interpolated at other times."""
    return np.stack([np.interp(time, known, column) for column in series.T], axis=1)
