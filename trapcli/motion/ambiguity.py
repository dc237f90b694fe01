"""What the images leave open: the mirror solution, and turns of the object about an axis of its symmetry.

The first-order equation knows the line of direction φ, not which way it points: φ and φ + π solve it alike,
which is the mirror ambiguity R ↔ ΣRΣ of the paper. Continuity in time leaves one choice for the whole
series.

Spin of a body of revolution about its axis can't be seen at all. A discrete symmetry can mislead as well, in
one case: rotation about an axis n that stays in the image plane, with γ = R e₃ on a great circle. There the
images are sinograms in planes across n. Harmonic m of their angle has no moments of an order below the amount
of m, and its parity (Helgason–Ludwig). An object with an f-fold axis n has the harmonics 0, ±f, ±2f, …, which
by the same conditions may be the harmonics 0, ±g, ±2g, … of another one, for g < f of the same parity: the
one turning by θ looks like the other turning by θ f / g.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from trapcli.motion.object_model import Assessment, Fit, ObjectModel
from trapcli.motion.path import Path, align

Array = NDArray[np.float64]

_MEMORY = 9  # reliable frames whose median the next one is compared with
_SPIN = 2 * np.pi  # spin in the whole stack that goes unseen if the object is a body of revolution; less may
# go unseen because little is seen of an object that hardly turns out of the image plane
_SMALL_SPIN = np.deg2rad(30.0)  # spin in the whole stack by which an axis of revolution is looked for
_WEAK = 0.3  # resistance to it, in units of that about other axes, from which on there is none
_PLANAR = np.sin(np.deg2rad(10.0))  # distance of γ from a great circle up to which it may be on one
_FOLDS = range(1, 9)  # symmetries of an axis that are looked for
_SYMMETRY_FACTORS = sorted({Fraction(f, g) for f in _FOLDS for g in _FOLDS if f != g and (f - g) % 2 == 0})
_RIVAL = 0.05  # rise of the misfit, in units of what is common, up to which another turn is refined
_MOST_RIVALS = 4  # turns that are refined at most
_LEAST = np.deg2rad(20.0)  # difference of two turns below which the stated errors tell
_STEPS = 6  # of the refinement of another motion
_SIGNIFICANT = 5.0  # standard deviations
_MODEL_ERROR = 0.02  # share of the misfit that the object model's lattice may be worth
_BEST_OF_MANY = 9.0  # gain of a parameter whose best of some hundred values the noise decides, 2 log 100


@dataclass(frozen=True)
class UnseenTurn:
    """A turn of the object about an axis of its own of which the images don't tell how far it goes.

    Attributes
    ----------
    axis:
        ``(3,)`` unit vector in object coordinates.
    turn:
        Angle that the fitted motion turns about it [rad].
    factors:
        By what the turn can be multiplied, ascending, 1 among them; empty where any other turn will do.
    """

    axis: Array
    turn: float
    factors: tuple[Fraction, ...] = ()

    @property
    def text(self) -> str:
        """What is unseen, in words."""
        if not self.factors:
            return (
                "ambiguous: the object looks like a body of revolution, whose spin about its axis can't be "
                "seen; what depends on it is not given"
            )
        turns = [abs(self.turn) * float(factor) / (2 * np.pi) for factor in self.factors]
        return (
            "ambiguous: the object looks symmetric about an axis in the image plane, and "
            f"{len(turns)} motions explain the images alike, with "
            f"{' or '.join(f'{turn:.2f}' for turn in turns)} turns about it; alpha and R are not given"
        )


def unseen_turn(fit: Fit, assessment: Assessment, band: float) -> UnseenTurn | None:
    """Find a turn about an axis of the object that other turns could replace, by trying them.

    The curvature of the misfit does not tell: where a turn is unseen the fit follows the noise into one of
    many shallow minima.

    Parameters
    ----------
    fit, assessment:
        A motion that explains the images.
    band:
        Highest spatial frequency of the object model [rad / length].

    Returns
    -------
    UnseenTurn or None
        None where the images tell the motion from all others that were tried.
    """
    R = fit.R
    low = fit.low.shifted(np.einsum("gji,j->gi", R, assessment.middle)[:, :2])
    centred = replace(fit, low=low)
    # what the lower half of the band tells apart needs no finer look
    models = [ObjectModel.after(centred, assessment, share * band) for share in (0.5, 1.0)]
    rivals = _Rivals(centred, models)
    axis = _axis_of_revolution(models[0], R, least_resisted_axes(fit, assessment))
    if axis is not None:
        spin = _SPIN * (fit.path.time - fit.path.time.mean()) / np.ptp(fit.path.time)
        # where a spin is unseen, each parameter has found the best of all values, not only of those close by
        if rivals.as_good(spun(fit.path, axis, spin), _BEST_OF_MANY * fit.spline.size):
            return UnseenTurn(axis, 0.0)
    return _other_symmetry(fit, models[0], rivals)


def least_resisted_axes(fit: Fit, assessment: Assessment) -> Array:
    """Return ``(3, 3)`` axes of the object as rows, that of the spin which changes the misfit least first.

    By the curvature of the misfit at a fit.
    """
    values = fit.spline.values(fit.low.time)
    ramp = np.linspace(-0.5, 0.5, len(values))
    spins = [
        np.linalg.lstsq(values, ramp[:, None] * fit.R[:, axis], rcond=None)[0].ravel() for axis in range(3)
    ]
    size = values.shape[1]
    known = np.linalg.pinv(assessment.covariance.reshape(3 * size, 3 * size), rcond=1e-12, hermitian=True)
    _, axes = np.linalg.eigh(np.array(spins) @ known @ np.transpose(spins))
    return np.asarray(axes.T)


def _axis_of_revolution(model: ObjectModel, R: Array, axes: Array) -> Array | None:
    """Return the axis near the first of `axes` where spin is seen least, if far less than about others."""
    least = model.cost(R, model.low.modes)
    ramp = np.linspace(-0.5, 0.5, len(R))

    def resistance(axis: Array, spin: float = _SMALL_SPIN) -> float:
        return model.cost(_about(axis, spin * ramp) @ R, model.low.modes) - least

    def near(tangent: Array) -> Array:
        axis = axes[0] + tangent @ axes[1:]
        return np.asarray(axis / np.linalg.norm(axis))

    # what is seen from few sides only resists a small spin about the optical axis alone
    if any(resistance(axes[0], spin) > _WEAK * resistance(axes[1], spin) for spin in (_SMALL_SPIN, _SPIN)):
        return None
    simplex = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]])
    options = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1.0, "maxfev": 60}
    best = minimize(lambda x: resistance(near(x)), simplex[0], method="Nelder-Mead", options=options)
    return near(best.x)


def _other_symmetry(fit: Fit, coarse: ObjectModel, rivals: _Rivals) -> UnseenTurn | None:
    """Try turns in proportion to the fitted one, where it is about an axis in the image plane."""
    gamma = fit.path.R[:, :, 2]
    _, _, (first, _, axis) = np.linalg.svd(gamma, full_matrices=False)
    if np.abs(gamma @ axis).max() > _PLANAR:
        return None
    order = np.argsort(fit.path.time, kind="stable")
    angle = np.empty(len(gamma))
    angle[order] = np.unwrap(np.arctan2(gamma @ np.cross(axis, first), gamma @ first)[order])
    turned = float(np.ptp(angle))
    factors = [factor for factor in _SYMMETRY_FACTORS if abs(factor - 1) * turned > _LEAST]
    others = [spun(fit.path, axis, float(factor - 1) * (angle - angle.mean())) for factor in factors]
    groups = len(fit.low.time)
    own = coarse.cost(fit.R, coarse.low.modes)
    rise = np.array([coarse.cost(other.R[-groups:], coarse.low.modes) - own for other in others])
    found, noise = [Fraction(1)], _BEST_OF_MANY * fit.spline.size
    for i in np.argsort(rise)[:_MOST_RIVALS]:
        if rise[i] < max(noise, _RIVAL * np.median(rise)) and rivals.as_good(others[i], fit.spline.size):
            found.append(factors[i])
    return UnseenTurn(axis, turned, tuple(sorted(found))) if len(found) > 1 else None


class _Rivals:
    """Other motions, refined and compared with the fitted one, with the lower half of the band first."""

    def __init__(self, fit: Fit, models: list[ObjectModel]) -> None:
        self._fit, self._models = fit, models
        self._own: list[tuple[float, float]] = []

    def as_good(self, path: Path, parameters: float) -> bool:
        """Tell whether a motion explains the images as well, where the noise decides so many parameters."""
        apart = self._apart(path)
        for i, model in enumerate(self._models):
            if i == len(self._own):
                self._own.append(self._refined(model, self._fit.path)[1:])
            path, cost, degrees = self._refined(model, path)
            if self._apart(path) < 0.5 * apart:
                return False
            own_cost, own_degrees = self._own[i]
            free = max(abs(own_degrees - degrees), parameters)
            allowed = free + _SIGNIFICANT * float(np.sqrt(2 * free)) + _MODEL_ERROR * own_cost
            if model is not self._models[-1]:
                # what a coarser model leaves over of the fitted motion itself is no reason against another
                allowed += max(own_cost - own_degrees, 0.0)
            if cost - degrees > own_cost - own_degrees + allowed:
                return False
        return True

    def _apart(self, path: Path) -> float:
        """Return the mean angle between a motion and the fitted one, gauge removed."""
        return float(align(path.R, self._fit.path.R)[0].mean())

    def _refined(self, model: ObjectModel, path: Path) -> tuple[Path, float, float]:
        """Return a motion bent to fit, its misfit and the degrees of freedom that are left."""
        fit = self._fit
        refined = model.fit(
            path, fit.low.time, fit.spline, smooth=fit.roughness is not None, axes=fit.axes, steps=_STEPS
        )
        return refined.path, refined.cost, model.assess(refined).degrees


def spun(path: Path, axis: Array, angle: Array) -> Path:
    """Return the path with the object turned by ``(M,)`` angles about one of its axes in addition [rad]."""
    order = np.argsort(path.time, kind="stable")
    time, first = np.unique(path.time[order], return_index=True)
    rate = CubicSpline(time, angle[order][first])(path.time, 1)
    return Path(path.time, _about(axis, angle) @ path.R, path.omega + rate[:, None] * (axis @ path.R))


def _about(axis: Array, angle: Array) -> Array:
    return np.asarray(Rotation.from_rotvec(angle[:, None] * axis).as_matrix())


def unwrap_directions(phi: Array, reliable: NDArray[np.bool_]) -> Array:
    """Make line directions continuous, in [0, π) at the first reliable frame.

    Parameters
    ----------
    phi:
        ``(N,)`` directions modulo π [rad]; NaN where not known.
    reliable:
        ``(N,)`` frames that decide; the others follow.

    Returns
    -------
    ndarray
        ``(N,)`` φ, NaN where `phi` is.
    """
    result = np.full(len(phi), np.nan)
    recent: list[float] = []
    known = np.flatnonzero(np.isfinite(phi))
    decisive = known[reliable[known]] if reliable[known].any() else known
    if len(decisive):
        recent.append(float(phi[decisive[0]] % np.pi))
    for n in known:
        result[n] = _nearest(float(phi[n]), float(np.median(recent)))
        if reliable[n]:
            recent = [*recent[1 - _MEMORY :], result[n]]
    return result


def _nearest(phi: float, target: float) -> float:
    """Return the angle equal to `phi` modulo π that is nearest to `target`."""
    return target + (phi - target + np.pi / 2) % np.pi - np.pi / 2
