"""The eliminated object: misfit at the truth, gradient, curvature, gauge, and errors that come true."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.motion.low_band import LowBand
from trapcli.motion.object_model import ObjectModel
from trapcli.motion.path import Path, Spline, align
from trapcli.motion.verdict import _rotation_covariance
from trapcli.simulation.motions import Tumbling
from trapcli.simulation.phantoms import Blobs

Array = NDArray[np.float64]
RADIUS = 5.0
BAND, FINE_BAND = 12 / RADIUS, 16 / RADIUS
NOISE = 0.002  # of a mode, as a share of the mass
FRAMES, KNOTS = 60, 5
SIGMA = np.diag([1.0, 1.0, -1.0])
TUMBLING = Tumbling.random(np.random.default_rng(4), total_angle=240.0, duration=1.0)


@pytest.fixture(scope="module")
def thing() -> Blobs:
    return Blobs.random(np.random.default_rng(1), radius=RADIUS)


@pytest.fixture(scope="module")
def path() -> Path:
    time = np.linspace(0, 1, FRAMES)
    return Path(time, TUMBLING.rotations(time), TUMBLING.omega(time))


def frequencies(band: float) -> Array:
    step = np.pi / (1.15 * RADIUS)
    axis = step * np.arange(-10, 11)
    k = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    half = (k[:, 1] > 1e-9) | ((np.abs(k[:, 1]) < 1e-9) & (k[:, 0] > -1e-9))
    k = k[half & (np.hypot(*k.T) <= band)]
    return np.asarray(k[np.argsort(np.hypot(*k.T), kind="stable")])


def low_band(thing: Blobs, path: Path, seed: int, *, band: float = BAND, noise: float = NOISE) -> LowBand:
    """Return exact modes with white noise."""
    k, n = frequencies(band), len(path.R)
    sigma = noise * thing.mass / (2 * np.pi)
    rng = np.random.default_rng(seed)
    white = (rng.normal(size=(n, len(k))) + 1j * rng.normal(size=(n, len(k)))) / np.sqrt(2)
    white[:, 0] = rng.normal(size=n)
    return LowBand(
        time=path.time,
        k=k,
        modes=np.array([thing.fourier(k, rotation) for rotation in path.R]) + sigma * white,
        variance=sigma**2,
        second=np.zeros((n, 3)),
        third=np.zeros((n, 4)),
        second_covariance=np.eye(3),
        third_covariance=np.eye(4),
        mass=np.ones(n),
        radius=RADIUS,
    )


def turned(R: Array, vectors: Array) -> Array:
    return np.asarray(R @ Rotation.from_rotvec(vectors).as_matrix())


@pytest.mark.parametrize("seed", range(3))
def test_misfit_per_degree_of_freedom_is_1_at_the_truth(path: Path, seed: int) -> None:
    thing = Blobs.random(np.random.default_rng(seed), radius=RADIUS)
    spline = Spline(0.0, 1.0, KNOTS)
    model = ObjectModel(low_band(thing, path, seed, band=FINE_BAND), FINE_BAND)
    fit = model.fit(path, path.time, spline, smooth=False, steps=0)
    # nothing was fitted but the object
    degrees = model.assess(fit).degrees + 3 * spline.size - 3 + 2 * FRAMES
    assert fit.cost / degrees == pytest.approx(1, abs=0.05)


def test_a_smooth_object_needs_a_coarser_lattice_than_a_sharp_one(path: Path) -> None:
    rng = np.random.default_rng(5)
    place = rng.normal(size=(6, 3))
    place *= 0.4 * RADIUS / np.linalg.norm(place, axis=1).max()
    guards = []
    for width in (0.15 * RADIUS, 0.02 * RADIUS):
        blobs = Blobs(np.ones(6), place, np.tile(width**2 * np.eye(3), (6, 1, 1)))
        guards.append(ObjectModel.likeliest(low_band(blobs, path, 0), BAND, path.R).guard)
    assert guards[0] < guards[1]


def test_a_motion_that_is_wrong_does_not_fit(thing: Blobs, path: Path) -> None:
    low, spline = low_band(thing, path, 0), Spline(0.0, 1.0, 20)
    model = ObjectModel(low, BAND)
    faster = Path.smooth(spline, spline.fit(path.time, 1.2 * path.omega), path.time)
    assert model.cost(faster.R, low.modes) > 5 * model.cost(path.R, low.modes)


def test_the_gradient_is_half_the_slope_downhill(thing: Blobs, path: Path) -> None:
    low = low_band(thing, path, 3)
    model = ObjectModel(low, BAND, weights=np.linspace(0.5, 1, FRAMES))
    rng = np.random.default_rng(0)
    R, h = turned(path.R, rng.normal(scale=0.05, size=(FRAMES, 3))), 1e-5
    state = model._state(model.views(R), low.modes)
    gradient = np.einsum("gki,gk->gi", state.slopes.conj(), state.residual).real
    assert model.cost(R, low.modes) == pytest.approx(state.cost)
    for _ in range(2):
        turn, shift = rng.normal(size=(FRAMES, 3)), rng.normal(size=(FRAMES, 2))
        slope = model.cost(turned(R, h * turn), low.modes) - model.cost(turned(R, -h * turn), low.modes)
        assert -slope / (4 * h) == pytest.approx(np.sum(gradient[:, :3] * turn), rel=1e-5)
        slope = model.cost(R, low.shifted(h * shift).modes) - model.cost(R, low.shifted(-h * shift).modes)
        assert -slope / (4 * h) == pytest.approx(np.sum(gradient[:, 3:] * shift), rel=1e-5)


def test_misfit_and_what_the_frames_see_do_not_favour_a_motion(path: Path) -> None:
    """Of noise alone, the object takes up less where all frames look the same way."""
    blank, band = Blobs.random(np.random.default_rng(1), radius=RADIUS), 8 / RADIUS
    low = low_band(blank, path, 0, band=band)
    model = ObjectModel(low, band)
    rng, sigma = np.random.default_rng(1), np.sqrt(low.variance)
    noises = [sigma / np.sqrt(2) * (rng.normal(size=(2, *low.modes.shape)).T @ [1, 1j]).T for _ in range(20)]
    for noise in noises:
        noise[:, 0] = sigma * rng.normal(size=FRAMES)
    biases = []
    for R in (path.R, np.tile(np.eye(3), (FRAMES, 1, 1))):
        views = model.views(R)
        costs = [model._cost(views, noise) for noise in noises]
        tolerance = 4 * np.sqrt(2 * model.data_count / len(noises))
        assert np.mean(costs) + views.seen == pytest.approx(model.data_count, abs=tolerance)
        biases.append(views.seen)
    assert biases[0] > biases[1] + 2 * tolerance


def test_the_slopes_of_what_the_frames_see(thing: Blobs, path: Path) -> None:
    low = low_band(thing, path, 3, noise=0.05)
    model = ObjectModel(low, BAND, weights=np.linspace(0.5, 1, FRAMES))
    slopes, h = model._seen_slopes(model.views(path.R)), 3e-5
    turn = np.random.default_rng(0).normal(size=(FRAMES, 3))
    after, before = (model.views(turned(path.R, sign * h * turn)).seen for sign in (1, -1))
    assert (after - before) / (2 * h) == pytest.approx(np.sum(slopes * turn), rel=1e-5)


def test_the_hessian_has_object_and_shifts_eliminated(thing: Blobs, path: Path) -> None:
    """Against a dense least-squares problem: no transform on the lattice, no elimination by blocks."""
    few, band = slice(0, FRAMES, 6), 8 / RADIUS
    path = Path(path.time[few], path.R[few], path.omega[few])
    low, values = low_band(thing, path, 1, band=band), Spline(0.0, 1.0, 1).values(path.time)
    model = ObjectModel(low, band)
    views = model.views(path.R)
    state = model._state(views, low.modes)
    found = model._eliminated(views, state, values).hessian

    blob = model._blob * np.sqrt(np.where((low.k == 0).all(axis=1), 1.0, 2.0) / low.variance)
    waves = np.exp(-1j * np.swapaxes(model.position @ (path.R[:, :, :2] @ low.k.T), 1, 2))
    amplitudes = (blob[:, None] * waves).reshape(-1, len(model.position))
    rows = len(amplitudes)
    turns = np.einsum("gb,gki->gkbi", values, state.slopes[..., :3]).reshape(rows, -1)
    shifts = np.einsum("gh,gki->gkhi", np.eye(len(values)), state.slopes[..., 3:]).reshape(rows, -1)
    nuisance = np.concatenate([amplitudes, shifts], axis=1)
    # real and imaginary parts, and the prior of the amplitudes
    prior = np.eye(nuisance.shape[1])[: len(model.position)]
    nuisance = np.concatenate([nuisance.real, nuisance.imag, prior])
    wanted = np.concatenate([turns.real, turns.imag, np.zeros((len(prior), turns.shape[1]))])
    wanted -= nuisance @ np.linalg.lstsq(nuisance, wanted, rcond=None)[0]
    assert found == pytest.approx(wanted.T @ wanted, abs=1e-6 * np.abs(found).max())


def test_the_mirror_and_turns_of_the_lattice_change_nothing(thing: Blobs, path: Path) -> None:
    low = low_band(thing, path, 2)
    model = ObjectModel(low, BAND)
    R = turned(path.R, np.random.default_rng(0).normal(scale=0.05, size=(FRAMES, 3)))
    cost = model.cost(R, low.modes)
    assert model.cost(SIGMA @ R @ SIGMA, low.modes) == pytest.approx(cost, rel=1e-8)
    quarter = Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix()
    assert model.cost(quarter @ R, low.modes) == pytest.approx(cost, rel=1e-8)


def test_a_turn_of_the_object_changes_hardly_anything(thing: Blobs, path: Path) -> None:
    """The lattice is not round; its trace in the misfit stays below two percent."""
    low = low_band(thing, path, 2)
    model = ObjectModel(low, BAND)
    turns = Rotation.random(8, rng=np.random.default_rng(5)).as_matrix()
    costs = [model.cost(turn @ path.R, low.modes) for turn in turns]
    assert np.ptp(costs) < 0.02 * np.mean(costs)


def on_grid(path: Path, spline: Spline) -> Path:
    """Return the path that is true, with the spline's grid before the groups."""
    time = np.concatenate([spline.grid, path.time])
    return Path(time, TUMBLING.rotations(time), TUMBLING.omega(time))


def wrong_by(path: Path, off: float, seed: int, knots: int = KNOTS) -> tuple[Path, Spline]:
    rough, spline = Spline(0.0, 1.0, KNOTS), Spline(0.0, 1.0, knots)
    bend = off * np.random.default_rng(seed).normal(size=(rough.size, 3))
    return on_grid(path, spline).bent(rough, bend), spline


def test_a_fit_comes_back_to_the_truth(thing: Blobs, path: Path) -> None:
    low = low_band(thing, path, 0)
    model = ObjectModel(low, BAND)
    wrong, spline = wrong_by(path, 0.05, 0)
    fit = model.fit(wrong, path.time, spline)
    assert np.rad2deg(align(wrong.R[-FRAMES:], path.R)[0].mean()) > 2
    assert np.rad2deg(align(fit.path.R[-FRAMES:], path.R)[0].mean()) < 0.3
    assessment = model.assess(fit)
    misfit = fit.cost / assessment.degrees
    assert misfit == pytest.approx(1, abs=0.1)
    # what the prior adds to the misfit belongs to no frame
    assert assessment.frame_misfit.mean() == pytest.approx(misfit, rel=0.1)
    assert assessment.mode_misfit.mean() == pytest.approx(misfit, rel=0.15)
    assert assessment.frame_misfit == pytest.approx(1, abs=0.8)
    assert fit.low.modes == pytest.approx(low.shifted(fit.shift).modes)


def test_the_middle_of_the_object_is_found_with_its_errors(path: Path) -> None:
    ratios, spline, band = [], Spline(0.0, 1.0, 12), 8 / RADIUS
    for seed in range(16):
        rng = np.random.default_rng(seed)
        off = rng.normal(scale=0.1, size=(FRAMES, 2))
        thing = Blobs.random(rng, radius=RADIUS)
        low = low_band(thing, path, seed, band=band, noise=0.004).shifted(off)
        model = ObjectModel(low, band)
        fit = model.fit(on_grid(path, spline), path.time, spline)
        place, errors = model.locate(fit, model.assess(fit).covariance, fit.path.R[-FRAMES:], low)
        way = (place + off) - (place + off)[0]
        assert errors[0] == pytest.approx(0)
        ratios.append(way[1:] / errors[1:])
    # the errors hold a little more than that: objects are tamer than their prior
    assert np.std(ratios) == pytest.approx(0.9, abs=0.2)


def test_outlying_frames_with_small_weights_do_no_harm(thing: Blobs, path: Path) -> None:
    low, weights = low_band(thing, path, 2), np.ones(FRAMES)
    low.modes[20] *= 1.5
    weights[20] = 1e-6
    wrong, spline = wrong_by(path, 0.02, 1)
    fit = ObjectModel(low, BAND, weights=weights).fit(wrong, path.time, spline)
    assert np.rad2deg(align(fit.path.R[-FRAMES:], path.R)[0].mean()) < 0.3


@pytest.mark.slow
def test_errors_of_the_angles_come_true() -> None:
    """Over objects, motions and noise: what smoothing takes away is within the errors as well."""
    ratios = []
    time = np.linspace(0, 1, FRAMES)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        thing = Blobs.random(rng, radius=RADIUS)
        motion = Tumbling.random(rng, total_angle=240.0, duration=1.0)
        spline, rough = Spline(0.0, 1.0, 30), Spline(0.0, 1.0, KNOTS)
        times = np.concatenate([spline.grid, time])
        path = Path(times, motion.rotations(times), motion.omega(times))
        truth = path.R[-FRAMES:]
        seen = Path(time, truth, path.omega[-FRAMES:])
        model = ObjectModel(low_band(thing, seen, seed, band=FINE_BAND), FINE_BAND)
        wrong = path.bent(rough, 0.02 * rng.normal(size=(rough.size, 3)))
        fit = model.fit(wrong, time, spline)
        covariance = model.assess(fit).covariance
        R, truth = (rotations[0].T @ rotations for rotations in (fit.path.R[-FRAMES:], truth))
        variances = np.diagonal(_rotation_covariance(R, spline.values(time), covariance), axis1=1, axis2=2)
        vectors = Rotation.from_matrix(np.swapaxes(R, 1, 2) @ truth).as_rotvec()
        ratios.append((vectors[5:] / np.sqrt(variances[5:])).ravel())
    ratio = np.abs(np.concatenate(ratios))
    # the errors of one motion hang together: twelve motions tell these shares to 0.03 and 0.01
    assert 0.6 < np.mean(ratio < 1) < 0.76
    assert 0.93 < np.mean(ratio < 2) < 0.985


def _started(path: Path, seed: int) -> tuple[Path, Array, Spline]:
    wrong, spline = wrong_by(path, 0.02, seed, knots=20)
    return wrong, path.time, spline
