"""The paper's chain from attenuation to motion (its workflow figure): ``--method paper``.

Centres give the translation and the reduced map; its first time derivative gives φ and ω₃ (``propD1``), its
second, in the third-order equation, α (``propD3``); ω is integrated to R. Noise is met only by the windows of
the time derivatives.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trapcli.config import MotionConfig
from trapcli.errors import ConfigError, InputError
from trapcli.motion.centers import Centers, Progress, estimate_centers
from trapcli.motion.integrate import integrate_rotation, rotation_errors
from trapcli.motion.reduced_map import reduce_frames
from trapcli.motion.rotation_rates import AT_REST, RotationRates, rotation_rates
from trapcli.motion.translation import translation
from trapcli.motion.types import UNKNOWN_ROTATION
from trapcli.result.motion import Flag, Motion
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_FEWEST = 5  # frames, and narrowest window
_SHORTEST_BRIDGE = 5  # frames
_ENOUGH = 0.5  # share of valid frames from which the motion counts as known
_SIGNIFICANT = 3.0  # standard deviations


def estimate_paper(
    attenuation: Frames,
    config: MotionConfig,
    *,
    time: Array,
    pixel_size: float = 1.0,
    progress: Progress | None = None,
) -> Motion:
    """Recover the motion by infinitesimal common lines (Elbau et al. 2020, Inverse Problems 36).

    Parameters
    ----------
    attenuation:
        N attenuation projections.
    config:
        `window` and `band` are used.
    time:
        ``(N,)`` evenly spaced times.
    pixel_size:
        Edge of a pixel [length].
    progress:
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    Motion
        In the units of `time` and `pixel_size`, which the caller names.

    Raises
    ------
    ConfigError
        For a window or a band that makes no sense.
    InputError
        Where fewer than 5 frames show an object.
    """
    if config.band < 0 or config.window < 0 or 0 < config.window < _FEWEST:
        raise ConfigError(
            f"motion: band must be positive and window at least {_FEWEST} frames (0: automatic)"
        )
    centers = estimate_centers(attenuation, pixel_size=pixel_size, progress=progress)
    if np.isfinite(centers.center[:, 0]).sum() < _FEWEST:
        raise InputError(
            f"{attenuation.info.source}: too few frames show an object for time derivatives; "
            f"at least {_FEWEST} are needed"
        )
    reduced = reduce_frames(
        attenuation, centers, time=time, pixel_size=pixel_size, band=config.band, progress=progress
    )
    rates = rotation_rates(reduced, window=config.window, frame=attenuation.index, progress=progress)
    return _motion(centers, rates, time, attenuation.index)


def _motion(centers: Centers, rates: RotationRates, time: Array, frame: NDArray[np.int64]) -> Motion:
    """Put translation and rotation together, judge each frame and the whole."""
    blank = ~np.isfinite(centers.center[:, 0])
    flags = rates.flags.copy()
    flags[blank] |= np.uint16(Flag.BLANK)
    flags[centers.clipped] |= np.uint16(Flag.CLIPPED)
    tilt = np.where(rates.untilted, 0.0, rates.alpha)
    # where nothing speaks for a tilt φ is not known, but not needed either
    direction = np.where(rates.untilted, 0.0, rates.phi)
    omega = np.stack([tilt * np.cos(direction), tilt * np.sin(direction), rates.omega_3], axis=-1)
    omega[flags & np.uint16(Flag.AMBIGUOUS_PHI) > 0] = np.nan
    least = np.maximum(_SIGNIFICANT * rates.omega_3_errors, AT_REST / float(np.median(np.diff(time))))
    moving = ~rates.untilted | (np.abs(rates.omega_3) > least)
    valid = np.isfinite(omega).all(axis=1) & moving & (flags & ~np.uint16(Flag.ALPHA_ZERO) == 0)
    R = integrate_rotation(omega, time, bridge=max(_SHORTEST_BRIDGE, rates.window // 2))
    R_errors = rotation_errors(omega, _covariance(rates, direction, tilt), time, rates.window / 2)
    lost = np.linalg.norm(R_errors, axis=1) > UNKNOWN_ROTATION
    R[lost] = np.nan
    trusted = valid & ~lost
    identifiable = bool(trusted.mean() >= _ENOUGH)
    T = translation(centers.center)
    return Motion(
        time=time,
        frame=frame,
        T=T,
        center=centers.center,
        phi=rates.phi,
        omega_3=rates.omega_3,
        alpha=rates.alpha,
        R=R,
        T_errors=np.hypot(centers.errors, _first(centers.errors)),
        phi_errors=rates.phi_errors,
        omega_3_errors=rates.omega_3_errors,
        alpha_errors=rates.alpha_errors,
        R_errors=np.where(np.isnan(R[:, :, 0]), np.nan, R_errors),
        valid=trusted.astype(np.uint8),
        flags=flags,
        residual=rates.residual,
        identifiable=identifiable,
        verdict=_verdict(valid, lost, flags, rates, blank),
        landscape=rates.landscape,
    )


def _first(series: Array) -> Array:
    """Return the first row without NaN; NaN where there is none."""
    known = np.flatnonzero(np.isfinite(series).all(axis=1))
    return series[known[0]] if len(known) else np.full(series.shape[1], np.nan)


def _covariance(rates: RotationRates, direction: Array, tilt: Array) -> Array:
    """Return the ``(N, 3, 3)`` covariance of ω from the errors of φ, α and ω₃."""
    v, across = (
        np.array([np.cos(direction), np.sin(direction)]),
        np.array([-np.sin(direction), np.cos(direction)]),
    )
    along = np.where(rates.untilted, 0.0, rates.alpha_errors) * v
    sideways = np.where(rates.untilted, 0.0, tilt * rates.phi_errors) * across
    covariance = np.zeros((len(direction), 3, 3))
    covariance[:, :2, :2] = np.einsum("in,jn->nij", along, along) + np.einsum(
        "in,jn->nij", sideways, sideways
    )
    covariance[:, 2, 2] = rates.omega_3_errors**2
    return covariance


def _verdict(valid: Bools, lost: Bools, flags: NDArray[np.uint16], rates: RotationRates, blank: Bools) -> str:
    """Say in words how far the motion is known and what stands in the way."""
    seen = int((~blank).sum())
    still = rates.untilted & ~valid
    silent, open_phi, faint = (
        flags & bit > 0 for bit in (Flag.THIRD_ORDER_SILENT, Flag.AMBIGUOUS_PHI, Flag.ALPHA_ZERO)
    )
    reasons = [
        (
            open_phi,
            "the images fit many directions of the rotation: an object with a symmetry, or too much noise",
        ),
        (silent, "omega_3 = -sigma, where the third-order equation says nothing about alpha"),
        (still, "nothing turns: the object is still, or turns about its own axis of symmetry"),
        (faint & ~still & ~valid, "alpha does not stand out of its error"),
        (lost, "the errors of the rates have added up to an orientation that is not known to 20 degrees"),
    ]
    told = [f"{text} ({int(which.sum())} frames)" for which, text in reasons if which.sum() > 0.05 * seen]
    summary = f"motion found in {int(valid.sum())} of {len(valid)} frames"
    return "; ".join([summary, *told])
