"""How far the object turns out of the image plane, where it turns little: the bas-relief ambiguity.

Views from nearly the same side look almost alike for a deeper object that turns less (Belhumeur, Kriegman and
Yuille 1999, DOI 10.1023/A:1008154927611). The misfit then has several shallow minima along that way, and what
an object may be like differs between them; a search downhill stays in the one that it comes upon first. So
the motion is tilted more and less, and fitted again each time with the object's model that suits it. What of
these explains the frames nearly as well as the best tells how far that may be off, where the curvature of its
misfit claims less.

Parts of a path may be mirror images, and what is long may turn otherwise about its length: these are tried as
well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.motion.ambiguity import least_resisted_axes, spun
from trapcli.motion.low_band import LowBand
from trapcli.motion.object_model import LOOSE, Assessment, Fit, ObjectModel, refitted
from trapcli.motion.path import Path, Spline, align, deviation
from trapcli.motion.verdict import typical_error
from trapcli.threads import in_parallel

Array = NDArray[np.float64]
Scored = tuple[Fit, Assessment]

_FACTORS = 2.0, 0.5, 4.0
_WIDE = np.deg2rad(30.0), np.deg2rad(60.0)  # tilts beyond which views mostly and surely tell it
_MOST = 6  # times that a better tilt is followed
_HOPELESS = 1.25  # misfit of a tilted motion before it is fitted, in units of the best's
_ROUNDS = 3  # parts that are turned over, or spins that are changed, at most
_TRIED = 2  # of them at a time, by the fine model
_UNNOTICED = np.deg2rad(3.0), np.deg2rad(90.0)  # least and largest turn out of the plane of such a part
_FLAT = 0.5  # of the usual α, below which a path may go over into its mirror image
_STEP = np.deg2rad(15.0)  # rotation between places from which on it may be one
_MOST_STEPS = 60  # of them at most
_DIP = 0.3  # what a mirror image from there on misses, as a share of what it does from places to both sides
_SPINS = tuple(np.deg2rad([-60.0, -30.0, 30.0, 60.0]))  # in the whole stack that are tried
_ELONGATED = 0.3  # resistance to a spin, in units of that about other axes, up to which it may be a wrong one
_OTHER = np.deg2rad(2.0)  # largest angle between motions from which on they are not one
_LIKELY = 1.1  # misfit of a coarse model, in units of that of the path as it was, up to which it may have
_BETTER = 1.0  # gain that counts, in units of the misfit
_SAME = 0.25  # mean angle between fits that are one motion, in units of its error
_RULED_OUT = 9.0  # squares of standard deviations
_OPEN = 10.0  # part of a difference of misfits that what is unknown of an object makes, as variance of 1


def relieved(low: LowBand, fit: Fit, assessment: Assessment, n: int) -> list[Scored]:
    """Return the best fit and, where views are much alike, others with other tilts that may be right as well.

    Parameters
    ----------
    low:
        The frames, with all modes.
    fit, assessment:
        A motion and what is known of it.
    n:
        How many of the path's times are those of frames.
    """
    views_apart = tilt(fit.path.R)
    alike = views_apart <= _WIDE[1] and next(_other_tilts(fit), None) is not None
    if not alike and views_apart > _WIDE[0]:
        return [(fit, assessment)]
    found = [(fit, assessment), refitted(low, fit, fit.path, LOOSE)]
    if not alike:
        return [min(found, key=lambda one: score(*one))]
    for _ in range(_MOST):
        best = min(found, key=lambda one: score(*one))
        for path in _other_tilts(best[0]):
            found.append(refitted(low, best[0], path, LOOSE))
            if score(*found[-1]) < score(*best) - _BETTER:
                break
        else:
            break
    best, *others = sorted(found, key=lambda one: score(*one))
    least = _SAME * typical_error(*best, n)
    likely = (one for one in others if _unlikelier(one, best) < _RULED_OUT)
    return [best, *(one for one in likely if _apart(one, best, n) > least)]


def widened(fit: Fit, assessment: Assessment, n: int, found: list[Scored]) -> Assessment:
    """Return the errors so that other tilts lie as many of them away as they are less likely.

    What a finer model of the object changed of the best is one of them as well: where tilts are told that
    badly, neither model knows better.

    Parameters
    ----------
    fit, assessment:
        A motion for which `found` was searched.
    n:
        How many of the path's times are those of frames.
    found:
        Fits, the best first.
    """
    size = 3 * fit.spline.size
    covariance = assessment.covariance.reshape(size, size)
    best, *others = found
    if not others:
        return assessment
    for one, other in [(fit, best), *((best[0], other) for other in others)]:
        apart = max(_unlikelier(other, best), 1.0)  # in squares of standard deviations
        way = fit.spline.fit(fit.path.time[:n], deviation(one.path.R[:n], other[0].path.R[:n])).ravel()
        told = float(way @ np.linalg.lstsq(covariance, way, rcond=1e-12)[0])
        covariance = covariance + max(1 / apart - 1 / max(told, 1e-300), 0.0) * np.outer(way, way)
    return replace(assessment, covariance=covariance.reshape(assessment.covariance.shape))


def _unlikelier(one: Scored, best: Scored) -> float:
    """Return how much less likely a fit is than the best, in squares of standard deviations."""
    return (score(*one) - score(*best)) / _OPEN


def _apart(one: Scored, other: Scored, n: int) -> float:
    return float(align(one[0].path.R[:n], other[0].path.R[:n])[0].mean())


def score(fit: Fit, assessment: Assessment) -> float:
    """Return the misfit less what is expected: of two motions the lower one is likelier."""
    return fit.cost - assessment.degrees


def tilt(R: Array) -> float:
    """Return the root mean square angle of ``(N, 3, 3)`` viewing directions R e₃ to their mean [rad]."""
    swing, _, _ = _swings(R)
    return float(np.sqrt(np.mean(np.sum(swing**2, axis=1))))


def tilted(path: Path, factor: float, spline: Spline) -> Path:
    """Return the path whose viewing directions are `factor` times as far from their mean, spin unchanged.

    Its ω is the nearest spline.
    """
    ascending = path.ascending()
    swing, spin, mean = _swings(ascending.R)
    R = mean @ Rotation.from_rotvec(factor * swing).as_matrix() @ spin
    return replace(ascending, R=R).near(spline, path.time)


def untangled(fit: Fit, assessment: Assessment) -> Scored:
    """Return the motion with parts that are mirror images turned back, if that is likelier.

    Where an object hardly turns out of the image plane, a path may go over into its mirror image
    (`Path.mirrored`) and come back a little later: what lies between two such places looks nearly alike.
    That of an object with nearly a plane of symmetry may go over at any other place, and stay there: then
    its mirror image from that place on explains much more than that from places before and after.
    """
    return _likeliest((fit, assessment), _partly_mirrored)


def unspun(fit: Fit, assessment: Assessment) -> Scored:
    """Return the motion with another spin of the object about its length, if that is likelier.

    How far what is long turns about its length shows little: the misfit has several minima along that way.
    """
    return _likeliest((fit, assessment), _otherwise_spun)


def _likeliest(best: Scored, others: Callable[[Fit, Assessment], list[Path]]) -> Scored:
    """Fit from other paths again and again, as long as that gains."""
    for _ in range(_ROUNDS):
        likely = [best[0].model.again(best[0], path) for path in others(*best)]
        likelier = min(likely, key=lambda one: score(*one), default=best)
        if score(*likelier) >= score(*best) - _BETTER:
            break
        best = likelier
    return best


def _partly_mirrored(fit: Fit, _: Assessment) -> list[Path]:
    """Return the path of a fit with a part mirrored, for the few that explain the frames nearly as well."""
    path = fit.path.ascending()
    coarse = ObjectModel.coarse(fit.low, fit.model.band, fit.model.guard)
    as_it_is = coarse.cost(fit.R, coarse.low.modes)

    def near(mirrored: Path) -> Path:
        return mirrored.near(fit.spline, fit.path.time)

    def excess(place: int) -> float:
        R = near(path.mirrored(place)).R[-len(fit.low.time) :]
        return coarse.cost(R, coarse.low.modes) - as_it_is

    others = [path.mirrored(first).mirrored(last) for first, last in _flat_ends(path)]
    others += [path.mirrored(place) for place in _crossings(path, excess)]
    return _nearly_as_good(fit, coarse, [near(other) for other in others])


def _otherwise_spun(fit: Fit, assessment: Assessment) -> list[Path]:
    """Return the path of a fit with other spins, if these are seen far less than those about other axes."""
    coarse = ObjectModel.coarse(fit.low, fit.model.band, fit.model.guard)
    as_it_is = coarse.cost(fit.R, coarse.low.modes)
    progress = (fit.path.time - fit.path.time.mean()) / np.ptp(fit.path.time)
    axes = least_resisted_axes(fit, assessment)
    others = [[spun(fit.path, axis, spin * progress) for spin in _SPINS] for axis in axes[:2]]
    groups = len(fit.low.time)
    missed = [[coarse.cost(other.R[-groups:], coarse.low.modes) for other in about] for about in others]
    least, more = np.mean(missed, axis=1) - as_it_is
    return _nearly_as_good(fit, coarse, others[0]) if least <= _ELONGATED * more else []


def _nearly_as_good(fit: Fit, coarse: ObjectModel, starts: list[Path]) -> list[Path]:
    """Return where a coarse model leads from other paths, the few that explain the frames nearly as well."""
    as_it_is, smooth = coarse.cost(fit.R, coarse.low.modes), fit.roughness is not None
    found = [coarse.fit(start, fit.low.time, fit.spline, smooth=smooth) for start in starts]
    others = [one for one in found if align(one.R, fit.R)[0].max() > _OTHER]
    others.sort(key=lambda one: one.cost)
    return [one.path for one in others[:_TRIED] if one.cost <= _LIKELY * as_it_is]


def _flat_ends(path: Path) -> list[tuple[int, int]]:
    """Return where parts begin and end, at both of which the object hardly turns out of the image plane."""
    alpha = np.hypot(path.omega[:, 0], path.omega[:, 1])
    middle = alpha[1:-1]
    low = (middle <= alpha[:-2]) & (middle < alpha[2:]) & (middle < _FLAT * np.median(alpha))
    if not low.any():
        return []
    turned = _turned(alpha, path.time)
    places = [0]
    for place in (*(np.flatnonzero(low) + 1), len(alpha) - 1):
        if turned[place] - turned[places[-1]] > _UNNOTICED[0]:
            places.append(int(place))
    return [pair for pair in pairwise(places) if turned[pair[1]] - turned[pair[0]] <= _UNNOTICED[1]]


def _crossings(path: Path, excess: Callable[[int], float]) -> list[int]:
    """Return from where on the mirror image explains much more than from elsewhere, by its misfit."""
    turned = _turned(np.linalg.norm(path.omega, axis=1), path.time)
    steps = min(round(turned[-1] / _STEP), _MOST_STEPS)
    places = np.unique(np.searchsorted(turned, np.linspace(0, turned[-1], steps + 1)[1:-1]))
    missed = np.array(in_parallel(excess, places.tolist()))
    found = []
    for k in range(1, len(places) - 1):
        least = missed[k] <= min(missed[k - 1], missed[k + 1])
        if least and missed[k] < _DIP * min(missed[:k].max(), missed[k + 1 :].max()):
            found.append(k)
    found.sort(key=lambda k: missed[k])
    return [int(places[k]) for k in found[:_TRIED]]


def _turned(speed: Array, time: Array) -> Array:
    """Return the ``(N,)`` angles turned since the first time."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))])


def _other_tilts(fit: Fit) -> Iterator[Path]:
    """Yield the path of a fit with other tilts that explain the frames nearly as well, before any fit."""
    for factor in _FACTORS:
        path = tilted(fit.path, factor, fit.spline)
        if fit.model.cost(path.R[-len(fit.low.time) :], fit.low.modes) <= _HOPELESS * fit.cost:
            yield path


def _swings(R: Array) -> tuple[Array, Array, Array]:
    """Return ``(N, 3)`` rotation vectors across e₃, ``(N, 3, 3)`` spins about e₃ and the mean orientation.

    R is the mean times the swing times the spin.
    """
    direction = R[:, :, 2].mean(axis=0)
    e3 = np.array([0.0, 0.0, 1.0])
    mean = Rotation.align_vectors(direction / np.linalg.norm(direction), e3)[0].as_matrix()
    about = mean.T @ R
    x, y, z = about[:, :, 2].T
    across = np.hypot(x, y)
    angle = np.arctan2(across, z) / np.maximum(across, 1e-300)
    swing = np.stack([-y * angle, x * angle, np.zeros_like(x)], axis=1)
    return swing, Rotation.from_rotvec(-swing).as_matrix() @ about, mean
