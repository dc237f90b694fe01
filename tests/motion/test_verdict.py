"""What the result says of a motion that is known in part."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from trapcli.config import MotionConfig
from trapcli.motion import joint, verdict
from trapcli.motion.branch import find_branches
from trapcli.motion.object_model import Assessment, Fit
from trapcli.motion.path import align
from trapcli.result.motion import Flag, Motion
from trapcli.simulation.render import simulate
from trapcli.stack.frames import Frames


def scene(seed: int = 2, **motion: object) -> tuple[np.ndarray, Motion]:
    return simulate(
        seed=seed,
        stack={"frames": 90, "height": 48, "width": 48, "pixel_size": 0.2},
        phantom={"kind": "blobs"},
        motion={"kind": "single-axis", **motion},
        camera={"noise": 0.01},
    )


def estimate(images: np.ndarray, time: np.ndarray) -> Motion:
    return (
        joint.find_motion(Frames.from_array(images), MotionConfig(), time=time, pixel_size=0.2)
        .refined()
        .motion()
    )


@pytest.fixture(autouse=True)
def few_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search less: the branch is not what is tested."""
    monkeypatch.setattr(joint, "find_branches", partial(find_branches, starts=8, keep=3))


def test_a_rotation_that_is_left_open_is_not_told(monkeypatch: pytest.MonkeyPatch) -> None:
    images, truth = scene(tilt=20.0)
    assert estimate(images, truth.time).identifiable
    monkeypatch.setattr(verdict, "_OPEN", 1e-6)
    found = estimate(images, truth.time)
    assert not found.identifiable
    assert "leave the rotation open" in found.verdict
    assert not found.valid.any()


@pytest.mark.slow
def test_rotation_about_the_optical_axis_with_model_error() -> None:
    """Blotches that are no noise of pixels widen the errors; α stays 0 within its error, φ undefined."""
    images, truth = scene(tilt=90.0)
    blotches = gaussian_filter(np.random.default_rng(5).normal(size=images.shape), (0, 2, 2))
    images = images + (0.0025 * images.max() * blotches / blotches.std()).astype(np.float32)
    found = estimate(images, truth.time)
    assert found.identifiable
    assert "imperfect model" in found.verdict
    assert (found.alpha_errors > 0).all()
    assert (found.alpha <= 2 * found.alpha_errors).all()
    assert (found.flags & np.uint16(Flag.ALPHA_ZERO) > 0).all()
    assert np.isnan(found.phi).all()
    assert np.isfinite(found.omega_3).all()


@pytest.mark.slow
def test_noise_pieces_and_more_noise_change_the_answer_by_no_more_than_its_errors() -> None:
    images, truth = scene(tilt=20.0)
    whole = estimate(images, truth.time)
    again = estimate(images, truth.time)
    assert np.array_equal(whole.R, again.R)
    assert np.array_equal(whole.phi, again.phi)
    piece = slice(12, 90)
    extra = np.random.default_rng(9).normal(scale=0.01 * images.max(), size=images.shape)
    for other, part in (
        (estimate(images[piece], truth.time[piece]), piece),
        (estimate((images + extra).astype(np.float32), truth.time), slice(None)),
    ):
        assert other.identifiable
        angles = align(other.R, whole.R[part])[0]
        error = np.hypot(np.linalg.norm(other.R_errors, axis=1), np.linalg.norm(whole.R_errors, axis=1)[part])
        # the gauge of a piece is that of its own first frame: its error is in all others
        assert angles.max() < 3 * np.median(error)
        apart = (whole.omega_3[part] - other.omega_3) / np.hypot(
            whole.omega_3_errors[part], other.omega_3_errors
        )
        assert np.abs(apart).max() < 4
        turn = (other.phi - whole.phi[part] + np.pi / 2) % np.pi - np.pi / 2
        assert np.abs(turn / np.hypot(other.phi_errors, whole.phi_errors[part])).max() < 4
        # one of the two mirror solutions, the same in all
        assert np.abs(other.phi - whole.phi[part]).max() < 0.5


@pytest.mark.slow
def test_errors_do_not_add_up_along_the_way() -> None:
    """Frames half a turn apart are mirrored, those a turn apart one view: the angle is tied to the first."""
    images, truth = scene(turns=1.2, azimuth=0.0)
    along = estimate(images, truth.time).R_errors[:, 0]
    third = len(along) // 3
    assert np.median(along[-third:]) < 1.2 * np.median(along[1:third])


def judged_by_parts(misfit: np.ndarray, left: float) -> verdict.Verdict:
    """Judge a motion by the misfits of 100 groups, and what is `left` in all modes of a unit of noise."""
    rng = np.random.default_rng(0)
    groups, modes = len(misfit), 40
    k = rng.normal(size=(modes, 2))
    low = SimpleNamespace(k=k, modes=10 * rng.normal(size=(groups, modes)), variance=left)
    fit = SimpleNamespace(cost=misfit.mean() * 40_000, axes=(0, 1, 2), low=low)
    told = np.full(modes, misfit.mean())
    assessment = SimpleNamespace(degrees=40_000.0, frame_misfit=misfit, mode_misfit=told)
    return verdict.judge(cast(Fit, fit), cast(Assessment, assessment))


def test_what_is_left_over_in_some_parts_only_is_no_imperfect_model() -> None:
    misfit = np.full(100, 1.2)
    judged = judged_by_parts(misfit, left=0.1)
    assert judged.identifiable
    assert "imperfect model" in judged.text
    misfit[:10] = 1.0
    judged = judged_by_parts(misfit, left=0.1)
    assert not judged.identifiable
    assert "not everywhere" in judged.text
    # where next to nothing is left over, the noise may not have been the same all the time
    assert judged_by_parts(misfit, left=0.001).identifiable


def test_a_motion_that_is_wrong_in_one_part_is_not_certified() -> None:
    misfit = np.full(100, 1.02)
    assert "explains the images" in judged_by_parts(misfit, left=0.5).text
    misfit[90:] = 1.25
    assert misfit.mean() < 1.06
    assert not judged_by_parts(misfit, left=0.5).identifiable
