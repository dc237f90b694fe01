"""Each exported geometry, followed by a projector of our own, shows the frames again.

The projectors integrate the true object along rays as each program's documentation lays them; none uses R.
"""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trapcli.errors import ConfigError, InputError
from trapcli.reconstruction.alignment import align
from trapcli.reconstruction.geometry import (
    Detector,
    angle_blocks,
    astra_blocks,
    euler_angles,
    npz,
    relion_blocks,
)
from trapcli.reconstruction.single_axis import find_single_axis, require_single_axis
from trapcli.result.motion import Motion

SIZE = 64  # enough pixels for the finest detail: moved frames are interpolated
FRAMES = 30


@pytest.fixture(params=["tumbling", "single-axis"])
def case(request, example):
    return example(request.param, frames=FRAMES, size=SIZE)


@pytest.fixture
def single(example):
    return example("single-axis", frames=FRAMES, size=SIZE)


def detector(case, name="frames.tif"):
    size = case.pixel_size
    return Detector(name, (SIZE, SIZE), size, "µm", case.motion.center / size)


def integrals(case, points, ray):
    """Integrate the object along rays through ``(..., 3)`` points [pixels from its centre]."""
    s = np.arange(-0.4 * SIZE, 0.4 * SIZE)
    at = points[..., None, :] + s[:, None] * ray
    return case.density(at * case.pixel_size).sum(axis=-1) * case.pixel_size


def check(frames, images):
    frames = np.asarray(frames)
    peak = frames.max()
    for shown, frame in zip(images, frames[::9], strict=True):
        np.testing.assert_allclose(shown, frame, atol=0.01 * peak)


def column_row(size=SIZE):
    """Detector pixels from the middle of the detector."""
    x2, x1 = np.meshgrid(*(np.arange(size) - (size - 1) / 2,) * 2, indexing="ij")
    return x1[..., None], x2[..., None]


def test_astra(case):
    """Detector pixel (row, column) lies at d + (column − middle) u + (row − middle) v; rays run along ray."""
    text = "".join(astra_blocks(case.motion, detector(case)))
    rows = np.loadtxt(io.StringIO(text))
    assert rows.shape == (FRAMES, 13)
    np.testing.assert_array_equal(rows[:, 0], case.motion.frame)
    column, row = column_row()
    images = [
        integrals(case, d + column * u + row * v, ray) for ray, d, u, v in rows[::9, 1:].reshape(-1, 4, 3)
    ]
    check(case.frames.to_array(), images)


def star_table(text):
    lines = text[text.index("data_particles") :].splitlines()
    names = [line.split()[0] for line in lines if line.startswith("_rln")]
    rows = [line.split() for line in lines if line and not line.startswith(("_", "data", "loop", "#"))]
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}


def relion_matrix(rot, tilt, psi):
    """RELION's matrix of Euler angles (Heymann et al. 2005), which takes object to image axes."""

    def z(angle):
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])

    c, s = np.cos(tilt), np.sin(tilt)
    return z(psi) @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ z(rot)


def test_relion(case):
    """The image moved by the origin is the projection along the third row of the matrix."""
    table = star_table("".join(relion_blocks(case.motion, detector(case, "frames.mrcs"))))
    assert table["_rlnImageName"][7] == "000008@frames.mrcs"
    names = ("_rlnAngleRot", "_rlnAngleTilt", "_rlnAnglePsi", "_rlnOriginXAngst", "_rlnOriginYAngst")
    rot, tilt, psi, x, y = (np.array(table[name], float) for name in names)
    images = []
    x2, x1 = np.meshgrid(*(np.arange(SIZE) - SIZE // 2,) * 2, indexing="ij")
    for i in range(0, FRAMES, 9):
        A = relion_matrix(*np.deg2rad([rot[i], tilt[i], psi[i]]))
        step = case.pixel_size * 1e4
        plane = np.stack([x1 + x[i] / step, x2 + y[i] / step, np.zeros_like(x1)], axis=-1)
        images.append(integrals(case, plane @ A, A[2]))
    check(case.frames.to_array(), images)


def upright(case):
    found = require_single_axis(case.motion.R)
    turn = np.pi / 2 - found.azimuth
    return align(case.frames, case.motion.center / case.pixel_size, turn=turn).to_array(), turn


def angles(case, **options):
    rows = np.loadtxt(io.StringIO("".join(angle_blocks(case.motion, **options))))
    np.testing.assert_array_equal(rows[:, 0], case.motion.frame)
    return rows[:, 1]


def turned_object(case, turn):
    """The object in axes that were turned with the frames."""
    c, s = np.cos(turn), np.sin(turn)
    Q = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    class Turned:
        pixel_size = case.pixel_size

        def density(self, points):
            return case.density(points @ Q)

    return Turned()


def test_tigre(single):
    """Source and detector turn about z by the angle: columns along (−sin, cos, 0), rows along z.

    TIGRE's z, x and y are the turned object's x2, x3 and x1.
    """
    frames, turn = upright(single)
    shown = turned_object(single, turn)
    x2, x1 = np.meshgrid(*(np.arange(SIZE) - SIZE // 2,) * 2, indexing="ij")
    images = []
    for angle in angles(single, sign=1, program="TIGRE")[::9]:
        u, ray = np.array([-np.sin(angle), np.cos(angle), 0]), np.array([np.cos(angle), np.sin(angle), 0])
        xyz = x1[..., None] * u + x2[..., None] * np.array([0, 0, 1.0])
        images.append(integrals(shown, xyz[..., [1, 2, 0]], ray[[1, 2, 0]]))
    check(frames, images)


def test_odtbrain(single):
    """The detector's x axis lies along (cos, 0, sin) of x, y, z, its y axis along y."""
    frames, turn = upright(single)
    shown = turned_object(single, turn)
    x2, x1 = np.meshgrid(*(np.arange(SIZE) - SIZE // 2,) * 2, indexing="ij")
    images = []
    for angle in angles(single, sign=-1, program="ODTbrain")[::9]:
        u, ray = np.array([np.cos(angle), 0, np.sin(angle)]), np.array([-np.sin(angle), 0, np.cos(angle)])
        images.append(integrals(shown, x1[..., None] * u + x2[..., None] * np.array([0, 1.0, 0]), ray))
    check(frames, images)


def test_aligned_frames_have_no_shift(case):
    aligned = align(case.frames, case.motion.center / case.pixel_size).to_array()
    there = Detector("aligned.tif", (SIZE, SIZE), case.pixel_size, "µm", np.zeros((FRAMES, 2)))
    rows = np.loadtxt(io.StringIO("".join(astra_blocks(case.motion, there))))
    column, row = column_row()
    images = [
        integrals(case, d + column * u + row * v, ray) for ray, d, u, v in rows[::9, 1:].reshape(-1, 4, 3)
    ]
    check(aligned, images)


def test_euler_angles_of_any_rotation():
    R = Rotation.random(200, rng=np.random.default_rng(0)).as_matrix()
    special = Rotation.from_euler("ZYZ", [[0, 0, 0], [50, 0, 20], [50, 180, 20], [0, 90, 0]], degrees=True)
    R = np.concatenate([R, special.as_matrix()])
    for rotation, angle in zip(R, euler_angles(R), strict=True):
        np.testing.assert_allclose(relion_matrix(*angle), rotation.T, atol=1e-9)


def test_frames_without_valid_motion_are_left_out(case):
    R, valid = case.motion.R.copy(), case.motion.valid.copy()
    R[3], valid[5] = np.nan, 0
    motion = dataclasses.replace(case.motion, R=R, valid=valid)
    rows = np.loadtxt(io.StringIO("".join(astra_blocks(motion, detector(case)))))
    assert sorted(set(range(FRAMES)) - set(rows[:, 0].astype(int))) == [3, 5]
    names = star_table("".join(relion_blocks(motion, detector(case))))["_rlnImageName"]
    assert "000004@frames.tif" not in names
    assert len(names) == FRAMES - 2
    none = dataclasses.replace(motion, valid=np.zeros(FRAMES, np.uint8))
    with pytest.raises(InputError, match="no frame has a valid motion"):
        next(astra_blocks(none, detector(case)))


def test_relion_needs_squares(case):
    wide = dataclasses.replace(detector(case), shape=(SIZE, SIZE + 2))
    with pytest.raises(InputError, match="square"):
        next(relion_blocks(case.motion, wide))


def test_axis_and_angles_in_closed_form():
    angle = np.linspace(0, 7, 50)
    axis = np.array([0.6, -0.8, 0.0])
    R = Rotation.from_rotvec(angle[:, None] * axis).as_matrix()
    R[7] = np.nan
    found = find_single_axis(R)
    sign = np.sign(found.axis @ axis)
    np.testing.assert_allclose(found.axis, sign * axis, atol=1e-12)
    np.testing.assert_allclose(np.delete(found.angle, 7), np.delete(sign * angle, 7), atol=1e-9)
    assert np.isnan(found.angle[7])
    assert found.deviation < 1e-9


def test_motions_that_have_no_single_axis(example):
    with pytest.raises(ConfigError, match=r"leaves the best one by \d"):
        require_single_axis(example("tumbling", frames=FRAMES, size=SIZE).motion.R)
    with pytest.raises(ConfigError, match="leaves the image plane by 30"):
        require_single_axis(example("single-axis", frames=FRAMES, size=SIZE, tilt=30.0).motion.R)
    with pytest.raises(ConfigError, match="hardly anything turns"):
        require_single_axis(np.tile(np.eye(3), (9, 1, 1)))


def test_npz_holds_the_motion(make_motion):
    motion: Motion = make_motion(30)
    with np.load(io.BytesIO(npz(motion))) as archive:
        np.testing.assert_array_equal(archive["R"], motion.R)
        np.testing.assert_array_equal(archive["T"], motion.T)
        np.testing.assert_allclose(
            Rotation.from_quat(archive["quaternion"]).as_matrix(), motion.R, atol=1e-12
        )
        assert archive["length_unit"] == "µm"
        assert archive["identifiable"]
