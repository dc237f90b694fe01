"""Motions against their definition RᵀR' = [ω]×, closed forms, and the gauge of the truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from trapcli.simulation.motions import (
    DegenerateThird,
    Drift,
    PaperMotion,
    PaperSpecial,
    SingleAxis,
    Still,
    Thermal,
    Tumbling,
    integrate,
    true_motion,
)
from trapcli.simulation.render import simulate

DURATION = 2.0
TUMBLING = Tumbling.random(
    np.random.default_rng(1),
    total_angle=300.0,
    duration=DURATION,
    drift=Drift.random(np.random.default_rng(2), amplitude=0.8, duration=DURATION),
)
IN_PLANE = SingleAxis.from_turns(turns=1.2, duration=DURATION)
TILTED = SingleAxis.from_turns(turns=-0.7, duration=DURATION, azimuth=-60.0, tilt=15.0)
THIRD = DegenerateThird(general=TUMBLING, single=IN_PLANE, duration=DURATION)
ALL = {
    "paper": PaperMotion(),
    "special": PaperSpecial(),
    "still": Still(),
    "in-plane": IN_PLANE,
    "tilted": TILTED,
    "tumbling": TUMBLING,
    "third": THIRD,
}
T = np.linspace(0.0, DURATION, 201)
# of frames that lie apart from those times: ω jumps at every frame
KICKED = Thermal.random(
    np.random.default_rng(4), TUMBLING, np.linspace(0.0, DURATION, 14), diffusion=0.2, shaking=0.3
)


@pytest.mark.parametrize("motion", [*ALL.values(), KICKED], ids=[*ALL, "kicked"])
def test_rotations_solve_their_differential_equation(motion):
    h = 2e-4
    # R is 1 at the first time, so all five times of a stencil go into one call
    t = (T[1:-1, None] + h * np.arange(-2, 3)).ravel()
    R = motion.rotations(np.sort(t)).reshape(-1, 5, 3, 3)
    slope = (R[:, 0] - 8 * R[:, 1] + 8 * R[:, 3] - R[:, 4]) / (12 * h)
    expected = np.cross(motion.omega(T[1:-1])[:, :, None], np.eye(3)[None], axisa=1, axisb=1, axisc=1)
    np.testing.assert_allclose(R[:, 2].transpose(0, 2, 1) @ slope, expected, atol=1e-7)


@pytest.mark.parametrize("motion", ALL.values(), ids=ALL)
def test_rotations_stay_rotations_and_start_at_1(motion):
    R = motion.rotations(T + 0.3)
    np.testing.assert_array_equal(R[0], np.eye(3))
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(T), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)


@pytest.mark.parametrize("motion", ALL.values(), ids=ALL)
@pytest.mark.parametrize("count", [2, 40])
def test_integration_agrees_with_runge_kutta_however_few_the_times(motion, count):
    def derivative(t, y):
        omega = motion.omega(np.array([t]))[0]
        return (y.reshape(3, 3) @ np.cross(omega, np.eye(3), axisb=0, axisc=0)).ravel()

    # stop where the fade of the third begins and ends, since the method assumes smoothness
    y = np.eye(3).ravel()
    for start, stop in zip(
        [0.0, DURATION / 3, 2 * DURATION / 3], [DURATION / 3, 2 * DURATION / 3, DURATION], strict=True
    ):
        y = solve_ivp(derivative, (start, stop), y, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    R = integrate(motion, np.linspace(0.0, DURATION, count))
    np.testing.assert_allclose(R[-1], y.reshape(3, 3), atol=5e-12)


def test_integration_of_one_frame_is_1():
    np.testing.assert_array_equal(integrate(TUMBLING, np.zeros(1)), np.eye(3)[None])


@pytest.mark.parametrize("motion", [IN_PLANE, TILTED, PaperSpecial(), Still()])
def test_closed_forms_agree_with_the_integration(motion):
    t = T + 0.17
    np.testing.assert_allclose(motion.rotations(t), integrate(motion, t), atol=1e-11)


def test_paper_special_is_the_rotation_in_the_paper_with_its_second_row_reversed():
    alpha, omega_3 = 3.0, 1.7
    R = PaperSpecial(alpha=alpha, omega_3=omega_3, phi=0.0).rotations(T)
    c, s, ca, sa = np.cos(omega_3 * T), np.sin(omega_3 * T), np.cos(alpha * T), np.sin(alpha * T)
    rows = [[c, -s, 0 * T], [s * ca, c * ca, -sa], [s * sa, c * sa, ca]]
    np.testing.assert_allclose(R, np.moveaxis(np.array(rows), 2, 0), atol=1e-14)


def test_paper_motion_is_the_papers():
    motion = PaperMotion()
    t = np.array([0.0, 0.25])
    omega = motion.omega(t)
    np.testing.assert_allclose(np.hypot(omega[:, 0], omega[:, 1]), [1.0, 1.625])
    np.testing.assert_allclose(np.arctan2(omega[:, 1], omega[:, 0]), [np.pi / 3, np.pi / 4 + np.pi / 3])
    np.testing.assert_allclose(omega[:, 2], [0.5 + np.sqrt(0.5), 0.5 + np.sqrt(1.75)])
    np.testing.assert_allclose(
        motion.T(t)[1], [np.cos(1.5) * np.cos(3.0), np.cos(1.5) * np.sin(3.0), np.sin(0.25)]
    )


def test_single_axis_turns_as_told_about_a_fixed_axis():
    np.testing.assert_allclose(IN_PLANE.angle(np.array([DURATION])), 2 * np.pi * 1.2)
    np.testing.assert_allclose(IN_PLANE.axis, [np.cos(np.pi / 6), 0.5, 0.0], atol=1e-15)
    assert TILTED.axis[2] == pytest.approx(np.sin(np.deg2rad(15)))
    R = TILTED.rotations(T)
    np.testing.assert_allclose(R @ TILTED.axis, np.tile(TILTED.axis, (len(T), 1)), atol=1e-14)
    speed = np.linalg.norm(IN_PLANE.omega(np.linspace(0, DURATION, 1001)), axis=1)
    assert speed.max() / speed.min() == pytest.approx(1.3 / 0.7, rel=1e-4)


def test_tumbling_turns_by_the_total_angle():
    t = np.linspace(0.0, DURATION, 20001)
    path = np.trapezoid(np.linalg.norm(TUMBLING.omega(t), axis=1), t)
    assert np.rad2deg(path) == pytest.approx(300.0, rel=1e-6)


def test_middle_third_turns_about_one_axis_in_the_image_and_omega_is_continuous():
    middle = THIRD.omega(np.linspace(DURATION / 3, 2 * DURATION / 3, 50))
    np.testing.assert_allclose(middle[:, 2], 0.0, atol=1e-14)
    np.testing.assert_allclose(np.cross(middle, IN_PLANE.axis), 0.0, atol=1e-14)
    omega = THIRD.omega(np.linspace(0.0, DURATION, 20001))
    assert np.abs(np.diff(omega, axis=0)).max() < 1e-2
    assert np.abs(omega[0, 2]) > 0.1


@pytest.mark.parametrize("motion", ALL.values(), ids=ALL)
def test_truth_is_in_the_gauge_of_the_result(motion):
    center = np.array([0.3, -0.2, 5.0])
    truth = true_motion(motion, center, T)
    np.testing.assert_array_equal(truth.R[0], np.eye(3))
    np.testing.assert_array_equal(truth.T[0], 0.0)
    np.testing.assert_allclose(truth.center, center[:2] - motion.T(T)[:, :2])
    np.testing.assert_allclose(truth.T, truth.center[0] - truth.center)
    np.testing.assert_allclose(truth.T, (motion.T(T) - motion.T(T[:1]))[:, :2], atol=1e-14)
    assert truth.truth
    assert truth.valid.all()
    assert not truth.flags.any()
    assert (truth.alpha >= 0).all()
    for errors in (
        truth.T_errors,
        truth.phi_errors,
        truth.omega_3_errors,
        truth.alpha_errors,
        truth.R_errors,
    ):
        assert np.isnan(errors).all()
    if isinstance(motion, Still):
        assert np.isnan(truth.phi).all()
        return
    assert 0 <= truth.phi[0] < np.pi
    assert np.abs(np.diff(truth.phi)).max() < 1.0


@pytest.mark.parametrize("azimuth", [-170.0, -60.0, 0.0, 45.0, 170.0, 190.0, 300.0])
def test_truth_of_either_mirror_is_a_solution_of_its_own(azimuth):
    motion = SingleAxis.from_turns(turns=0.5, duration=DURATION, azimuth=azimuth, tilt=20.0)
    truth = true_motion(motion, np.zeros(3), T)
    assert 0 <= truth.phi[0] < np.pi
    expected = Rotation.from_rotvec(
        np.stack([truth.omega_1, truth.omega_2, truth.omega_3], axis=-1)
        / np.linalg.norm(motion.omega(T), axis=1)[:, None]
        * motion.angle(T)[:, None]
    )
    np.testing.assert_allclose(truth.R, expected.as_matrix(), atol=1e-12)
    mirrored = np.allclose(truth.omega_1, -motion.omega(T)[:, 0])
    sign = np.array([1.0, 1.0, -1.0]) if mirrored else np.ones(3)
    np.testing.assert_allclose(truth.R, motion.rotations(T) * np.outer(sign, sign), atol=1e-14)


def test_phi_is_undefined_where_alpha_vanishes_and_the_gauge_follows_the_first_that_is():
    class Late(Still):
        def omega(self, t):
            speed = np.where(t < 0.5, 0.0, (t - 0.5) ** 3)
            return np.multiply.outer(speed, [0.0, -1.0, 0.0]) + np.array([0.0, 0.0, 1.0])

    truth = true_motion(Late(), np.zeros(3), T)
    known = np.isfinite(truth.phi)
    np.testing.assert_array_equal(known, truth.alpha > 1e-6 * np.sqrt(1 + 1.5**6))
    np.testing.assert_allclose(truth.phi[known], np.pi / 2)


def test_drift_is_smooth_and_of_the_given_size():
    sizes = [
        np.abs(Drift.random(np.random.default_rng(seed), amplitude=2.0, duration=DURATION)(T)).max()
        for seed in range(20)
    ]
    assert 0.2 < np.median(sizes) < 2.0
    assert max(sizes) < 2.5


def test_thermal_motion_is_a_random_walk_of_rotations_and_white_in_translation():
    time = np.arange(4000) * 0.01
    kicked = Thermal.random(np.random.default_rng(5), Still(), time, diffusion=0.02, shaking=0.3)
    R = kicked.rotations(time)
    np.testing.assert_array_equal(R[0], np.eye(3))
    kicks = Rotation.from_matrix(R[:-1].transpose(0, 2, 1) @ R[1:]).as_rotvec()
    np.testing.assert_allclose(kicks.std(axis=0), 0.02, rtol=0.04)
    np.testing.assert_allclose(np.corrcoef(kicks[:-1].T, kicks[1:].T), np.eye(6), atol=0.06)
    shifts = kicked.T(time)
    np.testing.assert_allclose(shifts.std(axis=0), 0.3, rtol=0.04)
    np.testing.assert_allclose(np.corrcoef(shifts[:-1].T, shifts[1:].T), np.eye(6), atol=0.06)


def test_thermal_motion_leaves_the_rest_as_it_is():
    quiet = simulate(seed=3, stack={"frames": 8}, motion={"kind": "tumbling"})[1]
    kicked = simulate(seed=3, stack={"frames": 8}, motion={"kind": "tumbling", "shaking": 0.1})[1]
    np.testing.assert_allclose(kicked.R, quiet.R, atol=1e-12)
    assert np.abs(kicked.T - quiet.T).max() > 0.01
