"""Common lines at finite baseline: ``eqRecSymmetry`` for any two frames.

With ``Q = R(s)ᵀ R(t)`` the two frames share the line whose angle is ``atan2(Q13, −Q23)`` in frame s and
``atan2(−Q31, Q32)`` in frame t; J̃ agrees along it whatever the object is. No volume is needed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.types import ReducedMap

Array = NDArray[np.float64]
Samples = NDArray[np.float32]
Index = NDArray[np.intp]

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
        ``(..., P)`` robust misfit; `degrees` is expected.
    degrees:
        Degrees of freedom of a pair.
    gradient:
        ``(..., P, 6)`` half the negative gradient by small rotations ε of frames s and t,
        ``R → R exp([ε]×)``.
    hessian:
        ``(..., P, 6, 6)`` half the Gauss–Newton Hessian.
    """

    cost: Array
    degrees: float
    gradient: Array
    hessian: Array


class LineTable:
    """J̃ of G frames (or groups of frames) along all lines, cubic between them (Hermite).

    Real parts come first, then the imaginary ones.

    Parameters
    ----------
    reduced:
        The reduced map of G frames on a polar grid, up to the band to be used.
    model_error:
        Error of the map besides its noise, as a share of the root mean square on each ring.
    centring:
        Error of the frames' centres along a line [length].
    """

    def __init__(self, reduced: ReducedMap, model_error: float, centring: float = 0.0) -> None:
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
        step = 2 * np.pi / fine
        left = _parts(np.fft.ifft(full, axis=2) * fine)
        slope_left = _parts(np.fft.ifft(full * (1j * wave), axis=2) * (fine * step))
        right, slope_right = np.roll(left, -1, axis=1), np.roll(slope_left, -1, axis=1)
        square = 3 * (right - left) - 2 * slope_left - slope_right
        cube = 2 * (left - right) + slope_left + slope_right
        self._cubics = np.stack([left, slope_left, square, cube], axis=2)
        power = np.mean(np.abs(samples) ** 2, axis=(0, 2))
        share = min(1.0, float(reduced.mu[1] - reduced.mu[0]) * reduced.radius / np.pi)
        error = reduced.noise**2 + (model_error**2 + (reduced.mu * centring) ** 2) * power
        self._weights = np.tile(share / error, 2)
        self.degrees = 2.0 * rings * share
        """Degrees of freedom of a pair of frames."""
        self.reach = float(reduced.mu[-1] * reduced.radius)
        """Highest frequency times radius: about the number of independent lines of a frame."""

    def __len__(self) -> int:
        return len(self._cubics)

    def select(self, start: int, stop: int) -> LineTable:
        """Return the table of consecutive frames."""
        part = object.__new__(LineTable)
        part.__dict__.update(self.__dict__)
        part._cubics = self._cubics[start:stop]
        return part

    def cost(self, R: Array, s: Index, t: Index) -> Array:
        """Return the ``(..., P)`` robust misfits of pairs of frames."""
        q, _, angles = _geometry(R, s, t)
        values = _value(*self._cubic(np.stack([s, t]), angles))
        difference = values[..., 0, :, :] - values[..., 1, :, :]
        return self._robust(difference**2 @ self._weights, _sin2(q))[0]

    def residuals(self, R: Array, s: Index, t: Index) -> LineResiduals:
        """Return the misfits of pairs of frames with their derivatives.

        Parameters
        ----------
        R:
            ``(..., G, 3, 3)`` rotations.
        s, t:
            ``(P,)`` frames of each pair.
        """
        q, p, angles = _geometry(R, s, t)
        values, slopes = self._interpolate(np.stack([s, t]), angles)
        difference = values[..., 0, :, :] - values[..., 1, :, :]
        by_s, by_t = slopes[..., 0, :, :], -slopes[..., 1, :, :]
        cost, weight = self._robust(difference**2 @ self._weights, _sin2(q))
        ss, st, tt, s_down, t_down = (
            weight * (a * b @ self._weights)
            for a, b in [(by_s, by_s), (by_s, by_t), (by_t, by_t), (by_s, difference), (by_t, difference)]
        )
        turns = _angle_derivatives(q, p)
        curvature = np.stack([ss, st, st, tt], axis=-1).reshape(*ss.shape, 2, 2)
        hessian = np.swapaxes(turns, -1, -2) @ (curvature @ turns)
        gradient = -(s_down[..., None] * turns[..., 0, :] + t_down[..., None] * turns[..., 1, :])
        return LineResiduals(cost, self.degrees, gradient, hessian)

    def _robust(self, misfit: Array, sin2: Array) -> tuple[Array, Array]:
        """Return the robust (Cauchy) misfit and the weight of each pair."""
        scale = _OUTLYING * self.degrees
        # a pair of (nearly) equal viewing directions says nothing, but must not look like a perfect fit
        trusted = np.minimum(1.0, sin2 / _SHORT_BASELINE)
        cost = trusted * scale * np.log1p(misfit / scale) + (1 - trusted) * self.degrees
        return cost, trusted / (1 + misfit / scale)

    def _interpolate(self, frame: Index, angle: Array) -> tuple[Samples, Samples]:
        """Return interpolants of J̃ and their slopes, ``(..., 2M)``."""
        cubic = self._cubic(frame, angle)
        return _value(*cubic), _slope(*cubic) * np.float32(self._cubics.shape[1] / (2 * np.pi))

    def _cubic(self, frame: Index, angle: Array) -> tuple[Samples, Samples]:
        """Return where between two lines angles lie, ``(..., 1)``, and the cubics there, ``(..., 4, 2M)``."""
        count = self._cubics.shape[1]
        x = np.mod(angle, 2 * np.pi) * (count / (2 * np.pi))
        line = np.floor(x).astype(np.intp)
        return (x - line).astype(np.float32)[..., None], self._cubics[frame, line % count]


def _parts(table: NDArray[np.complex128]) -> Samples:
    """Return real and imaginary parts of J̃, ``(G, angles, 2M)``."""
    return np.concatenate([table.real, table.imag], axis=1, dtype=np.float32).transpose(0, 2, 1)


def _value(u: Samples, cubic: Samples) -> Samples:
    a, b, c, d = np.moveaxis(cubic, -2, 0)
    return np.asarray(a + u * (b + u * (c + u * d)))


def _slope(u: Samples, cubic: Samples) -> Samples:
    _, b, c, d = np.moveaxis(cubic, -2, 0)
    return np.asarray(b + u * (2 * c + 3 * u * d))


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


def _geometry(R: Array, s: Index, t: Index) -> tuple[Array, Array, Array]:
    """Return q = Q e₃, p = Qᵀ e₃ and the ``(..., 2, P)`` angles of the common line in both frames."""
    first, second = R[..., s, :, :], R[..., t, :, :]
    q = np.einsum("...ki,...k->...i", first, second[..., 2])
    p = np.einsum("...ki,...k->...i", second, first[..., 2])
    angles = np.arctan2([q[..., 0], -p[..., 0]], [-q[..., 1], p[..., 1]])
    return q, p, np.moveaxis(angles, 0, -2)


def _sin2(q: Array) -> Array:
    return np.asarray(np.maximum(q[..., 0] ** 2 + q[..., 1] ** 2, 1e-4))


def _angle_derivatives(q: Array, p: Array) -> Array:
    """Return ``(..., P, 2, 6)`` derivatives of the two angles by ε_s and ε_t.

    From ``dq = [q]× ε_s − Q [e₃]× ε_t`` and ``dp = [p]× ε_t − Qᵀ [e₃]× ε_s``; q₃ = p₃ = Q₃₃.
    """
    turns = np.zeros((*q.shape[:-1], 2, 2, 3))
    turns[..., 0, 0, :2] = q[..., :2] * q[..., 2:]
    turns[..., 0, 1, :2] = p[..., :2]
    turns[..., 1, 0, :2] = q[..., :2]
    turns[..., 1, 1, :2] = p[..., :2] * p[..., 2:]
    turns[..., 0, 0, 2] = turns[..., 1, 1, 2] = -np.sum(q[..., :2] ** 2, axis=-1)
    turns /= _sin2(q)[..., None, None, None]
    return turns.reshape(*q.shape[:-1], 2, 6)
