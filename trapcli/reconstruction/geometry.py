"""The motion in the conventions of other programs; ``docs/reconstruction.md`` has the formulas.

In all of them the object's centre is the origin. With the frames' pixel p = (p₁, p₂, 0) from the object's
centre, a frame shows ``∫ u(R (p + s e₃)) ds``: R e₁ and R e₂ are the detector's axes and R e₃ the ray, in the
object's axes.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trapcli.errors import InputError
from trapcli.reconstruction.single_axis import require_single_axis
from trapcli.reconstruction.units import ANGSTROMS
from trapcli.result.hdf5 import quaternions
from trapcli.result.motion import Motion

Array = NDArray[np.float64]

_LOCKED = 1e-6  # sine of the tilt below which only rot + psi is defined


@dataclass(frozen=True)
class Detector:
    """The frames that a geometry is for.

    Attributes
    ----------
    name:
        File of the frames.
    shape:
        ``(H, W)``.
    pixel_size, unit:
        Edge of a pixel.
    center:
        ``(N, 2)`` of the object in each frame [pixels from pixel (H // 2, W // 2)].
    """

    name: str
    shape: tuple[int, int]
    pixel_size: float
    unit: str
    center: Array


def usable(motion: Motion) -> NDArray[np.intp]:
    """Return the positions of the frames whose motion is known and valid.

    Raises
    ------
    InputError
        Where there are none.
    """
    known = np.isfinite(motion.R).all(axis=(1, 2)) & np.isfinite(motion.center).all(axis=1)
    found = np.flatnonzero(known & (motion.valid > 0))
    if not len(found):
        raise InputError("no frame has a valid motion")
    return found


def npz(motion: Motion) -> bytes:
    """Return all series of a motion as a NumPy archive; the names are those of `Motion`."""
    # fmt: off
    names = (
        "time", "frame", "T", "T_errors", "center", "phi", "phi_errors", "omega_1", "omega_2", "omega_3",
        "omega_3_errors", "alpha", "alpha_errors", "R", "R_errors", "valid", "flags", "residual",
        "time_unit", "length_unit", "identifiable", "verdict",
    )
    # fmt: on
    file = io.BytesIO()
    arrays = {name: np.asarray(getattr(motion, name)) for name in names}
    np.savez_compressed(file, allow_pickle=False, quaternion=quaternions(motion.R), **arrays)
    return file.getvalue()


def astra_vectors(motion: Motion, detector: Detector) -> tuple[NDArray[np.intp], Array]:
    """Return the geometry vectors of ASTRA's ``parallel3d_vec``.

    Returns
    -------
    index:
        ``(M,)`` positions of the usable frames.
    vectors:
        ``(M, 12)`` ray, middle of the detector, step from column to column, step from row to row; x, y, z of
        ASTRA are the object's x1, x2, x3 from its centre, in pixels.
    """
    index = usable(motion)
    R = motion.R[index]
    height, width = detector.shape
    # the middle of the detector lies between pixels where the number of these is even
    middle = np.array([(width - 1) / 2 - width // 2, (height - 1) / 2 - height // 2]) - detector.center[index]
    at = np.einsum("nij,nj->ni", R[:, :, :2], middle)
    return index, np.concatenate([R[:, :, 2], at, R[:, :, 0], R[:, :, 1]], axis=1)


def euler_angles(R: Array) -> Array:
    """Return ``(N, 3)`` RELION's rot, tilt and psi [rad]: R = Rz(rot) Ry(tilt) Rz(psi)."""
    tilt = np.arctan2(np.hypot(R[:, 0, 2], R[:, 1, 2]), R[:, 2, 2])
    locked = np.sin(tilt) < _LOCKED
    rot = np.where(locked, 0.0, np.arctan2(R[:, 1, 2], R[:, 0, 2]))
    upright = np.arctan2(R[:, 1, 0], R[:, 1, 1])
    psi = np.where(locked, upright, np.arctan2(R[:, 2, 1], -R[:, 2, 0]))
    return np.stack([rot, tilt, psi], axis=1)


def astra_blocks(motion: Motion, detector: Detector) -> Iterator[str]:
    """Yield a text file of `astra_vectors`, one frame a row after its number."""
    index, vectors = astra_vectors(motion, detector)
    height, width = detector.shape
    yield (
        f"# ASTRA parallel3d_vec for {detector.name}: {height} detector rows, {width} detector columns\n"
        "# lengths in pixels; x, y, z are the object's x1, x2, x3 from its centre\n"
        "# frame rayX rayY rayZ dX dY dZ uX uY uZ vX vY vZ\n"
    )
    for frame, row in zip(motion.frame[index], vectors, strict=True):
        yield " ".join([str(frame), *(f"{value:.12g}" for value in row)]) + "\n"


def relion_blocks(motion: Motion, detector: Detector) -> Iterator[str]:
    """Yield a STAR file of RELION (3.1 and later)."""
    index = usable(motion)
    scale = detector.pixel_size * ANGSTROMS[detector.unit] if detector.unit in ANGSTROMS else 1.0
    height, width = detector.shape
    if height != width:
        raise InputError(
            f"{detector.name}: its frames are {height} x {width} pixels, but RELION needs square ones; "
            "write some with align and pass them as --aligned"
        )
    yield (
        "# version 30001\n# by trap-motion; no transfer function is known: reconstruct without --ctf\n\n"
        "data_optics\n\nloop_\n_rlnOpticsGroup #1\n_rlnOpticsGroupName #2\n_rlnImagePixelSize #3\n"
        "_rlnImageSize #4\n_rlnImageDimensionality #5\n_rlnVoltage #6\n_rlnSphericalAberration #7\n"
        f"_rlnAmplitudeContrast #8\n1 trap {scale:.9g} {width} 2 300 0 1\n\n\n"
        "# version 30001\n\ndata_particles\n\nloop_\n_rlnImageName #1\n_rlnOpticsGroup #2\n_rlnAngleRot #3\n"
        "_rlnAngleTilt #4\n_rlnAnglePsi #5\n_rlnOriginXAngst #6\n_rlnOriginYAngst #7\n_rlnRandomSubset #8\n"
    )
    angles = np.rad2deg(euler_angles(motion.R[index]))
    origins = -detector.center[index] * scale
    for count, (at, row, origin) in enumerate(zip(index, angles, origins, strict=True)):
        numbers = " ".join(f"{value:.9f}" for value in (*row, *origin))
        yield f"{at + 1:06d}@{detector.name} 1 {numbers} {count % 2 + 1}\n"
    yield "\n"


def angle_blocks(motion: Motion, *, sign: int, program: str) -> Iterator[str]:
    """Yield a text file of one angle a frame, for frames that ``align --upright`` wrote.

    Parameters
    ----------
    sign:
        Of the program's angle against the rotation about x2.

    Raises
    ------
    ConfigError
        Where the motion is not about one axis in the image plane.
    """
    index = usable(motion)
    axis = require_single_axis(motion.R)
    yield (
        f"# {program}, angles in rad, for the frames of trap-motion align --upright\n"
        f"# axis in the frames of the stack: {np.rad2deg(axis.azimuth):.6g} degrees from x1 towards x2\n"
        "# frame angle\n"
    )
    for at in index:
        yield f"{motion.frame[at]} {sign * axis.angle[at] + 0.0:.12g}\n"
