"""How rough ω is, found from the data: alike or not in all directions."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from trapcli.motion.path import Path, Spline
from trapcli.motion.roughness import Roughness

Array = NDArray[np.float64]
SPLINE = Spline(0.0, 1.0, 40)
ERROR = 1e-3  # of the angles at each time [rad]


def still(spline: Spline = SPLINE) -> Path:
    grid = spline.grid
    return Path(grid, np.tile(np.eye(3), (len(grid), 1, 1)), np.zeros((len(grid), 3)))


def measured(angles: Array, seed: int, spline: Spline = SPLINE) -> tuple[Array, Array]:
    """Return Hessian and gradient of the misfit to noisy small ``(N, 3)`` angles."""
    noisy = angles + ERROR * np.random.default_rng(seed).normal(size=angles.shape)
    values = spline.values(np.linspace(0, 1, len(angles)))
    return np.kron(values.T @ values, np.eye(3)) / ERROR**2, (values.T @ noisy).ravel() / ERROR**2


def uneven(time: Array) -> Array:
    """Return small angles that change unevenly about the second axis alone."""
    return np.stack([0.01 * time, np.sin(9 * time), -0.02 * time], axis=1)


def test_directions_of_steady_rotation_are_told_from_that_of_an_uneven_one() -> None:
    time = np.linspace(0, 1, 200)
    found = Roughness(SPLINE).weighed(*measured(uneven(time), 0), still(), 0)
    assert found.shape is not None
    assert np.linalg.det(found.shape) == pytest.approx(1)
    stiffness = np.diag(found.shape)
    assert min(stiffness[0], stiffness[2]) > 5 * stiffness[1]


def test_a_shape_errs_less_about_the_axes_that_are_steady() -> None:
    time, errors = np.linspace(0, 1, 200), []
    values = SPLINE.values(time)
    for seed in range(20):
        hessian, downhill = measured(uneven(time), seed)
        free = Roughness(SPLINE)
        design, bend = free._design(still(), 0), free._bend(still(), 0)
        for roughness in (
            free._alike(hessian, downhill, design, bend),
            free.weighed(hessian, downhill, still(), 0),
        ):
            step = np.linalg.solve(hessian + roughness.curvature(still(), 0), downhill)
            errors.append(np.mean((values @ step.reshape(-1, 3) - uneven(time)) ** 2, axis=0))
    alike_error, shaped_error = np.reshape(errors, (-1, 2, 3)).mean(axis=0)
    assert (shaped_error[[0, 2]] < 0.8 * alike_error[[0, 2]]).all()
    assert shaped_error.mean() < 0.9 * alike_error.mean()


def test_the_shape_turns_with_the_axes() -> None:
    time, turn = np.linspace(0, 1, 200), np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    values = SPLINE.values(time)
    hessian, downhill = measured(uneven(time), 1)
    shape = Roughness(SPLINE).weighed(hessian, downhill, still(), 0).shape
    turned = (downhill.reshape(-1, 3) @ turn.T).ravel()
    assert len(downhill) == 3 * values.shape[1]
    assert Roughness(SPLINE).weighed(hessian, turned, still(), 0).shape == pytest.approx(
        turn @ shape @ turn.T, rel=1e-3, abs=1e-3 * np.abs(shape).max()
    )


def test_kicks_are_told_from_a_motion_that_is_smooth() -> None:
    time = np.linspace(0, 1, 200)
    values = SPLINE.values(time)
    smooth_error: list[float] = []
    kicked_error: list[float] = []
    for seed in range(10):
        kicks = ERROR * np.random.default_rng(100 + seed).normal(size=(200, 3))
        angles = 0.1 * uneven(time) + np.cumsum(kicks, axis=0)
        assert Roughness(SPLINE).formed(*measured(0.1 * uneven(time), seed), still(), 0).kicks == 0
        change = *measured(angles, seed), still(), 0
        found = Roughness(SPLINE).formed(*change)
        assert found.kicks > 0
        for roughness, errors in ((Roughness(SPLINE), smooth_error), (found, kicked_error)):
            hessian = change[0] + roughness.weighed(*change).curvature(still(), 0)
            step = np.linalg.solve(hessian, change[1]).reshape(-1, 3)
            errors.append(np.mean((values @ step - angles) ** 2))
    assert (np.array(kicked_error) < np.array(smooth_error)).all()
    assert np.mean(kicked_error) < 0.95 * np.mean(smooth_error)


@pytest.mark.parametrize("intervals", [40, 80])
def test_the_smoother_the_motion_the_higher_the_order_and_the_less_it_errs(intervals: int) -> None:
    time, spline = np.linspace(0, 1, 200), Spline(0.0, 1.0, intervals)
    values, path = spline.values(time), still(spline)
    errors = []
    for seed in range(10):
        change = *measured(uneven(time), seed, spline), path, 0
        found = Roughness(spline).formed(*change)
        assert found.order > Roughness(spline).order
        for roughness in (Roughness(spline), found):
            step = np.linalg.solve(change[0] + roughness.weighed(*change).curvature(path, 0), change[1])
            errors.append(np.mean((values @ step.reshape(-1, 3) - uneven(time)) ** 2))
    plain, formed = np.reshape(errors, (-1, 2)).mean(axis=0)
    assert formed < 0.9 * plain
    # an angular velocity that jumps is not smooth to any order
    angles = np.abs(time - 0.43)[:, None] * [0.5, -0.3, 0.4]
    assert Roughness(spline).formed(*measured(angles, 0, spline), path, 0).order == Roughness(spline).order


@pytest.mark.parametrize("amplitude", [3e-4, 6e-4])
def test_errors_come_true_where_the_data_hardly_tell_that_the_motion_is_uneven(amplitude: float) -> None:
    time = np.linspace(0, 1, 200)
    values, axis = SPLINE.values(time), 1
    angles = amplitude * np.sin(9 * time)[:, None] * np.eye(3)[axis]
    squares = []
    for seed in range(30):
        hessian, downhill = measured(angles, seed)
        hessian = hessian + Roughness(SPLINE).weighed(hessian, downhill, still(), 0).curvature(still(), 0)
        error = values @ np.linalg.solve(hessian, downhill).reshape(-1, 3)[:, axis] - angles[:, axis]
        covariance = np.linalg.inv(hessian)[axis::3, axis::3]
        squares.append(np.mean(error**2 / np.einsum("nb,bc,nc->n", values, covariance, values)))
    assert 0.7 < np.mean(squares) < 1.4


@pytest.mark.parametrize("kicks", [0.0, 100.0])
def test_the_penalty_has_its_gradient_and_curvature(kicks: float) -> None:
    rng = np.random.default_rng(2)
    grid = SPLINE.grid
    path = Path(grid, np.tile(np.eye(3), (len(grid), 1, 1)), rng.normal(size=(len(grid), 3)))
    root = rng.normal(size=(3, 3))
    roughness = Roughness(SPLINE, weight=2.0, shape=root @ root.T, kicks=kicks)
    bend, h = rng.normal(size=(SPLINE.size, 3)), 1e-6
    up, down = (roughness.penalty(path.bent(SPLINE, sign * h * bend), 0) for sign in (1, -1))
    assert (up - down) / (4 * h) == pytest.approx(roughness.uphill(path, 0) @ bend.ravel(), rel=1e-5)
    # for ω = 0 the penalty is quadratic in small bends
    bent = still().bent(SPLINE, 1e-6 * bend)
    assert roughness.penalty(bent, 0) == pytest.approx(
        1e-12 * bend.ravel() @ roughness.curvature(still(), 0) @ bend.ravel(), rel=1e-4
    )
