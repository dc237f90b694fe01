"""The public interface on arrays: units, settings, provenance, and the truth of a rendered scene."""

from __future__ import annotations

import doctest
import subprocess
import sys
import tomllib
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import trapcli
from trapcli.config import EstimateConfig, InputConfig, MotionConfig, PreprocessConfig, from_dict
from trapcli.errors import ConfigError, InputError
from trapcli.result.motion import Flag, Motion
from trapcli.stack import Frames, StackInfo, open_stack
from trapcli.stack.tiff import write_tiff

INTERVAL, PIXEL = 0.0025, 0.4
PAPER = EstimateConfig(preprocess=PreprocessConfig(attenuation=True), motion=MotionConfig(method="paper"))


@pytest.fixture(scope="module")
def scene() -> tuple[NDArray[Any], Motion]:
    """The paper's object and motion, clean, 50 frames of 64 × 64."""
    return trapcli.simulate(stack={"frames": 50, "height": 64, "width": 64, "pixel_size": PIXEL})


def test_the_truth_is_found_in_its_units(scene: tuple[NDArray[Any], Motion]) -> None:
    frames, truth = scene
    motion = trapcli.estimate(
        frames, frame_interval=INTERVAL, pixel_size=PIXEL, pixel_unit="µm", config=PAPER
    )
    assert (motion.time_unit, motion.length_unit) == ("s", "µm")
    assert motion.identifiable
    assert motion.valid.all()
    np.testing.assert_allclose(motion.time, truth.time)
    np.testing.assert_allclose(motion.T, truth.T, atol=1e-5)
    np.testing.assert_allclose(motion.phi, truth.phi, atol=1e-4)
    np.testing.assert_allclose(motion.omega_3, truth.omega_3, atol=1e-3)
    errors = trapcli.compare(motion, truth, trim=5).errors
    assert errors["alpha_relative"].max < 1  # per cent
    assert errors["R"].max < 0.1  # degrees


def test_what_is_not_known_is_in_frames_and_pixels(scene: tuple[NDArray[Any], Motion]) -> None:
    frames, truth = scene
    motion = trapcli.estimate(frames, attenuation=True, method="paper")
    assert (motion.time_unit, motion.length_unit) == ("frame", "pixel")
    np.testing.assert_array_equal(motion.time, np.arange(50))
    np.testing.assert_allclose(motion.omega_3, truth.omega_3 * INTERVAL, rtol=1e-3)
    np.testing.assert_allclose(motion.T, truth.T / PIXEL, atol=1e-4)


def test_a_size_without_a_unit_makes_no_unit(scene: tuple[NDArray[Any], Motion]) -> None:
    info = StackInfo(frame_interval=INTERVAL, pixel_size=PIXEL, warnings=("its frames are\nodd",))
    motion = trapcli.estimate(Frames.from_array(scene[0], info), config=PAPER)
    assert (motion.time_unit, motion.length_unit) == ("s", "pixel")
    odd, unit = motion.provenance["warnings"].splitlines()
    assert odd == "its frames are odd"
    assert "unit" in unit
    np.testing.assert_allclose(motion.T, scene[1].T / PIXEL, atol=1e-4)


def test_frames_of_a_file(scene: tuple[NDArray[Any], Motion], tmp_path: Any) -> None:
    frames, truth = scene
    path = tmp_path / "stack.tif"
    write_tiff(
        path, [frames], shape=frames.shape, dtype=frames.dtype,
        frame_interval=INTERVAL, pixel_size=PIXEL, pixel_unit="µm",
    )  # fmt: skip
    selected = open_stack(str(path), InputConfig(frames="8:48:2"))
    motion = trapcli.estimate(selected, config=PAPER)
    np.testing.assert_array_equal(motion.frame, np.arange(8, 48, 2))
    np.testing.assert_allclose(motion.time, truth.time[8:48:2])
    np.testing.assert_allclose(motion.phi, truth.phi[8:48:2], atol=1e-3)
    own = trapcli.estimate(selected, frame_interval=1.0, config=PAPER)
    np.testing.assert_allclose(own.time, np.arange(8, 48, 2))


def test_raw_intensities_give_what_their_attenuation_gives(scene: tuple[NDArray[Any], Motion]) -> None:
    J = scene[0].astype(float) / scene[0].max()
    x = np.linspace(-1, 1, 64)
    field = 3000 * (1 - 0.2 * x**2 + 0.1 * x[:, None])
    raw = trapcli.estimate(field * np.exp(-J), background="border", method="paper")
    plain = trapcli.estimate(J, attenuation=True, method="paper")
    np.testing.assert_allclose(raw.T, plain.T, atol=1e-4)
    np.testing.assert_allclose(raw.phi, plain.phi, atol=1e-3)
    np.testing.assert_allclose(raw.omega_3, plain.omega_3, rtol=1e-3)


def test_frames_without_a_projection_say_why(scene: tuple[NDArray[Any], Motion]) -> None:
    raw = np.round(3000 * np.exp(-scene[0] / scene[0].max())).astype(np.uint16)
    raw[20], raw[30] = 65535, 0
    motion = trapcli.estimate(raw, background="border", method="paper")
    assert motion.flags[20] & (Flag.SATURATED | Flag.BLANK) == Flag.SATURATED
    assert motion.flags[30] & (Flag.SATURATED | Flag.BLANK) == Flag.BLANK
    assert not motion.valid[[20, 30]].any()


def test_an_argument_beats_the_configuration_and_both_are_kept(scene: tuple[NDArray[Any], Motion]) -> None:
    config = EstimateConfig(
        input=InputConfig(frame_interval=2.0), motion=MotionConfig(method="auto", window=9)
    )
    motion = trapcli.estimate(
        scene[0], frame_interval=INTERVAL, attenuation=True, method="paper", config=config
    )
    assert motion.time_unit == "s"
    np.testing.assert_allclose(motion.time, np.arange(50) * INTERVAL)
    stored = from_dict(EstimateConfig, tomllib.loads(motion.provenance["configuration"]), "stored")
    assert stored == EstimateConfig(
        input=InputConfig(frame_interval=INTERVAL),
        preprocess=PreprocessConfig(attenuation=True),
        motion=MotionConfig(method="paper", window=9),
    )
    assert motion.provenance["program"] == "trap-motion"


def test_progress_comes_in_stages_that_end(scene: tuple[NDArray[Any], Motion]) -> None:
    calls: list[tuple[str, int, int]] = []
    trapcli.estimate(scene[0], config=PAPER, progress=lambda *call: calls.append(call))
    last = {stage: (done, total) for stage, done, total in calls}
    assert {"centers", "reduced map", "rotation"} <= set(last)
    assert all(done == total for done, total in last.values())


def test_nothing_is_printed(scene: tuple[NDArray[Any], Motion], capfd: pytest.CaptureFixture[str]) -> None:
    trapcli.estimate(scene[0], config=PAPER)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "magic"}, "--method magic"),
        ({"frame_interval": 0.0}, "--frame-interval"),
        ({"frame_interval": float("nan")}, "--frame-interval"),
        ({"pixel_size": -1.0, "pixel_unit": "µm"}, "--pixel-size"),
        ({"pixel_size": 0.1}, "--pixel-unit"),
    ],
)
def test_settings_that_make_no_sense(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        trapcli.estimate(np.ones((9, 8, 8)), attenuation=True, **settings)


def test_a_unit_without_a_size() -> None:
    with pytest.raises(InputError, match="--pixel-size"):
        trapcli.estimate(np.ones((9, 8, 8)), attenuation=True, method="paper", pixel_unit="µm")


@pytest.mark.parametrize(
    "frames", [np.ones((8, 8)), np.ones((0, 8, 8)), np.ones((9, 8, 8), complex), np.ones((9, 8, 8), object)]
)
def test_arrays_that_are_no_stack(frames: NDArray[Any]) -> None:
    with pytest.raises(InputError, match="frames x rows x columns"):
        trapcli.estimate(frames)


@pytest.mark.parametrize("method", ["paper", "auto"])
@pytest.mark.parametrize("count", [1, 2, 4])
def test_too_few_frames(scene: tuple[NDArray[Any], Motion], count: int, method: str) -> None:
    with pytest.raises(InputError, match="needed"):
        trapcli.estimate(scene[0][:count], attenuation=True, method=method)


@pytest.mark.parametrize("method", ["paper", "auto"])
def test_empty_frames(method: str) -> None:
    with pytest.raises(InputError, match="array"):
        trapcli.estimate(np.zeros((20, 32, 32)), attenuation=True, method=method)


@pytest.mark.slow
def test_the_joint_method_on_noise() -> None:
    frames, truth = trapcli.simulate(
        stack={"frames": 150, "height": 64, "width": 64, "pixel_size": 0.4, "frame_interval": 0.02},
        phantom={"kind": "grain"},
        motion={"kind": "tumbling"},
        camera={"noise": 0.01},
    )
    motion = trapcli.estimate(frames, attenuation=True, frame_interval=0.02)
    assert motion.identifiable
    assert trapcli.compare(motion, truth).errors["R_aligned"].mean < 1  # degrees


def test_the_example_in_the_docstring() -> None:
    failed, attempted = doctest.testmod(trapcli)
    assert (failed, attempted > 0) == (0, True)


def test_importing_the_package_imports_nothing_heavy() -> None:
    program = "import sys, trapcli; dir(trapcli); assert not {'numpy', 'scipy', 'click'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)


def test_public_names() -> None:
    assert all(callable(getattr(trapcli, name)) for name in trapcli.__all__)
    assert set(trapcli.__all__) <= set(dir(trapcli))
    assert trapcli.Motion is Motion
    with pytest.raises(AttributeError, match="estimat"):
        trapcli.estimat  # noqa: B018
