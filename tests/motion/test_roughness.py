"""Roughness of ω: what it costs nothing, what it costs, its slopes, and the weight that the data ask for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from trapcli.motion.integrate import integrate_rotation
from trapcli.motion.path import Path, Spline
from trapcli.motion.roughness import Roughness

Array = NDArray[np.float64]
SPLINE = Spline(0.0, 2.0, 20)
STEP = 2.0 / 40


def path_of(powers: list[list[float]]) -> Path:
    """Return the path whose ω is a polynomial, on the spline's grid."""
    time = SPLINE.grid
    omega = np.polynomial.polynomial.polyval(time, np.array(powers)).T
    return Path(time, integrate_rotation(omega, time), omega)


CUBIC = path_of([[1.0, -2.0, 0.5], [0.3, 1.0, -1.0], [-2.0, 0.4, 1.0], [0.7, -0.5, 0.2]])


def test_a_cubic_in_time_costs_nothing() -> None:
    assert Roughness(SPLINE, weight=1.0).penalty(CUBIC, 0) == pytest.approx(0.0, abs=1e-24)


def test_the_cost_of_a_quartic_in_closed_form() -> None:
    quartic = path_of([[0.0] * 3] * 4 + [[0.5, 0.0, -2.0]])
    # the fourth differences of t⁴ are 24 h⁴
    square = (24 * STEP**5) ** 2 * (0.5**2 + 2.0**2) * (len(SPLINE.grid) - 4)
    assert Roughness(SPLINE, weight=3.0).penalty(quartic, 0) == pytest.approx(3 * square)


def test_slope_and_curvature_are_those_of_the_penalty() -> None:
    roughness = Roughness(SPLINE, weight=1e4)
    direction = np.random.default_rng(2).normal(size=(SPLINE.size, 3))
    path = CUBIC.bent(SPLINE, 0.05 * np.random.default_rng(1).normal(size=(SPLINE.size, 3)))
    step = 1e-5
    ahead, behind = (roughness.penalty(path.bent(SPLINE, s * direction), 0) for s in (step, -step))
    slope = 2 * roughness.uphill(path, 0) @ direction.ravel()
    assert (ahead - behind) / (2 * step) == pytest.approx(slope, rel=1e-5)
    # of a path that is not rough nothing but the square of the slopes is left
    step = 1e-3
    ahead, behind = (roughness.penalty(CUBIC.bent(SPLINE, s * direction), 0) for s in (step, -step))
    curvature = 2 * direction.ravel() @ roughness.curvature(CUBIC, 0) @ direction.ravel()
    assert (ahead + behind) / step**2 == pytest.approx(curvature, rel=1e-3)


def test_the_weight_is_that_of_motions_as_rough() -> None:
    """Motions drawn with a known variance of their fourth differences give it back."""
    rng = np.random.default_rng(0)
    unit = replace(Roughness(SPLINE), weight=1.0).curvature(CUBIC, 0)
    size, ways = np.linalg.eigh(unit)
    rough = size > 1e-9 * size[-1]
    hessian = 1e4 * np.trace(unit) / len(unit) * np.eye(len(unit))
    found = []
    for _ in range(10):
        true = ways[:, rough] @ (rng.normal(size=rough.sum()) / np.sqrt(size[rough]))
        downhill = hessian @ true + np.sqrt(np.diag(hessian)) * rng.normal(size=len(unit))
        found.append(Roughness(SPLINE).weighed(hessian, downhill, CUBIC, 0).weight)
    # the variance of a variance that n numbers tell is 2 / n
    spread = np.sqrt(2 / (10 * rough.sum()))
    assert np.log(np.mean(1 / np.array(found))) == pytest.approx(0.0, abs=5 * spread)
