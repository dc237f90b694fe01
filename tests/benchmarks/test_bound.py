"""The Cramér–Rao bound of benchmarks/accuracy against a Fisher matrix by differences of pixels."""

from __future__ import annotations

from dataclasses import replace

import bound as bounds
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.motion.integrate import integrate_rotation
from trapcli.motion.path import Spline, align
from trapcli.simulation.config import MotionConfig, PhantomConfig, SimulateConfig, StackConfig
from trapcli.simulation.render import Scene

Array = NDArray[np.float64]

BAND = 6.0
NOISE = 1e-5  # so low that what is thought of the object beforehand counts for nothing
INTERVALS = 2
SMALL = 1e-4


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_config(
        SimulateConfig(
            seed=3,
            stack=StackConfig(frames=14, height=32, width=32, pixel_size=0.5, frame_interval=0.1),
            phantom=PhantomConfig(kind="blobs", radius=6.0),
            motion=MotionConfig(kind="tumbling", total_angle=120.0),
        )
    )


def in_band(images: Array, pixel: float, highest: float) -> Array:
    """Return the part of ``(…, L, L)`` images below a spatial frequency."""
    frequency = 2 * np.pi * np.fft.fftfreq(images.shape[-1], pixel)
    kept = np.hypot(*np.meshgrid(frequency, frequency)) <= highest
    return np.fft.ifft2(np.fft.fft2(images) * kept).real


def by_differences(scene: Scene) -> Array:
    """Return the information of all rotations: every parameter is moved, and all pixels are looked at."""
    pixel, radius = scene.config.stack.pixel_size, bounds.visible_radius(scene)
    lattice, width = bounds._lattice(radius, BAND / radius)
    half = int(np.ceil((np.abs(lattice).max() + bounds._TAIL * width) / pixel))
    x = np.arange(-half, half) * pixel
    center, R = scene.phantom.center, scene.motion.rotations(scene.time)

    def image(R: Array, shift: Array) -> Array:
        return scene.phantom.project(R, center - [*shift, 0.0], x, x)

    def blob(place: Array) -> Array:
        return np.exp(-0.5 * ((x - place[0]) ** 2 + (x[:, None] - place[1]) ** 2) / width**2)

    count = len(R)
    turned = np.zeros((count, 3, count, len(x), len(x)))
    shifted = np.zeros((count, 2, count, len(x), len(x)))
    for g in range(count):
        for axis in range(3):
            turn = Rotation.from_rotvec(SMALL * np.eye(3)[axis]).as_matrix()
            more, less = image(R[g] @ turn, np.zeros(2)), image(R[g] @ turn.T, np.zeros(2))
            turned[g, axis, g] = (more - less) / (2 * SMALL)
        for axis in range(2):
            step = SMALL * np.eye(2)[axis]
            shifted[g, axis, g] = (image(R[g], step) - image(R[g], -step)) / (2 * SMALL)
    blobs = np.array([[blob(b @ rotation) for rotation in R] for b in lattice])
    turned, shifted, blobs = (in_band(images, pixel, BAND / radius) for images in (turned, shifted, blobs))
    slopes = turned.reshape(3 * count, -1).T
    nuisance = np.concatenate([blobs.reshape(len(lattice), -1), shifted.reshape(2 * count, -1)]).T
    nuisance /= np.linalg.norm(nuisance, axis=0)
    basis, size, _ = np.linalg.svd(nuisance, full_matrices=False)
    basis = basis[:, size > 1e-6 * size[0]]
    left = slopes - basis @ (basis.T @ slopes)
    return left.T @ left / (NOISE * scene.peak) ** 2


def test_information_is_what_differences_of_pixels_give(scene: Scene) -> None:
    found = bounds.information(scene, [NOISE], BAND)[0]
    np.testing.assert_array_equal(found.frame, np.arange(len(scene.time)))
    expected = by_differences(scene)
    scale = np.sqrt(np.diag(expected))
    # the square cuts off the tails of the outermost blobs
    assert np.abs((found.fisher - expected) / np.outer(scale, scale)).max() < 1e-2
    by_both = [
        bounds.bound_of_spline(scene, replace(found, fisher=fisher), 2) for fisher in (found.fisher, expected)
    ]
    assert by_both[0].mean == pytest.approx(by_both[1].mean, rel=2e-3)


def test_bound_is_the_error_of_many_small_changes_of_omega(scene: Scene) -> None:
    """Each change is integrated to rotations, and aligned as a result is."""
    found = bounds.information(scene, [NOISE], BAND)[0]
    stated = bounds.bound_of_spline(scene, found, INTERVALS)
    time = np.linspace(scene.time[0], scene.time[-1], 10 * (len(scene.time) - 1) + 1)
    values = Spline(time[0], time[-1], INTERVALS).values(time)
    R = scene.motion.rotations(scene.time)
    start, free = scene.motion.omega(time), values.shape[1]

    def turned(coefficients: Array) -> Array:
        return integrate_rotation(start + values @ coefficients.reshape(free, 3), time)[::10]

    unit = 1e-5 * np.eye(3 * free)
    design = np.stack(
        [Rotation.from_matrix(np.swapaxes(R, 1, 2) @ turned(one)).as_rotvec().ravel() / 1e-5 for one in unit],
        axis=1,
    )
    covariance = np.linalg.inv(design.T @ found.fisher @ design)
    draws = np.random.default_rng(5).multivariate_normal(np.zeros(3 * free), covariance, 300)
    angles = np.rad2deg([align(turned(draw), R)[0] for draw in draws])
    assert stated.mean == pytest.approx(angles.mean(), rel=0.1)
    assert stated.worst == pytest.approx(angles.max(axis=1).mean(), rel=0.1)


def test_the_more_is_free_the_larger_the_bound(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    found = bounds.information(scene, [NOISE], BAND)[0]
    errors = [bounds.bound_of_spline(scene, found, n).mean for n in (1, 2, 4)]
    assert errors == sorted(errors)
    errors = []
    for spread in (0.01, 1.0, 100.0):
        monkeypatch.setattr(bounds, "SPREAD", spread)
        errors.append(bounds.bound_of_spline(scene, bounds.information(scene, [0.05], BAND)[0], 2).mean)
    assert errors == sorted(errors)


def test_noise_and_bound_are_proportional_where_the_object_is_seen(scene: Scene) -> None:
    both = bounds.information(scene, [NOISE, 2 * NOISE], BAND)
    errors = [bounds.bound_of_spline(scene, found, 2).mean for found in both]
    assert errors[1] / errors[0] == pytest.approx(2.0, rel=1e-3)


def test_the_spline_of_the_bound_holds_the_true_motion(scene: Scene) -> None:
    slow = replace(scene.config, stack=replace(scene.config.stack, frames=40))
    smooth = Scene.from_config(replace(slow, motion=MotionConfig(kind="single-axis", turns=0.4)))
    stated = bounds.bound(smooth, bounds.information(smooth, [0.01], BAND)[0])
    assert stated.intervals > 1
    assert bounds._missed(smooth, stated.intervals) < 0.1 * stated.mean
    assert bounds._missed(smooth, stated.intervals - 1) > 0.1 * stated.mean
