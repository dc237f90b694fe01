"""The statistics of simulated pixel values."""

from __future__ import annotations

import numpy as np
import pytest

from trapcli.simulation.camera import BRIGHTNESS, Attenuation, Camera
from trapcli.simulation.config import CameraConfig

SHAPE = (200, 200)
IDEAL = {"output": "camera", "read_noise": 0.0, "vignetting": 0.0, "dust": 0, "flicker": 0.0, "offset": 0.0}


def camera(**settings):
    return Camera(CameraConfig(**(IDEAL | settings)), 2.0, SHAPE, np.random.SeedSequence(0))


def record(sensor, attenuation=0.0, seed=0):
    return sensor.record(np.full(SHAPE, attenuation), np.random.default_rng(seed))


def test_shot_noise_is_poisson():
    # one electron is 3.3 pixel values, so that rounding adds next to nothing
    sensor = camera(bits=16, full_well=20000.0)
    electrons = record(sensor, 1.0) * (20000.0 / 65535)
    mean = BRIGHTNESS * 20000 * np.exp(-0.25)
    assert electrons.mean() == pytest.approx(mean, abs=5 * np.sqrt(mean / electrons.size))
    assert electrons.var() == pytest.approx(mean, rel=5 * np.sqrt(2 / electrons.size))


def test_few_electrons_come_in_whole_numbers():
    sensor = camera(bits=16, full_well=200.0)
    electrons = record(sensor) * (200 / 65535)
    np.testing.assert_allclose(electrons, np.rint(electrons), atol=2e-3)
    assert electrons.mean() == pytest.approx(160, abs=0.3)


def test_read_noise_adds_its_variance():
    sensor = camera(bits=16, read_noise=100.0)
    electrons = record(sensor) * (20000.0 / 65535)
    assert electrons.var() == pytest.approx(BRIGHTNESS * 20000 + 1e4, rel=5 * np.sqrt(2 / electrons.size))


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_attenuation_comes_back_by_the_logarithm(bits):
    sensor = camera(bits=bits, full_well=1e9, offset=0.02, optical_depth=0.7)
    highest = 2**bits - 1
    frame, empty = record(sensor, 1.5) - 0.02 * highest, record(sensor) - 0.02 * highest
    assert sensor.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert empty.mean() == pytest.approx(BRIGHTNESS * 0.98 * highest, abs=0.5)
    assert -np.log(frame.mean() / empty.mean()) == pytest.approx(0.7 * 1.5 / 2.0, abs=2.0 / highest)


def test_flicker_scales_whole_frames():
    sensor = camera(flicker=0.05, full_well=1e9, bits=16)
    means = np.array([record(sensor, seed=seed)[:8, :8].mean() for seed in range(150)])
    assert means.std() / means.mean() == pytest.approx(0.05, rel=0.3)


def test_vignetting_darkens_the_corners_and_dust_is_static_and_dark():
    sensor = camera(vignetting=0.3)
    light = sensor.flat_field / (BRIGHTNESS * 20000)
    assert light[100, 100] == pytest.approx(1.0)
    assert light[0, 0] == pytest.approx(0.7)
    dusty = camera(dust=5).flat_field
    clean = camera().flat_field
    assert (dusty <= clean).all()
    assert dusty.min() < 0.95 * clean.min()
    np.testing.assert_array_equal(dusty, camera(dust=5).flat_field)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_white_noise_of_attenuation_is_a_share_of_the_peak(dtype):
    sensor = Attenuation(CameraConfig(dtype=dtype, noise=0.03), peak=50.0)
    frame = record(sensor, 10.0)
    assert frame.dtype == dtype
    assert frame.mean() == pytest.approx(10.0, abs=5 * 1.5 / 200)
    assert frame.std() == pytest.approx(1.5, rel=5 / np.sqrt(2 * frame.size))


@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_integer_attenuation_follows_the_stated_scale_and_is_never_cut_off(dtype, noise):
    sensor = Attenuation(CameraConfig(dtype=dtype, noise=noise), peak=50.0)
    highest = np.iinfo(dtype).max
    for attenuation in (0.0, 20.0, 50.0):
        frame = record(sensor, attenuation)
        assert frame.dtype == dtype
        value = (frame.mean() - sensor.pedestal) / sensor.scale
        assert value == pytest.approx(attenuation, abs=0.5 / sensor.scale + 5 * noise * 50 / 200)
        if noise:
            assert frame.min() > 0
            assert frame.max() < highest
    assert record(sensor, 50.0).max() > 0.75 * highest
    if not noise:
        assert not record(sensor, 0.0).any()
