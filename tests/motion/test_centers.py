from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from trapcli.motion.centers import estimate_centers, noise_between, object_radius, pixel_noise
from trapcli.motion.translation import translation
from trapcli.simulation.motions import PaperMotion
from trapcli.simulation.phantoms import PaperPhantom
from trapcli.stack.frames import Frames


def centers_of(frames: np.ndarray, pixel_size: float = 1.0):  # type: ignore[no-untyped-def]
    return estimate_centers(Frames.from_array(frames), pixel_size=pixel_size)


@pytest.fixture(scope="module")
def paper_frames(render) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """40 frames of 128² of the paper's phantom and the true centres."""
    time = np.linspace(0, 0.5, 40)
    frames = render(PaperPhantom(), PaperMotion(), time, 128, 0.2)
    return frames, PaperPhantom().center[:2] - PaperMotion().T(time)[:, :2]


def test_clean_frames_are_exact(paper_frames) -> None:  # type: ignore[no-untyped-def]
    frames, true = paper_frames
    found = centers_of(frames, 0.2)
    assert np.abs(found.center - true).max() < 1e-9
    assert found.mass == pytest.approx(np.full(40, PaperPhantom().mass), rel=1e-9)
    assert not found.clipped.any()


@pytest.mark.parametrize("shape", [(96, 128), (127, 100)])
def test_origin_is_the_pixel_in_the_middle(shape: tuple[int, int]) -> None:
    height, width = shape
    rows, columns = np.mgrid[:height, :width]
    blob = np.exp(-((columns - width // 2 - 7.25) ** 2 + (rows - height // 2 + 3.5) ** 2) / 50)
    found = centers_of(np.array([blob, blob]), 0.5)
    assert found.center[0] == pytest.approx([3.625, -1.75], abs=1e-9)


@pytest.mark.parametrize("level", [0.0, 0.3])
def test_noise_of_one_percent(level: float, render) -> None:  # type: ignore[no-untyped-def]
    time = np.linspace(0, 0.5, 100)
    frames = render(PaperPhantom(), PaperMotion(), time, 256, 0.1)
    peak = frames.max()
    rng = np.random.default_rng(4)
    noisy = (frames + peak * (level + 0.01 * rng.standard_normal(frames.shape))).astype(np.float32)
    found = centers_of(noisy)
    true = (PaperPhantom().center[:2] - PaperMotion().T(time)[:, :2]) / 0.1
    assert np.abs(found.center - true).max() < 0.03
    assert found.noise == pytest.approx(0.01 * peak, rel=0.05)
    assert found.level == pytest.approx(np.full(100, level * peak), abs=0.001 * peak)


def test_errors_come_true(render, blobs) -> None:  # type: ignore[no-untyped-def]
    time = np.zeros(1)
    clean = render(blobs, PaperMotion(), time, 64, 0.25)[0]
    rng = np.random.default_rng(0)
    # a jittering object: what is not smooth must not be smoothed
    jitter = rng.integers(-3, 4, (150, 2))
    frames = np.array([np.roll(clean, tuple(j), axis=(0, 1)) for j in jitter])
    noisy = frames + 0.01 * clean.max() * rng.standard_normal(frames.shape)
    found = centers_of(noisy)
    off = found.center - jitter[:, ::-1]
    pull = (off - off.mean(axis=0)) / found.errors
    assert 0.75 < pull.std() < 1.3


def test_blank_frames_are_unknown(paper_frames) -> None:  # type: ignore[no-untyped-def]
    frames = paper_frames[0][:20].copy()
    rng = np.random.default_rng(1)
    frames += 0.002 * frames.max() * rng.standard_normal(frames.shape)
    frames[[0, 5]] = 0.002 * frames.max() * rng.standard_normal((2, 128, 128))
    frames[9] = np.nan
    found = centers_of(frames)
    blank = np.isnan(found.center[:, 0])
    assert np.flatnonzero(blank).tolist() == [0, 5, 9]
    assert np.isnan(found.errors[blank]).all()
    T = translation(found.center)
    assert np.array_equal(T[1], [0, 0])
    assert np.isnan(T[0]).all()


def test_nothing_at_all() -> None:
    assert np.isnan(centers_of(np.zeros((3, 16, 16))).center).all()
    assert np.isnan(centers_of(np.full((3, 16, 16), np.nan)).center).all()
    assert np.isnan(translation(np.full((3, 2), np.nan))).all()


def test_object_at_the_edge_is_seen_to_be_clipped(paper_frames) -> None:  # type: ignore[no-untyped-def]
    cut = paper_frames[0][:6, :, 50:]
    assert centers_of(cut).clipped.all()


def test_another_type_of_pixel(paper_frames) -> None:  # type: ignore[no-untyped-def]
    frames, true = paper_frames
    counts = np.round(frames / frames.max() * 65535).astype(np.uint16)
    assert np.abs(centers_of(counts, 0.2).center - true).max() < 1e-4


def test_noise_of_small_frames_is_told_to_two_percent() -> None:
    rng = np.random.default_rng(0)
    told = [[noise_between(*rng.standard_normal((2, 64, 64))) for _ in range(20)] for _ in range(40)]
    assert np.mean(told) == pytest.approx(1.0, abs=0.01)
    assert np.std(np.median(told, axis=1)) < 0.02


def test_noise_and_radius_of_a_ball() -> None:
    rng = np.random.default_rng(2)
    rows, columns = np.mgrid[:128, :128] - 64
    ball = np.sqrt(np.maximum(25**2 - rows**2 - columns**2, 0)) / 25
    images = ball + 0.05 * rng.standard_normal((8, 128, 128))
    assert pixel_noise(images) == pytest.approx(0.05, rel=0.1)
    assert object_radius(images, 0.05) == pytest.approx(25, abs=2.1)


def test_what_is_left_of_a_background_in_a_corner_is_no_part_of_the_object() -> None:
    rng = np.random.default_rng(2)
    rows, columns = np.mgrid[:128, :128] - 64
    ball = np.sqrt(np.maximum(25**2 - rows**2 - columns**2, 0)) / 25
    corner = 0.05 * np.exp(-((rows + 60) ** 2 + (columns + 58) ** 2) / (2 * 4.0**2))
    images = ball + corner + 0.01 * rng.standard_normal((8, 128, 128))
    assert object_radius(images, 0.01) == pytest.approx(25, abs=2.1)
    # a part of the object may lie apart, if it is no mere remainder
    images += 0.5 * (np.hypot(rows, columns - 50) < 8)
    assert object_radius(images, 0.01) == pytest.approx(57.5, abs=5)


def turning_grain(count: int, noise: float) -> np.ndarray:
    """An ellipsoid, whose edges are sharp, which turns by 0.3 degrees from frame to frame."""
    rows, columns = np.mgrid[:128, :128] - 64
    angle = np.deg2rad(0.3) * np.arange(count)[:, None, None]
    along, across = (
        np.cos(angle) * columns + np.sin(angle) * rows,
        np.cos(angle) * rows - np.sin(angle) * columns,
    )
    grain = np.sqrt(np.maximum(1 - (along / 35.3) ** 2 - (across / 12.7) ** 2, 0))
    return grain + noise * np.random.default_rng(4).standard_normal(grain.shape)


def noise_of_pairs(images: np.ndarray) -> float:
    return float(np.median([noise_between(*pair) for pair in pairwise(images)]))


@pytest.mark.parametrize("noise", [0.005, 0.02, 0.2])
def test_sharp_edges_are_no_noise(noise: float) -> None:
    images = turning_grain(16, noise)
    assert noise_of_pairs(images) == pytest.approx(noise, rel=0.1)
    if noise == 0.005:
        assert pixel_noise(images) > 1.2 * noise


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int32])
def test_noise_of_whole_numbers(kind: type[np.integer]) -> None:
    images = 40 + 100 * turning_grain(4, 0.05)
    assert noise_of_pairs(images.round().astype(kind)) == pytest.approx(noise_of_pairs(images), rel=0.02)


@pytest.mark.parametrize("how", ["repeated", "interpolated"])
def test_noise_that_goes_on_into_the_next_frame_is_told_by_each(how: str) -> None:
    images = turning_grain(17, 0.2)
    if how == "repeated":
        images = images[::2].repeat(2, axis=0)
    else:
        images[1:-1:2] = (images[:-2:2] + images[2::2]) / 2
    whole = np.median([noise_between(*pair) for pair in zip(images[::2], images[1::2], strict=False)])
    assert whole == pytest.approx(0.2, rel=0.1)


def test_progress_is_told(paper_frames) -> None:  # type: ignore[no-untyped-def]
    told: list[tuple[str, int, int]] = []
    frames = Frames.from_array(paper_frames[0])
    estimate_centers(frames, progress=lambda *what: told.append(what))
    assert told[-1] == ("centers", 40, 40)


@pytest.mark.parametrize("cut", [False, True], ids=["whole", "cut"])
def test_noise_whose_high_frequencies_a_codec_has_cut(cut: bool) -> None:
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:128, :128] - 64
    ball = np.exp(-(rows**2 + columns**2) / (2 * 12**2))
    k1, k2 = np.abs(np.fft.fftfreq(128, 0.5)), np.abs(np.fft.rfftfreq(128, 0.5))
    radial = np.hypot(k1[:, None], k2)
    kept = 0.1 + 0.9 / (1 + (radial / 0.7) ** 16) if cut else np.ones(radial.shape)
    noise = 0.05 * rng.standard_normal((4, 128, 128))
    images = ball + np.fft.irfft2(np.fft.rfft2(noise) * kept, (128, 128))
    assert pixel_noise(images) == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize(("jitter", "drift"), [(0.1, 3.0), (0.0, 3.0), (0.1, 0.0)])
def test_a_particle_that_is_shaken_while_it_drifts(jitter: float, drift: float, render, blobs) -> None:  # type: ignore[no-untyped-def]
    pixel, frames = 0.25, 150
    rng = np.random.default_rng(1)
    slow = drift * np.sin(np.linspace(0, 5, frames))[:, None] * [1.0, -0.5]
    place = pixel * (slow + jitter * rng.standard_normal((frames, 2)))
    x = (np.arange(64) - 32) * pixel
    centre = blobs.center[:2]
    clean = np.array([blobs.project(np.eye(3), -np.array([*p, 0.0]), x, x) for p in place])
    noise = 0.05
    found = centers_of(clean + noise * clean.max() * rng.standard_normal(clean.shape), pixel)
    pull = (found.center - centre - place) / found.errors
    assert 0.8 < np.sqrt(np.mean(pull**2)) < 1.25
    # what is smooth is told better by all frames together, what is not by each alone
    alone = centers_of(clean[:2] + noise * clean.max() * rng.standard_normal(clean[:2].shape), pixel)
    assert (np.median(found.errors) < 0.5 * np.median(alone.errors)) == (jitter == 0)
