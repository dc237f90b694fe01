from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trapcli.config import PreprocessConfig
from trapcli.errors import ConfigError, InputError
from trapcli.preprocess.attenuation import to_attenuation
from trapcli.stack.frames import Frames, StackInfo
from trapcli.stack.tiff import write_tiff

SIZE = 64


def discs(centers: np.ndarray, radius: float = 7.0) -> np.ndarray:
    """Attenuation of balls at ``(N, 2)`` pixels from the middle."""
    rows, columns = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    r2 = (columns - centers[:, 0, None, None]) ** 2 + (rows - centers[:, 1, None, None]) ** 2
    return 0.8 * np.sqrt(np.maximum(1 - r2 / radius**2, 0))


@pytest.fixture(scope="module")
def moving() -> np.ndarray:
    angle = np.linspace(0, 6 * np.pi, 80)
    return discs(14 * np.stack([np.cos(angle), np.sin(angle)], axis=1))


@pytest.fixture(scope="module")
def field() -> np.ndarray:
    """Uneven light with specks."""
    rows, columns = np.mgrid[-1 : 1 : SIZE * 1j, -1 : 1 : SIZE * 1j]
    light = 40_000 * (1 - 0.25 * (rows**2 + columns**2) + 0.1 * columns)
    light[10:13, 30:33] *= 0.7
    light[50, 20] *= 0.5
    return light


def raw(attenuation: np.ndarray, field: np.ndarray, flicker: bool = True) -> np.ndarray:
    lamp = 1 + 0.05 * np.sin(np.arange(len(attenuation))) * flicker
    return np.round(field * lamp[:, None, None] * np.exp(-attenuation)).astype(np.uint16)


def attenuation_of(frames: np.ndarray, background: str, **options) -> np.ndarray:  # type: ignore[no-untyped-def]
    config = PreprocessConfig(background=background)
    return np.asarray(to_attenuation(Frames.from_array(frames), config, **options).to_array())


def saved(path: Path, field: np.ndarray) -> str:
    frames = np.repeat(field[None], 3, axis=0).astype(np.float32)
    write_tiff(path, [frames], shape=frames.shape, dtype=np.float32)
    return str(path)


@pytest.mark.parametrize("background", ["file", "median", "auto"])
def test_uneven_light_specks_and_flicker_are_taken_out(
    moving: np.ndarray, field: np.ndarray, background: str, tmp_path: Path
) -> None:
    source = saved(tmp_path / "empty field.tif", field) if background == "file" else background
    found = attenuation_of(raw(moving, field), source)
    assert found.dtype == np.float32
    # the median of a lamp that flickers is off by its scatter; half a count is 2e-5
    assert np.abs(found - moving).max() < (1e-4 if background == "file" else 5e-3)


def test_border_takes_out_smooth_light(moving: np.ndarray) -> None:
    rows, columns = np.mgrid[-1 : 1 : SIZE * 1j, -1 : 1 : SIZE * 1j]
    light = 40_000 * (1 - 0.25 * (rows**2 + columns**2) + 0.1 * columns)
    assert np.abs(attenuation_of(raw(moving, light), "border") - moving).max() < 1e-4


def test_none_is_a_flat_field(moving: np.ndarray) -> None:
    found = attenuation_of(raw(moving, np.full((SIZE, SIZE), 30_000.0)), "none")
    assert np.abs(found - moving).max() < 1e-4


def test_auto_sees_that_a_median_keeps_an_object_that_stays(field: np.ndarray) -> None:
    wobble = np.random.default_rng(0).normal(scale=0.7, size=(60, 2))
    truth = discs(wobble)
    smooth = np.full((SIZE, SIZE), 30_000.0)
    assert np.abs(attenuation_of(raw(truth, smooth), "auto") - truth).max() < 0.01


def test_attenuation_passes_through(moving: np.ndarray) -> None:
    frames = Frames.from_array(moving)
    assert to_attenuation(frames, PreprocessConfig(attenuation=True)) is frames


def test_double_precision_is_kept(moving: np.ndarray) -> None:
    found = attenuation_of(np.exp(-moving), "none")
    assert found.dtype == np.float64
    assert np.abs(found - moving).max() < 1e-12


def test_frames_are_read_lazily_and_repeatedly(moving: np.ndarray, field: np.ndarray) -> None:
    frames = to_attenuation(Frames.from_array(raw(moving, field)), PreprocessConfig(background="border"))
    first = next(frames.read_blocks(7))
    assert first.shape == (7, SIZE, SIZE)
    assert np.array_equal(np.concatenate(list(frames.blocks(9))), np.concatenate(list(frames.blocks(80))))


def test_pixels_without_light_are_masked_or_the_frame_is(moving: np.ndarray) -> None:
    frames = raw(moving, np.full((SIZE, SIZE), 30_000.0), flicker=False)
    frames[3, 20:22, 20:22] = 0  # a few
    frames[5, 20:30, 20:30] = 0  # too many
    frames[8] = 0
    found = attenuation_of(frames, "none")
    assert np.isfinite(found[3]).all()
    assert found[3, 20, 20] == pytest.approx(np.log(30_000 / 0.5))
    assert np.flatnonzero(np.isnan(found).any(axis=(1, 2))).tolist() == [5, 8]
    assert np.isnan(found[[5, 8]]).all()


@pytest.mark.parametrize("background", ["auto", "border", "median", "none"])
def test_dark_stacks_are_refused(background: str) -> None:
    with pytest.raises(InputError, match="--attenuation"):
        attenuation_of(np.zeros((9, SIZE, SIZE), np.uint8), background)


def test_what_is_attenuation_already_is_recognised(moving: np.ndarray) -> None:
    noise = 0.01 * np.random.default_rng(0).standard_normal(moving.shape)
    with pytest.raises(InputError, match="--attenuation"):
        attenuation_of(moving + noise, "none")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("background", ["auto", "none"])
def test_light_that_has_hardly_a_logarithm_is_no_fault(dtype: type, background: str) -> None:
    frames = np.zeros((9, SIZE, SIZE), dtype)
    frames[:, ::2] = np.finfo(dtype).smallest_subnormal
    frames[:, 1] = np.finfo(dtype).max
    with pytest.raises(InputError, match="--attenuation"):
        attenuation_of(frames, background)


def test_dead_pixels_of_the_background_say_nothing(moving: np.ndarray, tmp_path: Path) -> None:
    light = np.full((SIZE, SIZE), 30_000.0)
    light[31, 5] = 0
    found = attenuation_of(raw(moving, light, flicker=False), saved(tmp_path / "b.tif", light))
    assert np.isfinite(found).all()
    assert (found[:, 31, 5] == 0).all()


def test_background_of_another_size_is_refused(moving: np.ndarray, field: np.ndarray, tmp_path: Path) -> None:
    source = saved(tmp_path / "b.tif", field[:, :50])
    with pytest.raises(InputError, match=r"b\.tif.*64 x 50.*64 x 64"):
        attenuation_of(raw(moving, field), source)


def test_background_shows_the_same_region(moving: np.ndarray, field: np.ndarray, tmp_path: Path) -> None:
    source = saved(tmp_path / "b.tif", field)
    part = raw(moving, field)[:, 4:60, 2:62]
    found = attenuation_of(part, source, roi=(4, 60, 2, 62))
    assert np.abs(found - moving[:, 4:60, 2:62]).max() < 1e-4


def test_missing_background_names_the_file(moving: np.ndarray, field: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"no such place\.tif"):
        attenuation_of(raw(moving, field), "no such place.tif")


@pytest.mark.parametrize("path", [0.7, 2.0, 4.0], ids=lambda path: f"{path} pixels")
def test_median_refuses_an_object_that_stays(path: float) -> None:
    angle = np.linspace(0, 4 * np.pi, 60)
    truth = discs(path * np.stack([np.cos(angle), np.sin(angle)], axis=1), radius=12)
    frames = raw(truth, np.full((SIZE, SIZE), 30_000.0))
    with pytest.raises(InputError, match=r"array: the particle stays.*--background surface"):
        attenuation_of(frames, "median")
    assert np.abs(attenuation_of(frames, "auto") - truth).max() < 0.01


def test_auto_says_which_background_it_took_and_why(moving: np.ndarray, field: np.ndarray) -> None:
    info = to_attenuation(Frames.from_array(raw(moving, field)), PreprocessConfig()).info
    assert info.notes[0].startswith("background: median in time; the particle leaves")
    assert not info.warnings


@pytest.mark.parametrize("as_file", [False, True])
def test_dark_level_is_taken_off(
    moving: np.ndarray, field: np.ndarray, tmp_path: Path, as_file: bool
) -> None:
    dark = saved(tmp_path / "dark.tif", np.full(field.shape, 2000.0)) if as_file else "2000"
    background = saved(tmp_path / "empty.tif", field + 2000)
    config = PreprocessConfig(background=background, dark=dark)
    found = to_attenuation(Frames.from_array(raw(moving, field) + np.uint16(2000)), config).to_array()
    assert np.abs(found - moving).max() < 1e-4


def test_dark_level_must_be_one(moving: np.ndarray) -> None:
    frames = Frames.from_array(raw(moving, np.full((SIZE, SIZE), 30_000.0)))
    with pytest.raises(ConfigError, match="--dark -3"):
        to_attenuation(frames, PreprocessConfig(dark="-3"))
    with pytest.raises(InputError, match="nowhere"):
        to_attenuation(frames, PreprocessConfig(dark="nowhere.tif"))


def test_large_frames_agree_with_their_pixels(moving: np.ndarray, tmp_path: Path) -> None:
    rows, columns = np.mgrid[-1 : 1 : 8 * SIZE * 1j, -1 : 1 : 8 * SIZE * 1j]
    light = 40_000 * (1 - 0.25 * (rows**2 + columns**2) + 0.1 * columns + 0.05 * rows)
    light[7, 9] = 0  # dead, as in the frames
    large = np.kron(moving[:12], np.ones((8, 8)))
    frames = raw(large, light)
    frames[:, 7, 9] = 0
    large[:, 7, 9] = 0
    for background in (saved(tmp_path / "empty.tif", light), "border"):
        found = attenuation_of(frames, background)
        shown = np.abs(found - large)
        shown[:, 7, 9] *= background != "border"
        assert shown.max() < 2e-4


def test_overexposed_frames_are_left_out(moving: np.ndarray) -> None:
    frames = raw(moving, np.full((SIZE, SIZE), 3000.0), flicker=False)
    frames[7] = np.minimum(frames[7] * 1.5, 4095)
    projections = to_attenuation(Frames.from_array(frames, StackInfo(bits=12)), PreprocessConfig())
    assert np.flatnonzero(np.isnan(projections.to_array()).any(axis=(1, 2))).tolist() == [7]
    assert "overexposed and left out" in projections.info.warnings[0]


def test_a_stack_that_is_overexposed_throughout_is_used_with_a_warning(moving: np.ndarray) -> None:
    frames = np.minimum(raw(moving, np.full((SIZE, SIZE), 4200.0), flicker=False), 4095)
    projections = to_attenuation(Frames.from_array(frames, StackInfo(bits=12)), PreprocessConfig())
    assert "overexposed" in projections.info.warnings[0]
    assert np.isfinite(projections.to_array()).all()


def test_frames_that_repeat_are_named(moving: np.ndarray) -> None:
    frames = np.random.default_rng(0).poisson(5000 * np.exp(-moving)).astype(np.uint16)
    info = to_attenuation(Frames.from_array(frames.repeat(2, axis=0)), PreprocessConfig()).info
    assert "repeat the one before" in info.warnings[-1]
    assert not to_attenuation(Frames.from_array(frames), PreprocessConfig()).info.warnings
