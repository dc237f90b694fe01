"""Checks of background and noise: they find what was put in, and nothing where nothing is."""

from __future__ import annotations

import numpy as np
import pytest

from trapcli.report.checks import check_frames, findings
from trapcli.stack.frames import Frames

PEAK, SIGMA = 0.8, 0.02


@pytest.fixture
def blob():
    """40 noisy frames of a Gaussian of 64 × 64 pixels."""
    x = np.arange(64) - 32
    image = PEAK * np.exp(-(x[:, None] ** 2 + x**2) / (2 * 6.0**2))
    return image + SIGMA * np.random.default_rng(1).standard_normal((40, 64, 64))


def check(frames, chosen=()):
    return check_frames(Frames.from_array(frames), chosen)


def test_numbers_of_a_clean_stack(blob):
    checks = check(blob, [3, 7])
    peak = np.median(np.quantile(blob, 0.999, axis=(1, 2)))
    np.testing.assert_allclose(checks.noise * peak, SIGMA, rtol=0.1)
    assert checks.mass_noise == pytest.approx(checks.mass.std(), rel=0.35)
    assert checks.border_noise == pytest.approx(checks.border.std(), rel=0.35)
    assert [image.shape for image in checks.images] == [(64, 64), (64, 64)]
    np.testing.assert_array_equal(checks.images[1], blob[7])
    assert all(finding.good for finding in findings(checks))


def bad(frames):
    return [finding.name for finding in findings(check(frames)) if not finding.good]


def test_each_fault_is_found_and_named(blob):
    flicker = 1 + 0.2 * np.resize([-1, 1], 40)[:, None, None]
    assert bad(blob * flicker) == ["Total attenuation"]
    assert "Background" in bad(blob + 0.05 * PEAK)
    noise = np.random.default_rng(2).standard_normal(blob.shape)
    assert bad(blob + 0.2 * PEAK * noise) == ["Noise"]


def test_frames_that_hold_nothing(blob):
    blob[5] = np.nan
    checks = check(blob)
    assert np.flatnonzero(np.isnan(checks.mass)).tolist() == [5]
    assert all(finding.good for finding in findings(checks))
    assert [finding.good for finding in findings(check(np.full((4, 16, 16), np.nan)))] == [False]
    assert not all(finding.good for finding in findings(check(np.zeros((4, 16, 16)))))
