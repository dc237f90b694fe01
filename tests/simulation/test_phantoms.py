"""Projections against quadrature along rays and against the laws of projection."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trapcli.simulation.phantoms import NEGLIGIBLE, Blobs, Grain, PaperPhantom

SMOOTH = {
    "paper": PaperPhantom(),
    "anisotropic": Blobs.random(np.random.default_rng(1)),
    "isotropic": Blobs.random(np.random.default_rng(2), anisotropic=False),
    "coaxial": Blobs.coaxial(np.random.default_rng(3)),
}
SHARP = {"grain": Grain.random(np.random.default_rng(4)), "sphere": Grain.sphere(3.0)}
X = (np.arange(160) - 80) * 0.2


@pytest.fixture(params=range(3))
def pose(request):
    rng = np.random.default_rng(request.param)
    return Rotation.random(rng=rng).as_matrix(), rng.uniform(-1.0, 1.0, 3), rng


@pytest.mark.parametrize("phantom", SMOOTH.values(), ids=SMOOTH)
def test_projection_is_the_integral_along_the_ray(phantom, pose):
    R, T, rng = pose
    J = phantom.project(R, T, X, X[:150])
    column, row = rng.integers(30, 130, (2, 40))
    # the trapezoidal rule converges faster than any power for a Gaussian
    x3 = np.linspace(-25.0, 25.0, 1001)
    x = np.stack(np.broadcast_arrays(X[column][:, None], X[row][:, None], x3), axis=-1)
    u = phantom.density(phantom.center + (x - phantom.center + T) @ R.T)
    integral = u.sum(axis=1) * (x3[1] - x3[0])
    assert integral.max() > 0.1 * J.max()
    np.testing.assert_allclose(J[row, column], integral, rtol=0, atol=1e-12 * J.max())


@pytest.mark.parametrize("phantom", SHARP.values(), ids=SHARP)
def test_projection_of_ellipsoids_is_the_chord_in_object_coordinates(phantom, pose):
    R, T, _ = pose
    points = Grain(phantom.step, phantom.position, phantom.form, oversampling=1)
    J = points.project(R, T, X, X)
    x1, x2 = np.meshgrid(X, X)
    start = phantom.center + (np.stack([x1, x2, 0 * x1], axis=-1) - phantom.center + T) @ R.T
    direction = R[:, 2]
    expected = np.zeros_like(J)
    for step, c, A in zip(phantom.step, phantom.position, phantom.form, strict=True):
        a = direction @ A @ direction
        b = (start - c) @ A @ direction
        discriminant = b**2 - a * (np.einsum("...i,ij,...j", start - c, A, start - c) - 1)
        expected += step * 2 * np.sqrt(np.maximum(discriminant, 0)) / a
    # grazing rays take the square root of a rounding error
    difference = np.abs(J - expected)
    assert np.quantile(difference, 0.99) < 1e-12 * J.max()
    assert difference.max() < 1e-6 * J.max()


@pytest.mark.parametrize("name", ["anisotropic", "isotropic", "coaxial"])
def test_mass_and_center_of_blobs_agree_with_a_sum_over_voxels(name):
    phantom = SMOOTH[name]
    x = np.linspace(-5.2, 5.2, 75)
    points = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1).reshape(-1, 3)
    u = phantom.density(points)
    assert u.sum() * (x[1] - x[0]) ** 3 == pytest.approx(phantom.mass, rel=1e-6)
    np.testing.assert_allclose(u @ points / u.sum(), phantom.center, atol=1e-6)


def test_paper_center_and_mass_are_exact():
    phantom = PaperPhantom()
    x = np.linspace(-16.0, 16.0, 81)
    points = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1).reshape(-1, 3)
    u = phantom.density(points)
    assert u.sum() * (x[1] - x[0]) ** 3 == pytest.approx(phantom.mass, rel=1e-12)
    np.testing.assert_allclose(u @ points / u.sum(), phantom.center, atol=1e-12)


def test_mass_and_center_of_a_grain_agree_with_a_sum_over_voxels():
    phantom = Grain.random(np.random.default_rng(7))
    x = np.linspace(-5.0, 5.0, 101)
    points = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1).reshape(-1, 3)
    u = phantom.density(points)
    assert u.sum() * (x[1] - x[0]) ** 3 == pytest.approx(phantom.mass, rel=0.01)
    np.testing.assert_allclose(u @ points / u.sum(), phantom.center, atol=0.02)
    assert Grain.sphere(3.0).mass == pytest.approx(4 / 3 * np.pi * 27)


@pytest.mark.parametrize("phantom", SMOOTH.values(), ids=SMOOTH)
def test_image_has_the_mass_of_the_object_and_its_center_at_C3_minus_T(phantom, pose):
    R, T, _ = pose
    x = (np.arange(300) - 150) * 0.12
    J = phantom.project(R, T, x, x)
    assert J.sum() * 0.12**2 == pytest.approx(phantom.mass, rel=1e-9)
    center = np.array([J.sum(axis=0) @ x, J.sum(axis=1) @ x]) / J.sum()
    np.testing.assert_allclose(center, (phantom.center - T)[:2], atol=1e-9)


def test_image_of_a_grain_has_its_mass_and_center(pose):
    R, T, _ = pose
    phantom = SHARP["grain"]
    x = (np.arange(300) - 150) * 0.05
    J = phantom.project(R, T, x, x)
    assert J.sum() * 0.05**2 == pytest.approx(phantom.mass, rel=1e-3)
    center = np.array([J.sum(axis=0) @ x, J.sum(axis=1) @ x]) / J.sum()
    np.testing.assert_allclose(center, (phantom.center - T)[:2], atol=1e-3)


def test_oversampling_comes_close_to_the_mean_over_the_pixels_area():
    coarse, fine = (np.arange(n) - n / 2 + 0.5 for n in (24, 24 * 32))
    truth = Grain.sphere(9.3, oversampling=1).project(np.eye(3), np.zeros(3), fine / 32, fine / 32)
    truth = truth.reshape(24, 32, 24, 32).mean(axis=(1, 3))
    errors = [
        np.abs(
            Grain.sphere(9.3, oversampling=n).project(np.eye(3), np.zeros(3), coarse, coarse) - truth
        ).max()
        for n in (1, 2, 4)
    ]
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.5 * errors[1]


@pytest.mark.parametrize("name", ["anisotropic", "isotropic"])
def test_fourier_is_the_transform_of_the_image(name, pose):
    R, T, rng = pose
    phantom = SMOOTH[name]
    k = rng.uniform(-2.0, 2.0, (25, 2))
    J = phantom.project(R, T, X, X)
    center = (phantom.center - T)[:2]
    e1, e2 = np.exp(-1j * np.multiply.outer(k[:, 0], X)), np.exp(-1j * np.multiply.outer(k[:, 1], X))
    direct = np.einsum("kj,ki,ij->k", e1, e2, J) * 0.2**2 / (2 * np.pi) * np.exp(1j * k @ center)
    np.testing.assert_allclose(phantom.fourier(k, R), direct, atol=1e-10 * phantom.mass)


@pytest.mark.parametrize("phantom", [*SMOOTH.values(), *SHARP.values()], ids=[*SMOOTH, *SHARP])
def test_nothing_lies_outside_of_the_radius(phantom):
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((2000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    r = np.linspace(0.0, 1.5, 61)[:, None, None]
    u = phantom.density(phantom.center + phantom.radius * r * direction)
    # a sum of blobs may add up to slightly more than each of them
    assert u[r[:, 0, 0] > 1.0].max() <= 3 * NEGLIGIBLE * u.max()
    assert u[(r[:, 0, 0] > 0.5) & (r[:, 0, 0] <= 1.0)].max() > 0


@pytest.mark.parametrize("make", [Blobs.random, Blobs.coaxial, Grain.random])
def test_random_objects_have_the_given_radius_lie_at_0_and_follow_the_seed(make):
    first, again, other = (make(np.random.default_rng(seed), radius=7.0) for seed in (8, 8, 9))
    assert first.radius == pytest.approx(7.0)
    np.testing.assert_allclose(first.center, 0.0, atol=1e-12)
    points = np.random.default_rng(0).uniform(-4, 4, (100, 3))
    np.testing.assert_array_equal(first.density(points), again.density(points))
    assert np.any(first.density(points) != other.density(points))


def test_grains_have_no_negative_density_and_4_to_8_inclusions():
    points = np.random.default_rng(0).uniform(-5, 5, (4000, 3))
    counts = set()
    for seed in range(60):
        grain = Grain.random(np.random.default_rng(seed))
        assert grain.density(points).min() >= -1e-12
        counts.add(len(grain.step) - 2)
    assert counts == {4, 5, 6, 7, 8}


def test_a_body_of_revolution_looks_the_same_when_it_turns_about_its_axis():
    body = Blobs.coaxial(np.random.default_rng(3), axis=(1.0, 0.0, 0.0))
    turned = Rotation.from_rotvec([1.3, 0.0, 0.0]).as_matrix()
    images = [body.project(R, np.zeros(3), X, X) for R in (np.eye(3), turned)]
    np.testing.assert_allclose(images[0], images[1], atol=1e-12 * images[0].max())


def test_a_sphere_looks_the_same_from_everywhere(pose):
    R, _, _ = pose
    sphere = Grain.sphere(3.0)
    images = [sphere.project(Q, np.zeros(3), X, X) for Q in (np.eye(3), R)]
    np.testing.assert_allclose(images[0], images[1], atol=1e-6)
