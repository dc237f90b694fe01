"""Common lines at finite baseline: ``eqRecSymmetry`` for any two frames.

With ``Q = R(s)ᵀ R(t)`` the two frames share the line whose angle is ``atan2(Q13, −Q23)`` in frame s and
``atan2(−Q31, Q32)`` in frame t; J̃ agrees along it whatever the object is. No volume is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.path import cross_matrix
from trapcli.motion.types import ReducedMap

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_E3 = cross_matrix(np.array([0.0, 0.0, 1.0]))
_FINEST_ANGLES = 128  # least samples over the whole turn for cubic interpolation
_SHORT_BASELINE = (
    0.02  # sin² of the angle between viewing directions below which a common line is ill-determined
)
_OUTLYING = 8.0  # misfit per degree of freedom from which a pair counts less


@dataclass(frozen=True)
class LineResiduals:
    """Misfit of pairs of frames along their common lines.

    Attributes
    ----------
    cost:
        ``(P,)`` robust misfit; `degrees` is expected.
    degrees:
        Degrees of freedom of a pair.
    gradient:
        ``(P, 6)`` half the negative gradient by small rotations ε of frames s and t, ``R → R exp([ε]×)``.
    hessian:
        ``(P, 6, 6)`` half the Gauss–Newton Hessian.
    """

    cost: Array
    degrees: float
    gradient: Array
    hessian: Array


class LineTable:
    """J̃ and ∂φJ̃ of G frames (or groups of frames) along all lines, ready for interpolation.

    Parameters
    ----------
    reduced:
        The reduced map of G frames on a polar grid, up to the band to be used.
    model_error:
        Error of the map besides its noise, as a share of the root mean square on each ring.
    """

    def __init__(self, reduced: ReducedMap, model_error: float) -> None:
        samples = reduced.samples
        groups, rings, lines = samples.shape
        turn = np.concatenate([samples, samples.conj()], axis=2)
        count = 2 * lines
        fine = max(count, _FINEST_ANGLES)
        order = np.fft.fftfreq(count, 1 / count).astype(int)
        spectrum = np.fft.fft(turn, axis=2) / count
        full = np.zeros((groups, rings, fine), complex)
        full[:, :, order] = spectrum
        wave = np.fft.fftfreq(fine, 1 / fine)
        self._values = self._layout(np.fft.ifft(full, axis=2) * fine)
        self._slopes = self._layout(np.fft.ifft(full * (1j * wave), axis=2) * fine)
        self._angles = fine
        power = np.mean(np.abs(samples) ** 2, axis=(0, 2))
        share = min(1.0, float(reduced.mu[1] - reduced.mu[0]) * reduced.radius / np.pi)
        self._weights = share / (reduced.noise**2 + model_error**2 * power)
        self.degrees = 2.0 * rings * share
        """Degrees of freedom of a pair of frames."""
        self.reach = float(reduced.mu[-1] * reduced.radius)
        """Highest frequency times radius: about the number of independent lines of a frame."""

    def __len__(self) -> int:
        return len(self._values)

    @staticmethod
    def _layout(table: NDArray[np.complex128]) -> NDArray[np.complex64]:
        return np.ascontiguousarray(table.transpose(0, 2, 1)).astype(np.complex64)

    def select(self, start: int, stop: int) -> LineTable:
        """Return the table of consecutive frames."""
        part = object.__new__(LineTable)
        part.__dict__.update(self.__dict__)
        part._values, part._slopes = self._values[start:stop], self._slopes[start:stop]
        return part

    def cost(self, R: Array, s: Index, t: Index) -> Array:
        """Return the ``(P,)`` robust misfits of pairs of frames."""
        q, _, angle_s, angle_t, _ = _geometry(R, s, t)
        value_s, _ = self._interpolate(s, angle_s)
        value_t, _ = self._interpolate(t, angle_t)
        return self._robust(np.abs(value_s - value_t) ** 2 @ self._weights, _sin2(q))[0]

    def residuals(self, R: Array, s: Index, t: Index) -> LineResiduals:
        """Return the misfits of pairs of frames with their derivatives.

        Parameters
        ----------
        R:
            ``(G, 3, 3)`` rotations.
        s, t:
            ``(P,)`` frames of each pair.
        """
        q, p, angle_s, angle_t, Q = _geometry(R, s, t)
        value_s, slope_s = self._interpolate(s, angle_s)
        value_t, slope_t = self._interpolate(t, angle_t)
        difference = value_s - value_t
        sin2 = _sin2(q)
        cost, weight = self._robust(np.abs(difference) ** 2 @ self._weights, sin2)
        turn_s, turn_t = _angle_derivatives(q, p, Q, sin2)
        ss = weight * (np.abs(slope_s) ** 2 @ self._weights)
        tt = weight * (np.abs(slope_t) ** 2 @ self._weights)
        st = weight * ((slope_s.conj() * slope_t).real @ self._weights)
        cross = turn_s[:, :, None] * turn_t[:, None]
        hessian = (
            ss[:, None, None] * turn_s[:, :, None] * turn_s[:, None]
            + tt[:, None, None] * turn_t[:, :, None] * turn_t[:, None]
            - st[:, None, None] * (cross + cross.transpose(0, 2, 1))
        )
        down_s = weight * ((slope_s.conj() * difference).real @ self._weights)
        down_t = weight * ((slope_t.conj() * difference).real @ self._weights)
        gradient = -(down_s[:, None] * turn_s - down_t[:, None] * turn_t)
        return LineResiduals(cost, self.degrees, gradient, hessian)

    def _robust(self, misfit: Array, sin2: Array) -> tuple[Array, Array]:
        """Return the robust (Cauchy) misfit and the weight of each pair."""
        scale = _OUTLYING * self.degrees
        # a pair of (nearly) equal viewing directions says nothing, but must not look like a perfect fit
        trusted = np.minimum(1.0, sin2 / _SHORT_BASELINE)
        cost = trusted * scale * np.log1p(misfit / scale) + (1 - trusted) * self.degrees
        return cost, trusted / (1 + misfit / scale)

    def _interpolate(
        self, frame: Index, angle: Array
    ) -> tuple[NDArray[np.complexfloating], NDArray[np.complexfloating]]:
        """Return cubic Hermite interpolants of J̃ and their slopes, ``(P, M)``."""
        x = np.mod(angle, 2 * np.pi) * (self._angles / (2 * np.pi))
        left = np.floor(x).astype(np.intp)
        u = (x - left).astype(np.float32)[:, None]
        left %= self._angles
        right = (left + 1) % self._angles
        h = np.float32(2 * np.pi / self._angles)
        a, b = self._values[frame, left], self._values[frame, right]
        da, db = self._slopes[frame, left] * h, self._slopes[frame, right] * h
        w = 1 - u
        value = a * ((1 + 2 * u) * w * w) + da * (u * w * w) + b * (u * u * (3 - 2 * u)) - db * (u * u * w)
        slope = ((6 * u * w) * (b - a) + da * (w * (1 - 3 * u)) + db * (u * (3 * u - 2))) / h
        return value, slope


def choose_pairs(groups: int, per_group: int, seed: int) -> tuple[Index, Index]:
    """Return pairs (s, t), s + 2 ≤ t, of `groups` frames: all, or a random `per_group` for each frame."""
    if groups * (groups - 3) // 2 <= per_group * groups:
        s, t = np.triu_indices(groups, 2)
        return s, t
    rng = np.random.default_rng(seed)
    s, t = rng.integers(0, groups, (2, int(1.2 * per_group * groups)))
    apart = np.abs(s - t) >= 2
    pairs = np.unique(np.stack([np.minimum(s, t), np.maximum(s, t)])[:, apart], axis=1)
    return pairs[0], pairs[1]


def _geometry(R: Array, s: Index, t: Index) -> tuple[Array, Array, Array, Array, Array]:
    """Return Q e₃, Qᵀ e₃, the angles of the common line in both frames, and Q."""
    Q = np.swapaxes(R[s], 1, 2) @ R[t]
    q, p = Q[:, :, 2], Q[:, 2, :]
    return q, p, np.arctan2(q[:, 0], -q[:, 1]), np.arctan2(-p[:, 0], p[:, 1]), Q


def _sin2(q: Array) -> Array:
    return np.asarray(np.maximum(q[:, 0] ** 2 + q[:, 1] ** 2, 1e-4))


def _angle_derivatives(q: Array, p: Array, Q: Array, sin2: Array) -> tuple[Array, Array]:
    """Return ``(P, 6)`` derivatives of the two angles by ε_s and ε_t.

    ``dq = [q]× ε_s − Q [e₃]× ε_t`` and ``dp = [p]× ε_t − Qᵀ [e₃]× ε_s``.
    """
    zero = np.zeros(len(q))
    along_q = np.stack([-q[:, 1], q[:, 0], zero], axis=1) / sin2[:, None]
    along_p = np.stack([-p[:, 1], p[:, 0], zero], axis=1) / sin2[:, None]

    def row(vector: Array, matrix: Array) -> Array:
        return np.asarray(np.einsum("pi,pij->pj", vector, matrix))

    angle_s = np.concatenate([row(along_q, cross_matrix(q)), -row(along_q, Q @ _E3)], axis=1)
    angle_t = np.concatenate(
        [-row(along_p, np.swapaxes(Q, 1, 2) @ _E3), row(along_p, cross_matrix(p))], axis=1
    )
    return angle_s, angle_t
