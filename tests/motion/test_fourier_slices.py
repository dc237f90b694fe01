"""The forward operator: closed form, adjoint, normal operator."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trapcli.motion.fourier_slices import (
    NormalOperator,
    back_project,
    circulant_density,
    project,
    slice_points,
)
from trapcli.simulation.phantoms import Blobs


@pytest.fixture
def points():
    rng = np.random.default_rng(0)
    R = Rotation.random(30, rng=rng).as_matrix()
    k = rng.uniform(-2, 2, (40, 2))
    return slice_points(R, k)


def test_projection_of_blobs_in_closed_form():
    """Modes of a sampled smooth object are those of its projections (the Fourier slice theorem)."""
    rng = np.random.default_rng(1)
    blobs = Blobs.random(rng, count=4, radius=9.0)
    n, spacing = 40, 0.5
    axis = (np.arange(n) - n // 2) * spacing
    x1, x2, x3 = np.meshgrid(axis, axis, axis, indexing="ij")
    lattice = blobs.density(np.stack([x1, x2, x3], axis=-1) + blobs.center) * spacing**3
    R = Rotation.random(5, rng=rng).as_matrix()
    k = rng.uniform(-2, 2, (50, 2))
    found = project(slice_points(R, k, spacing), lattice).reshape(5, 50) / (2 * np.pi)
    exact = np.array([blobs.fourier(k, rotation) for rotation in R])
    np.testing.assert_allclose(found, exact, atol=2e-5 * np.abs(exact).max())


@pytest.mark.parametrize(("kind", "tolerance"), [(np.float64, 1e-11), (np.float32, 1e-4)])
def test_back_projection_is_the_adjoint(points, kind, tolerance):
    rng = np.random.default_rng(2)
    lattice = rng.standard_normal((10, 10, 10)).astype(kind)
    values = (rng.standard_normal((2, len(points[0]))).T @ [1, 1j]).astype(np.result_type(kind, 1j))
    forth = np.vdot(values, project(points, lattice)).real
    back = np.sum(back_project(points, values, 10) * lattice, dtype=float)
    assert back == pytest.approx(
        forth, abs=tolerance * float(np.linalg.norm(values) * np.linalg.norm(lattice))
    )
    assert project(points, lattice).dtype == values.dtype


@pytest.mark.parametrize("accuracy", [1e-6, 1e-10])
def test_projection_is_as_accurate_as_asked(points, accuracy):
    lattice = np.random.default_rng(4).standard_normal((7, 7, 7))
    b = np.stack(np.meshgrid(*3 * [np.arange(7) - 3], indexing="ij"), axis=-1).reshape(-1, 3)
    exact = np.exp(-1j * np.transpose(points) @ b.T) @ lattice.ravel()
    off = np.linalg.norm(project(points, lattice, accuracy) - exact) / np.linalg.norm(exact)
    assert off < 10 * accuracy


def test_several_lattices_at_once(points):
    lattices = np.random.default_rng(3).standard_normal((2, 6, 6, 6))
    both = project(points, lattices)
    np.testing.assert_allclose(both[1], project(points, lattices[1]), atol=1e-11)


def test_normal_operator_is_forth_and_back(points):
    rng = np.random.default_rng(4)
    weights = rng.uniform(0, 1, len(points[0]))
    lattice = rng.standard_normal((8, 8, 8)).astype(np.float32)
    normal = NormalOperator(back_project(points, weights.astype(complex), 16))
    expected = back_project(points, weights * project(points, lattice.astype(float)), 8)
    np.testing.assert_allclose(normal(lattice), expected, atol=1e-5 * np.abs(expected).max())


def test_density_of_lattice_frequencies_seen_evenly():
    """Every lattice frequency seen once, with weight w: the circulant is the operator itself."""
    n, weight = 6, 0.7
    frequency = 2 * np.pi * np.fft.fftfreq(n)
    points = [axis.ravel() for axis in np.meshgrid(frequency, frequency, frequency, indexing="ij")]
    kernel = back_project(points, np.full(n**3, weight, complex), 2 * n)
    np.testing.assert_allclose(circulant_density(kernel), weight * n**3, rtol=1e-6)
