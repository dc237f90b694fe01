"""The whole chain on the paper's example, and on motions that it can't or can only partly know."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trapcli.config import MotionConfig
from trapcli.errors import ConfigError, InputError
from trapcli.motion.paper import estimate_paper
from trapcli.result.motion import Flag, Motion
from trapcli.simulation.motions import (
    Drift,
    PaperMotion,
    PaperSpecial,
    RigidMotion,
    SingleAxis,
    Still,
    true_motion,
)
from trapcli.simulation.phantoms import Blobs, PaperPhantom, Phantom
from trapcli.stack.frames import Frames

DRIFT = Drift.random(np.random.default_rng(2), amplitude=0.4, duration=0.3)


def stored(frames: np.ndarray, dtype: str) -> np.ndarray:
    if dtype == "uint16":
        return np.round(frames / frames.max() * 65535).astype(np.uint16)
    return frames.astype(dtype)


def estimate(frames: np.ndarray, time: np.ndarray, pixel_size: float) -> Motion:
    return estimate_paper(Frames.from_array(frames), MotionConfig(), time=time, pixel_size=pixel_size)


@dataclass(frozen=True)
class Errors:
    T: np.ndarray
    phi: np.ndarray
    omega_3: np.ndarray
    alpha: np.ndarray
    R: np.ndarray

    @classmethod
    def of(cls, found: Motion, phantom: Phantom, motion: RigidMotion) -> Errors:
        true = true_motion(motion, phantom.center, found.time)
        turn = Rotation.from_matrix(found.R).inv() * Rotation.from_matrix(true.R)
        return cls(
            np.abs(found.T - true.T).max(axis=1),
            np.abs(found.phi - true.phi),
            np.abs(found.omega_3 - true.omega_3),
            np.abs(found.alpha / true.alpha - 1),
            np.rad2deg(turn.magnitude()),
        )


BARS = {  # stored as: T, φ, ω₃, α, R; the figure that counts: max or median
    "float64": ((1e-9, "max"), (1e-8, "max"), (1e-8, "max"), (1e-4, "max"), (1e-4, "max")),
    "float32": ((1e-6, "max"), (1e-5, "max"), (1e-5, "max"), (1e-3, "median"), (0.02, "max")),
    "uint16": ((1e-4, "max"), (2e-4, "median"), (2e-4, "median"), (0.02, "median"), (0.3, "max")),
}


def check_bars(errors: Errors, dtype: str) -> None:
    figures = (errors.T, errors.phi, errors.omega_3, errors.alpha, errors.R)
    for figure, (bar, kind) in zip(figures, BARS[dtype], strict=True):
        # the first and the last 10 frames have windows on one side only
        inner = figure[10:-10]
        assert (inner.max() if kind == "max" else np.median(inner)) < bar
    if dtype == "float64":
        assert np.median(errors.alpha) < 1e-6


@pytest.fixture(scope="module")
def paper_example(render):  # type: ignore[no-untyped-def]
    """200 frames over the paper's half second, of 128² pixels."""
    time = np.arange(200) * 0.0025
    return time, render(PaperPhantom(), PaperMotion(), time, 128, 0.2)


@pytest.mark.parametrize("dtype", ["float64", "float32", "uint16"])
def test_paper_example_at_reduced_size(paper_example, dtype: str) -> None:  # type: ignore[no-untyped-def]
    time, frames = paper_example
    found = estimate(stored(frames, dtype), time, 0.2)
    errors = Errors.of(found, PaperPhantom(), PaperMotion())
    if dtype == "uint16":
        # a fifth of the frames: more noise by its root, and steeper changes
        assert np.median(errors.phi) < 4e-4
        assert np.median(errors.omega_3) < 4e-4
        assert np.median(errors.alpha) < 0.02
        assert errors.R.max() < 0.3
    else:
        check_bars(errors, dtype)
    assert found.identifiable
    assert found.valid.all()
    assert not found.flags.any()
    assert np.abs(np.linalg.det(found.R) - 1).max() < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32", "uint16"])
def test_paper_example_in_full(render, dtype: str) -> None:  # type: ignore[no-untyped-def]
    time = np.arange(1000) * 0.0005
    frames = stored(render(PaperPhantom(), PaperMotion(), time, 128, 0.2), dtype)
    start = clock.perf_counter()
    found = estimate(frames, time, 0.2)
    assert clock.perf_counter() - start < 60
    check_bars(Errors.of(found, PaperPhantom(), PaperMotion()), dtype)


@pytest.mark.parametrize("sigma", [0.0, 1e-4])
def test_another_object_and_errors_that_cover(render, blobs, two_turns, sigma: float) -> None:  # type: ignore[no-untyped-def]
    time = np.arange(300) * 0.004
    x = (np.arange(64) - 32) * 0.25
    R = two_turns.rotations(time)
    frames = np.array([blobs.project(r, np.zeros(3), x, x) for r in R[0].T @ R])
    noise = sigma * frames.max() * np.random.default_rng(0).standard_normal(frames.shape)
    found = estimate(frames + noise, time, 0.25)
    omega = two_turns.omega(time)
    inner = slice(20, -20)
    off = {
        "phi": (found.phi - np.arctan2(omega[:, 1], omega[:, 0])) / found.phi_errors,
        "omega_3": (found.omega_3 - omega[:, 2]) / found.omega_3_errors,
        "alpha": (found.alpha - np.hypot(omega[:, 0], omega[:, 1])) / found.alpha_errors,
    }
    if sigma:
        for pull in off.values():
            assert np.nanmedian(np.abs(pull[inner])) < 2.5
    else:
        assert np.abs(found.phi - np.arctan2(omega[:, 1], omega[:, 0]))[inner].max() < 1e-8
        assert np.abs(found.alpha / np.hypot(omega[:, 0], omega[:, 1]) - 1)[inner].max() < 1e-4


def test_landscape_is_least_at_phi(paper_example) -> None:  # type: ignore[no-untyped-def]
    found = estimate(paper_example[1], paper_example[0], 0.2)
    assert found.landscape is not None
    assert 1 in found.landscape.frame
    least = found.landscape.phi[found.landscape.values.argmin(axis=1)]
    off = (least - found.phi[found.landscape.frame] + np.pi / 2) % np.pi - np.pi / 2
    assert np.abs(off).max() < 2 * np.pi / len(found.landscape.phi)


@pytest.mark.parametrize("dtype", ["float64", "uint16"])
def test_third_order_is_silent_in_the_papers_special_example(render, dtype: str) -> None:  # type: ignore[no-untyped-def]
    time = np.arange(150) * 0.002
    motion = PaperSpecial(drift=DRIFT)
    found = estimate(stored(render(PaperPhantom(), motion, time, 128, 0.2), dtype), time, 0.2)
    true = true_motion(motion, PaperPhantom().center, time)
    assert (found.flags & Flag.THIRD_ORDER_SILENT > 0).all()
    assert np.isnan(found.alpha).all()
    assert not found.identifiable
    assert "omega_3 = -sigma" in found.verdict
    # what the first order says is right all the same
    assert np.median(np.abs(found.phi - true.phi)) < 1e-3
    assert np.median(np.abs(found.omega_3 - true.omega_3)) < 1e-3


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_still_object(render, blobs, noise: float) -> None:  # type: ignore[no-untyped-def]
    time = np.arange(120) * 0.0025
    frames = render(blobs, Still(drift=DRIFT), time, 80, 0.25)
    frames += noise * frames.max() * np.random.default_rng(1).standard_normal(frames.shape)
    found = estimate(frames, time, 0.25)
    assert not found.identifiable
    assert "nothing turns" in found.verdict
    assert (found.flags & Flag.ALPHA_ZERO > 0).mean() > 0.9
    assert np.isnan(found.alpha).all()
    assert np.isnan(found.phi).mean() > 0.9
    true = true_motion(Still(drift=DRIFT), blobs.center, time)
    assert np.abs(found.T - true.T).max() < (0.03 if noise else 1e-9)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_ball(render, noise: float) -> None:  # type: ignore[no-untyped-def]
    ball = Blobs(np.ones(1), np.zeros((1, 3)), np.eye(3)[None])
    time = np.arange(120) * 0.0025
    frames = render(ball, PaperMotion(), time, 64, 0.25)
    frames += noise * frames.max() * np.random.default_rng(1).standard_normal(frames.shape)
    found = estimate(frames, time, 0.25)
    assert not found.identifiable
    assert "symmetry" in found.verdict
    assert not found.valid.any()
    assert np.isnan(found.alpha).all()
    assert np.isnan(found.omega_3).all()
    assert np.isnan(found.R[1:]).all()


def test_body_of_revolution(render) -> None:  # type: ignore[no-untyped-def]
    positions = np.outer([-2.0, -0.5, 0.4, 1.9], [0.4, 0.3, 0.7])
    body = Blobs(np.array([1.0, 0.4, 0.8, 0.5]), positions, np.full((4, 1, 1), 0.5) * np.eye(3))
    time = np.arange(120) * 0.0025
    found = estimate(render(body, PaperMotion(), time, 80, 0.25), time, 0.25)
    assert not found.identifiable
    assert "symmetry" in found.verdict


def test_turn_about_the_optical_axis(render, blobs) -> None:  # type: ignore[no-untyped-def]
    time = np.arange(150) * 0.002
    motion = SingleAxis(axis=np.array([0.0, 0.0, 1.0]), rate=4.0, unevenness=0.3, period=0.3)
    found = estimate(render(blobs, motion, time, 72, 0.25), time, 0.25)
    assert (found.flags == Flag.ALPHA_ZERO).all()
    assert np.isnan(found.phi).all()
    assert np.abs(found.omega_3 - motion.omega(time)[:, 2]).max() < 1e-6
    assert found.identifiable
    assert np.abs(found.R - motion.rotations(time)).max() < 1e-8


def test_blank_frames_are_bridged(paper_example) -> None:  # type: ignore[no-untyped-def]
    time, frames = paper_example
    holed = frames.copy()
    holed[[50, 51, 120]] = 0
    found = estimate(holed, time, 0.2)
    blank = np.zeros(200, bool)
    blank[[50, 51, 120]] = True
    assert np.array_equal(found.flags & Flag.BLANK > 0, blank)
    for series in (found.T[:, 0], found.phi, found.omega_3, found.alpha, found.residual):
        assert np.isnan(series[blank]).all()
    errors = Errors.of(found, PaperPhantom(), PaperMotion())
    assert np.nanmax(errors.phi) < 1e-4
    assert errors.R.max() < 1e-2


def test_a_fixed_window_and_band(paper_example) -> None:  # type: ignore[no-untyped-def]
    time, frames = paper_example
    config = MotionConfig(method="paper", window=31, band=2.5)
    told: list[str] = []
    found = estimate_paper(
        Frames.from_array(frames),
        config,
        time=time,
        pixel_size=0.2,
        progress=lambda *what: told.append(what[0]),
    )
    assert Errors.of(found, PaperPhantom(), PaperMotion()).R.max() < 1e-2
    assert {"centers", "reduced map", "rotation"} <= set(told)


def test_what_makes_no_sense_is_refused(paper_example) -> None:  # type: ignore[no-untyped-def]
    time, frames = paper_example
    for config in (MotionConfig(window=3), MotionConfig(band=-1.0), MotionConfig(window=-5)):
        with pytest.raises(ConfigError, match="window"):
            estimate_paper(Frames.from_array(frames), config, time=time)
    with pytest.raises(InputError, match="too few frames"):
        estimate(frames[:4], time[:4], 0.2)
    with pytest.raises(InputError, match="too few frames"):
        estimate(np.zeros((50, 20, 20)), np.arange(50.0), 1.0)


@pytest.mark.parametrize("n", [5, 7, 12])
def test_few_frames_do_not_break_it(paper_example, n: int) -> None:  # type: ignore[no-untyped-def]
    time, frames = paper_example
    found = estimate(frames[:n], time[:n], 0.2)
    assert len(found) == n
    assert np.isfinite(found.T).all()


def test_an_orientation_that_noise_has_lost_is_not_given(paper_example) -> None:  # type: ignore[no-untyped-def]
    time, frames = paper_example
    noise = np.random.default_rng(0).normal(scale=0.01 * frames.max(), size=frames.shape)
    found = estimate(frames + noise, time, 0.2)
    lost = np.isnan(found.R).any(axis=(1, 2))
    assert lost.sum() > 50
    assert np.isnan(found.R_errors[lost]).all()
    assert not found.valid[lost].any()
    assert not found.identifiable
    assert np.rad2deg(np.linalg.norm(found.R_errors[~lost], axis=1).max(initial=0.0)) <= 20
