"""One pass over the frames against closed forms, and against reading them for each purpose."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from trapcli.motion.centers import estimate_centers
from trapcli.motion.front_end import FrontEnd, read_front_end
from trapcli.simulation.motions import PaperMotion
from trapcli.simulation.phantoms import Blobs
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
TIME = np.linspace(0, 0.5, 16)
SIZE = 480
FINE = 12.5 / SIZE


@pytest.fixture(scope="module")
def frames(render: Callable[..., Array], blobs: Blobs) -> Array:
    """Pixels so fine that they are averaged."""
    return render(blobs, PaperMotion(), TIME, SIZE, FINE)


def read(frames: Array, pixel_size: float = FINE, band: float = 0.0) -> FrontEnd:
    time = np.arange(len(frames), dtype=float)
    stack = Frames.from_array(frames)
    return read_front_end(stack, time=time, pixel_size=pixel_size, line_band=8.0, fine_band=16.0, band=band)


def test_clean_frames_give_the_closed_form(frames: Array, blobs: Blobs) -> None:
    found = read(frames)
    assert found.centers.radius / FINE > 128
    rotations = PaperMotion().rotations(TIME)
    exact = np.array([blobs.fourier(found.low.k, R) for R in rotations])
    # the object ends where it falls below 0.5 % of its peak, for all that follows
    assert np.abs(found.low.modes - exact).max() < 2e-3 * np.abs(exact).max()
    mu, phi = found.reduced.mu, found.reduced.phi
    k = mu[:, None, None] * np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    exact = np.array([blobs.fourier(k, R) for R in rotations])
    assert np.abs(found.reduced.samples - exact).max() < 2e-3 * np.abs(exact).max()


@pytest.fixture(scope="module")
def noisy(frames: Array) -> NDArray[np.float32]:
    noise = np.random.default_rng(3).standard_normal(frames.shape)
    return (frames + frames.max() * (0.1 + 0.01 * noise)).astype(np.float32)


@pytest.fixture(scope="module")
def found(noisy: Array) -> FrontEnd:
    return read(noisy)


def test_noise_of_a_long_stack_is_told_by_many_of_its_frames() -> None:
    """128 pairs of frames of 128² tell it to 0.3 %."""
    rng = np.random.default_rng(5)
    x = np.arange(128) - 64.0
    disc = np.exp(-(x**2 + x[:, None] ** 2) / 400)
    stacks = (disc + 0.05 * rng.standard_normal((400, 128, 128), np.float32) for _ in range(6))
    told = np.array([read(stack.astype(np.float32)).centers.noise for stack in stacks])
    assert np.sqrt(np.mean((told / 0.05 - 1) ** 2)) < 0.006


def test_centers_are_those_of_the_pixels(noisy: Array, found: FrontEnd) -> None:
    centers = estimate_centers(Frames.from_array(noisy), pixel_size=FINE)
    assert found.centers.noise == pytest.approx(centers.noise, rel=0.01)
    # the level is told by more pixels
    off = (found.centers.center - centers.center) / centers.errors
    assert np.sqrt(np.mean(off**2)) < 0.5


def test_cells_hold_what_the_pixels_do(
    noisy: Array, found: FrontEnd, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trapcli.motion.cells._PER_RADIUS", 1e9)
    fine = read(noisy)
    # taken about the same centres
    shift = fine.centers.center - found.centers.center
    assert np.abs(shift / found.centers.errors).max() < 0.5
    low = fine.low.shifted(-shift)
    assert low.k == pytest.approx(found.low.k, rel=0.01)
    assert low.variance == pytest.approx(found.low.variance, rel=0.03)
    assert low.mass == pytest.approx(found.low.mass, rel=1e-3)
    for name in ("second", "third"):
        error = np.sqrt(np.diag(getattr(low, name + "_covariance")))
        off = (getattr(found.low, name) - getattr(low, name)) / error
        assert np.sqrt(np.mean(off**2)) < 0.3
    mu, phi = found.reduced.mu, found.reduced.phi
    assert fine.reduced.samples.shape == found.reduced.samples.shape
    k = mu[:, None, None] * np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    samples = fine.reduced.samples * np.exp(-1j * np.einsum("nx,mlx->nml", shift, k))
    off = np.abs(samples - found.reduced.samples) / found.reduced.noise
    assert np.sqrt(np.mean(off**2)) < 0.1


def test_blank_frames_hold_nan(noisy: Array) -> None:
    holed = noisy.copy()
    holed[4] = np.nan
    holed[9] = noisy[:, :8, :8].mean()
    found = read(holed)
    for series in (found.centers.center, found.low.modes, found.reduced.samples.reshape(len(holed), -1)):
        assert np.flatnonzero(np.isnan(series).all(axis=1)).tolist() == [4, 9]
        assert np.isnan(series).any(axis=1).sum() == 2


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_nothing_to_see(value: float) -> None:
    found = read(np.full((5, 24, 24), value))
    assert np.isnan(found.centers.center).all()
    assert np.isnan(found.low.mass).all()


def test_band_can_be_set(frames: Array) -> None:
    found = read(frames, band=1.5)
    assert np.linalg.norm(found.low.k, axis=1).max() <= 1.5
    assert found.reduced.mu[-1] < 1.5 + 2 * found.reduced.mu[0]
