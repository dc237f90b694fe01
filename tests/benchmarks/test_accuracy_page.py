"""The page of accuracy is what its results say; what the benchmark takes for given is so."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import peers
import pytest
import report
import scenes

ROOT = Path(__file__).parents[2]


def test_the_page_is_what_the_results_say(tmp_path: Path) -> None:
    results = json.loads((ROOT / "benchmarks" / "accuracy" / "results.json").read_text(encoding="utf-8"))
    report.write_page(results, tmp_path / "page.md")
    page = (ROOT / "docs" / "benchmarks-accuracy.md").read_text(encoding="utf-8")
    assert (tmp_path / "page.md").read_text(encoding="utf-8") == page


@pytest.mark.parametrize("bits", [8, 16])
def test_noise_of_a_camera_is_that_of_its_attenuation(bits: int) -> None:
    camera = {"output": "camera", "bits": bits, "full_well": 2000.0, "flicker": 0.0, "optical_depth": 0.5}
    table = {"stack": {"frames": 8, "height": 64, "width": 64, "pixel_size": 0.4}, "camera": camera}
    made = scenes.scene({**table, "phantom": {"kind": "blobs"}}, 1)
    dark = 0.01 * made.sensor.highest
    errors = []
    for n in range(8):
        counts = (made.frame(n) - dark) / (made.sensor.highest - dark) * 2000.0
        true = 0.5 / made.sensor.peak * made.attenuation(n)
        found = -np.log(np.maximum(counts, 1.0) / made.sensor.flat_field)
        errors.append((found - true)[true > 0.0025])
    # in parts of the peak, which is 0.5; the logarithm bends a little
    assert scenes.noise_of(made) == pytest.approx(np.concatenate(errors).std() / 0.5, rel=0.05)


def test_five_per_cent_is_five_per_cent() -> None:
    table = next(row for row in scenes.ROWS if row.key == "camera-5").table
    assert scenes.noise_of(scenes.scene(table(0), 0)) == pytest.approx(0.05, rel=0.15)


def test_images_for_peers_are_centred() -> None:
    x = np.arange(64) - 32
    center = np.random.default_rng(0).uniform(-3.0, 3.0, (60, 2))
    frames = np.exp(
        -((x - center[:, None, None, 0]) ** 2 + (x[:, None] - center[:, None, None, 1]) ** 2) / 18
    )
    images = peers.squares(frames, 0.5 * center, 0.5, 8.0)["single"]
    middle = np.arange(images.shape[1]) - images.shape[1] // 2
    expected = np.exp(-(middle**2 + middle[:, None] ** 2) / 18)
    np.testing.assert_allclose(images, np.broadcast_to(expected, images.shape), atol=1e-5)
