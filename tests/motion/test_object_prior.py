"""What the frames tell of an object before its motion is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.motion.test_object_model import (
    BAND,
    FINE_BAND,
    FRAMES,
    KNOTS,
    RADIUS,
    TUMBLING,
    low_band,
    on_grid,
    turned,
)
from trapcli.motion.object_model import ObjectModel
from trapcli.motion.object_prior import Prior, radial_density
from trapcli.motion.path import Path, Spline, align
from trapcli.simulation.phantoms import Blobs

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def path() -> Path:
    time = np.linspace(0, 1, FRAMES)
    return Path(time, TUMBLING.rotations(time), TUMBLING.omega(time))


def round_blob(width: float) -> Blobs:
    return Blobs(np.ones(1), np.zeros((1, 3)), width**2 * np.eye(3)[None])


def rod(seed: int, axis: Array) -> Blobs:
    """Return six blobs about a line through the middle."""
    rng, n = np.random.default_rng(seed), 6
    line = np.outer(np.linspace(-0.8, 0.8, n), axis / np.linalg.norm(axis))
    place = (line + 0.1 * rng.normal(size=(n, 3))) * RADIUS
    return Blobs(rng.uniform(0.5, 1, n), place, np.tile((0.1 * RADIUS) ** 2 * np.eye(3), (n, 1, 1)))


@pytest.mark.parametrize("width", [0.12, 0.2])
def test_the_radial_density_of_a_gaussian_is_a_gaussian(path: Path, width: float) -> None:
    low = low_band(round_blob(width * RADIUS), path, 0, band=4 * FINE_BAND, noise=1e-5)
    distance = np.linspace(0, RADIUS, 30)
    density = radial_density(low, distance)
    smoothed = np.hypot(width, 0.08) * RADIUS
    assert density / density[0] == pytest.approx(np.exp(-0.5 * (distance / smoothed) ** 2), abs=0.02)


def test_amplitudes_are_expected_where_the_object_is(path: Path) -> None:
    prior = Prior.of(low_band(round_blob(0.2 * RADIUS), path, 0, band=FINE_BAND))
    assert (np.diff(prior.density) <= 0).all()
    position = RADIUS * np.random.default_rng(0).uniform(-0.8, 0.8, (500, 3))
    variance = prior.variance(position)
    assert variance.mean() == pytest.approx(1)
    distance = np.linalg.norm(position, axis=1)
    assert variance[distance < 0.25 * RADIUS].min() > 10 * variance[distance > 0.7 * RADIUS].max()


def test_a_hollow_object_may_hold_something_inside(path: Path) -> None:
    low = low_band(round_blob(0.3 * RADIUS), path, 0, band=FINE_BAND, noise=1e-5)
    hole = low_band(round_blob(0.15 * RADIUS), path, 0, band=FINE_BAND, noise=1e-5)
    hollow = low.modes / low.modes[0, 0].real - 0.9 * hole.modes / hole.modes[0, 0].real
    low.modes[:] = hollow
    prior = Prior.of(low)
    assert prior.density[0] == 1


def test_the_prior_of_a_smooth_object_has_wider_blobs(path: Path) -> None:
    widths = []
    rng = np.random.default_rng(5)
    place = rng.normal(size=(12, 3))
    place *= 0.6 * RADIUS / np.linalg.norm(place, axis=1).max()
    for width in (0.06, 0.15):
        blobs = Blobs(rng.uniform(0.4, 1, 12), place, np.tile((width * RADIUS) ** 2 * np.eye(3), (12, 1, 1)))
        model = ObjectModel.likeliest(low_band(blobs, path, 0, band=FINE_BAND), FINE_BAND, path.R)
        assert model.prior is not None
        widths.append(model.prior.width / RADIUS)
    assert widths[1] > 2 * widths[0]


# blobs finer than the lattice, 0.08 over the radius, are beyond telling
@pytest.mark.parametrize("sharp", [True, False])
@pytest.mark.parametrize("width", [0.15, 0.2, 0.3])
def test_width_and_form_of_blobs_are_told_by_the_power_of_the_modes(
    path: Path, width: float, sharp: bool
) -> None:
    rng = np.random.default_rng(3)
    place = rng.normal(size=(300, 3))
    place *= 0.7 * RADIUS * rng.uniform(size=(300, 1)) ** (1 / 3) / np.linalg.norm(place, axis=1)[:, None]
    amplitude = rng.normal(size=300)
    amplitude -= place @ np.linalg.lstsq(place, amplitude, rcond=None)[0]  # its centre lies in the middle
    points = Blobs(amplitude, place, np.tile((1e-4 * RADIUS) ** 2 * np.eye(3), (300, 1, 1)))
    low = low_band(points, path, 0, band=FINE_BAND, noise=1e-9)
    square = np.sum((width * RADIUS * low.k) ** 2, axis=1)
    modes = low.modes * (1 / (1 + square) if sharp else np.exp(-0.5 * square))
    sigma = 0.01 * np.abs(modes).max()
    white = sigma * (rng.normal(size=modes.shape) + 1j * rng.normal(size=modes.shape)) / np.sqrt(2)
    low = replace(low, modes=modes + white, variance=sigma**2)
    prior = ObjectModel.likeliest(low, FINE_BAND, path.R).prior
    assert prior is not None
    assert prior.width / RADIUS == pytest.approx(width, rel=0.5)
    assert prior.sharp == sharp


def test_the_slopes_of_what_the_frames_see_with_a_prior(path: Path) -> None:
    thing = Blobs.random(np.random.default_rng(1), radius=RADIUS)
    low = low_band(thing, path, 3, noise=0.05)
    model = ObjectModel.likeliest(low, BAND, path.R)
    slopes, h = model._seen_slopes(model.views(path.R)), 3e-5
    turn = np.random.default_rng(0).normal(size=(FRAMES, 3))
    after, before = (model.views(turned(path.R, sign * h * turn)).seen for sign in (1, -1))
    assert (after - before) / (2 * h) == pytest.approx(np.sum(slopes * turn), rel=1e-4)


def test_the_misfit_is_that_of_the_data_alone(path: Path) -> None:
    thing = Blobs.random(np.random.default_rng(2), radius=RADIUS)
    low = low_band(thing, path, 2, noise=0.02)
    model = ObjectModel.likeliest(low, BAND, path.R)
    fit = model.fit(on_grid(path, Spline(0.0, 1.0, KNOTS)), path.time, Spline(0.0, 1.0, KNOTS))
    assert fit.cost == pytest.approx(np.sum(np.abs(fit.normal.residual) ** 2), rel=1e-3)
    assert fit.cost / model.assess(fit).degrees == pytest.approx(1, abs=0.06)


def test_the_variance_of_each_vicinity_is_told_by_its_amplitudes(path: Path) -> None:
    """Amplitudes with noise, of two opposite lobes of variance 4 in a ball of variance 0.01."""
    rng = np.random.default_rng(0)
    axis = np.arange(-7, 8) / 8
    cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    place = cube[np.linalg.norm(cube, axis=1) < 0.95]
    lobe = np.abs(place[:, 0]) > 0.5
    true, noise = np.where(lobe, 4.0, 0.01), 0.25
    seen = np.sqrt(true + noise) * rng.normal(size=len(place))
    low = replace(low_band(round_blob(1.0), path, 0), radius=1.0)
    prior = Prior(np.zeros(1), np.ones(1), 0.1, 1.0)
    for _ in range(20):
        variance = prior.power * prior.variance(place)
        gain = variance / (variance + noise)
        square, spread = (gain * seen) ** 2 / prior.power, gain * noise / prior.power
        prior = prior.placed(low, place, square, spread)
    told = prior.power * prior.variance(place)
    deep, far = np.abs(place[:, 0]) > 0.7, np.abs(place[:, 0]) < 0.3
    assert told[deep].mean() == pytest.approx(4.0, rel=0.15)
    assert np.median(told[far]) < 0.1
    assert told == pytest.approx(told[::-1])


def test_a_prior_that_knows_the_place_needs_fewer_amplitudes_and_explains_as_well(path: Path) -> None:
    spline = Spline(0.0, 1.0, KNOTS)
    low = low_band(rod(2, np.array([1.0, 0.0, 0.0])), path, 2, band=FINE_BAND, noise=0.01)
    model = ObjectModel.likeliest(low, FINE_BAND, path.R)
    fit = model.fit(on_grid(path, spline), path.time, spline, smooth=False)
    placed = model.placed(fit)
    again = placed.fit(fit.path, path.time, spline, smooth=False)
    assert placed.views(fit.R).seen < 0.7 * model.views(fit.R).seen
    assert again.cost / placed.assess(again).degrees == pytest.approx(1, abs=0.06)
    assert placed.prior is not None
    variance = placed.prior.variance(placed.position)
    along = np.abs(placed.position[:, 0]) > 0.5 * RADIUS
    beside = np.linalg.norm(placed.position[:, 1:], axis=1) > 0.5 * RADIUS
    assert variance[along & ~beside].mean() > 10 * variance[beside].mean()


@pytest.mark.slow
def test_errors_get_smaller_where_it_is_told_in_which_places_the_object_lies(path: Path) -> None:
    errors = []
    spline = Spline(0.0, 1.0, 12)
    for seed in range(8):
        thing = rod(seed, np.random.default_rng(seed).normal(size=3))
        low = low_band(thing, path, seed, band=FINE_BAND, noise=0.01)
        model = ObjectModel.likeliest(low, FINE_BAND, path.R)
        fit = model.fit(on_grid(path, spline), path.time, spline)
        again = model.placed(fit).fit(fit.path, path.time, spline)
        errors.append([align(one.R, path.R)[0].mean() for one in (fit, again)])
    before, after = np.mean(errors, axis=0)
    assert after < 0.9 * before


@pytest.mark.slow
def test_a_prior_lessens_the_errors_of_noisy_motions(path: Path) -> None:
    errors = []
    spline = Spline(0.0, 1.0, 12)
    for seed in range(10):
        thing = Blobs.random(np.random.default_rng(seed), radius=RADIUS)
        low = low_band(thing, path, seed, band=FINE_BAND, noise=0.02)
        likely = ObjectModel.likeliest(low, FINE_BAND, path.R)
        for model in (ObjectModel(low, FINE_BAND, guard=likely.guard), likely):
            fit = model.fit(on_grid(path, spline), path.time, spline)
            errors.append(align(fit.path.R[-FRAMES:], path.R)[0].mean())
    without, with_prior = np.reshape(errors, (-1, 2)).mean(axis=0)
    assert with_prior < 0.9 * without
