from __future__ import annotations

import numpy as np
import pytest

from trapcli.motion import first_order
from trapcli.motion.angular import RingErrors
from trapcli.simulation.phantoms import Blobs

MU = 0.35 * np.arange(1, 9)
GRID = np.arange(44) * np.pi / 44
TIMES = np.array([0.0, 0.4, 0.9, 1.3])


def errors(size: float = 1e-9) -> RingErrors:
    each = np.full(len(MU), size)
    return RingErrors(MU, 4.0, value=each, rate=each, acceleration=each)


def disc_noise(rng: np.random.Generator, count: int) -> np.ndarray:
    """What white noise of the pixels in a disc does to J̃, ``(count, M, L)`` of unit mean square."""
    x = 0.5 * np.arange(-8, 9)
    x1, x2 = np.meshgrid(x, x)
    inside = np.hypot(x1, x2) <= 4.0
    k = MU[:, None, None] * np.stack([np.cos(GRID), np.sin(GRID)], axis=-1)
    waves = np.exp(-1j * (k[..., :1] * x1[inside] + k[..., 1:] * x2[inside])) / np.sqrt(inside.sum())
    return np.einsum("mlp,np->nml", waves, rng.standard_normal((count, inside.sum())))


@pytest.fixture(scope="module")
def value_and_rate(blobs, two_turns, chebyshev_derivative):  # type: ignore[no-untyped-def]
    k = MU[:, None, None] * np.stack([np.cos(GRID), np.sin(GRID)], axis=-1)
    half, nodes = 0.1, np.polynomial.chebyshev.chebpts1(15)
    value = np.array([blobs.fourier(k, R) for R in two_turns.rotations(TIMES)])
    around = np.array([[blobs.fourier(k, R) for R in two_turns.rotations(t + half * nodes)] for t in TIMES])
    return value, chebyshev_derivative(around, half, 1, axis=1)


def test_exact_map_gives_direction_and_height(value_and_rate, two_turns) -> None:  # type: ignore[no-untyped-def]
    solution, phi_function = first_order.solve(*value_and_rate, errors())
    omega = two_turns.omega(TIMES)
    phi = np.arctan2(omega[:, 1], omega[:, 0]) % np.pi
    assert np.abs(solution.phi - phi).max() < 1e-10
    assert np.abs(solution.omega_3 - omega[:, 2]).max() < 1e-10
    assert not solution.ambiguous.any()
    assert solution.residual.max() < 1e-9
    # Φ by brute force comes as near as its spacing allows
    scanned = np.arange(phi_function.shape[1]) * np.pi / phi_function.shape[1]
    spacing = np.pi / phi_function.shape[1]
    assert np.abs(scanned[phi_function.argmin(axis=1)] - phi).max() <= spacing


def test_phi_function_is_the_printed_one(value_and_rate) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(1)
    slope, rate = (rng.standard_normal((2, 3)) + 1j * rng.standard_normal((2, 3)) for _ in range(2))
    found, height = first_order.landscape(slope, rate, 0.5)
    for line in range(3):
        a, b = slope[:, line], rate[:, line]
        # ω₃ is real: both parts of the complex equation count
        best = np.linalg.lstsq(np.r_[a.real, a.imag][:, None], np.r_[b.real, b.imag], rcond=None)[0][0]
        ratio = np.abs(b - best * a) ** 2 / (np.abs(best * a) ** 2 + 0.5)
        assert height[line] == pytest.approx(best)
        assert found[line] == pytest.approx(ratio.max())


def test_errors_come_true(value_and_rate, two_turns) -> None:  # type: ignore[no-untyped-def]
    value, rate = value_and_rate
    rng = np.random.default_rng(8)
    size = 2e-3 * np.abs(rate).max()
    tiny, each = np.full(len(MU), 1e-12), np.full(len(MU), size)
    # rings closer than π / radius are not independent
    share = 0.35 * 4.0 / np.pi
    sigma = RingErrors(MU, 4.0, value=tiny, rate=each, acceleration=each, share=share)
    many = np.repeat(np.arange(len(TIMES)), 60)
    solution, _ = first_order.solve(value[many], rate[many] + size * disc_noise(rng, len(many)), sigma)
    omega = two_turns.omega(TIMES)[many]
    phi = np.arctan2(omega[:, 1], omega[:, 0])
    off = (solution.phi - phi + np.pi / 2) % np.pi - np.pi / 2
    assert 0.8 < np.std(off / np.sqrt(solution.covariance[:, 0, 0])) < 1.25
    height = (solution.omega_3 - omega[:, 2]) / np.sqrt(solution.covariance[:, 1, 1])
    assert 0.8 < np.std(height) < 1.25


def test_a_body_of_revolution_leaves_all_directions_open(two_turns, chebyshev_derivative) -> None:  # type: ignore[no-untyped-def]
    body = Blobs.coaxial(np.random.default_rng(0), axis=(0.4, -0.2, 0.7), radius=4.0)
    k = MU[:, None, None] * np.stack([np.cos(GRID), np.sin(GRID)], axis=-1)
    half, nodes = 0.1, np.polynomial.chebyshev.chebpts1(15)
    value = np.array([body.fourier(k, R) for R in two_turns.rotations(TIMES)])
    around = np.array([[body.fourier(k, R) for R in two_turns.rotations(t + half * nodes)] for t in TIMES])
    solution, _ = first_order.solve(value, chebyshev_derivative(around, half, 1, axis=1), errors())
    assert (solution.open_share > 0.5).all()
    assert solution.structured.all()


def test_turning_about_the_optical_axis_leaves_nothing_over(blobs) -> None:  # type: ignore[no-untyped-def]
    k = MU[:, None, None] * np.stack([np.cos(GRID), np.sin(GRID)], axis=-1)
    across = MU[:, None, None] * np.stack([-np.sin(GRID), np.cos(GRID)], axis=-1)
    small = 1e-6
    value = blobs.fourier(k, np.eye(3))[None]
    # J̃ turns as a whole: ∂t = 1.7 ∂φ
    slope = (blobs.fourier(k + small * across, np.eye(3)) - blobs.fourier(k - small * across, np.eye(3))) / (
        2 * small
    )
    solution, _ = first_order.solve(value, 1.7 * slope[None], errors(1e-5))
    assert solution.common_height[0] == pytest.approx(1.7, rel=1e-6)
    assert solution.excess[0] < 2


def test_a_ball_has_no_structure() -> None:
    ball = Blobs(np.ones(1), np.zeros((1, 3)), np.eye(3)[None])
    k = MU[:, None, None] * np.stack([np.cos(GRID), np.sin(GRID)], axis=-1)
    value = ball.fourier(k, np.eye(3)) + 1e-6 * disc_noise(np.random.default_rng(0), 20)
    rate = 1e-6 * disc_noise(np.random.default_rng(1), 20)
    solution, _ = first_order.solve(value, rate, errors(1e-6))
    assert not solution.structured.any()
