"""From the fitted path to the result: gauge, errors, flags, and what can't be known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.motion.ambiguity import UnseenTurn
from trapcli.motion.centers import Centers
from trapcli.motion.elimination import local_support
from trapcli.motion.fourier_slices import conjugate_share
from trapcli.motion.integrate import interpolated
from trapcli.motion.low_band import LowBand
from trapcli.motion.object_model import Assessment, Fit
from trapcli.motion.translation import translation
from trapcli.motion.types import UNKNOWN_ROTATION, ReducedMap
from trapcli.result.motion import Flag, Motion

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_CERTIFIED = 1.06  # misfit per degree of freedom that pixel noise explains, where there are many
NOISE_ERROR = 0.03
"""How well the noise is known, as a share of its power."""

_SCATTER = 3.0  # standard deviations of the misfit beside that, which tell where there are few
_CLEAR = 5.0  # the same of the misfit of one part of the stack
_MODEL_ERROR = 0.03  # misfit, as a share of what changes in the images, that an imperfect model may leave
_PARTS = 10  # of a stack, of which each must be explained
_SPARED = 0.1  # least misfit of one beyond the noise, as a share of the largest, that is the model's
_SLIGHT = 0.005  # share of what changes that noise which is not the same all the time may leave
_STRONG = 12.0  # band times radius of the modes that misfits of frames are relative to
_FAINT = 2.0  # standard deviations below which α does not differ from 0
COARSE = np.deg2rad(1.0)
"""Error of R from which on the verdict mentions it."""

_OPEN = np.deg2rad(10.0)  # error of R, by the curvature of the misfit, up to which curvature tells it

_TOUCHED = 0.1  # share of an unseen turn in a component of ω that makes it unknown


@dataclass(frozen=True)
class Stack:
    """What is known of N frames before any motion.

    Attributes
    ----------
    reduced, low, centers:
        What the frames tell of lines, low modes and centres.
    seen, outlying:
        ``(N,)`` which frames show an object, and which of them differ from their neighbours.
    frame:
        ``(N,)`` the frames' numbers in the input.
    """

    reduced: ReducedMap
    low: LowBand
    centers: Centers
    seen: Bools
    outlying: Bools
    frame: NDArray[np.int64]

    @property
    def used(self) -> NDArray[np.intp]:
        """Which frames tell the motion."""
        return np.flatnonzero(self.seen & ~self.outlying)


@dataclass(frozen=True)
class Verdict:
    """Whether the motion can be trusted, why, and the share of what changes that no noise explains."""

    identifiable: bool
    text: str
    left: float = 0.0


def certified(fit: Fit, assessment: Assessment) -> bool:
    """Tell whether noise alone explains the misfit, in the whole and in each part."""
    limit = max(_CERTIFIED, 1 + NOISE_ERROR + _SCATTER * np.sqrt(2 / assessment.degrees))
    parts, by_noise = by_parts(assessment)
    worst = parts.max() - by_noise
    return bool(max(fit.cost / assessment.degrees, worst) <= limit)


def by_parts(assessment: Assessment) -> tuple[Array, float]:
    """Return the misfit of each part of the stack, and by how much more it is no noise."""
    parts = np.array([part.mean() for part in np.array_split(assessment.frame_misfit, _PARTS)])
    return parts, float(_CLEAR * np.sqrt(2 * _PARTS / assessment.degrees))


def judge(fit: Fit, assessment: Assessment) -> Verdict:
    """Say whether the misfit is what the noise leaves, or what else it is."""
    misfit = fit.cost / assessment.degrees
    planar = "; it turns about the optical axis alone, as far as can be told: phi is undefined"
    about = planar if fit.axes == (2,) else ""
    if certified(fit, assessment):
        return Verdict(
            True, f"the motion explains the images: misfit {misfit:.3f} of what the noise gives{about}"
        )
    changing = np.abs(fit.low.modes - fit.low.modes.mean(axis=0)) ** 2
    share = conjugate_share(fit.low.k)
    left = float(np.sum(share * np.maximum(assessment.mode_misfit - 1, 0.0)) * fit.low.variance)
    error = float(np.sqrt(left / max(float(np.sum(share * changing.mean(axis=0))), 1e-300)))
    if error <= _SLIGHT or (error <= _MODEL_ERROR and not _spared(assessment)):
        return Verdict(
            True,
            f"the motion explains all but {100 * error:.1f} % of what changes in the images; the rest, "
            f"{misfit:.1f} times the noise, is put down to an imperfect model, and errors are widened for it"
            + about,
            error,
        )
    return Verdict(
        False,
        f"not trustworthy: no motion found explains the images; {100 * error:.0f} % of what changes in them "
        f"is left over, {misfit:.1f} times the noise{'' if error > _MODEL_ERROR else ', and not everywhere'}",
    )


def _spared(assessment: Assessment) -> bool:
    """Tell whether a part of the stack is explained while others are not.

    What an imperfect model lacks shows everywhere; a wrong motion may be right in part.
    """
    excess = by_parts(assessment)[0] - 1
    return bool(excess.min() < _SPARED * excess.max())


def nothing_known(stack: Stack, text: str) -> Motion:
    """Return a result without rotation."""
    n = len(stack.low.time)
    unknown = np.full(n, np.nan)
    flags = _flags(stack)
    flags[stack.seen] |= np.uint16(Flag.ALPHA_ZERO | Flag.AMBIGUOUS_PHI)
    R = np.full((n, 3, 3), np.nan)
    return Motion(
        time=stack.low.time,
        frame=stack.frame,
        T=translation(stack.centers.center),
        center=stack.centers.center,
        phi=unknown,
        omega_3=unknown,
        alpha=unknown,
        R=R,
        T_errors=np.hypot(stack.centers.errors, stack.centers.errors[np.flatnonzero(stack.seen)[0]]),
        phi_errors=unknown,
        omega_3_errors=unknown,
        alpha_errors=unknown,
        R_errors=np.full((n, 3), np.nan),
        valid=np.zeros(n, np.uint8),
        flags=flags,
        residual=unknown,
        identifiable=False,
        verdict=text,
    )


def typical_error(fit: Fit, assessment: Assessment, n: int) -> float:
    """Return the root mean square error of the orientation in N frames, against the first [rad]."""
    values = fit.spline.values(fit.path.time[:n])
    covariance = _rotation_covariance(fit.path.R[:n], values, assessment.covariance)
    return float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean()))


def _flags(stack: Stack) -> NDArray[np.uint16]:
    flags = np.zeros(len(stack.seen), np.uint16)
    flags[~stack.seen] |= np.uint16(Flag.BLANK)
    flags[stack.centers.clipped] |= np.uint16(Flag.CLIPPED)
    flags[stack.outlying] |= np.uint16(Flag.OUTLIER)
    return flags


def to_motion(
    stack: Stack,
    fit: Fit,
    assessment: Assessment,
    verdict: Verdict,
    unseen: UnseenTurn | None = None,
) -> Motion:
    """Put the fitted path into the gauge of the result, with errors and flags; leave out what is unseen."""
    time = stack.low.time
    n = len(time)
    R = fit.path.R[0].T @ fit.path.R[:n]
    R_covariance = _rotation_covariance(R, fit.spline.values(time), assessment.covariance)
    R_errors = np.sqrt(np.maximum(np.diagonal(R_covariance, axis1=1, axis2=2), 0.0))
    # what is left over might be the mark of turns that are wrong by as much, in all frames alike
    turned = np.minimum(Rotation.from_matrix(R).magnitude(), 1.0)
    R_errors = np.hypot(R_errors, verdict.left * turned[:, None])
    rates = _rates(fit, assessment, n, unseen, verdict.left)
    judged = stack.seen & (np.linalg.norm(R_errors, axis=1) <= UNKNOWN_ROTATION)
    flags = _flags(stack)
    flags[rates.faint] |= np.uint16(Flag.ALPHA_ZERO)
    flags[rates.aimless] |= np.uint16(Flag.AMBIGUOUS_PHI)
    flags[rates.void] |= np.uint16(Flag.THIRD_ORDER_SILENT)
    valid = judged & (flags & np.uint16(Flag.OUTLIER | Flag.BLANK) == 0)
    open_by = np.sqrt(np.mean(np.sum(R_errors[stack.seen] ** 2, axis=1)))
    told = valid.mean() > 0.5 and open_by <= _OPEN
    identifiable = verdict.identifiable and unseen is None and bool(told)
    text = verdict.text
    if unseen is not None:
        text = unseen.text
    elif verdict.identifiable and not identifiable:
        text = (
            f"the images leave the rotation open by more than {np.rad2deg(_OPEN):.0f} degrees: "
            "a symmetric object, too much noise or too little rotation"
        )
    elif identifiable and (largest := float(np.linalg.norm(R_errors[valid], axis=1).max())) > COARSE:
        text += f"; errors of the orientation reach {np.rad2deg(largest):.1f} degrees (1 sigma)"

    def where_judged(values: Array) -> Array:
        return np.where(judged, values, np.nan)

    phi, mirrored = _in_gauge(where_judged(rates.phi))
    if mirrored:
        sigma = np.diag([1.0, 1.0, -1.0])
        R = sigma @ R @ sigma
    rotated = judged & (unseen is None)
    center, T_errors = _centers(stack, fit, assessment)
    # whatever the band of the model: results with different ones are compared
    strong = fit.low.modes[:, fit.low.inside(_STRONG / fit.low.radius)]
    size = np.sqrt(np.mean(np.abs(strong) ** 2))
    residual = np.interp(time, fit.low.time, np.sqrt(assessment.frame_misfit * fit.low.variance)) / size
    return Motion(
        time=time,
        frame=stack.frame,
        T=translation(center),
        center=center,
        phi=phi,
        omega_3=where_judged(rates.omega_3),
        alpha=where_judged(rates.alpha),
        phi_errors=where_judged(rates.phi_errors),
        omega_3_errors=where_judged(rates.omega_3_errors),
        alpha_errors=where_judged(rates.alpha_errors),
        R=np.where(rotated[:, None, None], R, np.nan),
        T_errors=T_errors,
        R_errors=np.where(rotated[:, None], R_errors, np.nan),
        valid=(valid & identifiable).astype(np.uint8),
        flags=flags,
        residual=np.where(stack.seen, residual, np.nan),
        identifiable=identifiable,
        verdict=text,
    )


@dataclass(frozen=True)
class _Rates:
    """φ, ω₃, α and their errors; NaN where an unseen turn has part in them.

    `faint`: α does not differ from 0; `aimless`: φ is lost to the unseen turn; `void`: α is, but φ is not.
    """

    phi: Array
    omega_3: Array
    alpha: Array
    phi_errors: Array
    omega_3_errors: Array
    alpha_errors: Array
    faint: Bools
    aimless: Bools
    void: Bools


def _rates(fit: Fit, assessment: Assessment, n: int, unseen: UnseenTurn | None, left: float) -> _Rates:
    time, R, omega = fit.path.time[:n], fit.path.R[:n], fit.path.omega[:n]
    covariance = _omega_covariance(
        omega, fit.spline.values(time), fit.spline.slopes(time), assessment.covariance
    )
    covariance += left**2 * np.einsum("ni,ni->n", omega, omega)[:, None, None] * np.eye(3)
    alpha = np.hypot(omega[:, 0], omega[:, 1])
    v = np.where(alpha[:, None] > 0, omega[:, :2] / np.maximum(alpha, 1e-300)[:, None], [1.0, 0.0])
    across = np.stack([-v[:, 1], v[:, 0]], axis=1)
    alpha_errors, sideways = (
        np.sqrt(np.einsum("ni,nij,nj->n", u, covariance[:, :2, :2], u)) for u in (v, across)
    )
    faint = alpha <= _FAINT * np.maximum(alpha_errors, sideways)
    open_turn = np.zeros((n, 3)) if unseen is None else unseen.axis @ R
    along, aside = (np.abs(np.einsum("ni,ni->n", u, open_turn[:, :2])) for u in (v, across))
    aimless = ~faint & (aside > _TOUCHED)
    void = np.where(faint, np.hypot(along, aside), along) > _TOUCHED
    spun = np.abs(open_turn[:, 2]) > _TOUCHED

    def known(values: Array, unknown: Bools) -> Array:
        return np.where(unknown, np.nan, values)

    return _Rates(
        phi=known(np.arctan2(omega[:, 1], omega[:, 0]), faint | aimless),
        omega_3=known(omega[:, 2], spun),
        alpha=known(alpha, void),
        phi_errors=known(sideways / np.maximum(alpha, 1e-300), faint | aimless),
        omega_3_errors=known(np.sqrt(covariance[:, 2, 2]), spun),
        alpha_errors=known(alpha_errors, void),
        faint=faint,
        aimless=aimless,
        void=void & ~faint & ~aimless,
    )


def _in_gauge(phi: Array) -> tuple[Array, bool]:
    """Return φ continuous and in [0, π) at the first frame that has one, and whether R → ΣRΣ leads there."""
    known = np.flatnonzero(np.isfinite(phi))
    if not len(known):
        return phi, False
    continuous = phi.copy()
    continuous[known] = np.unwrap(phi[known])
    half_turns = int(np.floor(continuous[known[0]] / np.pi))
    # an odd number of half turns is the mirror image
    return continuous - half_turns * np.pi, half_turns % 2 == 1


def _centers(stack: Stack, fit: Fit, assessment: Assessment) -> tuple[Array, Array]:
    """Return the centres C₂, where the object model is in each frame, and the errors of T."""
    used = stack.used
    own, errors = fit.model.locate(fit, assessment.covariance, fit.path.R[used], stack.low.select(used))
    time = stack.low.time
    place, errors = (interpolated(time, time[used], series) for series in (own, errors))
    return stack.centers.center + place, errors


def _rotation_covariance(R: Array, values: Array, covariance: Array) -> Array:
    """Return ``(N, 3, 3)`` covariances of R as rotation vectors in the lab, R = 1 at the first frame."""
    # the first frame's error turns all others: ε(t) − R(t)ᵀ R(0) ε(0)
    back = np.swapaxes(R, 1, 2) @ R[0]
    places, local = local_support(values)
    blocks = covariance[places[:, :, None], :, places[:, None, :], :]
    own = np.einsum("nb,nbcij,nc->nij", local, blocks, local, optimize=True)
    first = np.einsum("bicj,c->bij", covariance[:, :, places[0]], local[0])
    mixed = np.einsum("nb,nbij->nij", local, first[places])
    start = mixed[0]
    turned = mixed @ np.swapaxes(back, 1, 2)
    return np.asarray(own - turned - np.swapaxes(turned, 1, 2) + back @ start @ np.swapaxes(back, 1, 2))


def _omega_covariance(omega: Array, values: Array, slopes: Array, covariance: Array) -> Array:
    """Return ``(N, 3, 3)`` covariances of ω; δω = δ' + ω × δ."""
    x, y, z = omega.T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    places, local = local_support(values)
    design = np.einsum("nb,ij->nibj", np.take_along_axis(slopes, places, axis=1), np.eye(3))
    design += np.einsum("ijn,nb->nibj", cross, local)
    blocks = covariance[places[:, :, None], :, places[:, None, :], :]
    return np.asarray(np.einsum("nibj,nbcjk,nlck->nil", design, blocks, design, optimize=True))
