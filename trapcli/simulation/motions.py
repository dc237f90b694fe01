"""Rigid motions to simulate: ω(t), T(t), and R(t), which follows from RᵀR' = [ω]× (``eqDefOmega``)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate
from operator import mul

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.result.motion import Motion

Array = NDArray[np.float64]

ROTATION_TOLERANCE = 1e-12
"""Largest change of an entry of R when the steps of the integration are halved."""

ALPHA_ZERO = 1e-6
"""Share of the highest |ω| below which α counts as 0, so that φ is undefined."""


@dataclass(frozen=True, kw_only=True)
class Drift:
    """A smooth, slow translation: a few Fourier modes.

    Attributes
    ----------
    cosine, sine:
        ``(K, 3)`` coefficients [length] of the modes 1 … K.
    rate:
        Angular frequency of the first mode [rad / time].
    """

    cosine: Array = field(default_factory=lambda: np.zeros((1, 3)))
    sine: Array = field(default_factory=lambda: np.zeros((1, 3)))
    rate: float = 1.0

    @classmethod
    def random(cls, rng: np.random.Generator, *, amplitude: float, duration: float) -> Drift:
        """Return a drift of at most about `amplitude` [length] in each direction."""
        modes = np.arange(1, 4)[:, None]
        scale = amplitude / 3 / modes
        cosine, sine = (scale * rng.uniform(-1.0, 1.0, (3, 3)) for _ in range(2))
        return cls(cosine=cosine, sine=sine, rate=1.5 * np.pi / duration)

    def __call__(self, t: Array) -> Array:
        """Return ``(N, 3)`` translations at ``(N,)`` times."""
        angle = np.multiply.outer(t, self.rate * np.arange(1, len(self.cosine) + 1))
        value: Array = np.cos(angle) @ self.cosine + np.sin(angle) @ self.sine
        return value


@dataclass(frozen=True, kw_only=True)
class RigidMotion(ABC):
    """A motion by its angular velocity and translation, functions of time.

    Attributes
    ----------
    drift:
        The translation T(t).
    """

    drift: Drift = field(default_factory=Drift)

    @abstractmethod
    def omega(self, t: Array) -> Array:
        """Return the angular velocity, ``(N, 3)`` [rad / time], at ``(N,)`` times."""

    def T(self, t: Array) -> Array:
        """Return the translation, ``(N, 3)`` [length], at ``(N,)`` times."""
        return self.drift(t)

    def rotations(self, t: Array) -> Array:
        """Return ``(N, 3, 3)`` rotations at ``(N,)`` ascending times, 1 at the first."""
        return integrate(self, t)


def integrate(motion: RigidMotion, t: Array) -> Array:
    """Integrate RᵀR' = [ω]× from R = 1 at ``t[0]``.

    Each interval of `t` is cut into steps of the sixth-order Magnus method (three Gauss–Legendre nodes). They
    are halved until R no longer changes.

    Returns
    -------
    Array
        ``(N, 3, 3)`` rotations.
    """
    steps = 1
    R = _magnus(motion, t, steps)
    while steps < 1024:
        steps *= 2
        R, coarse = _magnus(motion, t, steps), R
        if np.max(np.abs(R - coarse)) < ROTATION_TOLERANCE:
            break
    return R


def _magnus(motion: RigidMotion, t: Array, steps: int) -> Array:
    h = np.diff(t)[:, None, None] / steps
    start = t[:-1, None] + np.diff(t)[:, None] * np.arange(steps) / steps
    node = np.sqrt(15.0) / 10
    # (Rᵀ)' = -[ω]× Rᵀ is the linear equation of the method, and [a×b]× the commutator of [a]× and [b]×
    a1, a2, a3 = (
        -motion.omega((start + h[..., 0] * (0.5 + c)).ravel()).reshape(*start.shape, 3)
        for c in (-node, 0.0, node)
    )
    b1 = h * a2
    b2 = h * np.sqrt(15.0) / 3 * (a3 - a1)
    b3 = h * 10.0 / 3 * (a3 - 2 * a2 + a1)
    c1 = np.cross(b1, b2)
    c2 = -np.cross(b1, 2 * b3 + c1) / 60
    vector = b1 + b3 / 12 + np.cross(c1 - 20 * b1 - b3, b2 + c2) / 240
    turns = Rotation.from_rotvec(-vector.reshape(-1, 3)).as_matrix().reshape(*start.shape, 3, 3)
    R = np.empty((len(t), 3, 3))
    R[:1] = np.eye(3)
    frame_turn = turns[:, 0]
    for step in range(1, steps):
        frame_turn = frame_turn @ turns[:, step]
    for n, turn in enumerate(frame_turn):
        R[n + 1] = R[n] @ turn
    return R


@dataclass(frozen=True, kw_only=True)
class PaperMotion(RigidMotion):
    """The motion of the paper's numerical example (``sec:numerics``)."""

    def omega(self, t: Array) -> Array:
        """Return ω of α = 1 + 10 t², φ = πt + π/3, ω₃ = ½ + √(½ + 5t)."""
        alpha, phi = 1 + 10 * t**2, np.pi * t + np.pi / 3
        return np.stack([alpha * np.cos(phi), alpha * np.sin(phi), 0.5 + np.sqrt(0.5 + 5 * t)], axis=-1)

    def T(self, t: Array) -> Array:
        """Return the paper's a(t)."""
        return np.stack([np.cos(6 * t) * np.cos(12 * t), np.cos(6 * t) * np.sin(12 * t), np.sin(t)], axis=-1)


@dataclass(frozen=True, kw_only=True)
class PaperSpecial(RigidMotion):
    """Constant α and ω₃ = −σ: the paper's example of a motion that its method can't recover.

    R(t) = exp(α t [v(0)]×) exp(ω₃ t [e₃]×) solves ``eqDefOmega``. The matrix printed in the paper is no
    rotation: the sign of its second row is reversed, and its determinant is −1.
    """

    alpha: float = 4.0
    omega_3: float = 2.0
    phi: float = np.pi / 3

    def omega(self, t: Array) -> Array:
        """Return ω with φ(t) = φ(0) − ω₃ t."""
        phi = self.phi - self.omega_3 * t
        return np.stack(
            [self.alpha * np.cos(phi), self.alpha * np.sin(phi), np.full_like(t, self.omega_3)], axis=-1
        )

    def rotations(self, t: Array) -> Array:
        """Return R(t) in closed form."""
        start = self.phi - self.omega_3 * t[0]
        axis = np.array([np.cos(start), np.sin(start), 0.0])
        elapsed = (t - t[0])[:, None]
        tilt = Rotation.from_rotvec(self.alpha * elapsed * axis)
        spin = Rotation.from_rotvec(self.omega_3 * elapsed * np.array([0.0, 0.0, 1.0]))
        R: Array = (tilt * spin).as_matrix()
        return R


@dataclass(frozen=True, kw_only=True)
class Still(RigidMotion):
    """No rotation at all, only the translation."""

    def omega(self, t: Array) -> Array:
        """Return zeros."""
        return np.zeros((len(t), 3))

    def rotations(self, t: Array) -> Array:
        """Return unit matrices."""
        return np.tile(np.eye(3), (len(t), 1, 1))


@dataclass(frozen=True, kw_only=True)
class SingleAxis(RigidMotion):
    """Rotation about one axis that is fixed in the lab, with uneven speed; the angle is known in closed form.

    Attributes
    ----------
    axis:
        ``(3,)`` unit vector in the lab.
    rate:
        Mean angular speed [rad / time].
    unevenness:
        Amplitude a of the speed `rate` · (1 + a sin(2π t / period)); below 1.
    period:
        Period of the unevenness [time].
    """

    axis: Array
    rate: float
    unevenness: float = 0.0
    period: float = 1.0

    @classmethod
    def from_turns(
        cls,
        *,
        turns: float,
        duration: float,
        azimuth: float = 30.0,
        tilt: float = 0.0,
        unevenness: float = 0.3,
        drift: Drift | None = None,
    ) -> SingleAxis:
        """Return `turns` in `duration`; `azimuth` and `tilt` turn the axis in and out of the image [°]."""
        a, e = np.deg2rad([azimuth, tilt])
        axis = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        return cls(
            axis=axis,
            rate=2 * np.pi * turns / duration,
            unevenness=unevenness,
            period=duration / 2,
            drift=drift or Drift(),
        )

    def angle(self, t: Array) -> Array:
        """Return the angle turned since time 0, ``(N,)`` [rad]."""
        uneven = self.unevenness * self.period / (2 * np.pi) * (1 - np.cos(2 * np.pi * t / self.period))
        value: Array = self.rate * (t + uneven)
        return value

    def omega(self, t: Array) -> Array:
        """Return the angular speed times the axis."""
        speed = self.rate * (1 + self.unevenness * np.sin(2 * np.pi * t / self.period))
        return np.multiply.outer(speed, self.axis)

    def rotations(self, t: Array) -> Array:
        """Return R(t) in closed form."""
        angle = self.angle(t) - self.angle(t[:1])
        R: Array = Rotation.from_rotvec(np.multiply.outer(angle, self.axis)).as_matrix()
        return R


@dataclass(frozen=True, kw_only=True)
class Tumbling(RigidMotion):
    """A smooth tumbling: ω(t) is a constant and a few Fourier modes.

    Attributes
    ----------
    mean:
        ``(3,)`` constant part of ω [rad / time].
    cosine, sine:
        ``(K, 3)`` coefficients of the modes 1 … K [rad / time].
    rate:
        Angular frequency of the first mode [rad / time].
    """

    mean: Array
    cosine: Array
    sine: Array
    rate: float

    @classmethod
    def random(
        cls, rng: np.random.Generator, *, total_angle: float, duration: float, drift: Drift | None = None
    ) -> Tumbling:
        """Return a random tumbling whose |ω| integrates to `total_angle` degrees over `duration`."""
        mean = rng.standard_normal(3)
        cosine, sine = (0.5 * rng.standard_normal((3, 3)) / np.arange(1, 4)[:, None] for _ in range(2))
        rate = 2 * np.pi / duration
        shape = cls(mean=mean, cosine=cosine, sine=sine, rate=rate)
        # the path length of ω over the whole period by the midpoint rule
        t = (np.arange(4096) + 0.5) / 4096 * duration
        path = float(np.linalg.norm(shape.omega(t), axis=1).mean()) * duration
        scale = np.deg2rad(total_angle) / path
        return cls(
            mean=scale * mean, cosine=scale * cosine, sine=scale * sine, rate=rate, drift=drift or Drift()
        )

    def omega(self, t: Array) -> Array:
        """Return the constant plus the modes."""
        angle = np.multiply.outer(t, self.rate * np.arange(1, len(self.cosine) + 1))
        value: Array = self.mean + np.cos(angle) @ self.cosine + np.sin(angle) @ self.sine
        return value


@dataclass(frozen=True, kw_only=True)
class DegenerateThird(RigidMotion):
    """General motion whose middle third is a rotation about one axis in the image plane; ω is continuous.

    Attributes
    ----------
    general:
        The tumbling of the outer thirds, faded out towards the middle one.
    single:
        The single-axis rotation underneath.
    duration:
        Length of the whole motion [time].
    """

    general: Tumbling
    single: SingleAxis
    duration: float

    def omega(self, t: Array) -> Array:
        """Return ω of the single axis plus the faded tumbling."""
        # distance from the middle third in units of a third, so that the fade is 0 there and 1 at both ends
        s = np.clip(np.abs(3 * t / self.duration - 1.5) - 0.5, 0.0, 1.0)
        fade = s**3 * (10 - 15 * s + 6 * s**2)
        return self.single.omega(t) + fade[:, None] * self.general.omega(t)


@dataclass(frozen=True, kw_only=True)
class Thermal(RigidMotion):
    """A motion with Brownian motion on top: R = R₀ B, where B goes from one random rotation to the next.

    Attributes
    ----------
    motion:
        What R₀ and the translation are without it.
    time:
        ``(N,)`` evenly spaced times, between which B turns at a constant rate.
    turn, shift:
        ``(N, 3)`` rotation vectors by which B turns until the next time [rad], and translations [length].
    """

    motion: RigidMotion
    time: Array
    turn: Array
    shift: Array

    @classmethod
    def random(
        cls, rng: np.random.Generator, motion: RigidMotion, time: Array, *, diffusion: float, shaking: float
    ) -> Thermal:
        """Return a motion that is kicked at every time.

        Parameters
        ----------
        diffusion:
            Standard deviation of the rotation about each axis from one time to the next [rad].
        shaking:
            Standard deviation of the translation along each axis, another one at every time [length].
        """
        turn, shift = rng.standard_normal((2, len(time), 3))
        return cls(motion=motion, time=time, turn=diffusion * turn, shift=shaking * shift)

    def omega(self, t: Array) -> Array:
        """Return ω₀, turned by B, plus the rate at which B turns from there on."""
        before, _ = self._place(t)
        return np.asarray(self._walk(t).inv().apply(self.motion.omega(t)) + self.turn[before] / self._step)

    def T(self, t: Array) -> Array:
        """Return the translation, linear from one time to the next."""
        shift: Array = np.stack([np.interp(t, self.time, component) for component in self.shift.T], axis=1)
        return self.motion.T(t) + shift

    def rotations(self, t: Array) -> Array:
        """Return R, 1 at the first of ``(N,)`` ascending times."""
        walk = self._walk(t).as_matrix()
        R: Array = walk[0].T @ self.motion.rotations(t) @ walk
        return R

    @property
    def _step(self) -> float:
        return float(self.time[1] - self.time[0]) if len(self.time) > 1 else 1.0

    @cached_property
    def _walked(self) -> Rotation:
        """B at the times."""
        walked = accumulate(Rotation.from_rotvec(self.turn[:-1]), mul, initial=Rotation.identity())
        return Rotation.concatenate(list(walked))

    def _walk(self, t: Array) -> Rotation:
        """Return B."""
        before, since = self._place(t)
        return self._walked[before] * Rotation.from_rotvec(since[:, None] * self.turn[before])

    def _place(self, t: Array) -> tuple[NDArray[np.intp], Array]:
        """Return the last of the times up to `t`, and how far `t` is on the way to the next."""
        # a time that rounding has left just before its own step belongs to it
        place = (t - self.time[0]) / self._step + 1e-9
        before = np.clip(np.floor(place).astype(np.intp), 0, len(self.time) - 1)
        return before, np.maximum(place - before - 1e-9, 0.0)


def true_motion(
    motion: RigidMotion,
    center: Array,
    time: Array,
    *,
    time_unit: str = "s",
    length_unit: str = "pixel",
) -> Motion:
    """Sample a motion as the truth of a stack, in the gauge of the result file.

    R = 1 and T = 0 at the first frame; of the two mirror solutions the one with φ in [0, π) at the first
    frame that has a φ; φ is continuous from there on.

    Parameters
    ----------
    center:
        ``(3,)`` centre C₃ of the object [length].
    time:
        ``(N,)`` ascending times.

    Returns
    -------
    Motion
        With all frames valid and NaN for the errors, which a truth doesn't have.
    """
    n = len(time)
    omega, R = motion.omega(time), motion.rotations(time)
    center_2 = center[:2] - motion.T(time)[:, :2]
    alpha = np.hypot(omega[:, 0], omega[:, 1])
    speed = np.linalg.norm(omega, axis=1).max(initial=0.0)
    defined = alpha > ALPHA_ZERO * speed
    phi = np.full(n, np.nan)
    phi[defined] = np.unwrap(np.arctan2(omega[defined, 1], omega[defined, 0]))
    if defined.any():
        half_turns = int(np.floor(phi[defined][0] / np.pi))
        phi -= half_turns * np.pi
        if half_turns % 2:
            mirror = np.array([1.0, 1.0, -1.0])
            R = R * np.outer(mirror, mirror)
    unknown = np.full(n, np.nan)
    return Motion(
        time=time,
        frame=np.arange(n),
        T=center_2[0] - center_2,
        center=center_2,
        phi=phi,
        omega_3=omega[:, 2],
        alpha=alpha,
        R=R,
        T_errors=np.full((n, 2), np.nan),
        phi_errors=unknown,
        omega_3_errors=unknown,
        alpha_errors=unknown,
        R_errors=np.full((n, 3), np.nan),
        valid=np.ones(n, np.uint8),
        flags=np.zeros(n, np.uint16),
        residual=unknown,
        time_unit=time_unit,
        length_unit=length_unit,
        truth=True,
    )
