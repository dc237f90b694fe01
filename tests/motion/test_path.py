"""Splines, bent paths and the removal of the gauge, against closed forms and numerical differentiation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trapcli.motion.path import Path, Spline, _right_jacobian, align, cross_matrix, deviation

SIGMA = np.diag([1.0, 1.0, -1.0])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_splines_sum_to_one_and_their_slopes_are_derivatives() -> None:
    spline, h = Spline(-1.0, 2.0, 5), 1e-6
    inside = np.linspace(-0.9, 1.9, 41)
    assert np.abs(spline.values(inside).sum(axis=1) - 1).max() < 1e-14
    assert spline.values(inside).shape == (41, spline.size)
    differences = (spline.values(inside + h) - spline.values(inside - h)) / (2 * h)
    assert np.abs(spline.slopes(inside) - differences).max() < 1e-7


def test_splines_fit_any_cubic_and_any_of_their_own() -> None:
    spline, t = Spline(0.0, 3.0, 6), np.linspace(0, 3, 60)
    cubic = np.stack([t**3 - 2 * t, 1 + t**2], axis=1)
    assert np.abs(spline.values(t) @ spline.fit(t, cubic) - cubic).max() < 2e-5 * np.abs(cubic).max()
    own = spline.values(t) @ np.random.default_rng(0).normal(size=(spline.size, 3))
    assert np.abs(spline.values(t) @ spline.fit(t, own) - own).max() < 2e-4 * np.abs(own).max()


def test_the_ends_belong_to_the_spline() -> None:
    spline = Spline(0.0, 1.0, 4)
    assert spline.values(np.array([0.0, 1.0])).sum(axis=1) == pytest.approx(1)


@pytest.mark.parametrize("size", [1e-6, 0.9e-4, 1.1e-4, 1e-2, 1.0, 3.0])
def test_right_jacobian_against_differences(rng: np.random.Generator, size: float) -> None:
    delta = rng.normal(size=(20, 3))
    delta *= size / np.linalg.norm(delta, axis=1)[:, None]
    h = 1e-5
    for axis, unit in enumerate(np.eye(3)):
        before, after = (Rotation.from_rotvec(delta + s * h * unit) for s in (-1, 1))
        column = (before.inv() * after).as_rotvec() / (2 * h)
        assert np.abs(_right_jacobian(delta)[:, :, axis] - column).max() < 1e-9


def test_cross_matrix(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(2, 4, 5, 3))
    assert np.einsum("...ij,...j->...i", cross_matrix(a), b) == pytest.approx(np.cross(a, b), abs=1e-15)


@pytest.mark.parametrize("size", [0.01, 1.0])
def test_a_bent_path_keeps_R_and_omega_together(
    two_turns: Any, rng: np.random.Generator, size: float
) -> None:
    spline, h = Spline(0.0, 2.0, 5), 1e-5
    middle = np.linspace(0.05, 1.95, 23)
    time = (middle[:, None] + [-h, 0, h]).ravel()
    path = Path(time, two_turns.rotations(time), two_turns.omega(time))
    coefficients = size * rng.normal(size=(spline.size, 3))
    bent = path.bent(spline, coefficients)
    delta = Rotation.from_rotvec(spline.values(time) @ coefficients).as_matrix()
    assert pytest.approx(path.R @ delta, abs=1e-14) == bent.R
    before, here, after = (slice(i, None, 3) for i in range(3))
    turns = np.swapaxes(bent.R[before], 1, 2) @ bent.R[after]
    numerical = Rotation.from_matrix(turns).as_rotvec() / (2 * h)
    assert bent.omega[here] == pytest.approx(numerical, abs=1e-8 * np.abs(numerical).max())


def test_several_paths_are_bent_at_once(two_turns: Any, rng: np.random.Generator) -> None:
    time, spline = np.linspace(0, 1, 20), Spline(0.0, 1.0, 4)
    paths = [Path(time, two_turns.rotations(t), two_turns.omega(t)) for t in (time, time + 0.3)]
    coefficients = rng.normal(size=(2, spline.size, 3))
    together = Path(time, np.stack([p.R for p in paths]), np.stack([p.omega for p in paths]))
    bent = together.bent(spline, coefficients)
    for i, path in enumerate(paths):
        alone = path.bent(spline, coefficients[i])
        assert pytest.approx(alone.R, abs=1e-14) == bent.R[i]
        assert bent.omega[i] == pytest.approx(alone.omega, abs=1e-12)


def test_no_bend_changes_nothing(two_turns: Any) -> None:
    time = np.linspace(0, 1, 20)
    path = Path(time, two_turns.rotations(time), two_turns.omega(time))
    spline = Spline(0.0, 1.0, 4)
    bent = path.bent(spline, np.zeros((spline.size, 3)))
    assert pytest.approx(path.R, abs=1e-15) == bent.R  # the step back to SO(3) rounds
    assert np.array_equal(bent.omega, path.omega)


def test_constant_angular_velocity() -> None:
    time, omega = np.array([0.0, 0.1, 0.3, 0.7, 1.0]), np.array([0.3, -1.2, 2.0])
    path = Path.constant(time, omega)
    assert path.mean_omega() == pytest.approx(np.tile(omega, (4, 1)), abs=1e-13)
    assert path.R[2].T @ path.R[3] == pytest.approx(Rotation.from_rotvec(0.4 * omega).as_matrix(), abs=1e-14)
    assert Path.constant(np.linspace(0, 1, 3), omega).R[1] == pytest.approx(np.eye(3))
    spline = Spline(0.0, 1.0, 3)
    smooth = Path.smooth(spline, np.tile(omega, (spline.size, 1)), time)
    assert smooth.omega == pytest.approx(path.omega, abs=1e-14)
    assert pytest.approx(path.R[0].T @ path.R, abs=1e-13) == smooth.R


def test_a_smooth_path_follows_its_omega(two_turns: Any) -> None:
    time = np.linspace(0, 1.5, 301)
    spline = Spline(0.0, 1.5, 40)
    path = Path.smooth(spline, spline.fit(time, two_turns.omega(time)), time)
    expected = two_turns.rotations(time)
    assert np.abs(path.R - expected[0].T @ expected).max() < 1e-6


def test_an_extended_path_goes_on_at_the_rate_of_its_ends() -> None:
    time, omega = np.linspace(0, 1, 31), np.array([1.0, -0.5, 0.7])
    whole = Path.constant(time, omega)
    part = Path(time[8:20], whole.R[8:20], whole.omega[8:20])
    extended = part.extended(time, 8, 4)
    assert np.array_equal(extended.R[8:20], part.R)
    assert pytest.approx(whole.R, abs=1e-12) == extended.R
    assert extended.omega == pytest.approx(whole.omega, abs=1e-12)


def test_a_path_goes_on_as_its_mirror_image(two_turns: Any) -> None:
    time = np.linspace(0, 1, 400)
    path = Path(time, two_turns.rotations(time), two_turns.omega(time))
    other = path.mirrored(150)
    assert pytest.approx(path.R[:151], abs=1e-12) == other.R[:151]
    steps, mirrored = (np.swapaxes(p.R[150:-1], 1, 2) @ p.R[151:] for p in (path, other))
    np.testing.assert_allclose(mirrored, SIGMA @ steps @ SIGMA, atol=1e-12)
    # its omega is that of its rotations
    np.testing.assert_allclose(
        other.mean_omega()[160:], other.omega[160:-1], atol=0.02 * np.abs(path.omega).max()
    )
    assert pytest.approx(path.R, abs=1e-12) == other.mirrored(150).R
    assert align(path.mirrored(0).R, path.R)[0].max() < 1e-12


@pytest.mark.parametrize("mirrored", [False, True])
def test_align_removes_the_gauge_exactly(two_turns: Any, rng: np.random.Generator, mirrored: bool) -> None:
    R = two_turns.rotations(np.linspace(0, 2, 50))
    constant = Rotation.random(rng=rng).as_matrix()
    other = constant @ (SIGMA @ R @ SIGMA if mirrored else R)
    angles, found = align(other, R)
    assert angles.max() < 1e-12
    assert found == mirrored


def test_align_leaves_what_is_not_gauge(two_turns: Any) -> None:
    R = two_turns.rotations(np.linspace(0, 2, 50))
    turn = Rotation.from_rotvec(0.02 * np.tile([0, 1, 0], (50, 1)) * np.linspace(-1, 1, 50)[:, None])
    angles, _ = align(R @ turn.as_matrix(), R)
    assert 0.002 < angles.mean() < 0.02


def test_the_part_about_the_optical_axis_turns_at_its_own_rate() -> None:
    """What else a path turns about has part in that angle."""
    spline, time = Spline(0.0, 1.0, 30), np.linspace(0.0, 1.0, 601)
    coefficients = spline.fit(
        time, np.stack([3 + 2 * np.sin(5 * time), 2 * time, 4 + np.cos(7 * time)], axis=1)
    )
    path = Path.smooth(spline, coefficients, time)
    planar = path.planar(spline)
    angle = np.unwrap(np.arctan2(planar.R[:, 1, 0], planar.R[:, 0, 0]))
    assert np.abs(planar.omega[:, 2] - path.omega[:, 2]).max() > 0.5
    assert not planar.omega[:, :2].any()
    np.testing.assert_allclose(np.gradient(angle, time)[1:-1], planar.omega[1:-1, 2], rtol=1e-3)
    relative = path.R[0].T @ path.R
    turned = np.arctan2(relative[:, 1, 0] - relative[:, 0, 1], relative[:, 0, 0] + relative[:, 1, 1])
    np.testing.assert_allclose(angle, np.unwrap(turned), atol=2e-3)


def test_the_simplest_path_nearby_has_lost_its_wiggles() -> None:
    fine, time = Spline(0.0, 10.0, 60), np.linspace(0, 10, 400)
    omega = np.stack([np.sin(time), np.ones_like(time), 0.1 * time], axis=1)
    smooth = Path.smooth(fine, fine.fit(time, omega), time)
    wiggles = np.random.default_rng(0).normal(size=(fine.size, 3))
    shuffled = np.random.default_rng(1).permutation(len(time))
    rough = smooth.bent(fine, 0.005 * wiggles)
    rough = Path(time[shuffled], rough.R[shuffled], rough.omega[shuffled])
    simple = rough.simplest(fine, 0.02)
    assert align(simple.R, rough.R)[0].mean() < 0.02

    def roughness(path: Path) -> float:
        return float(np.abs(np.diff(path.omega[np.argsort(path.time)], 2, axis=0)).mean())

    assert roughness(simple) < 0.1 * roughness(rough)
    # what only as many intervals can follow stays as it is
    assert rough.simplest(fine, 1e-9) is rough


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_way_from_one_path_to_another_is_free_of_the_gauge(
    rng: np.random.Generator, mirrored: bool
) -> None:
    R = Rotation.random(80, random_state=3).as_matrix()
    way = 0.01 * rng.normal(size=(80, 3))
    other = Rotation.random(random_state=4).as_matrix() @ R @ Rotation.from_rotvec(way).as_matrix()
    found = deviation(R, SIGMA @ other @ SIGMA if mirrored else other)
    # a turn of the object moves all frames alike, in its coordinates
    apart = np.einsum("nij,nj->ni", R, found - way)
    assert np.ptp(apart, axis=0).max() < 2e-4
    assert np.abs(np.einsum("nij,nj->i", R, found)).max() / 80 < 2e-4
