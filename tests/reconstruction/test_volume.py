"""The object from frames of exactly known motion, against the object itself."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from trapcli.errors import ConfigError, InputError
from trapcli.reconstruction.resolution import crossing, shell_correlation
from trapcli.reconstruction.volume import reconstruct
from trapcli.result.motion import Flag
from trapcli.stack.frames import Frames

FULL = {"total_angle": 480.0}


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def test_clean_and_seen_from_all_sides(example):
    case = example(**FULL)
    found = reconstruct(case.frames, case.motion, pixel_size=case.pixel_size)
    true = case.true(found)
    assert correlation(found.values, true) > 0.999
    assert found.voxel_size == pytest.approx(case.pixel_size)
    assert found.length_unit == "µm"
    # values are attenuation per length
    np.testing.assert_allclose(found.values, true, atol=0.1 * true.max())
    assert found.coverage.share > 0.97
    assert found.warnings == ()
    assert np.isfinite(found.residual).all()
    assert np.median(found.residual) < 0.01


def test_noise_of_five_percent(example):
    """The half-sets foretell how well the volume agrees with the truth."""
    case = example(noise=0.05, frames=200, **FULL)
    found = reconstruct(case.frames, case.motion, pixel_size=case.pixel_size)
    true = case.true(found)
    assert correlation(found.values, true) > 0.97
    # halves that correlate by c make a whole that correlates with the truth by sqrt(2 c / (1 + c))
    own = shell_correlation(found.values, true)
    frequency = found.resolution.frequency
    assert found.resolution.half == pytest.approx(crossing(frequency, own, np.sqrt(2 / 3)), rel=0.15)
    assert found.resolution.seventh == pytest.approx(crossing(frequency, own, 0.5), rel=0.15)
    # all that is left over is noise
    assert np.median(found.misfit) == pytest.approx(1, abs=0.05)
    assert np.median(found.misfit) < np.median(found.held_out) < 1.1


def test_single_axis(example):
    case = example("single-axis", noise=0.01, turns=1.2)
    found = reconstruct(case.frames, case.motion, pixel_size=case.pixel_size)
    assert correlation(found.values, case.true(found)) > 0.99


def test_limited_view_of_the_papers_motion(example):
    case = example("paper", phantom="paper", frames=100)
    found = reconstruct(case.frames, case.motion, pixel_size=case.pixel_size)
    assert 0.2 < found.coverage.share < 0.3
    (warning,) = found.warnings
    assert warning.startswith("limited view")
    assert correlation(found.values, case.true(found)) > 0.85


def test_positivity_fills_in_what_is_not_seen(example):
    case = example(seed=7, noise=0.01, **FULL)  # half of Fourier space
    free, positive = (
        reconstruct(case.frames, case.motion, pixel_size=case.pixel_size, positive=positive)
        for positive in (False, True)
    )
    true = case.true(free)
    assert free.values.min() < -0.02 * true.max()
    assert positive.values.min() == 0
    assert correlation(positive.values, true) > correlation(free.values, true) + 0.02


def test_sharp_edges(example):
    case = example(noise=0.05, phantom="grain", **FULL)
    smooth, sharp = (
        reconstruct(case.frames, case.motion, pixel_size=case.pixel_size, edges=edges)
        for edges in (False, True)
    )
    true = case.true(smooth)
    assert correlation(sharp.values, true) > correlation(smooth.values, true)


def test_negative_objects(example):
    case = example(**FULL)
    turned = Frames.from_array(-case.frames.to_array(), case.frames.info)
    found = reconstruct(turned, case.motion, pixel_size=case.pixel_size, positive=False)
    assert correlation(found.values, -case.true(found)) > 0.999


def test_coarse_voxels(example):
    case = example(**FULL)
    fine = reconstruct(case.frames, case.motion, pixel_size=case.pixel_size)
    coarse = reconstruct(case.frames, case.motion, pixel_size=case.pixel_size, voxels=24)
    assert coarse.values.shape == (24, 24, 24)
    assert 24 * coarse.voxel_size == pytest.approx(len(fine.values) * fine.voxel_size)
    assert correlation(coarse.values, case.true(coarse)) > 0.99
    mass = [float(v.values.sum(dtype=float)) * v.voxel_size**3 for v in (fine, coarse)]
    np.testing.assert_allclose(mass, case.scene.phantom.mass, rtol=0.01)


def test_odd_numbers_of_voxels(example):
    case = example(**FULL)
    found = reconstruct(case.frames, case.motion, pixel_size=case.pixel_size, voxels=27)
    assert correlation(found.values, case.true(found)) > 0.99


def test_a_field_of_uneven_level_and_pixels_as_unit(example):
    """What the empty field is at does not matter, and without a pixel size lengths are pixels."""
    case = example(**FULL)
    frames = Frames.from_array(case.frames.to_array() + np.linspace(0, 9, 120)[:, None, None])
    motion = dataclasses.replace(
        case.motion, center=case.motion.center / case.pixel_size, length_unit="pixel"
    )
    found = reconstruct(frames, motion)
    assert found.voxel_size == pytest.approx(1)
    true = case.volume(len(found.values), case.pixel_size) * case.pixel_size
    assert correlation(found.values, true) > 0.999
    np.testing.assert_allclose(found.values, true, atol=0.1 * true.max())


def test_frames_without_trust_are_left_out(example):
    case = example(**FULL)
    frames, R = case.frames.to_array().copy(), case.motion.R.copy()
    valid, flags = case.motion.valid.copy(), case.motion.flags.copy()
    frames[5], R[20], valid[30], flags[40] = np.nan, np.nan, 0, Flag.CLIPPED
    frames[30], frames[40] = 7, 9
    motion = dataclasses.replace(case.motion, R=R, valid=valid, flags=flags)
    found = reconstruct(Frames.from_array(frames), motion, pixel_size=case.pixel_size)
    assert np.flatnonzero(np.isnan(found.residual)).tolist() == [5, 20, 30, 40]
    assert correlation(found.values, case.true(found)) > 0.999


def test_clipped_frames_are_used_where_there_are_no_others(example):
    case = example(**FULL)
    motion = dataclasses.replace(case.motion, flags=np.full(120, Flag.CLIPPED, np.uint16))
    found = reconstruct(case.frames, motion, pixel_size=case.pixel_size)
    assert found.warnings == ("the field of view clips the object in 120 of the frames used",)


def test_wrong_motion_shows_in_what_is_held_out(example):
    case = example(noise=0.01, **FULL)
    motion = dataclasses.replace(case.motion, R=np.swapaxes(case.motion.R, 1, 2))
    found = reconstruct(case.frames, motion, pixel_size=case.pixel_size)
    assert "times the noise" in found.warnings[-1]
    assert np.median(found.held_out) > 2


def test_untrusted_motion_is_named(example):
    case = example(noise=0.01, **FULL)
    motion = dataclasses.replace(
        case.motion, identifiable=False, verdict="too round", valid=np.zeros(120, np.uint8)
    )
    found = reconstruct(case.frames, motion, pixel_size=case.pixel_size)
    assert "too round" in found.warnings[0]
    assert np.isfinite(found.residual).all()


def test_too_few_frames(example):
    case = example(**FULL)
    motion = dataclasses.replace(case.motion, valid=np.zeros(120, np.uint8))
    with pytest.raises(InputError, match="0 frames have a known motion"):
        reconstruct(case.frames, motion)


def test_arrays_and_the_public_name(example):
    import trapcli

    case = example(**FULL)
    found = trapcli.reconstruct(case.frames.to_array(), case.motion, pixel_size=case.pixel_size, voxels=24)
    assert found.values.shape == (24, 24, 24)
    with pytest.raises(InputError, match="has 9 frames where the motion has 120"):
        trapcli.reconstruct(case.frames.to_array()[:9], case.motion)


def test_noisy_frames_count_less(example):
    """A third of the frames with ten times the noise hardly do harm."""
    case = example(noise=0.01, **FULL)
    frames = case.frames.to_array().copy()
    extra = 0.1 * frames.max() * np.random.default_rng(0).standard_normal(frames[::3].shape)
    frames[::3] += extra.astype(frames.dtype)
    found = reconstruct(frames, case.motion, pixel_size=case.pixel_size)
    assert correlation(found.values, case.true(found)) > 0.99
    assert np.median(found.misfit) < 1.2


@pytest.mark.parametrize("voxels", [-1, 3, 4000])
def test_impossible_numbers_of_voxels(example, voxels):
    case = example(**FULL)
    with pytest.raises(ConfigError, match="voxels"):
        reconstruct(case.frames, case.motion, voxels=voxels)


def test_frames_are_streamed(example):
    """No block holds more frames than asked for, and nothing asks for all of them at once."""
    case = example(**FULL)
    read = []

    def read_blocks(size):
        for block in case.frames.read_blocks(min(size, 7)):
            read.append(len(block))
            yield block

    frames = dataclasses.replace(case.frames, read_blocks=read_blocks)
    found = reconstruct(frames, case.motion, pixel_size=case.pixel_size)
    assert correlation(found.values, case.true(found)) > 0.999
    assert max(read) <= 7


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "least"), [(0.0, 0.995), (0.05, 0.97)])
def test_estimated_motion(example, noise, least):
    import trapcli

    case = example(noise=noise, frames=200, size=64, **FULL)
    motion = trapcli.estimate(case.frames, attenuation=True)
    assert motion.identifiable
    found = reconstruct(case.frames, motion, pixel_size=case.pixel_size)
    true = case.true(found)
    # R is exact at the first frame only up to its error, and of two mirror images the gauge picks one
    assert correlation(found.values, true) > least
