"""The joint estimate from attenuation to motion: ``--method auto``.

Common lines at all baselines and moments find the motion without a starting value (`branch`); a low-frequency
model of the object, eliminated exactly, refines it and judges it (`object_model`). The misfit that remains,
per degree of freedom, is 1 where pixel noise explains it: the certificate of the result.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trapcli.config import MotionConfig
from trapcli.errors import InputError
from trapcli.motion.ambiguity import unseen_turn
from trapcli.motion.branch import (
    DISTINCT,
    Candidate,
    Evidence,
    Hypothesis,
    distinct,
    find_branches,
    turned_back,
)
from trapcli.motion.centers import Progress
from trapcli.motion.common_line import LineTable
from trapcli.motion.front_end import read_front_end
from trapcli.motion.low_band import LowBand, group_means
from trapcli.motion.moments import MomentTable
from trapcli.motion.object_model import Assessment, Fit, ObjectModel, refitted
from trapcli.motion.path import Path, Spline, align
from trapcli.motion.relief import relieved, score, unspun, untangled, widened
from trapcli.motion.types import ReducedMap
from trapcli.motion.verdict import (
    COARSE,
    NOISE_ERROR,
    Stack,
    by_parts,
    certified,
    judge,
    nothing_known,
    to_motion,
    typical_error,
)
from trapcli.result.motion import Motion
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
ComplexArray = NDArray[np.complex128]

_FEWEST = 12  # frames
_LINE_BAND = 8.0  # band times radius for common lines
_NARROWEST_BAND = 16.0  # band times radius of the object model that tells motions apart, at least
_FINE_BAND = 22.0  # the same at most
_FINEST_BAND = 28.0  # the same in the end, where the object is as sharp as that
_TOLD = 5.0  # signal over noise of the object's finest parts, from all frames, up to which they help
_WORTHWHILE = 0.05  # share in what tells the motion that makes a wider band worth its time
_LINE_GROUP = np.deg2rad(2.0)  # rotation over a group of frames that are averaged, to find the branch
_FINE_GROUP = np.deg2rad(1.0)  # the same, to refine it, at noise of 1 % of the peak
_FEWEST_GROUPS = 30
_LINE_ERROR = 0.01  # model error of the lines, as a share of the map
_STANDING_ERROR = 0.03  # the same where something stays in place
_MOMENT_ERROR = 0.002  # model error of the moments, as a share of their size
_ATTEMPTS = (
    (50, 0.5),
    (80, 0.5),
    (50, 0.15),
    (50, 0.85),
    (120, 0.5),
)  # first window [groups] and where it lies
_TURNED_BACK = 2  # hypotheses of which parts may be mirror images
_FITS = 1.5  # misfit per degree of freedom of lines and moments up to which one window will do at first
_LIKELY = 1.3  # cost, in units of the best's, up to which a hypothesis is looked into further
_MOST_HYPOTHESES = 2, 16  # of them at most, of the first window that fits and of all
_RIVAL = 1.1  # misfit of a coarse model, in units of the best's, up to which a fine one is fitted as well
_MOST_REFINED = 2, 4  # of them at most
_MOST_DESPITE = 6  # of hypotheses despite what stays in place
_FIRST_STEPS = 6  # of the first fit: a motion that is not found by then is none
_COARSE_KNOTS = np.deg2rad(24.0)  # rotation per interval of the spline that comes first
_FINE_KNOTS = np.deg2rad(6.0)  # the same in the end, where roughness of ω is weighed against the misfit
_FEWEST_KNOTS = 4, 12  # intervals of these splines at least
_CROWDED = 0.55  # share of the coefficients that the frames determine from which on there are too few
_HOPELESS = 6.0  # misfit per degree of freedom that no knots mend
_MOST_KNOTS = 400  # the same at most: matrices grow with their square
_NEAR = np.deg2rad(1.0)  # mean angle to a motion that another one may have which is fitted in its place
_LEAST_SHARE = 0.25  # of the noise, to which it is lowered: of clean frames it stands for model errors
_NEARLY_PLANAR = 0.5  # share of ω₃ in α below which a rotation about the optical axis alone is tried
_PATIENCE = 5.0  # of a look with a coarse model at such a rotation, in units of what noise gives
_SETTLED = 1.03  # misfit per degree of freedom up to which no other motion is tried, if this one is told well
_UNEVEN = 0.07  # share by which the misfit of one may be above that of most
_WORSE = 2.5  # standard deviations by which the misfit of the finest fit may be above that of the one before
_OUTLYING = 8.0  # misfit of a frame to its neighbours, in units of what is common, that makes it an outlier
_SIGNIFICANT = 5.0  # standard deviations of change that show that anything moves


@dataclass(frozen=True)
class Found:
    """The motion that explains the frames best, of all hypotheses, before it is refined.

    Attributes
    ----------
    stack:
        What is known of the frames.
    pace:
        Roughly the rotation from frame to frame [rad]; 0 where nothing changes.
    best:
        The motion and what is known of it; None where nothing changes.
    bands:
        Of the object model that found it and of the finest one that is worthwhile [rad / length].
    knots:
        Intervals of ω's spline, 0 where the data tell them.
    """

    stack: Stack
    pace: float
    best: tuple[Fit, Assessment] | None
    bands: tuple[float, float]
    knots: int

    def motion(self) -> Motion:
        """Return the motion as it is, once turns that a symmetry may hide have been looked for."""
        return self._motion(hidden=True)

    @cached_property
    def so_far(self) -> Motion:
        """The motion without that look."""
        return self._motion(hidden=False)

    def _motion(self, *, hidden: bool) -> Motion:
        if self.best is None:
            return nothing_known(
                self.stack,
                "nothing changes between the frames beyond the noise: the object is still, "
                "or turns about an axis of symmetry; no rotation can be told",
            )
        verdict = judge(*self.best)
        look = hidden and verdict.identifiable
        unseen = unseen_turn(*self.best, self.bands[0]) if look else None
        return to_motion(self.stack, *self.best, verdict, unseen)

    def about(self, center: Array) -> LowBand:
        """Return the low modes of all frames about other centres, ``(N, 2)`` [length]."""
        return self.stack.low.shifted(center - self.stack.centers.center)

    @property
    def explains(self) -> bool:
        """Whether noise alone explains what the motion leaves."""
        return self.best is not None and certified(*self.best)

    def without(self, pattern: ComplexArray, path: Path | None = None) -> Found:
        """Return where a path, or else this motion's, leads to without ``(N, K)`` modes in the frames."""
        if self.best is None:
            return self
        (fit, _), time = self.best, self.stack.low.time
        stack = replace(self.stack, low=replace(self.stack.low, modes=self.stack.low.modes - pattern))
        low = _fine_groups(stack, self.pace)
        coarse = fit
        if path is not None:
            (coarse,) = _coarse_fits([path.ascending()], low, time, fit.model.band, self.knots)
        model = ObjectModel.likeliest(low, fit.model.band, coarse.R, sharp=fit.model.sharp)
        best = _fine_fit(coarse, model, smooth=not self.knots)
        stack, best = _quieter(stack, self.pace, *best)
        return replace(self, stack=stack, best=best)

    def despite_standing(self, progress: Progress | None = None) -> list[Path]:
        """Return paths of motions that lines and moments allow where something stays in place."""
        evidence, turn = _evidence(self.stack, self.pace, standing=True)
        *_, found = _searched(evidence, turn, _MOST_DESPITE, progress)
        return [h.path for h in found]

    def refined(self) -> Found:
        """Return the likeliest motion near this one, with an object that has its sharp edges."""
        if self.best is None:
            return self
        low, time = _fine_groups(self.stack, self.pace), self.stack.low.time
        return replace(self, best=_refined(low, *self.best, time, self.bands[1], self.knots))


def find_motion(
    attenuation: Frames,
    config: MotionConfig,
    *,
    time: Array,
    pixel_size: float = 1.0,
    progress: Progress | None = None,
) -> Found:
    """Find the motion from all frames at once.

    Parameters
    ----------
    attenuation:
        N attenuation projections.
    config:
        `band` and `knots` are used.
    time:
        ``(N,)`` ascending times.
    pixel_size:
        Edge of a pixel [length].
    progress:
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    Found
        In the units of `time` and `pixel_size`, which the caller names.

    Raises
    ------
    InputError
        Where fewer than 12 frames show an object.
    """
    front = read_front_end(
        attenuation,
        time=time,
        pixel_size=pixel_size,
        line_band=_LINE_BAND,
        fine_band=_FINEST_BAND,
        band=config.band,
        progress=progress,
    )
    centers, reduced, low = front.centers, front.reduced, front.low
    seen = np.asarray(np.isfinite(centers.center).all(axis=1))
    if seen.sum() < _FEWEST:
        raise InputError(
            f"{attenuation.info.source}: {seen.sum()} frames show an object; at least {_FEWEST} are needed"
        )
    outlying = np.zeros(len(time), bool)
    outlying[seen] = _outliers(low.select(np.flatnonzero(seen)))
    stack = Stack(reduced, low, centers, seen, outlying, attenuation.index)
    used = stack.used
    pace = _turn_per_frame(reduced.samples[used], reduced.noise)
    bands = (config.band, config.band) if config.band else _bands(low.select(used))
    if pace == 0.0:
        return Found(stack, pace, None, bands, config.knots)
    best = _best_motion(stack, pace, bands[0], config.knots, progress)
    stack, best = _quieter(stack, pace, *best)
    return Found(stack, pace, best, bands, config.knots)


def _bands(low: LowBand) -> tuple[float, float]:
    """Return the bands of the object model that tells motions apart and of the last [rad / length].

    A part of the object at k is seen by those frames whose slice passes within half its width, π / radius.
    Where all of them together leave it in the noise, it tells nothing of the motion.
    """
    radial = low.radius * np.hypot(low.k[:, 0], low.k[:, 1])
    power = np.mean(np.abs(low.modes) ** 2, axis=0) / low.variance - 1
    ring = np.arange(_NARROWEST_BAND, _FINEST_BAND, 1.0)
    told = np.array([power[np.abs(radial - middle) <= 1.0].mean() for middle in ring])
    told *= len(low.modes) * np.pi / 2 / ring
    last = ring[told > _TOLD].max(initial=_NARROWEST_BAND - 1.0) + 1.0
    telling = radial**2 * np.maximum(power, 0.0)  # how much a small turn changes, in units of the noise
    finer = telling[(radial > _FINE_BAND) & (radial <= last)].sum() > _WORTHWHILE * telling.sum()
    first = min(last, _FINE_BAND)
    return first / low.radius, (last if finer else first) / low.radius


def _best_motion(
    stack: Stack, pace: float, band: float, knots: int, progress: Progress | None
) -> tuple[Fit, Assessment]:
    """Return the motion that explains the frames best, of all hypotheses that are worth a look."""
    low = _fine_groups(stack, pace)
    coarse: list[Fit] = []
    tried: list[Fit] = []
    best: tuple[Fit, Assessment] | None = None
    for most, hypotheses in zip(_MOST_REFINED, _hypotheses(stack, pace, progress), strict=False):
        # a coarse model of the object tells right from wrong far better than lines and moments do
        coarse += _coarse_fits([h.path for h in hypotheses], low, stack.low.time, band, knots)
        rivals = distinct(coarse, most)
        near = [fit for fit in rivals if fit.cost <= _RIVAL * rivals[0].cost]
        new = [fit for fit in near if not any(_repeats(fit, other) for other in tried)]
        tried += new
        for rival in new:
            fitted = _fine_fit(rival, ObjectModel.likeliest(low, band, rival.R), smooth=not knots)
            best = min(best or fitted, fitted, key=lambda one: score(*one))
        if best is not None and _settled(*best, len(stack.low.time)):
            break
    assert best is not None
    return best if best[0].axes == (2,) else untangled(*best)


def _quieter(
    stack: Stack, pace: float, fit: Fit, assessment: Assessment
) -> tuple[Stack, tuple[Fit, Assessment]]:
    """Lower the noise to what the motion leaves over: sharp edges that move pass for noise.

    Too much of it would hide a wrong motion's misfit, and makes motions look better that see less.
    """
    share = max(fit.cost / assessment.degrees, _LEAST_SHARE)
    if share >= 1 - NOISE_ERROR:
        return stack, (fit, assessment)
    stack = replace(stack, low=replace(stack.low, variance=share * stack.low.variance))
    low = _fine_groups(stack, pace)
    return stack, refitted(low, fit, fit.path)


def _refined(
    low: LowBand, fit: Fit, assessment: Assessment, time: Array, finest: float, knots: int
) -> tuple[Fit, Assessment]:
    """Look for a likelier tilt, give the motion as many knots as it needs, and the object its sharp edges."""
    turns_in_plane = fit.axes == (2,)  # what there is besides, a richer motion has told
    hopeless = fit.cost > _HOPELESS * assessment.degrees
    found = [(fit, assessment)]
    model = fit.model
    if not (turns_in_plane or hopeless):
        fit, assessment = unspun(fit, assessment)
        found = relieved(low, fit, assessment, len(time))
        fit, assessment = found[0]
        if not knots:
            fit, assessment = _uncrowded(fit, assessment, time)
        # a depth that the frames leave open would confirm itself
        model = _told(fit) if len(found) == 1 else fit.model
    bands = [finest] if finest > fit.model.band and not turns_in_plane and certified(fit, assessment) else []
    if model is not fit.model:
        bands.append(fit.model.band)
    for band in bands:
        # a prior told at low frequencies may be wrong so far beyond
        again, known = ObjectModel(low, band, guard=model.guard, prior=model.prior).again(fit)
        if _as_well(again, known, fit, assessment):
            fit, assessment = again, known
            break
    if not certified(fit, assessment):
        fit, assessment = _with_model_error(fit, assessment)
    return fit, widened(fit, assessment, len(time), found)


def _uncrowded(fit: Fit, assessment: Assessment, time: Array) -> tuple[Fit, Assessment]:
    """Give the motion more knots while the frames determine most of its coefficients, or it is kicked.

    A particle in thermal motion turns a little anew in every frame, however slowly it turns on the whole.
    """
    groups = fit.model.low.time
    while True:
        crowded = assessment.parameters > _CROWDED * 3 * fit.spline.size
        kicked = fit.roughness is not None and fit.roughness.kicks > 0
        most = min(len(groups) - 3, _MOST_KNOTS)  # as many coefficients as groups
        if not (crowded or kicked) or fit.spline.intervals >= most:
            return fit, assessment
        spline = replace(fit.spline, intervals=most if kicked else min(2 * fit.spline.intervals, most))
        path = fit.path.sampled(spline, np.concatenate([time, spline.grid, groups]))
        richer = fit.model.fit(path, groups, spline)
        told = fit.model.assess(richer)
        if score(richer, told) > score(fit, assessment):
            return fit, assessment
        fit, assessment = richer, told


def _told(fit: Fit) -> ObjectModel:
    """Return the model that the evidence at a motion tells: how large blobs are, how strong, and where.

    What lies at high frequencies is often no sample of what the low ones show. So these alone may tell it.
    """
    models = fit.model, fit.model.roughly_told(fit)
    return min(models, key=lambda model: model.score(fit)).placed(fit)


def _as_well(finer: Fit, told: Assessment, fit: Fit, assessment: Assessment) -> bool:
    """Tell whether the misfit per degree of freedom of a finer fit is that of another, but for noise."""
    worse = finer.cost / told.degrees - fit.cost / assessment.degrees
    return bool(worse <= _WORSE * np.sqrt(2 / told.degrees))


def _repeats(one: Candidate, other: Candidate) -> bool:
    """Tell whether a motion is that of another one, whose misfit is about as low or lower."""
    return bool(other.cost <= _RIVAL * one.cost and align(one.R, other.R)[0].mean() <= DISTINCT)


def _settled(fit: Fit, assessment: Assessment, n: int) -> bool:
    """Tell whether a motion explains all the images and is told so well that no other need be tried."""
    explained = fit.cost <= _SETTLED * assessment.degrees and _even(assessment)
    return explained and typical_error(fit, assessment, n) <= COARSE


def _even(assessment: Assessment) -> bool:
    """Tell whether all parts of the stack are explained alike: a motion may be wrong in one of them only."""
    parts, by_noise = by_parts(assessment)
    return bool(parts.max() <= (1 + max(_UNEVEN, by_noise)) * np.median(parts))


def _outliers(low: LowBand) -> Bools:
    """Tell which frames differ from their neighbours far more than is usual in their part of the stack."""
    n = len(low.time)
    good = np.ones(n, bool)
    while True:
        kept = np.flatnonzero(good)
        modes = low.modes[kept]
        middle = modes[1:-1] - 0.5 * (modes[:-2] + modes[2:])
        misfit = np.mean(np.abs(middle) ** 2, axis=1) / (1.5 * low.variance)
        # a flash spoils the differences of its neighbours too: only the worst of each three is judged
        padded = np.concatenate([[0.0], misfit, [0.0]])
        worst = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
        typical = np.array([np.median(misfit[max(0, i - 12) : i + 13]) for i in range(len(misfit))])
        # where the motion is fast, frames differ from their neighbours that no outlier is part of
        beside = np.pad(misfit, 3, mode="reflect")
        beside = np.median([beside[:-6], beside[1:-5], beside[5:-1], beside[6:]], axis=0)
        typical = np.maximum(typical, beside)
        bad = worst & (misfit > _OUTLYING * np.maximum(typical, 1.0))
        if not bad.any() or good.sum() - bad.sum() < 0.8 * n:
            return ~good
        good[kept[1:-1][bad]] = False


def _turn_per_frame(samples: NDArray[np.complexfloating], noise: float) -> float:
    """Return roughly the rotation from frame to frame [rad]; 0 where nothing changes.

    Turning by θ in the image changes J̃ by θ ∂φJ̃. Turning out of it may change much less of what is seen in
    one frame; but what changes in all the stack changes over about a radian.
    """
    n, rings, lines = samples.shape
    turn = np.concatenate([samples, samples.conj()], axis=2)
    order = np.fft.fftfreq(2 * lines, 1 / (2 * lines))
    slope = np.fft.ifft(np.fft.fft(turn, axis=2) * (1j * order), axis=2)
    structure = float(np.mean(np.abs(slope) ** 2))
    lags = [2**i for i in range(max(1, n.bit_length() - 1))]
    change = np.array([np.mean(np.abs(samples[lag:] - samples[:-lag]) ** 2) - 2 * noise**2 for lag in lags])
    error = np.array([2 * noise**2 / np.sqrt(max(n * rings / lag, 1.0)) for lag in lags])
    significant = np.flatnonzero(change > _SIGNIFICANT * error)
    if not len(significant):
        return 0.0
    clear = significant[change[significant] > noise**2]
    first = clear[0] if len(clear) else significant[-1]
    within = np.sqrt(change[first] / structure)
    overall = np.sqrt(change[first] / change.max()) if len(clear) > 1 else 0.0
    return float(max(within, overall) / lags[first])


def _grouped(stack: Stack, size: int) -> tuple[ReducedMap, LowBand]:
    """Return means over groups of `size` consecutive used frames."""
    used = stack.used
    low = stack.low.select(used).grouped(size)
    mean = group_means(stack.reduced.samples[used], len(low.time))
    noise = stack.reduced.noise * np.sqrt(len(low.time) / len(used))
    return replace(stack.reduced, samples=mean, time=low.time, noise=noise), low


def _fine_groups(stack: Stack, pace: float) -> LowBand:
    """Return means over groups of frames within which the object turns too little to see it in the noise."""
    fine = _FINE_GROUP * float(np.clip(np.sqrt(_relative_noise(stack) / 0.01), 0.3, 2.0))
    size = max(1, min(int(fine / pace), len(stack.used) // _FEWEST_GROUPS))
    return _grouped(stack, size)[1]


def _evidence(stack: Stack, pace: float, *, standing: bool = False) -> tuple[Evidence, float]:
    """Return what lines and moments of groups of frames tell, and roughly the turn between groups [rad].

    What is `standing` under the particle adds to moments what is linear in where the centre is, at first
    order: they are freed of it. It adds the same to lines that lie alike: they are believed less.
    """
    size = max(1, min(int(_LINE_GROUP / pace), len(stack.used) // _FEWEST_GROUPS))
    reduced, low = _grouped(stack, size)
    centring = float(np.median(stack.centers.errors[stack.used])) / np.sqrt(size)
    lines = LineTable(reduced, _STANDING_ERROR if standing else _LINE_ERROR, centring)
    series = _linear(group_means(stack.centers.center[stack.used], len(low.time))) if standing else None
    return Evidence(low.time, lines, MomentTable(low, _MOMENT_ERROR, series)), size * pace


def _searched(
    evidence: Evidence, turn: float, most: int, progress: Progress | None
) -> Iterator[list[Hypothesis]]:
    """Yield the best motions so far, after the search from each window."""
    found: list[Hypothesis] = []
    for attempt, (window, middle) in enumerate(_ATTEMPTS):
        tried = replace(evidence, seed=attempt)
        branches = find_branches(tried, window=window, middle=middle, turn=turn, progress=progress)
        found = distinct([*found, *(evidence.judge(h.path) for h in branches)], most)
        yield found


def _hypotheses(stack: Stack, pace: float, progress: Progress | None) -> Iterator[list[Hypothesis]]:
    """Yield motions that common lines and moments allow: of the first window that fits, then of all."""
    evidence, turn = _evidence(stack, pace)
    yielded: list[Hypothesis] = []
    for attempt, found in enumerate(_searched(evidence, turn, _MOST_HYPOTHESES[1], progress)):
        last = attempt == len(_ATTEMPTS) - 1
        fits = found[0].lines < _FITS and found[0].moments < _FITS
        if last:
            again = [turned_back(evidence, h, turn) for h in found[:_TURNED_BACK]]
            found = distinct([*again, *found], _MOST_HYPOTHESES[1])
        if last or (fits and not yielded):
            most = _MOST_HYPOTHESES[1 if yielded else 0]
            likely = [h for h in found[:most] if h.cost <= _LIKELY * found[0].cost]
            new = [h for h in likely if not any(_repeats(h, other) for other in yielded)]
            yielded += new
            if new:
                yield new


def _linear(center: Array) -> Array:
    """Return ``(G, 3)`` what depends on ``(G, 2)`` centres linearly: 1 and both, of unit size."""
    way = center - center.mean(axis=0)
    return np.column_stack([np.ones(len(way)), way / (np.sqrt(np.mean(way**2)) + 1e-300)])


def _coarse_fits(paths: list[Path], low: LowBand, time: Array, band: float, knots: int) -> list[Fit]:
    """Fit a coarse object model along paths, with as many knots as turns may need where it pays."""

    def light(fit: Fit) -> Fit:
        return replace(fit, known=None)  # normal equations of many motions would take much memory

    model = ObjectModel.coarse(low, band)
    first: list[Fit] = []
    finer: list[Spline] = []
    for path in paths:
        turned = float(np.linalg.norm(path.mean_omega(), axis=1).mean() * np.ptp(low.time))
        rough, fine = (
            Spline(time[0], time[-1], min(max(least, round(turned / angle)), len(low.time) // 3, _MOST_KNOTS))
            for least, angle in zip(_FEWEST_KNOTS, (_COARSE_KNOTS, _FINE_KNOTS), strict=True)
        )
        if knots:
            rough = fine = Spline(time[0], time[-1], knots)
        near = path.near(rough, np.concatenate([time, fine.grid, low.time]))
        first.append(light(model.fit(near, low.time, rough, smooth=False, steps=_FIRST_STEPS)))
        finer.append(fine)
    if knots:
        return first
    least = min(fit.cost for fit in first)
    return [
        light(model.fit(fit.path.simplest(spline, _NEAR), low.time, spline))
        for fit, spline in zip(first, finer, strict=True)
        if fit.cost <= _LIKELY * least
    ]


def _fine_fit(coarse: Fit, model: ObjectModel, *, smooth: bool) -> tuple[Fit, Assessment]:
    """Go on with a finer object model, and judge the motion by it."""
    # wiggles that bending can't quite undo would pass for a motion that is rough
    path = coarse.path.simplest(coarse.spline, _NEAR) if smooth else coarse.path
    fit = model.fit(path, model.low.time, coarse.spline, smooth=smooth)
    return _simplest(model, fit, model.assess(fit))


def _simplest(model: ObjectModel, fit: Fit, assessment: Assessment) -> tuple[Fit, Assessment]:
    """Take a rotation about the optical axis alone instead where it explains the images as well."""
    omega = np.median(np.abs(fit.path.omega), axis=0)
    if np.hypot(omega[0], omega[1]) >= _NEARLY_PLANAR * omega[2]:
        return fit, assessment
    # most rotations that are not about the optical axis alone show it at once
    coarse = ObjectModel.coarse(model.low, model.band, model.guard)
    rich = coarse.fit(fit.path, fit.low.time, fit.spline, smooth=fit.roughness is not None)
    if _planar(coarse, rich, coarse.assess(rich), _PATIENCE) is None:
        return fit, assessment
    simpler = _planar(model, fit, assessment)
    if simpler is None:
        return fit, assessment
    # how far out of the image plane it might turn is what the richer motion tells
    return simpler[0], replace(simpler[1], covariance=assessment.covariance)


def _planar(
    model: ObjectModel, fit: Fit, assessment: Assessment, patience: float = 1.0
) -> tuple[Fit, Assessment] | None:
    """Return the best rotation about the optical axis alone, if it explains the images as well.

    It may miss them by `patience` times what noise gives.
    """
    path, smooth = fit.path.planar(fit.spline), fit.roughness is not None
    planar = model.fit(path, fit.low.time, fit.spline, smooth=smooth, axes=(2,))
    simpler = model.assess(planar)
    misfit = max(fit.cost / assessment.degrees, 1.0)
    # seen from one side only, the object has fewer parameters too. Turns out of the plane times what they
    # show of it fit noise as the largest singular values of a random matrix do (Davidson and Szarek 2001,
    # DOI 10.1016/S1874-5849(01)80010-3)
    turns = max(assessment.parameters - simpler.parameters, 0.0)
    shown = max(simpler.degrees - assessment.degrees - turns, 0.0)
    by_noise = (np.sqrt(shown) + np.sqrt(turns) + _SIGNIFICANT / np.sqrt(2)) ** 2
    return (planar, simpler) if planar.cost - fit.cost < patience * misfit * by_noise else None


def _relative_noise(stack: Stack) -> float:
    """Return the pixel noise as a share of a typical attenuation of the object."""
    area = np.pi * stack.centers.radius**2
    return float(stack.centers.noise * area / np.nanmedian(stack.low.mass)) / 3


def _with_model_error(fit: Fit, assessment: Assessment) -> tuple[Fit, Assessment]:
    """Fit again with the noise of each mode raised to the misfit that was left, so that errors are honest.

    What an imperfect model leaves is much alike from group to group, and so many groups say it but once.
    """
    misfit = assessment.mode_misfit
    excess = np.where(misfit > 1, misfit * _alike(fit.normal.residual), 1.0)
    model = ObjectModel.after(fit, replace(assessment, mode_misfit=excess), fit.model.band)
    again, honest = model.again(fit)
    again = replace(again, shift=again.shift + fit.shift, cost=fit.cost, known=again.normal)
    covariance = honest.covariance
    if fit.axes == (2,):
        # errors out of the image plane, which the richer motion told, grow as those in the plane do
        own, before = (np.trace(a.covariance[:, 2, :, 2]) for a in (honest, assessment))
        covariance = assessment.covariance * max(own / before, fit.cost / assessment.degrees)
    return again, replace(
        honest,
        covariance=covariance,
        degrees=assessment.degrees,
        # what is left over is told in units of the pixel noise
        frame_misfit=assessment.frame_misfit,
        mode_misfit=honest.mode_misfit * excess,
    )


def _alike(residual: NDArray[np.complex128]) -> float:
    """Return the autocorrelation time of ``(G, K)`` residuals [groups], up to the first lag without any."""
    lags = range(len(residual) // 2)
    power = [float(np.sum((residual[: len(residual) - lag].conj() * residual[lag:]).real)) for lag in lags]
    uncorrelated = np.flatnonzero(np.array(power) <= 0)
    last = uncorrelated[0] if len(uncorrelated) else len(power)
    return 1 + 2 * sum(power[1:last]) / power[0]
