"""Dust that the particle always covers, told from the particle by its motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import trapcli
from trapcli.preprocess.standing import find_standing_pattern, without
from trapcli.result.motion import Motion
from trapcli.stack.frames import Frames

SIZE, PIXEL = 64, 0.4
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE] - SIZE // 2


@pytest.fixture(scope="module")
def turning() -> tuple[np.ndarray, Motion]:
    """A particle with noise of 1 % of its peak, and how it turns."""
    return trapcli.simulate(
        seed=3,
        stack={"frames": 60, "height": SIZE, "width": SIZE, "pixel_size": PIXEL},
        phantom={"kind": "blobs"},
        motion={"kind": "tumbling", "drift": 0.1},
        camera={"noise": 0.01, "dtype": "float32"},
    )


def specks(highest: float) -> np.ndarray:
    spots = ((-4, 5, 1.2), (7, -2, 1.5))
    spread = [np.exp(-((ROWS - row) ** 2 + (COLUMNS - column) ** 2) / (2 * s**2)) for row, column, s in spots]
    return np.asarray(0.1 * highest * np.sum(spread, axis=0))


def test_where_nothing_stays_nothing_is_found(turning: tuple[np.ndarray, Motion]) -> None:
    frames, truth = turning
    assert find_standing_pattern(Frames.from_array(frames), truth, PIXEL) is None


def test_nothing_is_found_where_the_motion_is_not_known(turning: tuple[np.ndarray, Motion]) -> None:
    frames, truth = turning
    unknown = replace(truth, R=np.full_like(truth.R, np.nan))
    assert find_standing_pattern(Frames.from_array(frames), unknown, PIXEL) is None


@pytest.mark.slow
def test_specks_under_the_particle_are_found(turning: tuple[np.ndarray, Motion]) -> None:
    frames, truth = turning
    dust = specks(float(frames.max()))
    found = find_standing_pattern(Frames.from_array((frames + dust).astype(np.float32)), truth, PIXEL)
    assert found is not None
    # the pattern holds low frequencies only; what is round about the middle may be the object's
    error, smooth = (ndimage.gaussian_filter(image, 2.0) for image in (found - dust, dust))
    assert np.abs(error - error.mean()).max() < 0.25 * smooth.max()


@pytest.mark.slow
def test_what_dust_costs_comes_back(turning: tuple[np.ndarray, Motion]) -> None:
    frames, truth = turning
    dusty = (frames + specks(float(frames.max()))).astype(np.float32)
    scale = {"frame_interval": float(truth.time[1]), "pixel_size": PIXEL, "pixel_unit": "µm"}

    def error(images: np.ndarray) -> tuple[Motion, float]:
        motion = trapcli.estimate(images, attenuation=True, **scale)
        return motion, trapcli.compare(motion, truth).errors["R_aligned"].mean

    _, clean = error(frames)
    spoilt, more = error(dusty)
    assert more > 2 * clean
    pattern = find_standing_pattern(Frames.from_array(dusty), spoilt, PIXEL)
    assert pattern is not None
    cleared = without(Frames.from_array(dusty), pattern)
    assert "stays in place" in cleared.info.warnings[-1]
    assert np.array_equal(next(cleared.pick(np.array([7]))), cleared.to_array()[7])
    assert error(np.asarray(cleared.to_array()))[1] < 1.6 * clean
