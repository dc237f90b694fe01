"""Motion about one axis: the axis and the angle of every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.errors import ConfigError

Array = NDArray[np.float64]

TOLERANCE = np.deg2rad(2.0)
"""How far a motion may be from one about a single axis in the image plane."""

_LEAST_TURN = np.deg2rad(5.0)


@dataclass(frozen=True)
class SingleAxis:
    """Rotation R(t) = exp(θ(t) [a]×).

    Attributes
    ----------
    axis:
        ``(3,)`` unit vector a in the lab, a₁ > 0 or a = e₂ nearly.
    angle:
        ``(N,)`` θ, continuous [rad]; NaN where R is not known.
    deviation:
        Largest angle between R and the rotation about the axis [rad].
    """

    axis: Array
    angle: Array
    deviation: float

    @property
    def azimuth(self) -> float:
        """Angle of the axis in the image, from x1 towards x2 [rad]."""
        return float(np.arctan2(self.axis[1], self.axis[0]))

    @property
    def tilt(self) -> float:
        """Angle of the axis out of the image plane [rad]."""
        return float(np.arcsin(np.clip(self.axis[2], -1, 1)))


def find_single_axis(R: Array) -> SingleAxis:
    """Find the axis that the rotations leave in place best.

    Parameters
    ----------
    R:
        ``(N, 3, 3)``, 1 at the first frame; NaN where not known.

    Raises
    ------
    ConfigError
        Where nothing turns far enough to have an axis.
    """
    known = np.isfinite(R).all(axis=(1, 2))
    turns = R[known]
    # Σ |R a − a|² = 2 aᵀ Σ (1 − (R + Rᵀ) / 2) a
    moved = np.sum(np.eye(3) - 0.5 * (turns + turns.transpose(0, 2, 1)), axis=0)
    axis = np.linalg.eigh(moved)[1][:, 0]
    largest = int(np.argmax(np.abs(axis)))
    axis = axis * np.sign(axis[largest])
    quaternion = Rotation.from_matrix(turns).as_quat() if len(turns) else np.zeros((0, 4))
    along = np.unwrap(2 * np.arctan2(quaternion[:, :3] @ axis, quaternion[:, 3]))
    if not len(along) or np.ptp(along) < _LEAST_TURN:
        raise ConfigError("hardly anything turns, so that there is no axis")
    rest = Rotation.from_matrix(turns) * Rotation.from_rotvec(-along[:, None] * axis)
    angle = np.full(len(R), np.nan)
    angle[known] = along
    return SingleAxis(axis, angle, float(rest.magnitude().max()))


def require_single_axis(R: Array) -> SingleAxis:
    """Return the axis of a motion about one axis in the image plane.

    Raises
    ------
    ConfigError
        Where the motion isn't one, with the reason.
    """
    found = find_single_axis(R)
    if found.deviation > TOLERANCE:
        raise ConfigError(
            "the motion is not about one axis: it leaves the best one by "
            f"{np.rad2deg(found.deviation):.3g} degrees"
        )
    if abs(found.tilt) > TOLERANCE:
        raise ConfigError(
            f"the axis leaves the image plane by {abs(np.rad2deg(found.tilt)):.3g} degrees, which one angle "
            "a frame can't tell"
        )
    return found
