from __future__ import annotations

import numpy as np
import pytest

from trapcli.errors import InputError
from trapcli.motion.centers import estimate_centers
from trapcli.motion.reduced_map import reduce_frames
from trapcli.motion.types import ReducedMap
from trapcli.simulation.motions import PaperMotion
from trapcli.simulation.phantoms import Blobs
from trapcli.stack.frames import Frames

TIME = np.linspace(0, 0.5, 24)


def reduced(frames: np.ndarray, pixel_size: float, band: float = 0.0) -> ReducedMap:
    stack = Frames.from_array(frames)
    centers = estimate_centers(stack, pixel_size=pixel_size)
    return reduce_frames(stack, centers, time=np.arange(len(frames)) * 1.0, pixel_size=pixel_size, band=band)


def exact(found: ReducedMap, blobs: Blobs) -> np.ndarray:
    k = found.mu[:, None, None] * np.stack([np.cos(found.phi), np.sin(found.phi)], axis=-1)
    return np.array([blobs.fourier(k, R) for R in PaperMotion().rotations(TIME)])


@pytest.fixture(scope="module")
def frames(render, blobs) -> np.ndarray:  # type: ignore[no-untyped-def]
    return render(blobs, PaperMotion(), TIME, 72, 0.25)


def test_clean_frames_give_the_closed_form(frames, blobs) -> None:  # type: ignore[no-untyped-def]
    found = reduced(frames, 0.25)
    true = exact(found, blobs)
    assert found.samples.dtype == np.complex128
    assert np.abs(found.samples - true).max() < 1e-12 * np.abs(true).max()
    # all of the spectrum that carries anything
    assert np.abs(true[:, -1]).max() < 2e-5 * np.abs(true).max()


def test_grid_is_what_the_type_says(frames) -> None:  # type: ignore[no-untyped-def]
    found = reduced(frames, 0.25)
    assert np.diff(found.mu) == pytest.approx(np.full(len(found.mu) - 1, found.mu[0]))
    assert found.phi == pytest.approx(np.arange(len(found.phi)) * np.pi / len(found.phi))
    # an object of that radius is resolved along the lines and around the rings
    assert found.mu[0] < np.pi / found.radius


def test_fine_pixels_are_binned_without_loss(render, blobs) -> None:  # type: ignore[no-untyped-def]
    fine = render(blobs, PaperMotion(), TIME, 360, 0.05)
    found = reduced(fine, 0.05, band=4.0)
    true = exact(found, blobs)
    assert np.abs(found.samples - true).max() < 1e-10 * np.abs(true).max()


def test_band_can_be_set(frames) -> None:  # type: ignore[no-untyped-def]
    found = reduced(frames, 0.25, band=2.0)
    assert 2.0 <= found.mu[-1] < 2.0 + found.mu[0]


@pytest.mark.parametrize(("sigma", "dtype"), [(1e-5, np.complex128), (1e-2, np.complex64)])
def test_noise_is_known(frames, blobs, sigma: float, dtype: type) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(6)
    noisy = frames + sigma * frames.max() * rng.standard_normal(frames.shape)
    found = reduced(noisy, 0.25)
    assert found.samples.dtype == dtype
    off = found.samples - exact(found, blobs)
    # the lowest rings also carry the error of the centre
    assert np.sqrt(np.mean(np.abs(off[:, 3:]) ** 2)) == pytest.approx(found.noise, rel=0.15)


def test_more_noise_leaves_less_band(frames) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(7)
    noise = frames.max() * rng.standard_normal(frames.shape)
    bands = [reduced(frames + sigma * noise, 0.25).mu[-1] for sigma in (0.0, 1e-4, 1e-2)]
    assert bands[0] > bands[1] > bands[2]


def test_blank_frames_hold_nan(frames) -> None:  # type: ignore[no-untyped-def]
    holed = frames.copy()
    holed[[3, 11]] = 0
    found = reduced(holed, 0.25)
    assert np.flatnonzero(np.isnan(found.samples[:, 0, 0])).tolist() == [3, 11]


def test_a_level_of_the_empty_field_does_not_matter(frames, blobs) -> None:  # type: ignore[no-untyped-def]
    found = reduced(np.pad(frames, ((0, 0), (30, 30), (30, 30))) + 0.2, 0.25, band=4.0)
    true = exact(found, blobs)
    assert np.abs(found.samples - true).max() < 1e-6 * np.abs(true).max()


def test_nothing_to_see() -> None:
    with pytest.raises(InputError, match="no frame shows an object"):
        reduced(np.zeros((4, 20, 20)), 1.0)
