"""What a change of the images must do to the motion, whatever the object: laws of ``--method paper``."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trapcli.config import MotionConfig
from trapcli.motion.paper import estimate_paper
from trapcli.result.motion import Motion
from trapcli.simulation.motions import PaperMotion
from trapcli.simulation.phantoms import Blobs
from trapcli.stack.frames import Frames

PIXEL = 0.25
TIME = np.arange(90) * 0.004
INNER = slice(10, -10)
MIRROR = np.diag([1.0, 1.0, -1.0])


def estimate(frames: np.ndarray, time: np.ndarray = TIME, pixel_size: float = PIXEL) -> Motion:
    return estimate_paper(Frames.from_array(frames), MotionConfig(), time=time, pixel_size=pixel_size)


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    """An odd number of pixels, so that the origin is the middle."""
    rng = np.random.default_rng(21)
    covariance = rng.uniform(0.35, 0.8, 6)[:, None, None] * np.eye(3)
    blobs = Blobs(rng.uniform(0.5, 1.0, 6), rng.normal(scale=1.2, size=(6, 3)), covariance)
    x = (np.arange(73) - 36) * PIXEL
    poses = zip(PaperMotion().rotations(TIME), PaperMotion().T(TIME), strict=True)
    return np.array([blobs.project(R, T, x, x) for R, T in poses])


@pytest.fixture(scope="module")
def motion(frames: np.ndarray) -> Motion:
    return estimate(frames)


def line_difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs((a - b + np.pi / 2) % np.pi - np.pi / 2)[INNER].max())


def same_up_to_mirror(found: np.ndarray, expected: np.ndarray) -> bool:
    def off(R: np.ndarray) -> float:
        return float((Rotation.from_matrix(found).inv() * Rotation.from_matrix(R)).magnitude().max())

    return min(off(expected), off(MIRROR @ expected @ MIRROR)) < 1e-6


def test_rotations_are_in_the_group(motion: Motion) -> None:
    assert np.abs(np.swapaxes(motion.R, 1, 2) @ motion.R - np.eye(3)).max() < 1e-12
    assert np.abs(np.linalg.det(motion.R) - 1).max() < 1e-10
    assert np.array_equal(motion.R[0], np.eye(3))
    assert 0 <= motion.phi[0] < np.pi
    assert np.abs(np.diff(motion.phi)).max() < 0.1


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_rotating_the_images_rotates_the_motion(frames: np.ndarray, motion: Motion, quarters: int) -> None:
    # x1 to columns, x2 to rows: NumPy's quarter turn takes (x1, x2) to (x2, −x1)
    found = estimate(np.rot90(frames, quarters, axes=(1, 2)).copy())
    turn = np.linalg.matrix_power(np.array([[0.0, 1.0], [-1.0, 0.0]]), quarters)
    assert line_difference(found.phi, motion.phi - quarters * np.pi / 2) < 1e-9
    assert np.abs(found.T - motion.T @ turn.T).max() < 1e-9
    assert np.abs(found.omega_3 - motion.omega_3)[INNER].max() < 1e-8
    assert np.abs(found.alpha / motion.alpha - 1)[INNER].max() < 1e-5
    Q = np.eye(3)
    Q[:2, :2] = turn
    assert same_up_to_mirror(found.R, Q @ motion.R @ Q.T)


def test_shifting_the_images_shifts_the_translation(frames: np.ndarray, motion: Motion) -> None:
    steps = np.round(3 * np.sin(20 * TIME)).astype(int)
    moved = np.array(
        [np.roll(np.pad(f, 6), (s, -s), axis=(0, 1)) for f, s in zip(frames, steps, strict=True)]
    )
    found = estimate(moved)
    # towards higher rows is towards smaller T2
    expected = motion.T - PIXEL * np.stack([-(steps - steps[0]), steps - steps[0]], axis=1)
    assert np.abs(found.T - expected).max() < 1e-8
    assert line_difference(found.phi, motion.phi) < 1e-8
    assert np.abs(found.alpha / motion.alpha - 1)[INNER].max() < 1e-4


def test_reversing_time_reverses_the_angular_velocity(frames: np.ndarray, motion: Motion) -> None:
    found = estimate(frames[::-1].copy())
    # ω(t) → −ω(T − t): the line of φ stays, and so does α
    assert line_difference(found.phi, motion.phi[::-1]) < 1e-9
    assert np.abs(found.omega_3 + motion.omega_3[::-1])[INNER].max() < 1e-8
    assert np.abs(found.alpha / motion.alpha[::-1] - 1)[INNER].max() < 1e-5
    # the last frame becomes the gauge
    assert same_up_to_mirror(found.R, motion.R[-1].T @ motion.R[::-1])
    assert np.abs(found.T - (motion.T[::-1] - motion.T[-1])).max() < 1e-9


def test_mirroring_the_stack_mirrors_the_motion(frames: np.ndarray, motion: Motion) -> None:
    found = estimate(frames[:, :, ::-1].copy())
    S = np.diag([-1.0, 1.0, 1.0])
    # a reflection takes the pseudovector ω to −Sω
    assert line_difference(found.phi, -motion.phi) < 1e-9
    assert np.abs(found.omega_3 + motion.omega_3)[INNER].max() < 1e-8
    assert np.abs(found.alpha / motion.alpha - 1)[INNER].max() < 1e-5
    assert same_up_to_mirror(found.R, S @ motion.R @ S)
    assert np.abs(found.T - motion.T * [-1, 1]).max() < 1e-9


@pytest.mark.parametrize("factor", [1e-6, 7.3, 1e5])
def test_scaling_the_attenuation_changes_nothing(frames: np.ndarray, motion: Motion, factor: float) -> None:
    found = estimate(factor * frames)
    assert np.abs(found.T - motion.T).max() < 1e-9
    assert line_difference(found.phi, motion.phi) < 1e-9
    assert np.abs(found.alpha / motion.alpha - 1)[INNER].max() < 1e-5


def test_units_scale_the_result(frames: np.ndarray, motion: Motion) -> None:
    found = estimate(frames, time=1000 * TIME, pixel_size=2 * PIXEL)
    assert pytest.approx(2 * motion.T, abs=1e-9) == found.T
    assert found.phi[INNER] == pytest.approx(motion.phi[INNER], abs=1e-9)
    assert 1000 * found.omega_3[INNER] == pytest.approx(motion.omega_3[INNER], rel=1e-8)
    assert 1000 * found.alpha[INNER] == pytest.approx(motion.alpha[INNER], rel=1e-5)
    assert np.abs(found.R - motion.R).max() < 1e-7


def test_the_same_input_gives_the_same_output(frames: np.ndarray, motion: Motion) -> None:
    again = estimate(frames)
    for column in dataclasses.fields(motion):
        value = getattr(motion, column.name)
        if isinstance(value, np.ndarray):
            assert np.array_equal(value, getattr(again, column.name), equal_nan=value.dtype.kind == "f")
