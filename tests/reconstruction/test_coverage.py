"""What a motion shows of Fourier space, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trapcli.reconstruction.coverage import cover
from trapcli.simulation.motions import PaperMotion


def about(axis: list[float], degrees: float, frames: int = 100) -> np.ndarray:
    angle = np.deg2rad(np.linspace(0, degrees, frames))
    return Rotation.from_rotvec(angle[:, None] * np.array(axis) / np.linalg.norm(axis)).as_matrix()


@pytest.mark.parametrize("degrees", [20, 90, 150])
def test_part_of_a_turn_about_an_axis_in_the_image(degrees):
    """Planes through one line sweep over a wedge: the share is that of half a turn."""
    found = cover(about([1, 0.5, 0], degrees))
    assert found.share == pytest.approx(degrees / 180, abs=0.01)
    # the widest cone in the wedge that is left
    assert np.rad2deg(found.missing_angle) == pytest.approx(90 - degrees / 2, abs=2)
    assert abs(found.missing_axis @ [1, 0.5, 0]) < 0.15
    assert found.limited == bool(found.warning)


def test_half_a_turn_shows_everything():
    found = cover(about([1, 0, 0], 181))
    assert found.share == 1
    assert found.missing_angle == 0
    assert np.isnan(found.missing_axis).all()
    assert not found.limited
    assert found.warning == ""


def test_axis_out_of_the_image_leaves_a_cone():
    """A whole turn about an axis at an angle to the image: a cone about it is never seen."""
    tilt = 35.0
    axis = [np.cos(np.deg2rad(tilt)), 0, np.sin(np.deg2rad(tilt))]
    found = cover(about(axis, 360))
    # the planes' normals keep the angle 90° − tilt to the axis, so what lies closer than tilt to it is unseen
    assert np.rad2deg(found.missing_angle) == pytest.approx(tilt, abs=2)
    assert abs(found.missing_axis @ axis) > 0.999
    assert found.share == pytest.approx(np.cos(np.deg2rad(tilt)), abs=0.01)
    assert f"{100 * found.share:.0f} %" in found.warning


def test_rotation_in_the_image_shows_one_plane():
    found = cover(about([0, 0, 1], 360))
    assert found.share == 0
    assert found.missing_angle == pytest.approx(np.pi / 2)


def test_frames_without_rotation_are_bridged_and_jumps_are_not():
    R = about([1, 0, 0], 60, 61)
    R[10:12] = np.nan
    assert cover(R).share == pytest.approx(1 / 3, abs=0.01)
    jump = np.concatenate([about([1, 0, 0], 10, 11), about([1, 0, 0], 10, 11) @ about([1, 0, 0], 90, 2)[1]])
    assert cover(jump).share == pytest.approx(20 / 180, abs=0.01)


def test_the_papers_motion():
    """Against a count of random directions on a motion sampled 25 times as densely."""
    motion = PaperMotion()
    few, many = (motion.rotations(np.linspace(0, 0.5, n)) for n in (200, 5_000))
    direction = np.random.default_rng(0).standard_normal((4000, 3))
    above = direction @ many[:, :, 2].T > 0
    exact = float(np.mean(above.any(axis=1) & ~above.all(axis=1)))
    assert cover(few).share == pytest.approx(exact, abs=0.02)
