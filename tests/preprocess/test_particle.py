"""Debris, a second particle and the edge of the field: what is not the particle is erased or left out."""

from __future__ import annotations

import numpy as np
import pytest

from trapcli.config import PreprocessConfig
from trapcli.errors import InputError
from trapcli.preprocess.attenuation import Projections, to_attenuation
from trapcli.result.motion import Flag
from trapcli.stack.frames import Frames

SIZE, FRAMES, RADIUS, LIGHT = 80, 60, 16.0, 20_000.0
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE] - SIZE // 2


def ball(x1: float, x2: float, radius: float = RADIUS, depth: float = 0.6) -> np.ndarray:
    return depth * np.sqrt(np.maximum(1 - ((COLUMNS - x1) ** 2 + (ROWS - x2) ** 2) / radius**2, 0))


def path(n: int) -> tuple[float, float]:
    return 3 * np.sin(n / 9), 3 * np.cos(n / 7)


def particle() -> np.ndarray:
    """A ball with a smaller one inside, which turns in it."""
    return np.array(
        [ball(*path(n)) + ball(path(n)[0] + 6 * np.cos(n / 12), path(n)[1], 6, 0.3) for n in range(FRAMES)]
    )


def projections(attenuation: np.ndarray, background: str = "auto") -> Frames:
    light = np.random.default_rng(0).poisson(LIGHT * np.exp(-attenuation)).astype(np.uint16)
    return to_attenuation(Frames.from_array(light), PreprocessConfig(background=background))


def left_out(frames: Frames) -> list[int]:
    return np.flatnonzero(np.isnan(frames.to_array()).all(axis=(1, 2))).tolist()


def why(frames: Frames) -> dict[int, int]:
    """Return the flag of each frame that is left out."""
    assert isinstance(frames, Projections)
    return {n: int(frames.left_out[n]) for n in left_out(frames)}


@pytest.mark.parametrize("background", ["auto", "border"])
def test_a_particle_alone_is_left_as_it_is(background: str) -> None:
    frames = projections(particle(), background)
    assert not frames.info.warnings
    assert np.std(frames.to_array() - particle()) < 1.5 / np.sqrt(LIGHT)


def test_debris_that_passes_by_is_erased() -> None:
    alone = particle()
    passing = alone.copy()
    for n in range(20, 50):
        passing[n] += ball(-50 + 2.5 * (n - 18), -32, 4, 0.4)
    frames = projections(passing)
    assert "something else" in frames.info.warnings[0]
    assert not left_out(frames)
    # what remains is its faint rim
    assert np.abs(frames.to_array() - alone).sum(axis=(1, 2)).max() < 1.1 * 0.8 * SIZE**2 / np.sqrt(LIGHT)


def test_frames_in_which_debris_crosses_the_particle_are_left_out() -> None:
    passing = particle()
    for n in range(20, 50):
        passing[n] += ball(-50 + 3.5 * (n - 20), 2, 4, 0.5)
    frames = projections(passing)
    touched = [n for n in range(20, 50) if abs(-50 + 3.5 * (n - 20) - path(n)[0]) < RADIUS + 1]
    assert set(touched) <= set(left_out(frames))
    assert len(left_out(frames)) <= len(touched) + 6
    assert any("left out" in warning for warning in frames.info.warnings)
    assert set(why(frames).values()) == {Flag.OUTLIER}


def test_a_smaller_neighbour_is_erased() -> None:
    alone = particle()
    frames = projections(alone + ball(30, 30, 5, 0.4))
    assert np.abs(frames.to_array() - alone).max() < 0.1
    assert not left_out(frames)


def test_two_particles_are_refused() -> None:
    alone = particle()[:, 10:-10, 10:-10]
    both = np.concatenate([alone, np.roll(alone, 17, axis=0)], axis=2)
    with pytest.raises(InputError, match=r"array: shows two particles.*--roi"):
        projections(both)


def test_frames_in_which_the_particle_leaves_the_field_are_left_out() -> None:
    out = np.maximum(np.arange(FRAMES) - 45, 0) * 3.0
    leaving = np.array([ball(path(n)[0] + out[n], path(n)[1]) for n in range(FRAMES)])
    cut = [n for n in range(FRAMES) if path(n)[0] + out[n] > SIZE / 2 - RADIUS + 4]
    frames = projections(leaving)
    assert set(cut) <= set(left_out(frames))
    assert min(left_out(frames)) > 45
    assert set(why(frames).values()) == {Flag.CLIPPED}


def test_large_frames_are_looked_at_coarsely() -> None:
    image = np.kron(particle()[0], np.ones((7, 7)))
    debris = np.kron(ball(32, -30, 4, 0.4), np.ones((7, 7)))
    stack = np.repeat(image[None], 20, axis=0).astype(np.float32)
    stack[3] += debris
    stack[5] += np.roll(debris, (150, -200), axis=(0, 1))
    light = (LIGHT * np.exp(-stack)).astype(np.uint16)
    found = to_attenuation(Frames.from_array(light), PreprocessConfig(background="border")).to_array()
    assert np.abs(found[3] - image).max() < 0.1
    assert np.isnan(found[5]).all()
