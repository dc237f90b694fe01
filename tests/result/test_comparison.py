"""Comparison with the truth: what can't be known is removed exactly, every other error is found."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trapcli.errors import ConfigError, InputError
from trapcli.result.comparison import SIGMA, compare, mirror

EXACT = 1e-12
DEGREES = 1e-5  # rounding of angles near zero


def about(axis, degrees):
    return Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis)).as_matrix()


@pytest.fixture
def truth(make_motion):
    return make_motion(60, truth=True)


def assert_exact(comparison):
    for name, errors in comparison.errors.items():
        assert errors.max < (DEGREES if errors.unit == "deg" else EXACT), name
        assert errors.count == comparison.compared, name


class TestWhatCannotBeKnown:
    def test_nothing_differs(self, truth):
        comparison = compare(truth, truth)
        assert_exact(comparison)
        assert (comparison.common, comparison.compared) == (60, 60)
        assert not comparison.mirrored
        assert comparison.notes == ()

    def test_mirror_solution(self, truth):
        mirrored = dataclasses.replace(truth, R=SIGMA @ truth.R @ SIGMA, phi=truth.phi - 3 * np.pi)
        comparison = compare(mirrored, truth)
        assert_exact(comparison)
        assert comparison.mirrored

    def test_mirror_satisfies_the_definition_of_omega(self, truth):
        """RᵀR' of the mirror solution, by differences, is the ω that its φ, α and ω₃ say."""
        other = mirror(truth)
        middle = Rotation.from_matrix(other.R[:-1].transpose(0, 2, 1) @ other.R[1:]).as_rotvec() / 0.05
        omega = np.stack([other.omega_1, other.omega_2, other.omega_3], axis=1)
        np.testing.assert_allclose(middle, (omega[1:] + omega[:-1]) / 2, atol=1e-3)

    def test_offset_of_T(self, truth):
        comparison = compare(dataclasses.replace(truth, T=truth.T + np.array([300.0, -2.0])), truth)
        assert comparison.errors["T"].max < EXACT
        assert comparison.errors["T_offset_removed"].max < EXACT

    def test_orientation_of_the_object(self, truth):
        turned = dataclasses.replace(truth, R=about([0, 0.6, 0.8], 50) @ truth.R)
        assert_exact(compare(turned, truth))

    def test_whole_turns_of_phi(self, truth):
        comparison = compare(dataclasses.replace(truth, phi=truth.phi + 4 * np.pi), truth)
        assert comparison.errors["phi"].max < EXACT

    def test_result_starts_later(self, truth):
        """Its gauge is fixed at its own first frame, the tenth of the truth; it has every third frame."""
        rows = slice(10, 60, 3)
        later = dataclasses.replace(
            truth,
            **{
                f.name: v[rows]
                for f in dataclasses.fields(truth)
                if isinstance(v := getattr(truth, f.name), np.ndarray)
            },
        )
        later = dataclasses.replace(later, R=later.R[0].T @ later.R, T=later.T - later.T[0])
        comparison = compare(later, truth)
        assert_exact(comparison)
        assert comparison.common == 17


class TestErrorsAreFound:
    def test_rotation_that_grows(self, truth):
        """An error of 0.1° more a frame about one axis: its mean, median and maximum are known."""
        drift = Rotation.from_rotvec(np.radians(np.outer(0.1 * np.arange(60), [0, 0, 1]))).as_matrix()
        comparison = compare(dataclasses.replace(truth, R=drift @ truth.R), truth)
        free, aligned = comparison.errors["R"], comparison.errors["R_aligned"]
        assert free.mean == pytest.approx(2.95)
        assert free.median == pytest.approx(2.95)
        assert free.max == pytest.approx(5.9)
        # the best constant turn is the middle one
        assert aligned.max == pytest.approx(2.95)
        assert aligned.mean == pytest.approx(1.5)

    def test_rotation_error_in_one_frame(self, truth):
        R = truth.R.copy()
        R[20] = R[20] @ about([1, 0, 0], 30)
        errors = compare(dataclasses.replace(truth, R=R), truth).errors["R"]
        assert errors.max == pytest.approx(30)
        assert errors.median < DEGREES
        assert errors.mean == pytest.approx(0.5)

    def test_rates_and_angle(self, truth):
        wrong = dataclasses.replace(
            truth, phi=truth.phi + 0.01, omega_3=truth.omega_3 - 0.2, alpha=1.03 * truth.alpha
        )
        errors = compare(wrong, truth).errors
        assert errors["phi"].mean == pytest.approx(0.01)
        assert errors["omega_3"].median == pytest.approx(0.2)
        assert errors["alpha_relative"].max == pytest.approx(3)
        assert errors["alpha_relative"].unit == "%"
        assert errors["alpha"].max == pytest.approx(0.03 * truth.alpha.max())

    def test_mirror_is_chosen_as_a_whole(self, truth):
        """Half the frames on the other branch are an error of π, not two right halves."""
        phi = truth.phi + np.where(np.arange(60) < 20, np.pi, 0)
        comparison = compare(dataclasses.replace(truth, phi=phi), truth)
        assert not comparison.mirrored
        assert comparison.errors["phi"].max == pytest.approx(np.pi)
        assert comparison.errors["phi"].mean == pytest.approx(np.pi / 3)

    def test_mirror_from_phi_where_no_rotation_is_known(self, truth):
        lost = dataclasses.replace(truth, R=np.full_like(truth.R, np.nan), phi=truth.phi + np.pi)
        comparison = compare(lost, truth)
        assert comparison.mirrored
        assert comparison.errors["phi"].max < EXACT
        assert comparison.errors["R"].count == 0
        assert np.isnan(comparison.errors["R"].mean)

    def test_first_frame_error_shifts_T_only_without_its_offset(self, truth):
        T = truth.T.copy()
        T[0] += [3, 4]
        errors = compare(dataclasses.replace(truth, T=T), truth).errors
        assert errors["T"].median == pytest.approx(5)
        assert errors["T_offset_removed"].median == pytest.approx(5 / 60)


class TestFrames:
    def test_invalid_and_unknown_frames_are_left_out(self, truth):
        alpha, valid = truth.alpha + 100.0 * (np.arange(60) == 5), truth.valid.copy()
        valid[5] = 0
        omega_3 = truth.omega_3.copy()
        omega_3[[7, 8]] = np.nan
        comparison = compare(dataclasses.replace(truth, alpha=alpha, valid=valid, omega_3=omega_3), truth)
        assert (comparison.common, comparison.compared) == (60, 59)
        assert comparison.errors["alpha"].max < EXACT
        assert comparison.errors["omega_3"].count == 57

    def test_first_frames_invalid(self, truth):
        valid, R, T = truth.valid.copy(), truth.R.copy(), truth.T.copy()
        valid[:3], R[:3], T[:3] = 0, np.nan, np.nan
        assert_exact(compare(dataclasses.replace(truth, valid=valid, R=R, T=T), truth))

    def test_no_frame_is_valid(self, truth):
        comparison = compare(dataclasses.replace(truth, valid=np.zeros(60, np.uint8)), truth)
        assert comparison.compared == 0
        assert all(errors.count == 0 and np.isnan(errors.max) for errors in comparison.errors.values())

    def test_trim(self, truth):
        phi = truth.phi.copy()
        phi[[0, 4, 55, 59]] += 1
        wrong = dataclasses.replace(truth, phi=phi)
        assert compare(wrong, truth, trim=4).errors["phi"].max == pytest.approx(1)
        trimmed = compare(wrong, truth, trim=5)
        assert trimmed.common == 50
        assert trimmed.errors["phi"].max < EXACT

    @pytest.mark.parametrize("trim", [-1, 30])
    def test_trim_that_makes_no_sense(self, truth, trim):
        with pytest.raises(ConfigError, match="--trim"):
            compare(truth, truth, trim=trim)

    def test_nothing_in_common(self, truth):
        with pytest.raises(InputError, match="no frame in common"):
            compare(dataclasses.replace(truth, frame=truth.frame + 1000), truth)


class TestUnits:
    def test_result_in_frames_truth_in_seconds(self, truth):
        step = 0.05
        in_frames = dataclasses.replace(
            truth,
            time=truth.time / step,
            omega_3=truth.omega_3 * step,
            alpha=truth.alpha * step,
            time_unit="frame",
        )
        comparison = compare(in_frames, truth)
        assert_exact(comparison)
        assert comparison.errors["omega_3"].unit == "rad/frame"
        assert "converted from s to frame" in comparison.notes[0]

    def test_clocks_that_disagree(self, truth):
        with pytest.raises(InputError, match="--frame-interval"):
            compare(dataclasses.replace(truth, time=truth.time**2, time_unit="frame"), truth)

    def test_lengths_that_cannot_be_converted(self, truth):
        comparison = compare(dataclasses.replace(truth, length_unit="pixel"), truth)
        assert comparison.errors["T"].count == 0
        assert comparison.errors["R"].count == 60
        assert "--pixel-size" in comparison.notes[0]


class TestStatedErrors:
    def test_shares(self, make_motion):
        """Gaussian errors of the stated size lie within 1 and 2 σ as often as they should."""
        n, rng = 4000, np.random.default_rng(3)
        truth = make_motion(n)
        sigma = rng.uniform(0.001, 0.01, n)
        turn = Rotation.from_rotvec(sigma[:, None] * rng.normal(size=(n, 3)))
        result = dataclasses.replace(
            truth,
            phi=truth.phi + sigma * rng.normal(size=n),
            phi_errors=sigma,
            T=truth.T + sigma[:, None] * rng.normal(size=(n, 2)),
            T_errors=np.stack([sigma, sigma], axis=1),
            # the truth is R exp([d]×), so R is the truth times exp(−[d]×)
            R=truth.R @ turn.inv().as_matrix(),
            R_errors=np.repeat(sigma[:, None], 3, axis=1),
        )
        errors = compare(result, truth).errors
        for name in ("phi", "T_offset_removed", "R_aligned"):
            assert errors[name].within_1_sigma == pytest.approx(0.683, abs=0.025), name
            assert errors[name].within_2_sigma == pytest.approx(0.954, abs=0.015), name

    def test_rotation_errors_are_about_lab_axes(self, truth):
        """An error about x1 of the laboratory only: stated for x1 it is covered, stated for x2 it is not."""
        R = truth.R @ about([1, 0, 0], 1.0)
        R[0] = truth.R[0]
        for stated, share in (([1.01, 0.1, 0.1], 1), ([0.1, 1.01, 0.1], (180 - 59) / 180)):
            result = dataclasses.replace(truth, R=R, R_errors=np.radians(np.tile(stated, (60, 1))))
            assert compare(result, truth).errors["R"].within_1_sigma == pytest.approx(share)

    def test_not_stated(self, truth):
        assert np.isnan(compare(truth, truth).errors["phi"].within_1_sigma)
