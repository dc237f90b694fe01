"""A smooth path R(t) on SO(3) and the cubic splines by which it is bent.

The path is bent by small rotations in lab coordinates, ``R(t) → R(t) exp([δ(t)]×)``, with δ a cubic spline. A
spline coefficient moves a few knots' worth of the path and nothing else, so that normal equations stay local;
ω follows exactly, ``ω → exp(−[δ]×) ω + J_r(δ) δ'``, with the right Jacobian J_r of SO(3).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from trapcli.motion.integrate import integrate_rotation

Array = NDArray[np.float64]

_FEWEST = 3  # intervals of the simplest path that is tried
_SIGMA = np.diag([1.0, 1.0, -1.0])  # mirrors at the image plane


@dataclass(frozen=True)
class Spline:
    """Cubic B-splines of `intervals` equal intervals on [start, end]: values and slopes at given times."""

    start: float
    end: float
    intervals: int

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return self.intervals + 3

    @property
    def grid(self) -> Array:
        """Times of the knots and of the middles between them, ``(2 · intervals + 1,)``."""
        return np.linspace(self.start, self.end, 2 * self.intervals + 1)

    def values(self, time: Array) -> Array:
        """Return ``(N, size)`` values of the basis functions."""
        return np.asarray(BSpline.design_matrix(self._scaled(time), self._knots(), 3).toarray())

    def slopes(self, time: Array) -> Array:
        """Return ``(N, size)`` time derivatives of the basis functions."""
        basis = BSpline(self._knots(), np.eye(self.size), 3)
        return np.asarray(basis.derivative()(self._scaled(time))) * self.intervals / (self.end - self.start)

    def fit(self, time: Array, series: Array) -> Array:
        """Return ``(size, D)`` coefficients of the least-squares fit to an ``(N, D)`` series."""
        values = self.values(time)
        # a faint curvature penalty decides what sparse data leave open
        bend = np.diff(np.eye(self.size), 2, axis=0)
        scale = 1e-6 * max(len(time) / self.size, 1e-3)
        return np.asarray(np.linalg.solve(values.T @ values + scale * bend.T @ bend, values.T @ series))

    def _knots(self) -> Array:
        return np.arange(-3.0, self.intervals + 4.0)

    def _scaled(self, time: Array) -> Array:
        x = (time - self.start) / (self.end - self.start) * self.intervals
        return np.clip(x, 0.0, self.intervals * (1 - 1e-12))


@dataclass(frozen=True)
class Path:
    """R and ω at ascending times. Several paths, on leading axes of R and ω, are bent at once.

    Attributes
    ----------
    time:
        ``(N,)``.
    R:
        ``(..., N, 3, 3)`` rotations, lab to object coordinates.
    omega:
        ``(..., N, 3)`` angular velocity, ``RᵀR' = [ω]×`` (``eqDefOmega``) [rad / time].
    """

    time: Array
    R: Array
    omega: Array

    @classmethod
    def constant(cls, time: Array, omega: Array) -> Path:
        """Return the path of constant ω [rad / time] with R = 1 in the middle."""
        middle = 0.5 * (time[0] + time[-1])
        R = Rotation.from_rotvec((time - middle)[:, None] * omega).as_matrix()
        return cls(time, R, np.tile(omega, (len(time), 1)))

    @classmethod
    def smooth(cls, spline: Spline, coefficients: Array, time: Array) -> Path:
        """Return the path of an ω that is a spline, integrated from R = 1 at the first time."""
        omega = spline.values(time) @ coefficients
        return cls(time, integrate_rotation(omega, time), omega)

    def near(self, spline: Spline, times: Array) -> Path:
        """Return the path of the spline nearest to ω of this one, at other `times` in any order."""
        middle = 0.5 * (self.time[1:] + self.time[:-1])
        return Path._at(spline, spline.fit(middle, self.mean_omega()), times)

    def simplest(self, spline: Spline, tolerance: float) -> Path:
        """Return the path near this one, at its times, whose ω is a spline of the fewest intervals.

        Near is a mean angle up to `tolerance` [rad]. Where that takes as many intervals as `spline` has, it
        is this path itself.
        """
        intervals = _FEWEST
        while intervals < spline.intervals:
            path = self.sampled(replace(spline, intervals=intervals), self.time)
            if align(path.R, self.R)[0].mean() <= tolerance:
                return path
            intervals += 1 + intervals // 3
        return self

    def sampled(self, spline: Spline, times: Array) -> Path:
        """Return the path of the spline nearest to ω at its own times, at other `times` in any order."""
        return Path._at(spline, spline.fit(self.time, self.omega), times)

    @classmethod
    def _at(cls, spline: Spline, coefficients: Array, times: Array) -> Path:
        """Return the path of an ω that is a spline, at times in any order."""
        ascending, back = np.unique(times, return_inverse=True)
        smooth = cls.smooth(spline, coefficients, ascending)
        return cls(times, smooth.R[back], smooth.omega[back])

    def bent(self, spline: Spline, coefficients: Array) -> Path:
        """Return ``R exp([δ]×)`` for the spline δ with ``(..., size, 3)`` coefficients [rad]."""
        delta, slope = spline.values(self.time) @ coefficients, spline.slopes(self.time) @ coefficients
        turn = Rotation.from_rotvec(delta.reshape(-1, 3)).as_matrix().reshape(self.R.shape)
        omega = np.einsum("...ji,...j->...i", turn, self.omega)
        omega += np.einsum("...ij,...j->...i", _right_jacobian(delta), slope)
        return Path(self.time, orthonormal(self.R @ turn), omega)

    def planar(self, spline: Spline) -> Path:
        """Return the path of the spline nearest to the part of this one that turns about the optical axis."""
        path = self.ascending()
        R = path.R[0].T @ path.R
        angle = np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1])
        turned = Rotation.from_rotvec(angle[:, None] * np.array([0.0, 0.0, 1.0])).as_matrix()
        # what turns about other axes has part in the angle, so that its derivative is not ω₃
        return replace(path, R=turned).near(spline, self.time)

    def mirrored(self, index: int) -> Path:
        """Return the path that goes on from the time at `index` as its mirror image, ΣRΣ, does.

        What turns out of the image plane changes its sign there.
        """
        R, omega = self.R.copy(), self.omega.copy()
        joint = R[index]
        R[index:] = joint @ _SIGMA @ (joint.T @ R[index:]) @ _SIGMA
        omega[index:, :2] *= -1
        return Path(self.time, R, omega)

    def ascending(self) -> Path:
        """Return the path at its own times in order, each of them once."""
        time, first = np.unique(self.time, return_index=True)
        return Path(time, self.R[first], self.omega[first])

    def mean_omega(self) -> Array:
        """Return the ``(N−1, 3)`` constant angular velocities that lead from each time to the next."""
        turns = Rotation.from_matrix(np.swapaxes(self.R[:-1], 1, 2) @ self.R[1:]).as_rotvec()
        return np.asarray(turns / np.diff(self.time)[:, None])

    def extended(self, time: Array, first: int, tail: int) -> Path:
        """Return the path on the longer grid `time`, where this one starts at index `first`.

        Beyond its ends it goes on with the mean angular velocity of the last `tail` steps.
        """
        last = first + len(self.time) - 1
        steps = self.mean_omega()
        before, after = steps[:tail].mean(axis=0), steps[-tail:].mean(axis=0)
        head = Rotation.from_rotvec((time[:first] - time[first])[:, None] * before).as_matrix()
        rest = Rotation.from_rotvec((time[last + 1 :] - time[last])[:, None] * after).as_matrix()
        R = np.concatenate([self.R[0] @ head, self.R, self.R[-1] @ rest])
        omega = np.concatenate([np.tile(before, (len(head), 1)), self.omega, np.tile(after, (len(rest), 1))])
        return Path(time, R, omega)


def orthonormal(R: Array) -> Array:
    """Return ``(..., 3, 3)`` rotations after one Newton step back to SO(3), for rounding that accumulates."""
    return np.asarray(R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R))


def cross_matrix(v: Array) -> Array:
    """Return ``(..., 3, 3)`` matrices [v]× with [v]× x = v × x."""
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


def align(R: Array, reference: Array) -> tuple[Array, bool]:
    """Remove the gauge between two paths: a constant rotation of the object and the mirror ΣRΣ.

    Returns
    -------
    angles, mirrored:
        ``(N,)`` remaining angles [rad] and whether the mirror image of R fits better.
    """
    best: tuple[Array, bool] | None = None
    for mirrored in (False, True):
        other = _SIGMA @ R @ _SIGMA if mirrored else R
        constant = _between(other, reference)
        angles = Rotation.from_matrix(np.swapaxes(constant @ reference, 1, 2) @ other).magnitude()
        if best is None or angles.mean() < best[0].mean():
            best = angles, mirrored
    assert best is not None
    return best


def deviation(R: Array, reference: Array) -> Array:
    """Return ``(N, 3)`` rotation vectors in the lab from R to a reference, their gauge removed [rad]."""
    if align(R, reference)[1]:
        reference = _SIGMA @ reference @ _SIGMA
    turns = np.swapaxes(R, 1, 2) @ _between(R, reference) @ reference
    return np.asarray(Rotation.from_matrix(turns).as_rotvec())


def _between(R: Array, reference: Array) -> Array:
    """Return the constant rotation of the object that brings a path nearest to another."""
    u, _, vt = np.linalg.svd(np.einsum("nij,nkj->ik", R, reference))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _right_jacobian(delta: Array) -> Array:
    """Return J_r(δ), ``(..., 3, 3)``: exp([δ + dδ]×) = exp([δ]×) exp([J_r dδ]×)."""
    angle = np.linalg.norm(delta, axis=-1)[..., None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    cross = cross_matrix(delta)
    return np.asarray(np.eye(3) - first * cross + second * cross @ cross)
