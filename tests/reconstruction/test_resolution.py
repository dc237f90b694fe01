"""Fourier shell correlation: limits known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from trapcli.reconstruction.resolution import crossing, resolve, shell_correlation


def noise(seed: int, n: int = 24) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n, n, n))


def test_a_volume_with_itself():
    np.testing.assert_allclose(shell_correlation(noise(0), 3 * noise(0)), 1)


def test_independent_noise():
    correlation = shell_correlation(noise(0), noise(1))
    # shells of radius m hold about 4 π m² frequencies, half of them independent
    shells = np.arange(4, 13)
    assert np.abs(correlation[4:] * np.sqrt(2 * np.pi) * shells).max() < 4


def test_equal_parts_of_signal_and_noise():
    """Signal of power S in noise of power N correlates by S / (S + N)."""
    signal, ratio = noise(0, 32), 0.5
    halves = [signal + ratio * noise(seed, 32) for seed in (1, 2)]
    expected = 1 / (1 + ratio**2)
    np.testing.assert_allclose(shell_correlation(*halves)[8:], expected, atol=0.08)


def test_crossing_between_shells():
    frequency = np.array([0.0, 0.1, 0.2, 0.3])
    assert crossing(frequency, np.array([1, 1, 0.75, 0.25]), 0.5) == pytest.approx(1 / 0.25)
    assert crossing(frequency, np.array([1, 1, 0.9, 0.8]), 0.5) == pytest.approx(1 / 0.3)
    assert crossing(frequency, np.array([1, 0.2, 0.9, 0.8]), 0.5) == pytest.approx(1 / 0.0625)
    assert crossing(frequency, np.array([0.3, 0.2, 0.1, 0.1]), 0.5) >= 10


def test_resolution_of_a_low_passed_signal():
    """White signal up to a frequency, in as much noise: both criteria are met there."""
    n, cut, voxel = 32, 8, 0.25
    axis = np.fft.fftfreq(n, 1 / n)
    radius = np.sqrt(axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2)
    signal = np.fft.ifftn(np.where(radius <= cut, np.fft.fftn(noise(0, n)), 0)).real
    found = resolve(signal + 0.1 * noise(1, n), signal + 0.1 * noise(2, n), voxel)
    assert found.half == pytest.approx(n * voxel / cut, rel=0.1)
    assert found.seventh == pytest.approx(n * voxel / cut, rel=0.1)
    assert found.frequency[1] == pytest.approx(1 / (n * voxel))
    assert not found.limited_by_voxels
    assert resolve(signal, signal, voxel).limited_by_voxels
