"""The joint estimate from frames to motion: accuracy, errors that come true, verdicts, outlying frames."""

from __future__ import annotations

import dataclasses
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.config import MotionConfig
from trapcli.errors import InputError
from trapcli.motion import joint
from trapcli.motion.branch import find_branches
from trapcli.motion.path import align
from trapcli.result.comparison import Comparison, compare
from trapcli.result.motion import Flag, Motion
from trapcli.simulation.render import simulate
from trapcli.stack.frames import Frames

PIXEL = 0.2
CELL = Path(__file__).parents[2] / "../shared/data/fdtd_cell_tilted.tif"
SERIES = ("phi", "omega_3", "alpha", "phi_errors", "omega_3_errors", "alpha_errors", "R", "R_errors")

Images = NDArray[Any]


def render(
    kind: str, phantom: str, seed: int, frames: int = 90, pixels: int = 48, noise: float = 0.01, **motion: Any
) -> tuple[Images, Motion]:
    return simulate(
        seed=seed,
        stack={"frames": frames, "height": pixels, "width": pixels, "pixel_size": PIXEL},
        phantom={"kind": phantom},
        motion={"kind": kind, **motion},
        camera={"noise": noise},
    )


def estimate(images: Images, time: NDArray[np.float64], **options: Any) -> Motion:
    motion = (
        joint.find_motion(Frames.from_array(images), MotionConfig(), time=time, pixel_size=PIXEL, **options)
        .refined()
        .motion()
    )
    return dataclasses.replace(motion, time_unit="s", length_unit="µm")


def errors(found: Motion, truth: Motion) -> Comparison:
    assert truth.length_unit == found.length_unit
    return compare(found, truth)


@pytest.fixture
def few_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search less where the branch is not what is tested."""
    monkeypatch.setattr(joint, "find_branches", partial(find_branches, starts=8, keep=3))


@pytest.fixture(scope="module")
def tumbling() -> tuple[Motion, Motion, Images]:
    images, truth = render("tumbling", "blobs", seed=2)
    return estimate(images, truth.time), truth, images


@pytest.fixture(scope="module")
def single_axis() -> tuple[Motion, Motion, Images]:
    images, truth = render("single-axis", "blobs", seed=2)
    return estimate(images, truth.time), truth, images


@pytest.fixture(params=["tumbling", "single_axis"])
def case(request: pytest.FixtureRequest) -> tuple[Motion, Motion, Images]:
    result: tuple[Motion, Motion, Images] = request.getfixturevalue(request.param)
    return result


def test_accuracy_at_one_percent_noise(case: tuple[Motion, Motion, Images]) -> None:
    found, truth, _ = case
    compared = errors(found, truth).errors
    assert compared["R_aligned"].mean < 0.5
    assert compared["R_aligned"].max < 1.5
    assert compared["T_offset_removed"].mean < 0.05 * PIXEL
    assert compared["alpha_relative"].median < 5
    assert compared["omega_3"].median < 0.05 * truth.alpha.mean()


def test_a_good_fit_says_so(case: tuple[Motion, Motion, Images]) -> None:
    found = case[0]
    assert found.identifiable
    assert "the motion explains the images" in found.verdict
    assert found.valid.all()
    assert (found.flags & ~np.uint16(Flag.ALPHA_ZERO) == 0).all()
    assert (found.residual > 0).all()
    assert found.residual.max() < 0.1


def test_the_result_is_in_its_gauge(case: tuple[Motion, Motion, Images]) -> None:
    found = case[0]
    assert found.R[0] == pytest.approx(np.eye(3), abs=1e-12)
    assert np.abs(np.linalg.det(found.R) - 1).max() < 1e-10
    assert np.abs(np.swapaxes(found.R, 1, 2) @ found.R - np.eye(3)).max() < 1e-10
    assert np.array_equal(found.T[0], [0, 0])
    assert pytest.approx(found.center[0] - found.center) == found.T
    phi = found.phi[np.isfinite(found.phi)]
    assert 0 <= phi[0] < np.pi
    assert np.abs(np.diff(phi)).max() < np.pi
    assert (found.alpha >= 0).all()


def test_R_and_omega_belong_together(case: tuple[Motion, Motion, Images]) -> None:
    found = case[0]
    step = np.swapaxes(found.R[:-2], 1, 2) @ found.R[2:]
    mean = Rotation.from_matrix(step).as_rotvec() / (found.time[2:] - found.time[:-2])[:, None]
    omega = np.stack([found.omega_1, found.omega_2, found.omega_3], axis=1)[1:-1]
    known = np.isfinite(omega).all(axis=1)
    assert np.abs(mean - omega)[known].max() < 0.01 * np.linalg.norm(omega[known], axis=1).max()


def test_errors_are_stated_and_of_the_right_size(case: tuple[Motion, Motion, Images]) -> None:
    found, truth, _ = case
    assert found.R_errors[0] == pytest.approx(0, abs=1e-6)
    assert (found.R_errors[1:] > 0).all()
    assert np.isfinite(found.T_errors).all()
    assert np.array_equal(np.isfinite(found.phi), np.isfinite(found.phi_errors))
    for name, least in (("R", 0.45), ("omega_3", 0.3), ("alpha", 0.3), ("phi", 0.3), ("T", 0.2)):
        statistics = errors(found, truth).errors[name]
        assert statistics.within_1_sigma > least
        assert statistics.within_2_sigma > least + 0.25


def test_errors_of_R_come_true(
    tumbling: tuple[Motion, Motion, Images], single_axis: tuple[Motion, Motion, Images]
) -> None:
    within = [errors(found, truth).errors["R"].within_1_sigma for found, truth, _ in (tumbling, single_axis)]
    assert 0.5 < np.mean(within) < 0.85


@pytest.mark.parametrize(
    ("kind", "phantom", "options"),
    [
        ("tumbling", "sphere", {}),
        ("still", "blobs", {}),
        ("still", "grain", {}),
        ("single-axis", "revolution", {"azimuth": 0.0}),
    ],
)
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_what_cannot_be_known_is_not_made_up(
    kind: str, phantom: str, options: dict[str, float], noise: float
) -> None:
    images, truth = render(kind, phantom, seed=1, frames=60, noise=noise, **options)
    found = estimate(images, truth.time)
    assert not found.identifiable
    assert "no rotation can be told" in found.verdict
    assert not found.valid.any()
    for name in SERIES:
        assert np.isnan(getattr(found, name)).all()
    # but where it is can be known
    assert errors(dataclasses.replace(found, valid=truth.valid), truth).errors["T"].max < 0.3 * PIXEL


@pytest.mark.usefixtures("few_starts")
def test_outlying_frames_are_flagged_and_spoil_nothing(tumbling: tuple[Motion, Motion, Images]) -> None:
    clean, truth, images = tumbling
    images = images.copy()
    flash, passing = 30, 61
    images[flash] *= 1.5
    x2, x1 = np.indices(images.shape[1:])
    images[passing] += images.max() * np.exp(-((x1 - 31) ** 2 + (x2 - 18) ** 2) / 18).astype(np.float32)
    found = estimate(images, truth.time)
    assert np.array_equal(np.flatnonzero(found.flags & Flag.OUTLIER), [flash, passing])
    assert np.array_equal(np.flatnonzero(found.valid == 0), [flash, passing])
    assert errors(found, truth).errors["R_aligned"].mean < 0.5
    near = np.array([flash - 1, flash + 1, passing - 1, passing + 1])
    angles, _ = align(found.R, clean.R)
    assert np.rad2deg(angles[near]).max() < 0.5
    assert np.abs(found.T - clean.T)[near].max() < 0.2 * PIXEL


@pytest.mark.parametrize("spoilt", [[], [20], [60], [59, 64], [20, 60]])
def test_fast_frames_are_no_outliers(spoilt: list[int]) -> None:
    """The pace goes from 1 to 12 degrees a frame and back within 20 frames."""
    rng = np.random.default_rng(0)
    pace = 1 + 11 * np.exp(-(((np.arange(120) - 60) / 5) ** 2))
    modes = np.exp(1j * np.outer(np.cumsum(np.deg2rad(pace)), np.arange(1, 9)))
    modes += 0.01 * (rng.normal(size=modes.shape) + 1j * rng.normal(size=modes.shape))
    modes[spoilt] += 1.5
    low = SimpleNamespace(time=np.arange(120.0), modes=modes, variance=2e-4)
    assert np.flatnonzero(joint._outliers(low)).tolist() == spoilt  # type: ignore[arg-type]


@pytest.mark.usefixtures("few_starts")
def test_blank_frames_are_left_out(tumbling: tuple[Motion, Motion, Images]) -> None:
    _, truth, images = tumbling
    images = images.copy()
    blank = np.array([17, 40, 41])
    images[blank] = np.random.default_rng(0).normal(scale=0.01 * images.max(), size=(3, *images.shape[1:]))
    stages = []
    found = estimate(
        images, truth.time, progress=lambda stage, done, total: stages.append((stage, done, total))
    )
    assert np.array_equal(np.flatnonzero(found.flags & Flag.BLANK), blank)
    assert np.array_equal(np.flatnonzero(found.valid == 0), blank)
    for name in ("R", "T", "omega_3", "alpha", "phi", "residual"):
        assert np.isnan(getattr(found, name)[blank]).all()
    assert errors(found, truth).errors["R_aligned"].mean < 0.5
    assert {stage for stage, _, _ in stages} >= {"frames", "branches"}
    assert all(0 <= done <= total for _, done, total in stages)


@pytest.mark.parametrize("share", [0.0, 0.6, 0.9])
def test_frames_over_which_a_residual_is_alike(share: float) -> None:
    """The autocorrelation time of a first-order autoregression with coefficient ρ is (1 + ρ) / (1 − ρ)."""
    rng = np.random.default_rng(6)
    residual = rng.normal(size=(400, 300)) + 1j * rng.normal(size=(400, 300))
    for before, after in pairwise(residual):
        after *= np.sqrt(1 - share**2)
        after += share * before
    assert joint._alike(residual) == pytest.approx((1 + share) / (1 - share), rel=0.1)


@pytest.mark.parametrize(("misfit", "taken"), [(0.98, True), (1.005, True), (1.03, False)])
def test_the_finest_fit_must_explain_the_images_as_well(misfit: float, taken: bool) -> None:
    coarse, fine = (SimpleNamespace(cost=c * 20000.0, degrees=20000.0) for c in (1.0, misfit))
    assert joint._as_well(fine, fine, coarse, coarse) == taken  # type: ignore[arg-type]


@pytest.mark.parametrize("worse", [0.0, 0.2])
def test_a_motion_that_is_wrong_in_a_quarter_of_the_stack_does_not_end_the_search(worse: float) -> None:
    """The misfit of all frames together may still look like noise."""
    rng = np.random.default_rng(3)
    modes = 200
    misfit = rng.chisquare(modes, 200) / modes
    misfit[:50] *= 1 + worse
    assert misfit.mean() < 1.05 + 0.01
    assessment = SimpleNamespace(frame_misfit=misfit, degrees=200.0 * modes)
    assert joint._even(assessment) == (worse == 0)  # type: ignore[arg-type]


def test_too_few_frames() -> None:
    images, truth = render("tumbling", "blobs", seed=1, frames=8)
    with pytest.raises(InputError, match="at least 12 are needed"):
        estimate(images, truth.time)


@pytest.mark.slow
@pytest.mark.skipif(not CELL.exists(), reason="the wave-optics simulation of a cell is not here")
def test_a_cell_by_wave_optics() -> None:
    """One turn in 220 steps about an axis tilted by 0.2 rad, through light that does not go straight."""
    frames = tifffile.imread(CELL)
    time = np.arange(float(len(frames)))
    found = joint.find_motion(Frames.from_array(frames), MotionConfig(), time=time).refined().motion()
    assert found.identifiable
    omega = np.stack([found.omega_1, found.omega_2, found.omega_3], axis=1)
    speed = np.linalg.norm(omega, axis=1)
    turned = np.sum(0.5 * (speed[1:] + speed[:-1])) * len(frames) / (len(frames) - 1)
    assert turned == pytest.approx(2 * np.pi, rel=0.005)
    rate = 2 * np.pi / len(frames)
    assert np.median(found.alpha) == pytest.approx(np.cos(0.2) * rate, rel=0.01)
    axis = np.array([0, np.cos(0.2), np.sin(0.2)])
    tilts = [axis, axis * [1, 1, -1]]
    paths = [Rotation.from_rotvec(np.outer(time * rate, s * a)).as_matrix() for a in tilts for s in (1, -1)]
    assert min(np.rad2deg(align(found.R, path)[0].mean()) for path in paths) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_rotation_about_the_optical_axis(few_starts: None, seed: int) -> None:
    """Seen from one side only: ω₃ is known, α is 0 within its error, φ is undefined."""
    images, truth = render("single-axis", "blobs", seed=seed, tilt=90.0)
    found = estimate(images, truth.time)
    assert found.identifiable
    assert "optical axis" in found.verdict
    assert (found.flags & np.uint16(Flag.ALPHA_ZERO) > 0).all()
    assert np.isnan(found.phi).all()
    assert (found.alpha < 2 * found.alpha_errors).all()
    off = np.abs(found.omega_3 / truth.omega_3 - 1)
    assert np.median(off) < 0.02
    # at its ends a spline is held from one side only, and says so
    assert (off < np.maximum(0.05, 3 * found.omega_3_errors / np.abs(truth.omega_3))).all()
    assert np.rad2deg(align(found.R, truth.R)[0].mean()) < 0.2


@pytest.mark.slow
def test_an_axis_near_the_optical_one_is_not_taken_for_it() -> None:
    images, truth = render("single-axis", "blobs", seed=2, tilt=80.0)
    found = estimate(images, truth.time)
    assert found.identifiable
    assert np.median(np.abs(found.alpha / truth.alpha - 1)) < 0.1


@pytest.mark.slow
def test_a_motion_that_the_first_window_misses() -> None:
    """Searched from the middle of this stack alone, a motion 18° off is the best that is found."""
    images, truth = render("tumbling", "blobs", seed=4, frames=80, pixels=64, noise=0.05, total_angle=400.0)
    found = estimate(images, truth.time)
    assert found.identifiable
    assert np.rad2deg(align(found.R, truth.R)[0].mean()) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "best"), [(0.01, 0.35), (0.05, 1.0)])
def test_thermal_motion(noise: float, best: float) -> None:
    """The particle turns anew in every frame: no few knots hold that, and no smooth ω."""
    compared = []
    for seed in (2, 3, 4):
        kicks = {"diffusion": 0.5, "shaking": 0.03}
        images, truth = render("tumbling", "blobs", seed=seed, frames=160, noise=noise, **kicks)
        found = estimate(images, truth.time)
        assert found.identifiable
        compared.append(errors(found, truth).errors)
    assert np.mean([one["R_aligned"].mean for one in compared]) < best
    for name, least in (("T", 0.88), ("R", 0.8), ("phi", 0.5), ("omega_3", 0.45), ("alpha", 0.5)):
        assert np.mean([one[name].within_2_sigma for one in compared]) > least, name


@pytest.mark.slow
def test_a_long_noisy_stack() -> None:
    """Three turns at 5 % noise: what a path has gone through keeps its ends from going astray."""
    images, truth = render("tumbling", "blobs", 5, frames=600, pixels=64, noise=0.05, total_angle=1080.0)
    found = estimate(images, truth.time)
    assert found.identifiable
    assert np.rad2deg(align(found.R, truth.R)[0].mean()) < 0.5


@pytest.mark.parametrize(
    ("phantom", "noise", "first", "last"),
    [
        ("grain", 0.01, (22.0, 22.0), (28.0, 28.0)),
        ("blobs", 0.01, (22.0, 22.0), (22.0, 22.0)),
        ("blobs", 0.5, (16.0, 20.0), (16.0, 20.0)),
    ],
)
def test_the_band_ends_where_the_object_does_or_in_the_noise(
    phantom: str, noise: float, first: tuple[float, float], last: tuple[float, float]
) -> None:
    images, truth = render("tumbling", phantom, 3, frames=60, pixels=96, noise=noise)
    low = joint.read_front_end(
        Frames.from_array(images), time=truth.time, pixel_size=PIXEL, line_band=8.0, fine_band=28.0
    ).low
    bands = np.array(joint._bands(low)) * low.radius
    for band, (least, most) in zip(bands, (first, last), strict=True):
        assert least - 1e-9 <= band <= most + 1e-9


@pytest.mark.usefixtures("few_starts")
def test_misfits_of_frames_do_not_depend_on_the_band() -> None:
    images, truth = render("single-axis", "blobs", 2)
    frames = Frames.from_array(images)
    narrow, wide = (
        joint.find_motion(frames, MotionConfig(band=band), time=truth.time, pixel_size=PIXEL)
        .refined()
        .motion()
        .residual
        for band in (17 / 3.4, 22 / 3.4)
    )
    assert np.median(narrow) == pytest.approx(np.median(wide), rel=0.05)
