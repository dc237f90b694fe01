"""The third-order equation on exact data: as printed, in polar form, and where ω₃ = −σ."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.motion import third_order
from trapcli.motion.angular import RingErrors
from trapcli.motion.third_order import LineDerivatives

Array = NDArray[np.float64]

MU = np.array([0.4, 0.9, 1.5, 2.1, 2.8])


@dataclass(frozen=True)
class Exact:
    """All that the equation takes, at one time, from closed forms."""

    omega_3: float
    sigma: float
    change: float
    alpha: float
    log_rate: float
    phi: float
    time: float


def series(omega: Callable[[Array], Array], t: float, chebyshev_derivative: Callable[..., Array]) -> Exact:
    half = 0.1
    samples = omega(t + half * np.polynomial.chebyshev.chebpts1(15))
    phi, alpha = np.unwrap(np.arctan2(samples[:, 1], samples[:, 0])), np.hypot(samples[:, 0], samples[:, 1])
    d = lambda values, order: float(chebyshev_derivative(values, half, order, axis=0))  # noqa: E731
    return Exact(
        omega_3=d(samples[:, 2], 0),
        sigma=d(phi, 1),
        change=d(samples[:, 2], 1),
        alpha=d(alpha, 0),
        log_rate=d(alpha, 1) / d(alpha, 0),
        phi=d(phi, 0),
        time=t,
    )


@pytest.fixture
def scene(blobs, two_turns, exact_map, chebyshev_derivative):  # type: ignore[no-untyped-def]
    def make(t: float):  # type: ignore[no-untyped-def]
        at = series(two_turns.omega, t, chebyshev_derivative)
        return at, exact_map(blobs, two_turns.rotations, t, at.phi, MU)

    return make


def line_derivatives(exact) -> LineDerivatives:  # type: ignore[no-untyped-def]
    d = lambda time, phi: exact.derivative(time, phi)[None]  # noqa: E731
    return LineDerivatives(d(0, 1), d(0, 2), d(0, 3), d(1, 1), d(1, 2), d(2, 1))


class Tensors:
    """D¹, D² and D³ of the blobs' J̃ in closed form, for the equation as it is printed."""

    def __init__(self, phantom, R: Array) -> None:  # type: ignore[no-untyped-def]
        self.masses = phantom._masses / (2 * np.pi)
        self.S = np.einsum("ia,bij,jc->bac", R[:, :2], phantom.covariance, R[:, :2])
        self.p = (phantom.position - phantom.center) @ R[:, :2]

    def __call__(self, k: Array, *directions: Array) -> complex:
        # each blob is exp(q) with q quadratic in k
        wave = self.masses * np.exp(-0.5 * np.einsum("a,bac,c->b", k, self.S, k) - 1j * self.p @ k)
        first = [-(self.S @ k + 1j * self.p) @ v for v in directions]
        second = lambda v, w: -np.einsum("a,bac,c->b", v, self.S, w)  # noqa: E731
        if len(directions) == 1:
            factor = first[0]
        elif len(directions) == 2:
            factor = first[0] * first[1] + second(*directions)
        else:
            u, v, w = directions
            factor = first[0] * first[1] * first[2]
            factor = factor + first[0] * second(v, w) + first[1] * second(u, w) + first[2] * second(u, v)
        return complex(np.sum(wave * factor))


def printed(blobs, rotations, at: Exact, chebyshev_derivative):  # type: ignore[no-untyped-def]
    """A₀, A₀₂ and μA₁ of propD3, letter by letter."""
    half = 0.1
    around = [Tensors(blobs, R) for R in rotations(at.time + half * np.polynomial.chebyshev.chebpts1(15))]
    v, across = np.array([np.cos(at.phi), np.sin(at.phi)]), np.array([-np.sin(at.phi), np.cos(at.phi)])
    w3, s, dw3 = at.omega_3, at.sigma, at.change
    rows = []
    for mu in MU:

        def D(*directions: Array, time_order: int = 0, mu: float = mu) -> complex:
            values = np.array([tensors(mu * v, *directions) for tensors in around])
            return complex(chebyshev_derivative(values, half, time_order, axis=0))

        a0 = (
            0.25
            * mu
            * (w3 + s)
            * (
                mu**2 * w3 * (w3 - s) * D(across, across, across)
                + 2 * mu * D(across, w3 * s * v - dw3 * across)
                + 2 * D(w3**2 * across + dw3 * v)
                - mu * (3 * w3 - s) * D(across, across, time_order=1)
                + 2 * D(across, time_order=2)
            )
        )
        a02 = 0.5 * mu * (w3 + s) * D(across)
        a1 = 0.5 * (w3 + s) * (mu * w3 * D(across, across) - w3 * D(v) - D(across, time_order=1))
        rows.append((a0, a02, mu * a1))
    return np.array(rows).T


@pytest.mark.parametrize("t", [0.2, 0.8, 1.4])
def test_printed_equation_holds(scene, blobs, two_turns, chebyshev_derivative, t: float) -> None:  # type: ignore[no-untyped-def]
    at, _ = scene(t)
    a0, a02, mu_a1 = printed(blobs, two_turns.rotations, at, chebyshev_derivative)
    terms = np.abs(a0) + np.abs(a02 * at.alpha**2) + np.abs(mu_a1 * at.log_rate)
    assert np.abs(a0 + a02 * at.alpha**2 + mu_a1 * at.log_rate).max() < 1e-8 * terms.max()


@pytest.mark.parametrize("t", [0.2, 0.8, 1.4])
def test_polar_form_is_the_printed_one(scene, blobs, two_turns, chebyshev_derivative, t: float) -> None:  # type: ignore[no-untyped-def]
    at, exact = scene(t)
    found = third_order.coefficients(
        line_derivatives(exact), *(np.array([x]) for x in (at.omega_3, at.sigma, at.change))
    )
    expected = printed(blobs, two_turns.rotations, at, chebyshev_derivative) / (0.5 * (at.omega_3 + at.sigma))
    for ours, theirs in zip(found, expected, strict=True):
        assert np.abs(ours[0] - theirs).max() < 1e-8 * np.abs(theirs).max()


def test_tensors_follow_from_polar_derivatives(blobs, two_turns, exact_map) -> None:  # type: ignore[no-untyped-def]
    t, phi, h = 0.6, 1.1, 1e-4
    tensors = Tensors(blobs, two_turns.rotations(np.array([t]))[0])
    v, across = np.array([np.cos(phi), np.sin(phi)]), np.array([-np.sin(phi), np.cos(phi)])
    polar = {q: exact_map(blobs, two_turns.rotations, t, phi, MU).derivative(0, q) for q in (1, 2, 3)}
    for i, mu in enumerate(MU):
        k = mu * v
        assert tensors(k, mu * across) == pytest.approx(polar[1][i], rel=1e-9)
        second = mu**2 * tensors(k, across, across) - mu * tensors(k, v)
        assert second == pytest.approx(polar[2][i], rel=1e-9)
        third = mu**3 * tensors(k, across, across, across) - 3 * mu**2 * tensors(k, v, across)
        assert third - mu * tensors(k, across) == pytest.approx(polar[3][i], rel=1e-9)
        # the closed forms themselves, against differences
        difference = (tensors(k + h * v, across) - tensors(k - h * v, across)) / (2 * h)
        assert tensors(k, v, across) == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize("t", [0.2, 0.8, 1.4])
def test_solution_gives_alpha(scene, t: float) -> None:  # type: ignore[no-untyped-def]
    at, exact = scene(t)
    one = np.ones(len(MU))
    zero = np.zeros(1)
    solution = third_order.solve(
        line_derivatives(exact),
        *(np.array([x]) for x in (at.omega_3, at.sigma, at.change)),
        RingErrors(MU, 3.0, value=one, rate=one, acceleration=one),
        sigma_error=zero,
        omega_3_rate_error=zero,
        inflation=np.ones(1),
    )
    assert solution.alpha_squared[0] == pytest.approx(at.alpha**2, rel=1e-8)
    assert solution.log_rate[0] == pytest.approx(at.log_rate, rel=1e-7)


@pytest.mark.parametrize("spin", [0.0, 2.0])
def test_divided_equation_holds_where_the_printed_one_is_silent(  # type: ignore[no-untyped-def]
    spin: float, blobs, exact_map, chebyshev_derivative
) -> None:
    """ω₃ = −σ: the paper's example (spin) and one axis in the image plane (no spin), at uneven speed."""
    angle = lambda t: 1.1 * t + 0.3 * np.sin(1.5 * t)  # noqa: E731
    axis = np.array([np.cos(0.8), np.sin(0.8), 0.0])

    def rotations(t: Array) -> Array:
        turn = Rotation.from_rotvec(np.multiply.outer(angle(t), axis))
        return (turn * Rotation.from_rotvec(np.multiply.outer(spin * t, [0, 0, 1.0]))).as_matrix()

    def omega(t: Array) -> Array:
        speed = 1.1 + 0.45 * np.cos(1.5 * t)
        phi = 0.8 - spin * t
        return np.stack([speed * np.cos(phi), speed * np.sin(phi), np.full_like(t, spin)], axis=-1)

    at = series(omega, 0.4, chebyshev_derivative)
    assert at.omega_3 + at.sigma == pytest.approx(0.0, abs=1e-10)
    line = line_derivatives(exact_map(blobs, rotations, 0.4, at.phi, MU, half=0.1, nodes=17))
    constant, by_square, by_log_rate = third_order.coefficients(
        line, *(np.array([x]) for x in (at.omega_3, at.sigma, at.change))
    )
    assert np.abs(by_square).max() > 0.1
    left = constant + by_square * at.alpha**2 + by_log_rate * at.log_rate
    assert np.abs(left).max() < 1e-8 * np.abs(by_square * at.alpha**2).max()
