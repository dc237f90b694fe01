"""Scenes of the simulated camera, no background file: what is left of light and dust is below the noise."""

from __future__ import annotations

import numpy as np
import pytest

from trapcli.config import PreprocessConfig, from_dict
from trapcli.preprocess.attenuation import to_attenuation
from trapcli.simulation.camera import Camera
from trapcli.simulation.config import SimulateConfig
from trapcli.simulation.render import Scene


def scene(phantom: str, seed: int, flicker: float, bits: int) -> Scene:
    table = {
        "seed": seed,
        "stack": {"frames": 100, "pixel_size": 0.2},
        "phantom": {"kind": phantom},
        "motion": {"kind": "tumbling"},
        "camera": {
            "output": "camera", "bits": bits, "full_well": 40000.0, "vignetting": 0.3, "flicker": flicker
        },
    }  # fmt: skip
    return Scene.from_config(from_dict(SimulateConfig, table, "scene"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("phantom", "seed", "flicker", "bits"),
    [
        ("blobs", 2, 0.02, 12),
        ("blobs", 6, 0.02, 16),
        ("grain", 1, 0.1, 12),
        ("grain", 5, 0.02, 8),
        ("grain", 6, 0.02, 12),
    ],
)
def test_what_stays_is_far_below_the_noise(phantom: str, seed: int, flicker: float, bits: int) -> None:
    simulated = scene(phantom, seed, flicker, bits)
    camera = simulated.sensor
    assert isinstance(camera, Camera)
    dark = camera.config.offset * camera.highest
    found = to_attenuation(simulated.frames(), PreprocessConfig(dark=str(dark))).to_array()
    depth = camera.config.optical_depth / simulated.peak
    true = np.array([depth * simulated.attenuation(n) for n in range(len(found))])
    good = np.isfinite(found).all(axis=(1, 2))
    assert good.mean() > 0.97
    error = (found - true)[good]
    noise = np.median(error.std(axis=(1, 2)))
    covered = true.mean(axis=0) > 0.02
    # a mean over 100 frames leaves 0.1 of the noise
    assert error.mean(axis=0)[covered].std() < 0.17 * noise
    assert error.mean(axis=(1, 2)).std() < 0.02 * noise
