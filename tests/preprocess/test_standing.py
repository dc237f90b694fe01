"""Dust that the particle always covers, told from the particle by its motion."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

import trapcli
from trapcli import pipeline
from trapcli.motion import joint
from trapcli.motion.front_end import read_front_end
from trapcli.motion.low_band import read_low_band
from trapcli.preprocess import standing
from trapcli.preprocess.standing import StandingPattern, find_standing_pattern, without
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


def pattern_in(frames: np.ndarray, motion: Motion) -> StandingPattern | None:
    front = read_front_end(
        Frames.from_array(frames), time=motion.time, pixel_size=PIXEL, line_band=1.0, fine_band=28.0
    )
    low = front.low.shifted(motion.center - front.centers.center)
    return find_standing_pattern(low, motion.center, motion.R)


def test_where_nothing_stays_nothing_is_found(turning: tuple[np.ndarray, Motion]) -> None:
    frames, truth = turning
    assert pattern_in(frames, truth) is None


def test_dust_is_found_up_to_the_frequencies_that_judge_the_motion() -> None:
    # what stays at higher ones would bend the motion
    assert standing._FINEST_BAND == joint._FINEST_BAND


def test_nothing_is_found_where_the_motion_is_not_known(turning: tuple[np.ndarray, Motion]) -> None:
    frames, truth = turning
    unknown = replace(truth, R=np.full_like(truth.R, np.nan))
    assert pattern_in(frames, unknown) is None


@pytest.mark.slow
def test_specks_are_found_though_the_motion_is_off(turning: tuple[np.ndarray, Motion]) -> None:
    frames, truth = turning
    dust = specks(float(frames.max()))
    sway = np.deg2rad(0.5) * np.sin(np.linspace(0, 3, len(truth)))[:, None] * [1, -1, 0]
    motion = replace(truth, R=truth.R @ Rotation.from_rotvec(sway).as_matrix())
    found = pattern_in((frames + dust).astype(np.float32), motion)
    assert found is not None
    # the pattern holds low frequencies only; what is round about the middle may be the object's
    image = found.image(dust.shape, PIXEL)
    error, smooth = (ndimage.gaussian_filter(one, 2.0) for one in (image - dust, dust))
    assert np.abs(error - error.mean()).max() < 0.25 * smooth.max()


def test_the_modes_of_a_pattern_are_those_of_its_image(turning: tuple[np.ndarray, Motion]) -> None:
    frames, truth = turning
    front = read_front_end(
        Frames.from_array(frames), time=truth.time, pixel_size=PIXEL, line_band=1.0, fine_band=22.0
    )
    points = standing._Points.over(front.low, np.array([0.4, -0.8]), 22.0)
    away = np.linalg.norm(points.place - [1.5, -1.0], axis=1)
    pattern = StandingPattern(points, np.exp(-0.5 * (away / 1.2) ** 2))

    def seen(images: np.ndarray) -> np.ndarray:
        band = 22.0 / front.low.radius
        stack = Frames.from_array(images)
        return read_low_band(stack, front.centers, time=truth.time, band=band, pixel_size=PIXEL).modes

    added = seen(frames + pattern.image((SIZE, SIZE), PIXEL)) - seen(frames)
    modes = pattern.modes(front.centers.center)
    assert np.abs(added - modes).max() < 1e-3 * np.abs(modes).max()


def test_a_pattern_is_taken_off_every_frame(turning: tuple[np.ndarray, Motion]) -> None:
    frames = turning[0].astype(np.float32)
    pattern = specks(1.0)
    cleared = without(Frames.from_array(frames), pattern)
    assert "stays in place" in cleared.info.warnings[-1]
    np.testing.assert_array_equal(cleared.to_array(), frames - pattern.astype(np.float32))
    assert np.array_equal(next(cleared.pick(np.array([7]))), cleared.to_array()[7])


def found_by(motion: Motion, *, residual: float, explains: bool) -> SimpleNamespace:
    """Return what `pipeline` asks of a motion that was found."""
    told = replace(motion, residual=np.full(len(motion), residual))
    low = SimpleNamespace(select=lambda _: None)
    return SimpleNamespace(
        so_far=told,
        about=lambda _: None,
        best=(SimpleNamespace(model=None), None),
        stack=SimpleNamespace(
            centers=SimpleNamespace(center=motion.center, clipped=np.zeros(len(motion), bool)),
            low=low,
            used=np.arange(len(motion)),
        ),
        explains=explains,
        despite_standing=lambda _: [],
    )


@pytest.fixture
def a_pattern(monkeypatch: pytest.MonkeyPatch) -> None:
    """Something that is always found to stay."""
    pattern = SimpleNamespace(image=lambda *_: specks(1.0), modes=lambda center: center)
    monkeypatch.setattr("trapcli.preprocess.standing.find_standing_pattern", lambda *_: pattern)


@pytest.mark.usefixtures("a_pattern")
@pytest.mark.parametrize("better", [True, False])
def test_a_pattern_counts_only_where_it_explains_the_images(
    better: bool, turning: tuple[np.ndarray, Motion]
) -> None:
    frames, truth = Frames.from_array(turning[0].astype(np.float32)), turning[1]
    found = found_by(truth, residual=2.0, explains=True)
    again = found_by(truth, residual=1.0 if better else 3.0, explains=True)
    found.without = lambda *_: again
    taken, chosen = pipeline._without_dust(frames, found, lambda _: None, PIXEL)
    assert chosen is (again if better else found)
    assert bool(taken.info.warnings) == better


@pytest.mark.usefixtures("a_pattern")
@pytest.mark.parametrize("best", [0, 1, 2, 3])
def test_where_nothing_explains_the_images_the_best_of_all_is_taken(
    best: int, turning: tuple[np.ndarray, Motion], monkeypatch: pytest.MonkeyPatch
) -> None:
    frames, truth = Frames.from_array(turning[0].astype(np.float32)), turning[1]
    monkeypatch.setattr("trapcli.preprocess.standing.most_likely", lambda *_: truth)
    residuals = [3.0, 4.0, 5.0, 6.0]
    residuals[best] = 2.0
    found, again, hidden, anew = (found_by(truth, residual=one, explains=False) for one in residuals)
    found.without = lambda _, path=None: again if path is None else hidden
    _, chosen = pipeline._without_dust(frames, found, lambda _: anew, PIXEL)
    assert chosen is (found, again, hidden, anew)[best]
