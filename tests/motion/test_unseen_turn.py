"""Turns about an axis of symmetry are found where there is one, from closed-form Fourier transforms."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.motion.ambiguity import UnseenTurn, unseen_turn
from trapcli.motion.low_band import LowBand
from trapcli.motion.object_model import ObjectModel
from trapcli.motion.path import Path, Spline
from trapcli.simulation.motions import RigidMotion, SingleAxis, Tumbling
from trapcli.simulation.phantoms import Blobs

Array = NDArray[np.float64]
RADIUS, BAND, NOISE, FRAMES = 5.0, 12 / 5.0, 0.002, 60
TUMBLING = Tumbling.random(np.random.default_rng(4), total_angle=240.0, duration=1.0)
IN_PLANE = SingleAxis.from_turns(turns=1.2, duration=1.0)


def low_band(thing: Blobs, path: Path, noise: float) -> LowBand:
    """Return exact modes with white noise, in units of the mass."""
    step = np.pi / (1.15 * RADIUS)
    axis = step * np.arange(-10, 11)
    k = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    half = (k[:, 1] > 1e-9) | ((np.abs(k[:, 1]) < 1e-9) & (k[:, 0] > -1e-9))
    k = k[half & (np.hypot(*k.T) <= BAND)]
    k = k[np.argsort(np.hypot(*k.T), kind="stable")]
    n, sigma = len(path.R), noise * thing.mass / (2 * np.pi)
    rng = np.random.default_rng(0)
    white = (rng.normal(size=(n, len(k))) + 1j * rng.normal(size=(n, len(k)))) / np.sqrt(2)
    white[:, 0] = rng.normal(size=n)
    modes = np.array([thing.fourier(k, rotation) for rotation in path.R]) + sigma * white
    unused = np.zeros((n, 3)), np.zeros((n, 4)), np.eye(3), np.eye(4)
    return LowBand(path.time, k, modes, sigma**2, *unused, mass=np.ones(n), radius=RADIUS)


def found(thing: Blobs, motion: RigidMotion, noise: float = NOISE) -> UnseenTurn | None:
    """Fit from the true motion on, and look for turns that are not seen."""
    time, spline = np.linspace(0, 1, FRAMES), Spline(0.0, 1.0, 6)
    times = np.concatenate([time, spline.grid, time])
    order = np.argsort(times, kind="stable")
    R = np.empty((len(times), 3, 3))
    R[order] = motion.rotations(times[order])
    path = Path(times, R, motion.omega(times))
    model = ObjectModel(low_band(thing, Path(time, R[:FRAMES], path.omega[:FRAMES]), noise), BAND)
    fit = model.fit(path, time, spline, steps=3)
    return unseen_turn(fit, model.assess(fit), BAND)


def symmetric(fold: int, axis: Array) -> Blobs:
    """Return round blobs that a turn by 360° / `fold` leaves as they are."""
    rng = np.random.default_rng(7)
    place, size = 0.4 * RADIUS * rng.normal(size=(2, 3)), rng.uniform(0.1, 0.12, 2) * RADIUS
    turns = Rotation.from_rotvec(2 * np.pi / fold * np.arange(fold)[:, None] * axis)
    position = np.concatenate([turn.apply(place) for turn in turns])
    covariance = np.tile(size**2, fold)[:, None, None] * np.eye(3)
    thing = Blobs(np.tile(rng.uniform(0.5, 1, 2), fold), position, covariance)
    scale = RADIUS / thing.radius
    return Blobs(thing.amplitude, scale * thing.position, scale**2 * covariance)


@pytest.mark.parametrize(
    "motion",
    [TUMBLING, pytest.param(IN_PLANE, marks=pytest.mark.slow)],
    ids=["tumbling", "single axis"],
)
@pytest.mark.parametrize("noise", [NOISE, 10 * NOISE])
def test_an_object_without_symmetry_hides_nothing(motion: RigidMotion, noise: float) -> None:
    assert found(Blobs.random(np.random.default_rng(1), radius=RADIUS), motion, noise) is None


@pytest.mark.parametrize("noise", [NOISE, pytest.param(5 * NOISE, marks=pytest.mark.slow)])
def test_the_spin_of_a_tumbling_body_of_revolution_is_unseen(noise: float) -> None:
    axis = np.array([2.0, 1.0, -2.0]) / 3
    thing = Blobs.coaxial(np.random.default_rng(2), radius=RADIUS, axis=(axis[0], axis[1], axis[2]))
    unseen = found(thing, TUMBLING, noise)
    assert unseen is not None
    assert abs(unseen.axis @ axis) > np.cos(np.deg2rad(3 if noise == NOISE else 10))
    assert unseen.factors == ()
    assert "body of revolution" in unseen.text


@pytest.mark.slow
@pytest.mark.parametrize(("fold", "factors"), [(2, None), (3, (1, 3)), (4, (1, 2))])
def test_symmetry_about_an_axis_in_the_image_plane_is_counted(
    fold: int, factors: tuple[Fraction, ...] | None
) -> None:
    """f-fold and turning by θ, or g-fold and turning by θ f / g, for all g < f of the same parity."""
    unseen = found(symmetric(fold, IN_PLANE.axis), IN_PLANE, 0.5 * NOISE)
    if factors is None:
        assert unseen is None
        return
    assert unseen is not None
    assert unseen.factors == factors
    assert unseen.turn == pytest.approx(2 * np.pi * 1.2, rel=0.01)
    assert f"{len(factors)} motions" in unseen.text


@pytest.mark.slow
def test_a_tilted_axis_of_symmetry_hides_nothing() -> None:
    tilted = SingleAxis.from_turns(turns=1.2, duration=1.0, tilt=30.0)
    assert found(symmetric(3, tilted.axis), tilted) is None


def test_images_of_the_alternatives_agree() -> None:
    """What the method rests on: the sinogram of a 3-fold object in the angle 3θ is that of another object."""
    thing = symmetric(3, np.array([1.0, 0, 0]))
    angle = 2 * np.pi * np.arange(96) / 96
    planes = Rotation.from_rotvec(angle[:, None] * [1.0, 0, 0]).as_matrix()
    s = np.linspace(-1.5 * RADIUS, 1.5 * RADIUS, 400)
    profiles = np.array([thing.project(R, np.zeros(3), np.zeros(1), s)[:, 0] for R in planes])
    harmonics = np.fft.fft(profiles, axis=0) / len(angle)
    size = np.abs(harmonics[0]).max()
    assert np.abs(harmonics[[1, 2, 4, 5]]).max() < 1e-12 * size
    # harmonic 3j of the 3-fold object as harmonic j: no moments of order below j, parity of j
    for j in (1, 2, 3):
        moments = [np.sum(s**order * harmonics[3 * j]) * (s[1] - s[0]) for order in range(j)]
        assert np.abs(moments / RADIUS ** np.arange(j)).max() < 1e-9 * size * RADIUS
        assert harmonics[3 * j][::-1] == pytest.approx((-1) ** j * harmonics[3 * j], abs=1e-12 * size)
