"""What is sent to the page so that the object can turn: samples, frames, scales."""

from __future__ import annotations

import base64
import dataclasses
import zlib

import numpy as np
import pytest

from trapcli.errors import InputError
from trapcli.report.turning import MOST_FRAMES, packed, prepare, to_json, with_film
from trapcli.stack.frames import Frames


def blob(n: int, at, width: float = 3.0) -> np.ndarray:
    """A Gaussian at ``(x1, x2, x3)`` voxels from the middle one."""
    axis = np.arange(n) - n // 2
    x3, x2, x1 = np.meshgrid(axis, axis, axis, indexing="ij")
    square = sum((x - a) ** 2 for x, a in zip((x1, x2, x3), at, strict=True))
    return np.exp(-square / (2 * width**2)).astype(np.float32)


def centroid(samples: np.ndarray) -> np.ndarray:
    """Of the bright part, from the middle sample, last axis first."""
    weight = np.where(samples > 0.3 * samples.max(), samples, 0.0).astype(float)
    axes = np.meshgrid(*(np.arange(n) - n // 2 for n in samples.shape), indexing="ij")
    return np.array([(axis * weight).sum() for axis in axes])[::-1] / weight.sum()


@pytest.mark.parametrize("n", [40, 64, 101])
def test_place_and_values_are_kept(make_motion, n):
    at = np.array([6.0, -4.0, 9.0])
    shown = prepare(2 * blob(n, at, n / 16), 0.25, "µm", make_motion())
    assert len(shown.values) == min(n, 64)
    assert len(shown.values) * shown.step == pytest.approx(n * 0.25)
    np.testing.assert_allclose(shown.step * centroid(shown.values), 0.25 * at, atol=0.02)
    assert shown.low == 0
    assert shown.high == pytest.approx(2, rel=0.1)
    # an infinitely long ray through the middle of the blob
    assert shown.film_high == pytest.approx(2 * 0.25 * n / 16 * np.sqrt(2 * np.pi), rel=0.05)


def test_values_below_0(make_motion):
    shown = prepare(-blob(20, (0, 0, 0)), 1.0, "µm", make_motion())
    assert (shown.low, shown.values[10, 10, 10]) == (-1, 0)
    # 255 is the value far away
    assert shown.high == pytest.approx(0, abs=1e-6)


def test_units(make_motion):
    values = blob(20, (0, 0, 0))
    shown, same = (prepare(values, *edge, make_motion()) for edge in ((2500.0, "Å"), (0.25, "µm")))
    assert shown.step == pytest.approx(same.step)
    assert shown.unit == "µm"
    # attenuation per length changes with the unit, and its integral does not
    assert shown.high == pytest.approx(1e4 * same.high)
    assert shown.high * shown.step == pytest.approx(2500 * values.max())
    with pytest.raises(InputError, match="a volume in pixel does not fit a result in µm"):
        prepare(values, 1.0, "pixel", make_motion())


@pytest.mark.parametrize("values", [np.zeros((4, 4, 5)), np.zeros((4, 4)), np.full((4, 4, 4), np.nan)])
def test_what_is_no_volume(make_motion, values):
    with pytest.raises(InputError, match="no cube"):
        prepare(values, 1.0, "µm", make_motion())


def test_frames_are_so_close_that_the_object_is_seen_to_turn(make_motion):
    values = blob(16, (0, 0, 0))
    # 0.065 rad a frame
    many = prepare(values, 1.0, "µm", make_motion(1000)).positions
    np.testing.assert_array_equal(many, 2 * np.arange(MOST_FRAMES))
    few = prepare(values, 1.0, "µm", make_motion(50)).positions
    np.testing.assert_array_equal(few, np.arange(50))
    slow = make_motion(1000)
    slow = dataclasses.replace(slow, R=slow.R[np.arange(1000) // 20])
    whole = prepare(values, 1.0, "µm", slow).positions
    assert whole[-1] > 980
    assert len(set(np.diff(whole))) == 1


def test_frames_that_are_not_valid_are_left_out(make_motion):
    values, motion = blob(16, (0, 0, 0)), make_motion()
    motion.valid[7], motion.R[9] = 0, np.nan
    assert sorted(set(range(40)) - set(prepare(values, 1.0, "µm", motion).positions)) == [7, 9]
    none = dataclasses.replace(motion, valid=np.zeros(40, np.uint8))
    assert len(prepare(values, 1.0, "µm", none).positions) == 39
    with pytest.raises(InputError, match="no rotation"):
        prepare(values, 1.0, "µm", make_motion(R=np.full((40, 3, 3), np.nan)))


@pytest.mark.parametrize("pixel_size", [0.1, 0.5])
def test_film_shows_the_object_in_the_middle_and_as_large_as_the_volume(make_motion, pixel_size):
    """A spot 2 µm to the right of the centre and 1 µm above it, before a field that is not dark."""
    edge = round(30 / pixel_size)
    x = (np.arange(edge) - edge // 2) * pixel_size
    motion = make_motion(6)
    spots = [
        0.2 + np.exp(-((x - c1 - 2) ** 2 + (x[:, None] - c2 + 1) ** 2) / 0.5) for c1, c2 in motion.center
    ]
    shown = prepare(blob(48, (0, 0, 0)), 0.25, "µm", motion)
    shown = with_film(shown, Frames.from_array(np.array(spots)), motion, pixel_size)
    side = shown.film.shape[1]
    assert side == min(96, round(12 / pixel_size))
    for image in shown.film:
        np.testing.assert_allclose(centroid(image) * 12 / side, [2, -1], atol=0.1)
        value = shown.film_low + image[0, 0] / 255 * (shown.film_high - shown.film_low)
        assert abs(value) < 0.01
    assert shown.film_high == pytest.approx(1, rel=0.1)


def test_what_is_sent(make_motion):
    motion = make_motion(5, alpha=np.array([np.nan, 1, 1, 1, 1]))
    shown = prepare(blob(8, (1, 0, 0)), 1.0, "µm", motion)
    np.testing.assert_array_equal(
        np.frombuffer(zlib.decompress(base64.b64decode(packed(shown))), np.uint8), shown.values.ravel()
    )
    scene = to_json(shown, motion)
    np.testing.assert_allclose(np.reshape(scene["R"], (5, 3, 3)), motion.R, atol=1e-5)
    assert scene["omega"][0] is None
    np.testing.assert_allclose(scene["omega"][1], [motion.omega_1[1], motion.omega_2[1], motion.omega_3[1]])
    assert (scene["samples"], scene["side"]) == (8, 0)
