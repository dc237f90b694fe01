"""Moments of the images: tensors under rotation, the projected misfit, its gradient and its curvature."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.motion.low_band import LowBand
from trapcli.motion.moments import MomentTable, _Order

Array = NDArray[np.float64]
FRAMES = 40
SECOND = np.diag([0.5, 0.7, 0.6]) * 1e-3
THIRD = np.diag([0.3, 0.2, 0.4, 0.5]) * 1e-3


def symmetric(order: int, rng: np.random.Generator) -> Array:
    tensor = rng.normal(scale=0.3, size=(3,) * order)
    orders = list(itertools.permutations(range(order)))
    return sum(tensor.transpose(p) for p in orders) / len(orders)


def seen(tensor: Array, R: Array, order: int) -> Array:
    """Return the components of an object's tensor that the frames show, ``(G, C)``."""
    components = itertools.combinations_with_replacement((0, 1), order)
    if order == 2:
        lab = np.einsum("gia,gjb,ij->gab", R, R, tensor)
    else:
        lab = np.einsum("gia,gjb,gkc,ijk->gabc", R, R, R, tensor)
    return np.stack([lab[(slice(None), *c)] for c in components], axis=1)


def low_band(R: Array, rng: np.random.Generator, noise: float = 0.0) -> LowBand:
    second, third = (seen(symmetric(n, rng), R, n) for n in (2, 3))
    n = len(R)
    return LowBand(
        time=np.arange(float(n)),
        k=np.zeros((1, 2)),
        modes=np.ones((n, 1), complex),
        variance=1.0,
        second=second + noise * rng.multivariate_normal(np.zeros(3), SECOND, n),
        third=third + noise * rng.multivariate_normal(np.zeros(4), THIRD, n),
        second_covariance=SECOND,
        third_covariance=THIRD,
        mass=np.ones(n),
        radius=1.0,
    )


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(12)


@pytest.fixture
def R(rng: np.random.Generator) -> Array:
    return np.asarray(Rotation.random(FRAMES, rng=rng).as_matrix())


def bent(R: Array, direction: Array) -> Array:
    return R @ Rotation.from_rotvec(direction).as_matrix()


@pytest.mark.parametrize("order", [2, 3])
def test_tensors_turn_with_the_frame(R: Array, rng: np.random.Generator, order: int) -> None:
    components = 3 if order == 2 else 4
    table = _Order.create(order, np.zeros((FRAMES, components)), np.eye(components), 0.0)
    assert len(table.basis) == {2: 6, 3: 10}[order]
    coefficients = rng.normal(size=len(table.basis))
    tensor = (coefficients @ table.basis).reshape((3,) * order)
    found = table.design(R) @ coefficients
    assert found == pytest.approx(seen(tensor, R, order), abs=1e-13)
    lab = table.lab(R, coefficients).reshape(FRAMES, *(3,) * order)
    assert lab[:, *table.components.T] == pytest.approx(found, abs=1e-13)
    assert lab == pytest.approx(np.swapaxes(lab, 1, -1), abs=1e-13)
    assert np.sum(lab**2, axis=tuple(range(1, order + 1))) == pytest.approx(np.sum(tensor**2))


@pytest.mark.parametrize("model_error", [0.0, 0.01])
def test_exact_moments_leave_nothing_at_the_truth(
    R: Array, rng: np.random.Generator, model_error: float
) -> None:
    table = MomentTable(low_band(R, rng), model_error)
    wrong = table.cost(np.asarray(Rotation.random(FRAMES, rng=rng).as_matrix()))
    assert table.cost(R) < 1e-12 * wrong


def test_what_stays_under_the_particle_is_eliminated(R: Array, rng: np.random.Generator) -> None:
    series = np.column_stack([np.ones(FRAMES), rng.normal(size=(FRAMES, 2))])
    low = low_band(R, rng)
    spoilt = replace(
        low,
        second=low.second + series @ rng.normal(size=(3, 3)),
        third=low.third + series @ rng.normal(size=(3, 4)),
    )
    table = MomentTable(spoilt, 0.01, series)
    wrong = table.cost(np.asarray(Rotation.random(FRAMES, rng=rng).as_matrix()))
    assert table.cost(R) < 1e-12 * wrong
    assert MomentTable(spoilt, 0.01).cost(R) > 0.1 * wrong
    half = table.select(0, FRAMES // 2)
    assert half.cost(R[: FRAMES // 2]) < 1e-12 * wrong


def test_a_turn_of_the_object_and_the_mirror_change_nothing(R: Array, rng: np.random.Generator) -> None:
    table = MomentTable(low_band(R, rng), 0.01)
    R = bent(R, rng.normal(scale=0.2, size=(FRAMES, 3)))
    cost, sigma = table.cost(R), np.diag([1.0, 1.0, -1.0])
    assert table.cost(Rotation.random(rng=rng).as_matrix() @ R) == pytest.approx(cost, rel=1e-9)
    assert table.cost(sigma @ R @ sigma) == pytest.approx(cost, rel=1e-9)


@pytest.mark.parametrize("standing", [None, np.linspace(-1, 1, FRAMES)[:, None] ** [0, 1]])
def test_the_gradient_is_half_the_slope_downhill(
    R: Array, rng: np.random.Generator, standing: Array | None
) -> None:
    table = MomentTable(low_band(R, rng, noise=3.0), 0.01, standing)
    R = bent(R, rng.normal(scale=0.1, size=(FRAMES, 3)))
    orders = table.residuals(R)
    assert sum(order.cost for order in orders) == pytest.approx(table.cost(R))
    gradient = sum(order.gradient for order in orders)
    h = 1e-5
    for frame, axis in itertools.product(range(0, FRAMES, 7), range(3)):
        step = np.zeros((FRAMES, 3))
        step[frame, axis] = h
        slope = (table.cost(bent(R, step)) - table.cost(bent(R, -step))) / (2 * h)
        assert -slope / 2 == pytest.approx(gradient[frame, axis], abs=1e-6 * np.abs(gradient).max())


def test_the_projected_hessian_is_half_the_curvature_at_the_truth(R: Array, rng: np.random.Generator) -> None:
    table = MomentTable(low_band(R, rng), 0.0)
    h = 1e-3
    for _ in range(5):
        direction = rng.normal(size=(FRAMES, 3))
        expected = 0.0
        for order in table.residuals(R):
            change = np.einsum("gce,ge->gc", order.slopes, direction)
            coupling = np.einsum("gcu,gc->u", order.design, change)
            expected += float(np.sum(change**2) - coupling @ np.linalg.solve(order.normal, coupling))
        curvature = (table.cost(bent(R, h * direction)) + table.cost(bent(R, -h * direction))) / h**2
        assert curvature / 2 == pytest.approx(expected, rel=1e-3)


def test_the_misfit_at_the_truth_is_the_degrees_of_freedom(R: Array) -> None:
    ratios = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        table = MomentTable(low_band(R, rng, noise=1.0), 0.0)
        degrees = sum(order.degrees for order in table.residuals(R))
        assert degrees == 7 * FRAMES - 16
        ratios.append(table.cost(R) / degrees)
    assert np.mean(ratios) == pytest.approx(1, abs=4 * np.sqrt(2 / (7 * FRAMES - 16) / len(ratios)))


def test_one_axis_in_the_image_is_seen(rng: np.random.Generator) -> None:
    """All frames share one common line, yet another angular speed does not fit."""
    angle = np.linspace(0, 5, FRAMES)[:, None]
    R = np.asarray(Rotation.from_rotvec(angle * [0.8, 0.6, 0]).as_matrix())
    table = MomentTable(low_band(R, rng), 0.0)
    faster = np.asarray(Rotation.from_rotvec(1.05 * angle * [0.8, 0.6, 0]).as_matrix())
    assert table.cost(faster) > 100 > 1e3 * table.cost(R)


def test_several_paths_at_once(R: Array, rng: np.random.Generator) -> None:
    table = MomentTable(low_band(R, rng, noise=1.0), 0.01)
    several = np.stack([bent(R, rng.normal(scale=size, size=(FRAMES, 3))) for size in (0.0, 0.1, 1.0)])
    assert table.cost(several) == pytest.approx(np.array([table.cost(one) for one in several]))
    for order, found in enumerate(table.residuals(several)):
        for i, one in enumerate(several):
            alone = table.residuals(one)[order]
            assert found.gradient[i] == pytest.approx(alone.gradient, abs=1e-9 * np.abs(alone.gradient).max())
            assert found.slopes[i] == pytest.approx(alone.slopes, abs=1e-9 * np.abs(alone.slopes).max())
            assert found.normal[i] == pytest.approx(alone.normal)


def test_selection(R: Array, rng: np.random.Generator) -> None:
    low = low_band(R, rng, noise=1.0)
    part = MomentTable(low, 0.0).select(5, 30)
    again = MomentTable(low.select(np.arange(5, 30)), 0.0)
    assert part.cost(R[5:30]) == pytest.approx(again.cost(R[5:30]))
