"""Find the motion without a starting value: common lines and moments, hypotheses, growing windows.

Random constant angular velocities on a first window are refined to local minima of one noise-weighted
objective; the best few distinct ones survive while the window grows over the whole stack and the spline that
bends them gets more knots. A wrong branch that fits a short window does not fit a long one.

A short piece of a motion looks the same as its mirror image ΣRΣ, which turns out of the image plane the other
way. Where little turns out of it, a path may go over from one to the other: whatever fits worse than before
is tried the other way round as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.common_line import LineTable, choose_pairs
from trapcli.motion.elimination import bent_blocks
from trapcli.motion.moments import MomentTable
from trapcli.motion.path import Path, Spline, align, orthonormal

Array = NDArray[np.float64]
Index = NDArray[np.intp]

DISTINCT = np.deg2rad(3.0)
"""Mean angle beyond which two motions differ by more than gauge and mirror."""

_PAIRS = 12  # pairs of frames a frame
_USUAL_TURN = np.deg2rad(2.0)  # from group to group, for which the numbers of groups are meant
_FEWEST = 12  # groups of the first window
_REACH = 10  # groups added at each end at a time
_PER_KNOT = 12  # groups per interval of the spline
_SHORT = 480  # groups up to which every refinement takes the whole path
_STRAINED = 1.5  # misfit of groups that are added, in units of those before, from which the mirror is tried
_PLACES = 80  # where a path may go over into its mirror image that are looked at, and those that are tried
_TRIED = 8
_TURNS_BACK = 12  # of parts of a path, at most
_GAIN = 1e-3  # share of the misfit that a change of the path must gain
_GROWTH = 1.4  # growth of a longer path after which the whole is refined again
_LARGEST_STEP = 0.4  # radians
_FASTEST = np.deg2rad(160.0)  # turn over the first window
_SLOWEST = np.deg2rad(10.0)
_TAIL = 4  # steps whose mean carries a path on


@dataclass(frozen=True)
class Hypothesis:
    """A path with its cost; `lines` and `moments` are its parts per degree of freedom (1 fits the noise)."""

    path: Path
    cost: float
    lines: float
    moments: float

    @property
    def R(self) -> Array:
        """``(G, 3, 3)`` rotations of the groups."""
        return self.path.R


class Candidate(Protocol):
    """A motion of G groups of frames, and its misfit."""

    @property
    def R(self) -> Array:
        """``(G, 3, 3)`` rotations of the groups."""

    @property
    def cost(self) -> float:
        """Misfit to the data."""


C = TypeVar("C", bound=Candidate)


@dataclass(frozen=True)
class Evidence:
    """Line and moment tables of G groups of frames, and the pairs of groups that are compared."""

    time: Array
    lines: LineTable
    moments: MomentTable
    seed: int = 0

    def select(self, start: int, stop: int) -> Evidence:
        """Return the evidence of consecutive groups."""
        return Evidence(
            self.time[start:stop], self.lines.select(start, stop), self.moments.select(start, stop), self.seed
        )

    @cached_property
    def pairs(self) -> tuple[Index, Index]:
        """The pairs of groups that are compared."""
        return choose_pairs(len(self.time), _PAIRS, self.seed)

    def judge(self, path: Path) -> Hypothesis:
        """Return the path with its cost."""
        return self._judged(_together([path]))[0]

    def refine(self, paths: list[Path], spline: Spline, steps: int) -> list[Hypothesis]:
        """Bend paths to local minima (Levenberg–Marquardt in the spline's coefficients).

        Each goes its own way; they share the overhead of small arrays.
        """
        values = spline.values(self.time)
        count, size = len(paths), 3 * spline.size
        best = _together(paths)
        cost = self._cost(best.R)
        hessian, gradient = np.zeros((count, size, size)), np.zeros((count, size))
        damping = np.full(count, 1e-2)
        moving = np.arange(count)
        for _ in range(steps):
            hessian[moving], gradient[moving] = self._normal_equations(best.R[moving], values)
            before, waiting = cost.copy(), moving
            for _ in range(5):
                step = _damped_step(hessian[waiting], gradient[waiting], damping[waiting])
                largest = np.linalg.norm(values @ step, axis=-1).max(axis=-1)
                step *= np.minimum(1.0, _LARGEST_STEP / np.maximum(largest, 1e-300))[:, None, None]
                tried = Path(self.time, best.R[waiting], best.omega[waiting]).bent(spline, step)
                tried_cost = self._cost(tried.R)
                better = tried_cost < cost[waiting]
                accepted = waiting[better]
                best.R[accepted], best.omega[accepted] = tried.R[better], tried.omega[better]
                cost[accepted] = tried_cost[better]
                waiting = waiting[~better]
                damping[waiting] *= 8
                if not len(waiting):
                    break
            damping[moving] = np.maximum(damping[moving] / 5, 1e-7)
            # a path that gained little, or nothing in all trials, has come to rest
            moving = moving[(before - cost)[moving] > 2e-3 * cost[moving]]
            if not len(moving):
                break
        return self._judged(best)

    def _misfits(self, R: Array) -> tuple[Array, Array]:
        """Return the misfits of lines and of moments."""
        return self.lines.cost(R, *self.pairs).sum(axis=-1), self.moments.cost(R)

    def _cost(self, R: Array) -> Array:
        lines, moments = self._misfits(R)
        return self._scale * lines + moments

    def _judged(self, paths: Path) -> list[Hypothesis]:
        """Return each of several paths with its cost."""
        lines, moments = self._misfits(paths.R)
        cost = self._scale * lines + moments
        lines /= len(self.pairs[0]) * self.lines.degrees
        moments /= max(7 * len(self.time) - 16, 1)
        each = zip(paths.R, paths.omega, np.stack([cost, lines, moments], axis=-1).tolist(), strict=True)
        return [Hypothesis(Path(self.time, R, omega), *judged) for R, omega, judged in each]

    @property
    def _scale(self) -> float:
        """What one pair counts: a frame has few independent lines, however many pairs share them."""
        return min(1.0, 0.5 * self.lines.reach * len(self.time) / len(self.pairs[0]))

    def _normal_equations(self, R: Array, values: Array) -> tuple[Array, Array]:
        """Return Hessians and downhill gradients by the spline's coefficients."""
        s, t = self.pairs
        lines = self.lines.residuals(R, s, t)
        across = bent_blocks(values, s, t, lines.hessian[..., :3, 3:])
        hessian = across + np.swapaxes(across, -1, -2)
        hessian += bent_blocks(values, s, s, lines.hessian[..., :3, :3])
        hessian += bent_blocks(values, t, t, lines.hessian[..., 3:, 3:])
        hessian *= self._scale
        gradient = values[s].T @ lines.gradient[..., :3] + values[t].T @ lines.gradient[..., 3:]
        gradient *= self._scale
        every = np.arange(len(self.time))
        for order in self.moments.residuals(R):
            gradient += values.T @ order.gradient
            hessian += bent_blocks(values, every, every, np.swapaxes(order.slopes, -1, -2) @ order.slopes)
            coupling = np.swapaxes(order.design, -1, -2) @ order.slopes
            bent = np.einsum("gb,...gui->...ubi", values, coupling, optimize=True)
            bent = bent.reshape(*bent.shape[:-2], -1)
            hessian -= np.swapaxes(bent, -1, -2) @ np.linalg.solve(order.normal, bent)
        return hessian, gradient.reshape(*gradient.shape[:-2], -1)


def find_branches(
    evidence: Evidence,
    *,
    window: int,
    middle: float = 0.5,
    turn: float = _USUAL_TURN,
    starts: int = 32,
    keep: int = 6,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[Hypothesis]:
    """Return the hypotheses that survive on the whole stack, best first.

    Parameters
    ----------
    evidence:
        Line and moment tables of G groups of frames.
    window:
        Groups in the first window, where they turn as usual.
    middle:
        Where in the stack the first window lies: 0 at the start, 1 at the end.
    turn:
        From group to group [rad]: where it is more than usual, fewer groups make up a window.
    starts:
        Random constant angular velocities tried on the first window.
    keep:
        Hypotheses carried along.
    progress:
        Called as ``progress("branches", groups reached, G)``.
    """
    groups = len(evidence.time)
    density, per_knot = _density(turn), _per_knot(turn)
    reach = max(1, round(density * _REACH))
    window = min(max(_FEWEST, round(density * window)), groups)
    low = int(middle * (groups - window))
    high = low + window
    hypotheses = _first_window(evidence.select(low, high), starts, keep)
    refined = high - low
    while high - low < groups:
        if progress is not None:
            progress("branches", high - low, groups)
        new_low, new_high = max(0, low - reach), min(groups, high + reach)
        wider = evidence.select(new_low, new_high)
        length = new_high - new_low
        whole = length < _SHORT or length >= _GROWTH * refined or length == groups
        tail = min(_TAIL, high - low - 1)
        grown = []
        for h in hypotheses:
            path = h.path.extended(wider.time, low - new_low, tail)
            plain = _refined(wider, [path], per_knot, whole)
            grown += plain
            added = length - (high - low)
            if plain[0].cost - h.cost > _STRAINED * h.cost * added / (high - low):
                ends = {low - new_low, high - new_low - 1} - {0, length - 1}
                grown += _refined(wider, [path.mirrored(end) for end in sorted(ends)], per_knot, whole)
        hypotheses = distinct(grown, keep)
        low, high = new_low, new_high
        refined = length if whole else refined
    if progress is not None:
        progress("branches", groups, groups)
    return hypotheses


def turned_back(evidence: Evidence, hypothesis: Hypothesis, turn: float) -> Hypothesis:
    """Return the motion with parts that were mirror images turned back, as long as that fits better.

    Parameters
    ----------
    turn:
        From group to group [rad].
    """
    groups = len(evidence.time)
    spline = _spline(evidence.time, _per_knot(turn))
    places = range(1, groups - 1, max(1, groups // _PLACES))
    for _ in range(_TURNS_BACK):
        raw = np.array([evidence.judge(hypothesis.path.mirrored(place)).cost for place in places])
        padded = np.concatenate([[np.inf], raw, [np.inf]])
        lowest = np.flatnonzero((raw <= padded[:-2]) & (raw <= padded[2:]))
        likely = [places[i] for i in lowest[np.argsort(raw[lowest])[:_TRIED]]]
        tried = evidence.refine([hypothesis.path.mirrored(place) for place in likely], spline, 12)
        best = min(tried, key=lambda one: one.cost)
        if best.cost > (1 - _GAIN) * hypothesis.cost:
            break
        hypothesis = best
    return hypothesis


def distinct(candidates: list[C], keep: int) -> list[C]:
    """Return the best motions that differ by more than gauge and mirror and are not hopeless."""
    kept: list[C] = []
    for c in sorted(candidates, key=lambda c: c.cost):
        if kept and c.cost > 1.5 * kept[0].cost + 20:
            break
        if all(align(c.R, other.R)[0].mean() > DISTINCT for other in kept):
            kept.append(c)
        if len(kept) == keep:
            break
    return kept


def _density(turn: float) -> float:
    """Return how many groups there are to a turn, as a share of the usual."""
    return float(min(1.0, _USUAL_TURN / turn))


def _per_knot(turn: float) -> int:
    return max(2, round(_density(turn) * _PER_KNOT))


def _spline(time: Array, groups_per_knot: int) -> Spline:
    return Spline(time[0], time[-1], max(2, round(len(time) / groups_per_knot)))


def _refined(evidence: Evidence, paths: list[Path], per_knot: int, whole: bool) -> list[Hypothesis]:
    """Refine paths, or their ends only."""
    if whole:
        return evidence.refine(paths, _spline(evidence.time, per_knot), 12)
    return [evidence.judge(_refine_ends(evidence, path, per_knot)) for path in paths]


def _refine_ends(evidence: Evidence, path: Path, groups_per_knot: int) -> Path:
    """Refine both ends of a long path on their own; the middle stays."""
    groups, size = len(path.time), _SHORT // 2
    for window, joint in ((slice(0, size), size - 1), (slice(groups - size, groups), 0)):
        end = evidence.select(window.start, window.stop)
        piece = Path(path.time[window], path.R[window], path.omega[window])
        bent = end.refine([piece], _spline(end.time, groups_per_knot), 8)[0].path
        R, omega = path.R.copy(), path.omega.copy()
        # the object's orientation is free in each refinement: join where the window meets the rest
        R[window] = orthonormal((path.R[window][joint] @ bent.R[joint].T) @ bent.R)
        omega[window] = bent.omega
        path = Path(path.time, R, omega)
    return path


def _first_window(evidence: Evidence, starts: int, keep: int) -> list[Hypothesis]:
    rng = np.random.default_rng(evidence.seed)
    time = evidence.time
    span = time[-1] - time[0]
    # constant angular velocity: a rotation that grows linearly is all that bends at first
    line, curve = Spline(time[0], time[-1], 1), Spline(time[0], time[-1], 2)
    paths = []
    for _ in range(starts):
        axis = rng.normal(size=3)
        omega = axis / np.linalg.norm(axis) * rng.uniform(_SLOWEST, _FASTEST) / span
        paths.append(Path.constant(time, omega))
    rough = evidence.refine(paths, line, 8)
    return distinct(evidence.refine([h.path for h in rough], curve, 8), keep)


def _together(paths: list[Path]) -> Path:
    """Return paths at the same times on a leading axis."""
    return Path(paths[0].time, np.stack([p.R for p in paths]), np.stack([p.omega for p in paths]))


def _damped_step(hessian: Array, gradient: Array, damping: Array) -> Array:
    """Return ``(..., size, 3)`` coefficients of the damped step downhill."""
    diagonal = np.diagonal(hessian, axis1=-2, axis2=-1)
    ridge = damping[..., None] * diagonal + 1e-6 * diagonal.mean(axis=-1, keepdims=True) + 1e-300
    damped = hessian + ridge[..., None] * np.eye(diagonal.shape[-1])
    step = np.linalg.solve(damped, gradient[..., None])
    return np.asarray(step.reshape(*gradient.shape[:-1], -1, 3))
