"""The Taylor coefficients of the appendix's lemma (``thTayPolynomial``) against derivatives of R."""

from __future__ import annotations

from math import factorial

import numpy as np
import pytest

E3 = np.array([0.0, 0.0, 1.0])
HALF, NODES = 0.4, 25


def cross_part(vectors: np.ndarray) -> np.ndarray:
    return np.cross(E3, vectors)[..., :2]


@pytest.mark.parametrize("s", [0.3, 1.1])
def test_coefficients_of_the_lemma(two_turns, chebyshev_derivative, s: float) -> None:  # type: ignore[no-untyped-def]
    times = s + HALF * np.polynomial.chebyshev.chebpts1(NODES)
    R, Rs = two_turns.rotations(times), two_turns.rotations(np.array([s]))[0]
    forward = cross_part(R @ E3 @ Rs)  # P(e₃ × R(s)ᵀR(t)e₃)
    backward = cross_part(np.einsum("nji,j->ni", R, Rs @ E3))  # P(e₃ × R(t)ᵀR(s)e₃)
    d = lambda values, order: chebyshev_derivative(values, HALF, order, axis=0)  # noqa: E731
    a = [d(forward, j + 1) / factorial(j + 1) for j in range(4)]
    b = [-d(backward, j + 1) / factorial(j + 1) for j in range(4)]

    omega = two_turns.omega(times)
    w3, dw3, ddw3 = (d(omega[:, 2], order) for order in range(3))
    av = [d(omega[:, :2], order) for order in range(4)]
    perp = [np.array([-x[1], x[0]]) for x in av]
    aa = av[0] @ av[0]  # α²
    aa_rate = av[0] @ av[1]  # αα'
    square = aa + w3**2
    expected_a = [
        av[0],
        (w3 * perp[0] + av[1]) / 2,
        (-square * av[0] + 2 * w3 * perp[1] + dw3 * perp[0] + av[2]) / 6,
        (
            -square * w3 * perp[0]
            + 2 * w3 * dw3 * av[0]
            - 2 * w3**2 * av[1]
            - 5 * (aa_rate + w3 * dw3) * av[0]
            + 3 * w3 * perp[2]
            - square * av[1]
            + 3 * dw3 * perp[1]
            + ddw3 * perp[0]
            + av[3]
        )
        / 24,
    ]
    expected_b = [
        av[0],
        (-w3 * perp[0] + av[1]) / 2,
        (-square * av[0] - w3 * perp[1] - 2 * dw3 * perp[0] + av[2]) / 6,
        (
            square * w3 * perp[0]
            - 2 * w3 * dw3 * av[0]
            + 2 * w3**2 * av[1]
            - 3 * (aa_rate + w3 * dw3) * av[0]
            - w3 * perp[2]
            - 3 * square * av[1]
            - 3 * dw3 * perp[1]
            - 3 * ddw3 * perp[0]
            + av[3]
        )
        / 24,
    ]
    for j in range(4):
        assert a[j] == pytest.approx(expected_a[j], rel=1e-8, abs=1e-8)
        assert b[j] == pytest.approx(expected_b[j], rel=1e-8, abs=1e-8)


def test_the_motion_has_the_angular_velocity_it_says(two_turns, chebyshev_derivative) -> None:  # type: ignore[no-untyped-def]
    times = 0.6 + HALF * np.polynomial.chebyshev.chebpts1(NODES)
    R = two_turns.rotations(times)
    rate = chebyshev_derivative(R, HALF, 1, axis=0)
    B = two_turns.rotations(np.array([0.6]))[0].T @ rate
    omega = two_turns.omega(np.array([0.6]))[0]
    assert np.array([B[2, 1], B[0, 2], B[1, 0]]) == pytest.approx(omega, abs=1e-10)
