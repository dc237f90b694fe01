"""The Cramér–Rao bound of the rotation, with the object and each frame's shift unknown.

The Fisher information of a spline that bends the true path, given white pixel noise, after the amplitudes of
a lattice that fills the object's ball and two shifts a frame are eliminated. The error it allows is averaged
as measured errors are: draws from the covariance go through the same alignment.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scenes import Stack
from scipy.spatial.transform import Rotation

from trapcli.motion.centers import Centers
from trapcli.motion.low_band import read_low_band
from trapcli.motion.object_model import Fit, ObjectModel
from trapcli.motion.path import Path, Spline, align
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]

REFERENCE = 1e-3
"""Noise, in peaks, at which the bound is computed: so low that the object's prior counts for little."""
BAND = 24.0
"""Band times radius: 96 to 100 % of the information of a known object of these scenes lies below."""
KNOT_ANGLE = 12.0
"""Degrees turned per interval of the spline, the middle one of those that the joint estimate chooses from."""

_DRAWS = 200


@dataclass(frozen=True)
class Bound:
    """Expected errors per unit of noise.

    Attributes
    ----------
    mean, worst:
        Mean and largest error over the frames [degrees] at noise of 1 % of the peak; proportional to noise.
    band:
        Highest spatial frequency times the object's radius.
    intervals:
        Intervals of the spline.
    unknowns:
        Amplitudes of the object.
    """

    mean: float
    worst: float
    band: float
    intervals: int
    unknowns: int


def bounds(stack: Stack, quick: bool) -> dict[str, Any]:
    """Return the bound, and by which factor its mean changes with what it depends on."""
    band = BAND - 4 if quick else BAND
    best, lower = bound(stack, band), bound(stack, band - 4)
    # what the spline changes hardly depends on the band, but a low band is far cheaper
    cheap = bound(stack, band / 2)
    coarse, fine = (bound(stack, band / 2, knot_angle=f * KNOT_ANGLE) for f in (2.0, 0.5))
    return {
        **asdict(best),
        "factor": {
            "band_lower_by_4": lower.mean / best.mean,
            "knots_half_as_many": coarse.mean / cheap.mean,
            "knots_twice_as_many": fine.mean / cheap.mean,
            "prior_at_noise_10_percent": bound(stack, band, noise=0.1).mean / best.mean,
        },
    }


def bound(stack: Stack, band: float, *, knot_angle: float = KNOT_ANGLE, noise: float = REFERENCE) -> Bound:
    """Compute the bound for the modes up to `band` / radius; the prior of the object weighs as at `noise`."""
    truth, n = stack.truth, len(stack.truth)
    centers = Centers(
        center=truth.center,
        errors=np.zeros((n, 2)),
        mass=np.ones(n),
        level=np.zeros(n),
        noise=noise * stack.peak,
        radius=stack.radius,
        clipped=np.zeros(n, bool),
    )
    highest = band / stack.radius
    low = read_low_band(
        Frames.from_array(stack.clean),
        centers,
        time=truth.time,
        band=highest,
        pixel_size=stack.pixel_size,
    )
    intervals = max(4, round(np.rad2deg(stack.turn) / knot_angle))
    spline = Spline(truth.time[0], truth.time[-1], intervals)
    model = ObjectModel(low, highest)
    path = Path(truth.time, truth.R, np.stack([truth.omega_1, truth.omega_2, truth.omega_3], axis=1))
    covariance = model.assess(Fit(path, model.low, np.zeros((n, 2)), spline, 0.0)).covariance
    mean, worst = _expected_errors(truth.R, spline.values(truth.time), covariance)
    unit = 0.01 / noise
    return Bound(unit * mean, unit * worst, band, intervals, len(model.position))


def _expected_errors(R: Array, values: Array, covariance: Array) -> tuple[float, float]:
    """Return the expected mean and largest angle [degrees] after alignment."""
    size = values.shape[1]
    root = np.linalg.cholesky(covariance.reshape(3 * size, 3 * size))
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(_DRAWS):
        bend = values @ (root @ rng.standard_normal(3 * size)).reshape(size, 3)
        angles = align(R @ Rotation.from_rotvec(bend).as_matrix(), R)[0]
        errors.append((angles.mean(), angles.max()))
    mean, worst = np.rad2deg(np.mean(errors, axis=0))
    return float(mean), float(worst)
