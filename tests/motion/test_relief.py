"""How far the object turns out of the image plane, on paths of closed form and on ambiguous data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import trapcli
from tests.motion.test_object_model import FINE_BAND, FRAMES, RADIUS, low_band
from trapcli.motion.ambiguity import spun
from trapcli.motion.object_model import ObjectModel
from trapcli.motion.path import Path, Spline, align, deviation
from trapcli.motion.relief import relieved, score, tilt, tilted, unspun, untangled, widened
from trapcli.simulation.phantoms import Blobs

Array = NDArray[np.float64]

SPLINE = Spline(0.0, 1.0, 12)
GROUPS = np.linspace(0, 1, FRAMES)
TIMES = np.concatenate([GROUPS, SPLINE.grid, GROUPS])


def rocking(amplitude: float, spin: float, times: Array, seed: int = 0) -> Path:
    """Return a path whose views swing about their mean, while it spins about the optical axis."""
    time = np.linspace(0, 1, 1201)
    object_side = Rotation.random(random_state=seed)
    angle = amplitude * np.sin(2 * np.pi * time)
    axis = np.stack([np.cos(0.7 * time), np.sin(0.7 * time), 0 * time], axis=1)
    swing = Rotation.from_rotvec(angle[:, None] * axis)
    turn = Rotation.from_rotvec(spin * time[:, None] * np.array([0.0, 0.0, 1.0]))
    R = (object_side * swing * turn).as_matrix()
    return Path(time, R, np.zeros((len(time), 3))).near(SPLINE, times)


def apart(one: Path, other: Path) -> float:
    return float(align(one.R[:FRAMES], other.R[:FRAMES])[0].mean())


@pytest.mark.parametrize("spin", [0.0, 1.0, 7.0])
def test_tilt_is_the_angle_of_the_views_to_their_mean(spin: float) -> None:
    assert tilt(rocking(0.2, spin, GROUPS).R) == pytest.approx(0.2 / np.sqrt(2), rel=0.03)


@pytest.mark.parametrize("factor", [0.5, 2.0, 4.0])
@pytest.mark.parametrize("spin", [0.0, 3.0])
def test_a_tilted_path_swings_more_or_less_and_spins_as_before(factor: float, spin: float) -> None:
    path = rocking(0.1, spin, TIMES)
    assert apart(tilted(path, factor, SPLINE), rocking(factor * 0.1, spin, TIMES)) < 0.03 * factor * 0.1


def test_a_path_that_is_not_tilted_stays() -> None:
    path = rocking(0.15, 2.0, TIMES)
    assert apart(tilted(path, 1.0, SPLINE), path) < 1e-3


def small_turns(seed: int) -> Path:
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, 400)
    rate = rng.normal(size=(3, 3))
    phase = rng.uniform(size=3)
    omega = np.cos(2 * np.pi * (time[:, None] * [0.8, 1.3, 2.1] + phase)) @ rate
    return Path.smooth(SPLINE, SPLINE.fit(time, 0.25 * omega), np.linspace(0, 1, 801)).near(SPLINE, TIMES)


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_a_tilt_that_is_too_small_is_left_and_errors_are_told(seed: int) -> None:
    path = small_turns(seed)
    rng = np.random.default_rng(seed)
    place = rng.normal(size=(8, 3))
    place *= 0.75 * RADIUS / np.linalg.norm(place, axis=1).max()
    thing = Blobs(rng.uniform(0.3, 1, 8), place, np.tile((0.1 * RADIUS) ** 2 * np.eye(3), (8, 1, 1)))
    views = Path(GROUPS, path.R[-FRAMES:], path.omega[-FRAMES:])
    low = low_band(thing, views, seed, band=FINE_BAND, noise=0.003)
    start = tilted(path, 0.2, SPLINE)
    model = ObjectModel.likeliest(low, FINE_BAND, start.R[-FRAMES:])
    fit = model.fit(start, GROUPS, SPLINE)
    before = model.assess(fit)
    found = relieved(low, fit, before, FRAMES)
    best, assessment = found[0]
    assert score(best, assessment) <= score(fit, before)
    assert apart(best.path, path) < 0.7 * apart(fit.path, path)
    wide = widened(best, assessment, FRAMES, found)
    # covariances grow, and never shrink
    size = 3 * SPLINE.size
    more = (wide.covariance - assessment.covariance).reshape(size, size)
    assert np.linalg.eigvalsh(more).min() > -1e-9 * np.trace(more)


def test_another_tilt_lies_as_many_errors_away_as_it_is_less_likely() -> None:
    path = small_turns(0)
    thing = Blobs.random(np.random.default_rng(0), radius=RADIUS)
    views = Path(GROUPS, path.R[-FRAMES:], path.omega[-FRAMES:])
    model = ObjectModel(low_band(thing, views, 0, band=12 / RADIUS, noise=0.003), 12 / RADIUS)
    fit = model.fit(path, GROUPS, SPLINE, steps=1)
    assessment = model.assess(fit)
    other = replace(fit, path=tilted(fit.path, 1.5, SPLINE), cost=fit.cost + 40.0)
    wide = widened(fit, assessment, FRAMES, [(fit, assessment), (other, assessment)])
    size = 3 * SPLINE.size
    way = SPLINE.fit(GROUPS, deviation(fit.path.R[:FRAMES], other.path.R[:FRAMES])).ravel()

    def away(covariance: Array) -> float:
        return float(way @ np.linalg.solve(covariance.reshape(size, size), way))

    assert away(assessment.covariance) > 100
    assert away(wide.covariance) == pytest.approx(4.0, rel=0.01)
    # nor is a finer model believed that leaves the tilt that was found by more than an error
    finer = replace(fit, path=tilted(fit.path, 1.5, SPLINE))
    same = replace(fit, cost=fit.cost + 1e6)
    assert away(widened(finer, assessment, FRAMES, [(fit, assessment), (same, assessment)]).covariance) < 1.01


def test_a_motion_that_turns_enough_is_left_and_its_errors_too() -> None:
    thing = Blobs.random(np.random.default_rng(0), radius=RADIUS)
    path = rocking(0.9, 3.0, TIMES)
    views = Path(GROUPS, path.R[-FRAMES:], path.omega[-FRAMES:])
    model = ObjectModel(low_band(thing, views, 0, band=12 / RADIUS, noise=0.003), 12 / RADIUS)
    fit = model.fit(path, GROUPS, SPLINE, steps=1)
    assessment = model.assess(fit)
    found = relieved(model.low, fit, assessment, FRAMES)
    assert len(found) == 1
    assert found[0][0] is fit
    assert widened(fit, assessment, FRAMES, found) is assessment


def chords(form: Array, middle: Array, R: Array, size: int, fine: int = 3) -> Array:
    """Return the ``(size, size)`` projection of an ellipsoid of density 1, exact on finer pixels.

    The ellipsoid is ``(x − middle)ᵀ form (x − middle) ≤ 1`` in object coordinates.
    """
    x = (np.arange(size * fine) + 0.5) / fine - size / 2
    u, v = np.meshgrid(x, x)
    here, lab = R.T @ middle, R.T @ form @ R
    u, v = u - here[0], v - here[1]
    half = lab[2, 0] * u + lab[2, 1] * v
    rest = lab[0, 0] * u**2 + 2 * lab[0, 1] * u * v + lab[1, 1] * v**2 - 1
    chord = 2 * np.sqrt(np.maximum(half**2 - lab[2, 2] * rest, 0)) / lab[2, 2]
    return np.asarray(chord.reshape(size, fine, size, fine).mean(axis=(1, 3)))


def shell(rng: np.random.Generator, radius: float) -> list[tuple[float, Array, Array]]:
    """Return densities, forms and middles of the ellipsoids of a shell with five things inside."""
    axes = np.array([1.0, 0.85, 0.7]) * radius
    parts = [(1.0, np.diag(axes**-2.0), np.zeros(3)), (-0.7, np.diag((0.88 * axes) ** -2.0), np.zeros(3))]
    for _ in range(5):
        middle = rng.normal(size=3)
        middle *= rng.uniform(0.2, 0.6) * radius / np.linalg.norm(middle)
        own = rng.uniform(0.08, 0.22, 3) * radius
        turn = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
        parts.append((rng.uniform(0.5, 1.5), turn @ np.diag(own**-2.0) @ turn.T, middle))
    return parts


@pytest.mark.slow
def test_small_swings_of_a_sharp_object_are_not_told_better_than_they_are() -> None:
    seed, size = 2, 48
    rng = np.random.default_rng(seed)
    R = rocking(np.deg2rad(10), 2.0, np.linspace(0, 1, 120), seed).R
    parts = shell(rng, 0.34 * size)
    frames = np.array([sum(d * chords(form, middle, one, size) for d, form, middle in parts) for one in R])
    frames += 0.01 * frames.max() * rng.normal(size=frames.shape)
    motion = trapcli.estimate(frames.astype(np.float32), attenuation=True)
    truth = R[0].T @ R
    if align(motion.R, R)[1]:
        truth = np.diag([1.0, 1.0, -1.0]) @ truth @ np.diag([1.0, 1.0, -1.0])
    error = Rotation.from_matrix(np.swapaxes(motion.R, 1, 2) @ truth).as_rotvec()
    assert np.mean(np.abs(error[1:]) < 2 * motion.R_errors[1:]) > 0.7


def test_a_part_that_is_its_mirror_image_is_turned_over() -> None:
    time = np.linspace(0, 1, 801)
    # α is least at 0.2, 0.6 and 1, where ω₁ changes its sign
    omega = np.stack([5 * np.cos(2.5 * np.pi * time), 0.6 + 0 * time, 2.5 * np.cos(3 * time)], axis=1)
    true = Path.smooth(SPLINE, SPLINE.fit(time, omega), time)
    path = true.near(SPLINE, TIMES)
    thing = Blobs.random(np.random.default_rng(0), count=8, radius=RADIUS)
    views = Path(GROUPS, path.R[-FRAMES:], path.omega[-FRAMES:])
    low = low_band(thing, views, 0, band=FINE_BAND, noise=0.02)
    start = true.mirrored(160).mirrored(480).near(SPLINE, TIMES)
    model = ObjectModel.likeliest(low, FINE_BAND, start.R[-FRAMES:])
    tangled, right = (model.fit(one, GROUPS, SPLINE, steps=steps) for one, steps in ((start, 0), (path, 10)))
    assert apart(tangled.path, path) > np.deg2rad(30)
    best, told = untangled(tangled, model.assess(tangled))
    assert apart(best.path, path) < np.deg2rad(1)
    assert best.cost == pytest.approx(told.degrees, rel=0.05)
    # the right motion is left as it is
    assert untangled(right, model.assess(right))[0] is right


def test_a_path_that_ends_as_its_mirror_image_is_turned_over_where_alpha_is_not_small() -> None:
    time = np.linspace(0, 1, 801)
    # ω turns in the image plane, and α stays as it is
    omega = np.stack([4 * np.cos(5 * time), 4 * np.sin(5 * time), 1.5 + 0 * time], axis=1)
    true = Path.smooth(SPLINE, SPLINE.fit(time, omega), time)
    path = true.near(SPLINE, TIMES)
    # bent, and nearly its own mirror image
    bent = np.linspace(-1, 1, 7)
    place = RADIUS * np.stack([0.7 * bent, 0.5 * bent**2 - 0.2, 0.02 * np.sin(5 * bent)], axis=1)
    size = np.array([0.1, 0.13, 0.09, 0.12, 0.1, 0.14, 0.11]) * RADIUS
    thing = Blobs(np.linspace(0.6, 1.0, 7), place, size[:, None, None] ** 2 * np.eye(3))
    views = Path(GROUPS, path.R[-FRAMES:], path.omega[-FRAMES:])
    low = low_band(thing, views, 0, band=FINE_BAND, noise=0.01)
    start = true.mirrored(370).near(SPLINE, TIMES)
    model = ObjectModel.likeliest(low, FINE_BAND, start.R[-FRAMES:])
    tangled = model.fit(start, GROUPS, SPLINE, steps=0)
    assert apart(tangled.path, path) > np.deg2rad(30)
    best, told = untangled(tangled, model.assess(tangled))
    assert apart(best.path, path) < np.deg2rad(1.5)
    assert best.cost == pytest.approx(told.degrees, rel=0.05)


@pytest.mark.slow
def test_what_is_long_is_turned_about_its_length_where_a_search_downhill_stays() -> None:
    time = np.linspace(0, 1, 801)
    omega = np.stack([4 * np.cos(3 * time), 4 * np.sin(3 * time) + 1, 2 + 2 * np.cos(5 * time)], axis=1)
    path = Path.smooth(SPLINE, SPLINE.fit(time, omega), time).near(SPLINE, TIMES)
    rng = np.random.default_rng(4)
    height, angle = rng.uniform(-0.7, 0.7, 8), rng.uniform(0, 2 * np.pi, 8)
    # a rod, with small bodies about it
    rod = np.linspace(-0.75, 0.75, 9)[:, None] * np.array([0.0, 0.0, 1.0])
    about = np.stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), height], axis=1)
    turn = Rotation.from_euler("zy", [47, 61], degrees=True).as_matrix().T
    size = RADIUS * np.concatenate([np.full(9, 0.12), np.full(8, 0.05)])
    place = RADIUS * np.concatenate([rod, about]) @ turn
    thing = Blobs(np.repeat([1.0, 2.0], [9, 8]), place, size[:, None, None] ** 2 * np.eye(3))
    views = Path(GROUPS, path.R[-FRAMES:], path.omega[-FRAMES:])
    low = low_band(thing, views, 0, band=FINE_BAND, noise=0.003)
    start = spun(path, turn[2], np.deg2rad(-120) * (TIMES - 0.5))
    fit = ObjectModel.likeliest(low, FINE_BAND, start.R[-FRAMES:]).fit(start, GROUPS, SPLINE)
    assert apart(fit.path, path) > np.deg2rad(10)
    best, told = unspun(fit, fit.model.assess(fit))
    assert apart(best.path, path) < np.deg2rad(0.5)
    assert best.cost == pytest.approx(told.degrees, rel=0.05)
    # the right motion is left as it is
    assert unspun(best, told)[0] is best
