"""Fourier modes and moments of the frames against closed forms, their noise against Monte Carlo."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.motion.centers import Centers
from trapcli.motion.low_band import LowBand, read_low_band
from trapcli.simulation.phantoms import Blobs
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
PIXEL = 0.25
PIXELS = 80
BAND = 2.5
COUNT = 6


def known_centers(center: Array, radius: float, noise: float = 0.0, level: float = 0.0) -> Centers:
    n = len(center)
    return Centers(
        center=center,
        errors=np.zeros((n, 2)),
        mass=np.ones(n),
        level=np.full(n, level),
        noise=noise,
        radius=radius,
        clipped=np.zeros(n, bool),
    )


def read(frames: Array, centers: Centers, band: float = BAND) -> LowBand:
    time = np.arange(len(frames), dtype=float)
    return read_low_band(Frames.from_array(frames), centers, time=time, band=band, pixel_size=PIXEL)


@pytest.fixture(scope="module")
def rotations() -> Array:
    return Rotation.random(COUNT, rng=np.random.default_rng(2)).as_matrix()


@pytest.fixture(scope="module")
def places() -> Array:
    """Centres between the pixels."""
    return np.random.default_rng(3).uniform(-1, 1, (COUNT, 2))


@pytest.fixture(scope="module")
def radius(blobs: Blobs) -> float:
    """Far enough out for Gaussian tails to be negligible."""
    return float(np.linalg.norm(blobs.position - blobs.center, axis=1).max() + 6 * np.sqrt(0.8))


@pytest.fixture(scope="module")
def frames(blobs: Blobs, rotations: Array, places: Array) -> Array:
    x = (np.arange(PIXELS) - PIXELS // 2) * PIXEL
    moves = np.column_stack([blobs.center[:2] - places, np.zeros(COUNT)])
    return np.array([blobs.project(R, T, x, x) for R, T in zip(rotations, moves, strict=True)])


@pytest.fixture(scope="module")
def low(frames: Array, places: Array, radius: float) -> LowBand:
    return read(frames, known_centers(places, radius))


def test_modes_are_the_reduced_map(low: LowBand, blobs: Blobs, rotations: Array) -> None:
    exact = np.array([blobs.fourier(low.k, R) for R in rotations])
    assert np.abs(low.modes - exact).max() < 1e-7 * np.abs(exact).max()


def test_modes_are_half_of_a_disc_of_the_lattice(low: LowBand, radius: float) -> None:
    assert np.array_equal(low.k[0], [0, 0])
    length = np.linalg.norm(low.k, axis=1)
    assert (np.diff(length) > -1e-12).all()
    assert length.max() <= BAND
    both = np.round(np.concatenate([low.k, -low.k[1:]]), 9)
    assert len(np.unique(both, axis=0)) == len(both)
    step = np.abs(low.k[low.k[:, 0] > 1e-9, 0]).min()
    # as many as the lattice has in a disc, to its perimeter
    assert len(both) == pytest.approx(np.pi * (BAND / step) ** 2, abs=2 * np.pi * BAND / step)
    assert step == pytest.approx(np.pi / (1.15 * radius), rel=0.05)


def test_a_level_is_taken_away(frames: Array, places: Array, radius: float, low: LowBand) -> None:
    raised = read(frames + 0.3, known_centers(places, radius, level=0.3))
    assert raised.modes == pytest.approx(low.modes, abs=1e-12 * np.abs(low.modes).max())
    assert raised.second == pytest.approx(low.second, abs=1e-12)


def test_an_object_at_the_edge_of_the_frame(blobs: Blobs, rotations: Array, radius: float) -> None:
    # the square reaches beyond the frame, the object does not
    x = (np.arange(PIXELS) - PIXELS // 2) * PIXEL
    place = np.array([[3.1, -3.3]])
    image = blobs.project(rotations[0], np.append(blobs.center[:2] - place[0], 0.0), x, x)
    edge = read(image[None] + 0.2, known_centers(place, radius, level=0.2))
    exact = blobs.fourier(edge.k, rotations[0])
    assert np.abs(edge.modes - exact).max() < 1e-4 * np.abs(exact).max()


def test_blank_frames_are_nan(frames: Array, places: Array, radius: float) -> None:
    centers = places.copy()
    centers[2] = np.nan
    low = read(frames, known_centers(centers, radius))
    for series in (low.modes, low.second, low.third, low.mass[:, None]):
        assert np.array_equal(np.isnan(series).all(axis=1), np.arange(COUNT) == 2)


def test_shifting_the_centres(frames: Array, places: Array, radius: float, low: LowBand) -> None:
    shift = np.random.default_rng(8).normal(scale=0.2, size=(COUNT, 2))
    moved = read(frames, known_centers(places + shift, radius))
    assert low.shifted(shift).modes == pytest.approx(moved.modes, abs=1e-7 * np.abs(low.modes).max())


def closed_form(blobs: Blobs, R: Array, order: int) -> Array:
    """Return the moment tensor of `order` about the centre in lab coordinates, per unit mass."""
    masses = blobs.amplitude * np.sqrt(np.linalg.det(blobs.covariance))
    share = masses / masses.sum()
    c = (blobs.position - blobs.center) @ R
    S = R.T @ blobs.covariance @ R
    if order == 2:
        return np.einsum("b,bij->ij", share, S + c[:, :, None] * c[:, None])
    mixed = np.einsum("b,bi,bjk->ijk", share, c, S)
    pure = np.einsum("b,bi,bj,bk->ijk", share, c, c, c)
    return pure + mixed + mixed.transpose(1, 0, 2) + mixed.transpose(1, 2, 0)


def test_moments_of_gaussian_blobs(low: LowBand, blobs: Blobs, rotations: Array, radius: float) -> None:
    assert low.mass == pytest.approx(blobs.mass, rel=1e-7)
    for order, found in ((2, low.second), (3, low.third)):
        seen = list(itertools.combinations_with_replacement((0, 1), order))
        exact = np.array([[closed_form(blobs, R, order)[c] for c in seen] for R in rotations])
        assert found == pytest.approx(exact / radius**order, abs=1e-7)


def test_noise_of_the_modes_is_white_and_known() -> None:
    count, sigma = 2500, 0.7
    noise = sigma * np.random.default_rng(4).normal(size=(count, 32, 32))
    low = read(noise, known_centers(np.full((count, 2), 0.06), 3.2, noise=sigma), band=4.0)
    power = np.mean(np.abs(low.modes) ** 2, axis=0)
    assert power.mean() == pytest.approx(low.variance, rel=5 / np.sqrt(count * len(low.k)))
    # |n|² of a complex mode is exponential, of the real one at k = 0 it is χ²
    assert np.abs(power[1:] / low.variance - 1).max() < 5 / np.sqrt(count)
    assert power[0] == pytest.approx(low.variance, rel=5 * np.sqrt(2 / count))
    white = low.modes / np.sqrt(low.variance)
    correlation = white.T @ white.conj() / count - np.diag(power / low.variance)
    assert np.abs(correlation).max() < 6 / np.sqrt(count)


def test_covariance_of_the_moments(blobs: Blobs, radius: float) -> None:
    count, sigma = 2000, 0.5
    x = (np.arange(48) - 24) * PIXEL
    image = blobs.project(np.eye(3), np.append(blobs.center[:2], 0.0), x, x)
    noisy = image + sigma * np.random.default_rng(6).normal(size=(count, 48, 48))
    low = read(noisy, known_centers(np.zeros((count, 2)), 0.6 * radius, noise=sigma), band=0.5)
    for moments, covariance in ((low.second, low.second_covariance), (low.third, low.third_covariance)):
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        sample = np.cov((moments - moments.mean(axis=0)) @ whitening.T, rowvar=False)
        assert np.abs(np.linalg.eigvalsh(sample) - 1).max() < 0.12
    # even against odd: nothing in common
    cross = np.corrcoef(low.second, low.third, rowvar=False)[:3, 3:]
    assert np.abs(cross).max() < 5 / np.sqrt(count)


def test_groups_are_means(low: LowBand) -> None:
    pairs = low.grouped(2)
    for name in ("time", "modes", "second", "third", "mass"):
        series = getattr(low, name)
        assert getattr(pairs, name) == pytest.approx((series[::2] + series[1::2]) / 2)
    assert pairs.variance == pytest.approx(low.variance / 2)
    assert pairs.third_covariance == pytest.approx(low.third_covariance / 2)
    # a last, shorter group is left out
    assert len(low.grouped(4).time) == 1


def test_selection(low: LowBand) -> None:
    chosen = low.select(np.array([4, 1]))
    assert np.array_equal(chosen.modes, low.modes[[4, 1]])
    assert np.array_equal(chosen.time, [4.0, 1.0])
    assert np.array_equal(chosen.k, low.k)
