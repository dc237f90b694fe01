from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from trapcli.motion.integrate import integrate_rotation, rotation_errors


def angle(R: np.ndarray, S: np.ndarray) -> np.ndarray:
    return (Rotation.from_matrix(R).inv() * Rotation.from_matrix(S)).magnitude()


def test_fourth_order(two_turns) -> None:  # type: ignore[no-untyped-def]
    errors = []
    for n in (41, 81):
        t = np.linspace(0, 2, n)
        exact = two_turns.rotations(t)
        exact = exact[0].T @ exact
        errors.append(angle(integrate_rotation(two_turns.omega(t), t), exact).max())
    assert errors[1] < 1e-6
    assert errors[0] / errors[1] > 11


def test_uneven_times(two_turns) -> None:  # type: ignore[no-untyped-def]
    t = np.sort(np.random.default_rng(1).uniform(0, 1, 400))
    exact = two_turns.rotations(t)
    assert angle(integrate_rotation(two_turns.omega(t), t), exact[0].T @ exact).max() < 1e-6


def test_constant_velocity_is_exact() -> None:
    t = np.linspace(0, 3, 10)
    omega = np.array([0.3, -1.0, 0.5])
    exact = Rotation.from_rotvec(np.multiply.outer(t, omega)).as_matrix()
    assert np.abs(integrate_rotation(np.tile(omega, (10, 1)), t) - exact).max() < 1e-13


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 300))
def test_stays_in_the_group(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    R = integrate_rotation(
        rng.normal(scale=30, size=(n, 3)), np.sort(rng.uniform(0, 1, n)) + np.arange(n) * 1e-6
    )
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-12
    assert np.abs(np.linalg.det(R) - 1).max() < 1e-10
    assert np.array_equal(R[0], np.eye(3))


def test_twenty_thousand_frames() -> None:
    t = np.arange(20_000) * 1e-3
    omega = np.stack([5 * np.cos(t), 3 * np.sin(2 * t), 4 + np.cos(7 * t)], axis=1)
    R = integrate_rotation(omega, t)
    assert np.abs(np.linalg.det(R) - 1).max() < 1e-10
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-12


def test_gaps(two_turns) -> None:  # type: ignore[no-untyped-def]
    t = np.linspace(0, 1, 201)
    exact = two_turns.rotations(t)
    omega = two_turns.omega(t)
    omega[50:53] = np.nan
    omega[120:140] = np.nan
    R = integrate_rotation(omega, t, bridge=5)
    assert np.isfinite(R[:120]).all()
    assert np.isnan(R[120:]).all()
    assert angle(R[:120], (exact[0].T @ exact)[:120]).max() < 1e-4


@pytest.mark.parametrize("missing", [slice(0, 3), slice(197, 200)])
def test_short_gaps_at_the_ends_are_continued(missing: slice, two_turns) -> None:  # type: ignore[no-untyped-def]
    t = np.linspace(0, 1, 200)
    omega = two_turns.omega(t)
    omega[missing] = np.nan
    assert np.isfinite(integrate_rotation(omega, t, bridge=5)).all()


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_few_or_unknown_frames(n: int) -> None:
    R = integrate_rotation(np.full((n, 3), np.nan), np.arange(n, dtype=float))
    assert R.shape == (n, 3, 3)
    assert np.isnan(R[1:]).all()
    assert np.array_equal(R[:1], np.eye(3)[None][:n])


def test_errors_of_white_noise_come_true() -> None:
    rng = np.random.default_rng(5)
    t = np.linspace(0, 2, 80)
    omega = np.stack([2 * np.cos(t), np.sin(t), 1 + 0 * t], axis=1)
    sigma = np.array([0.02, 0.05, 0.03])
    clean = integrate_rotation(omega, t)
    off = []
    for _ in range(300):
        noisy = integrate_rotation(omega + sigma * rng.standard_normal(omega.shape), t)
        off.append(Rotation.from_matrix(np.swapaxes(clean, 1, 2) @ noisy).as_rotvec())
    errors = rotation_errors(omega, np.tile(np.diag(sigma**2), (80, 1, 1)), t, 1.0)
    assert np.std(off, axis=0)[20:] == pytest.approx(errors[20:], rel=0.2)
    assert np.array_equal(errors[0], np.zeros(3))


def test_bridged_frames_are_not_trusted() -> None:
    t = np.linspace(0, 1, 50)
    omega = np.tile([1.0, 0.0, 0.5], (50, 1))
    covariance = np.tile(1e-6 * np.eye(3), (50, 1, 1))
    known = rotation_errors(omega, covariance, t, 1.0)
    omega[10:15] = np.nan
    covariance[10:15] = np.nan
    assert (rotation_errors(omega, covariance, t, 1.0)[20] > 10 * known[20]).all()
    assert np.isnan(rotation_errors(np.full((5, 3), np.nan), covariance[:5], t[:5], 1.0)).all()
