from __future__ import annotations

import numpy as np
import pytest

from trapcli.motion.angular import RingErrors, on_grid, on_lines


def polar(fourier, R, mu, phi):  # type: ignore[no-untyped-def]
    return fourier(mu[:, None, None] * np.stack([np.cos(phi), np.sin(phi)], axis=-1), R)


@pytest.fixture(scope="module")
def mu() -> np.ndarray:
    return np.array([0.3, 1.0, 2.0, 3.0])


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_derivatives_between_grid_angles_are_spectral(blobs, exact_map, two_turns, mu, order) -> None:  # type: ignore[no-untyped-def]
    size = 48
    grid = np.arange(size) * np.pi / size
    R = two_turns.rotations(np.array([0.7]))[0]
    samples = polar(blobs.fourier, R, mu, grid)[None]
    for phi in (0.0, 0.37, 1.9, 3.1, -0.4, 4.0):
        exact = exact_map(blobs, two_turns.rotations, 0.7, phi, mu).derivative(0, order)
        found = on_lines(samples, np.array([[phi]]), (order,))[0, 0, :, 0]
        assert np.abs(found - exact).max() < 1e-9 * np.abs(exact).max()


def test_grid_and_lines_agree(blobs, two_turns, mu) -> None:  # type: ignore[no-untyped-def]
    grid = np.arange(32) * np.pi / 32
    samples = np.array([polar(blobs.fourier, R, mu, grid) for R in two_turns.rotations(np.array([0.0, 0.3]))])
    angles = np.array([0.1, 1.0, 2.5])
    on_angles = on_grid(samples, angles, 1)
    for n in range(2):
        lines = on_lines(samples[n : n + 1], angles[None], (1,))[0, :, :, 0]
        assert np.allclose(lines.T, on_angles[n], rtol=1e-12)
    assert np.allclose(on_grid(samples, grid, 0), samples, rtol=0, atol=1e-13 * np.abs(samples).max())


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_gain_of_white_pixel_noise_in_a_disc(order: int) -> None:
    rng = np.random.default_rng(2)
    radius, mu, size = 20.0, np.array([0.2, 0.5]), 96
    x = np.arange(-20, 21.0)
    x1, x2 = np.meshgrid(x, x)
    inside = np.hypot(x1, x2) <= radius
    grid = np.arange(size) * np.pi / size
    k = mu[:, None, None] * np.stack([np.cos(grid), np.sin(grid)], axis=-1)
    waves = np.exp(-1j * (k[..., :1] * x1[inside] + k[..., 1:] * x2[inside]))
    samples = np.einsum("mlp,np->nml", waves, rng.standard_normal((60, inside.sum())))
    found = np.sqrt(np.mean(np.abs(on_grid(samples, grid, order)) ** 2, axis=(0, 2)))
    one = np.ones(2)
    errors = RingErrors(mu, radius, value=one, rate=one, acceleration=one)
    assert found == pytest.approx(np.sqrt(inside.sum()) * errors.gain(order), rel=0.12)
