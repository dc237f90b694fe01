"""Scenes whose reduced map and rotation are known in closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.simulation.motions import RigidMotion
from trapcli.simulation.phantoms import Blobs, Phantom

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TwoTurns:
    """R = exp(a(t) [e3]×) exp(b(t) [e1]×), so that ω = (b', a' sin b, a' cos b)."""

    def angles(self, t: Array) -> tuple[Array, Array]:
        return 1.3 * t + 0.2 * np.sin(2 * t), 0.4 + 0.9 * t + 0.3 * t**2

    def rotations(self, t: Array) -> Array:
        a, b = self.angles(t)
        spin = Rotation.from_rotvec(np.multiply.outer(a, [0, 0, 1.0]))
        roll = Rotation.from_rotvec(np.multiply.outer(b, [1.0, 0, 0]))
        return (spin * roll).as_matrix()

    def omega(self, t: Array) -> Array:
        _, b = self.angles(t)
        spin, roll = 1.3 + 0.4 * np.cos(2 * t), 0.9 + 0.6 * t
        return np.stack([roll, spin * np.sin(b), spin * np.cos(b)], axis=-1)


@pytest.fixture(scope="session")
def two_turns() -> TwoTurns:
    return TwoTurns()


@pytest.fixture(scope="session")
def blobs() -> Blobs:
    """Round blobs without symmetry, wide enough for pixels of 0.25."""
    rng = np.random.default_rng(11)
    count = 7
    covariance = rng.uniform(0.35, 0.8, count)[:, None, None] * np.eye(3)
    return Blobs(rng.uniform(0.5, 1.0, count), rng.normal(scale=1.3, size=(count, 3)), covariance)


Render = Callable[..., Array]


@pytest.fixture(scope="session")
def render() -> Render:
    """``render(phantom, motion, time, pixels, pixel_size)``: clean frames ``(N, H, W)``."""

    def make(phantom: Phantom, motion: RigidMotion, time: Array, pixels: int, pixel_size: float) -> Array:
        x = (np.arange(pixels) - pixels // 2) * pixel_size
        poses = zip(motion.rotations(time), motion.T(time), strict=True)
        return np.array([phantom.project(R, T, x, x) for R, T in poses])

    return make


def derivative(values: Array, half: float, order: int, axis: int) -> Array:
    """Return the derivative in the middle of an interval from values at its Chebyshev nodes."""
    n = values.shape[axis]
    nodes = np.polynomial.chebyshev.chebpts1(n)
    unit = np.polynomial.chebyshev.chebder(np.eye(n), order) if order else np.eye(n)
    at_middle = np.polynomial.chebyshev.chebval(0.0, unit)
    weights = np.linalg.solve(np.polynomial.chebyshev.chebvander(nodes, n - 1).T, at_middle)
    return np.tensordot(weights, np.moveaxis(values, axis, 0), axes=1) / half**order


@dataclass(frozen=True)
class ExactMap:
    """J̃ of a phantom around one time and one line, differentiated spectrally."""

    phantom: Blobs
    rotations: Callable[[Array], Array]
    time: float
    phi: float
    mu: Array
    half: float = 0.15
    nodes: int = 15

    def derivative(self, time_order: int, phi_order: int) -> Array:
        """Return ∂t^a ∂φ^b J̃ at all μ, ``(M,)``."""
        nodes = self.half * np.polynomial.chebyshev.chebpts1(self.nodes)
        angles = self.phi + nodes
        k = self.mu[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        values = np.array([self.phantom.fourier(k, R) for R in self.rotations(self.time + nodes)])
        along_time = derivative(values, self.half, time_order, axis=0)
        return derivative(along_time, self.half, phi_order, axis=-1)


@pytest.fixture(scope="session")
def exact_map() -> type[ExactMap]:
    return ExactMap


@pytest.fixture(scope="session")
def chebyshev_derivative() -> Callable[..., Array]:
    return derivative
