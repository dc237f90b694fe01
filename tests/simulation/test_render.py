"""Scenes: geometry, reproducibility, memory, and the presets."""

from __future__ import annotations

import dataclasses
import tomllib
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from trapcli.config import from_dict, load_toml, merge, to_toml
from trapcli.errors import ConfigError
from trapcli.simulation.config import MOTIONS, PHANTOMS, PRESETS, SimulateConfig
from trapcli.simulation.motions import Still
from trapcli.simulation.phantoms import Blobs
from trapcli.simulation.render import Scene, simulate

CONFIGS = Path(__file__).parents[2] / "configs"
SMALL = {"frames": 12, "height": 40, "width": 48, "pixel_size": 0.6, "frame_interval": 0.01}


def scene(**tables):
    table = merge({"stack": SMALL}, tables)
    return Scene.from_config(from_dict(SimulateConfig, table, "test"))


def test_columns_are_x1_rows_are_x2_and_the_origin_is_the_middle_pixel():
    blob = Blobs(np.ones(1), np.array([[3.0, -1.8, 2.0]]), 0.2 * np.eye(3)[None])
    still = Scene(scene().config, blob, Still())
    assert np.unravel_index(still.frame(0).argmax(), (40, 48)) == (20 - 3, 24 + 5)
    np.testing.assert_allclose(still.truth().center[0], [3.0, -1.8])


def test_positive_T1_moves_the_image_to_smaller_columns():
    blob = Blobs(np.ones(1), np.zeros((1, 3)), 0.2 * np.eye(3)[None])

    class Shift(Still):
        def T(self, t):
            return np.multiply.outer(t / 0.11, [6.0, -3.0, 1.0])

    moved = Scene(scene().config, blob, Shift())
    assert np.unravel_index(moved.frame(11).argmax(), (40, 48)) == (20 + 5, 24 - 10)
    np.testing.assert_allclose(moved.truth().T[11], [6.0, -3.0])


@pytest.mark.parametrize("phantom", PHANTOMS)
@pytest.mark.parametrize("motion", MOTIONS)
def test_centers_of_the_images_are_the_true_ones(phantom, motion):
    made = scene(phantom={"kind": phantom, "oversampling": 4}, motion={"kind": motion})
    truth = made.truth()
    assert truth.length_unit == "µm"
    assert truth.time_unit == "s"
    np.testing.assert_allclose(np.diff(truth.time), 0.01)
    # the pixels are coarse for the smallest blobs
    sharp = phantom in ("grain", "sphere")
    for n in (0, 11):
        J = made.attenuation(n)
        center = np.array([J.sum(axis=0) @ made.x1, J.sum(axis=1) @ made.x2]) / J.sum()
        np.testing.assert_allclose(center, truth.center[n], atol=0.02 if sharp else 1e-4)


def test_one_frame_is_enough():
    frames, motion = simulate(stack=SMALL | {"frames": 1}, motion={"kind": "tumbling"})
    assert frames.shape == (1, 40, 48)
    assert len(motion) == 1


@pytest.mark.parametrize("output", ["attenuation", "camera"])
def test_frames_do_not_depend_on_the_blocks_and_follow_the_seed(output):
    camera = {"output": output, "noise": 0.02 if output == "attenuation" else 0.0}
    made = scene(camera=camera, phantom={"kind": "blobs"}, motion={"kind": "tumbling"})
    whole = made.frames().to_array()
    for size in (1, 5, 100):
        blocks = list(made.frames().blocks(size))
        assert max(len(b) for b in blocks) <= size
        np.testing.assert_array_equal(np.concatenate(blocks), whole)
    again = scene(camera=camera, phantom={"kind": "blobs"}, motion={"kind": "tumbling"})
    np.testing.assert_array_equal(again.frame(7), whole[7])
    other = scene(seed=1, camera=camera, phantom={"kind": "blobs"}, motion={"kind": "tumbling"})
    assert np.any(other.frame(7) != whole[7])
    assert np.any(other.truth().omega_3 != made.truth().omega_3)


def test_noise_of_frames_is_independent():
    made = scene(camera={"noise": 0.05}, motion={"kind": "still", "drift": 0.0}, phantom={"kind": "blobs"})
    noise = made.frames().to_array() - made.attenuation(0)
    assert noise.std() == pytest.approx(0.05 * made.peak, rel=0.03)
    correlation = np.corrcoef(noise.reshape(12, -1)) - np.eye(12)
    assert np.abs(correlation).max() < 5 / np.sqrt(40 * 48)


def test_peak_is_the_highest_attenuation_of_the_stack():
    made = scene(stack={"frames": 200})
    highest = max(made.attenuation(n).max() for n in range(200))
    assert 0.97 * highest < made.peak <= highest


def test_info_tells_sampling():
    info = scene(camera={"output": "camera"}).frames().info
    assert (info.frame_interval, info.time_unit) == (0.01, "s")
    assert (info.pixel_size, info.pixel_unit) == (0.6, "µm")
    assert info.bits == 12


def test_background_is_the_mean_empty_field():
    made = scene(camera={"output": "camera", "flicker": 0.0, "full_well": 1e6})
    background = made.background()
    assert background.dtype == np.float32
    expected = 0.01 * 4095 + made.sensor.flat_field / 1e6 * (0.99 * 4095)
    np.testing.assert_allclose(background, expected, atol=3.0)
    with pytest.raises(ConfigError, match="camera"):
        scene().background()


def test_truth_carries_the_configuration_and_the_scale():
    made = scene(camera={"dtype": "uint16"})
    truth = made.truth()
    stored = tomllib.loads(truth.provenance["configuration"])
    assert from_dict(SimulateConfig, stored, "truth") == made.config
    assert truth.provenance["pixel_values"] == f"{made.sensor.scale!r} * J + 0.0"


def test_simulate_takes_a_configuration_and_changes_to_it():
    config = from_dict(SimulateConfig, {"stack": SMALL}, "test")
    frames, motion = simulate(config, seed=3, phantom={"kind": "grain"}, camera={"dtype": "uint16"})
    assert frames.shape == (12, 40, 48)
    assert frames.dtype == np.uint16
    assert motion.truth
    with pytest.raises(ConfigError, match="did you mean 'phantom'"):
        simulate(config, fantom={})


def test_a_long_stack_streams_in_bounded_memory():
    made = scene(stack={"frames": 1000, "height": 1024, "width": 1024, "pixel_size": 0.05})
    tracemalloc.start()
    try:
        for count, _ in enumerate(made.frames().blocks()):
            if count == 5:
                break
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 100e6


@pytest.mark.parametrize("name", PRESETS)
def test_the_explained_file_of_a_preset_holds_its_values(name):
    file = CONFIGS / f"simulate-{name}.toml"
    explained = from_dict(SimulateConfig, load_toml(file), str(file))
    assert explained == from_dict(SimulateConfig, PRESETS[name], name)


def test_paper_preset_is_the_papers_sampling_and_the_default_covers_the_same_time():
    paper = from_dict(SimulateConfig, PRESETS["paper"], "paper")
    assert dataclasses.astuple(paper.stack)[:4] == (1000, 1024, 1024, 0.05)
    default = SimulateConfig().stack
    assert default.frames * default.frame_interval == paper.stack.frames * paper.stack.frame_interval == 0.5


def test_configuration_survives_toml():
    config = from_dict(SimulateConfig, PRESETS["camera"], "camera")
    assert from_dict(SimulateConfig, tomllib.loads(to_toml(config)), "toml") == config


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"stack": {"frames": 0}}, "stack.frames"),
        ({"stack": {"pixel_size": float("nan")}}, "stack.pixel_size"),
        ({"stack": {"pixel_unit": ""}}, "pixel_unit"),
        ({"phantom": {"kind": "cat"}}, "grain"),
        ({"motion": {"kind": "walk"}}, "tumbling"),
        ({"motion": {"unevenness": 1.0}}, "unevenness"),
        ({"camera": {"bits": 10}}, "8, 12, 16"),
        ({"camera": {"dtype": "int8"}}, "uint8"),
        ({"camera": {"noise": -0.1}}, "noise"),
        ({"camera": {"output": "camera", "noise": 0.1}}, "full_well"),
        ({"seed": -1}, "seed"),
    ],
)
def test_values_that_make_no_sense_are_refused(table, message):
    with pytest.raises(ConfigError, match=message):
        from_dict(SimulateConfig, table, "test")
