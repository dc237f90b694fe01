"""Scenes that tell no motion, or not in all frames: never a confident one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trapcli import estimate
from trapcli.errors import InputError
from trapcli.result.motion import Flag, Motion
from trapcli.simulation.render import simulate

RNG = np.random.default_rng(0)
SHAPE = (60, 48, 48)


def camera(kind: str = "grain", motion: str = "tumbling", **phantom: Any) -> np.ndarray:
    frames, _ = simulate(
        seed=2,
        stack={"frames": SHAPE[0], "height": SHAPE[1], "width": SHAPE[2], "pixel_size": 0.5},
        phantom={"kind": kind, **phantom},
        motion={"kind": motion, "total_angle": 120.0},
        camera={"output": "camera", "bits": 12, "dust": 0},
    )
    return frames


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (np.zeros(SHAPE, np.uint16), "all frames are dark"),
        (np.full(SHAPE, np.nan, np.float32), "all frames are dark"),
        (np.full(SHAPE, 65535, np.uint16), "frames show an object"),
        (np.full(SHAPE, 900, np.uint16), "frames show an object"),
        (RNG.poisson(2000, SHAPE).astype(np.uint16), "frames show an object"),
        (-RNG.poisson(2000, SHAPE).astype(np.int16), "all frames are dark"),
        (RNG.normal(0, 1, SHAPE).astype(np.float32), "--attenuation"),
    ],
    ids=["black", "nan", "saturated", "flat", "light", "negative", "signed noise"],
)
@pytest.mark.parametrize("background", ["auto", "none"])
def test_nothing_to_see_is_an_error(frames: np.ndarray, words: str, background: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        estimate(frames, background=background)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("scene", ["sphere", "still", "the same frame"])
def test_what_does_not_change_is_not_trustworthy(scene: str) -> None:
    frames = camera("sphere") if scene == "sphere" else camera(motion="still")
    found = estimate(np.repeat(frames[:1], 60, axis=0) if scene == "the same frame" else frames)
    assert not found.identifiable
    assert not found.valid.any()
    assert np.isnan(found.alpha).all()


@pytest.mark.slow
def test_an_object_larger_than_the_frame_is_not_trustworthy() -> None:
    found = estimate(camera(radius=14.0))
    assert not found.identifiable
    assert not found.valid.any()


@pytest.mark.slow
def test_frames_that_are_spoilt_are_left_out() -> None:
    frames = camera()
    frames[[7, 8]], frames[20] = 0, 4095
    found: Motion = estimate(frames)
    assert found.identifiable
    # of a bright frame without a known depth of bits it isn't known what has happened to it
    spoilt = np.flatnonzero(found.flags & (Flag.BLANK | Flag.SATURATED | Flag.CLIPPED | Flag.OUTLIER))
    assert spoilt.tolist() == [7, 8, 20]
    assert np.array_equal(np.flatnonzero(found.valid == 0), spoilt)
    assert np.isnan(found.R[spoilt]).all()
