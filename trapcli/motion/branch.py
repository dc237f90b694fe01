"""Find the motion without a starting value: common lines and moments, hypotheses, growing windows.

Random constant angular velocities on a first window are refined to local minima of one noise-weighted
objective; the best few distinct ones survive while the window grows over the whole stack and the spline that
bends them gets more knots. A wrong branch that fits a short window does not fit a long one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.common_line import LineTable, choose_pairs
from trapcli.motion.elimination import bent_blocks
from trapcli.motion.moments import MomentTable
from trapcli.motion.path import Path, Spline, align, orthonormal

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_PAIRS = 12  # pairs of frames a frame
_DISTINCT = np.deg2rad(3.0)  # mean angle between paths that are hypotheses of their own
_REACH = 10  # groups added at each end at a time
_SHORT = 120  # groups up to which every refinement takes the whole path
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
        s, t = self.pairs
        lines, moments = self.lines.cost(path.R, s, t).sum(), self.moments.cost(path.R)
        per_pair = lines / (len(s) * self.lines.degrees)
        degrees = max(7 * len(self.time) - 16, 1)
        return Hypothesis(path, self._scale(len(s)) * lines + moments, float(per_pair), moments / degrees)

    def refine(self, path: Path, spline: Spline, steps: int) -> Hypothesis:
        """Bend a path to a local minimum (Levenberg–Marquardt in the spline's coefficients)."""
        values = spline.values(self.time)
        damping = 1e-2
        best = self.judge(path)
        for _ in range(steps):
            hessian, gradient = self._normal_equations(best.path, values)
            diagonal = np.diag(hessian)
            for _ in range(5):
                damped = hessian + np.diag(damping * diagonal + 1e-6 * diagonal.mean() + 1e-300)
                step = np.linalg.solve(damped, gradient).reshape(-1, 3)
                largest = np.linalg.norm(values @ step, axis=1).max()
                tried = self.judge(
                    best.path.bent(spline, step * min(1.0, _LARGEST_STEP / max(largest, 1e-300)))
                )
                if tried.cost < best.cost:
                    break
                damping *= 8
            else:
                return best
            gain, best = best.cost - tried.cost, tried
            damping = max(damping / 5, 1e-7)
            if gain < 2e-3 * best.cost:
                break
        return best

    def _scale(self, pairs: int) -> float:
        """Return what one pair counts: a frame has few independent lines, however many pairs share them."""
        return min(1.0, 0.5 * self.lines.reach * len(self.time) / pairs)

    def _normal_equations(self, path: Path, values: Array) -> tuple[Array, Array]:
        """Return Hessian and downhill gradient by the spline's coefficients."""
        s, t = self.pairs
        lines = self.lines.residuals(path.R, s, t)
        scale = self._scale(len(s))
        groups, size = values.shape
        own = np.zeros((groups, 3, 3))
        np.add.at(own, s, scale * lines.hessian[:, :3, :3])
        np.add.at(own, t, scale * lines.hessian[:, 3:, 3:])
        gradient = np.zeros((groups, 3))
        np.add.at(gradient, s, scale * lines.gradient[:, :3])
        np.add.at(gradient, t, scale * lines.gradient[:, 3:])
        eliminated = np.zeros((3 * size, 3 * size))
        for order in self.moments.residuals(path.R):
            gradient += order.gradient
            own += np.swapaxes(order.slopes, 1, 2) @ order.slopes
            coupling = np.swapaxes(order.design, 1, 2) @ order.slopes
            bent = np.einsum("gb,gui->ubi", values, coupling, optimize=True).reshape(-1, 3 * size)
            eliminated += bent.T @ np.linalg.solve(order.normal, bent)
        every = np.arange(groups)
        across = bent_blocks(values, s, t, scale * lines.hessian[:, :3, 3:])
        hessian = bent_blocks(values, every, every, own) + across + across.T - eliminated
        return hessian, (values.T @ gradient).ravel()


def find_branches(
    evidence: Evidence,
    *,
    window: int,
    middle: float = 0.5,
    starts: int = 32,
    keep: int = 6,
    groups_per_knot: int = 12,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[Hypothesis]:
    """Return the hypotheses that survive on the whole stack, best first.

    Parameters
    ----------
    evidence:
        Line and moment tables of G groups of frames.
    window:
        Groups in the first window.
    middle:
        Where in the stack the first window lies: 0 at the start, 1 at the end.
    starts:
        Random constant angular velocities tried on the first window.
    keep:
        Hypotheses carried along.
    groups_per_knot:
        Groups per interval of the spline.
    progress:
        Called as ``progress("branches", groups reached, G)``.
    """
    groups = len(evidence.time)
    window = min(window, groups)
    low = int(middle * (groups - window))
    high = low + window
    hypotheses = _first_window(evidence.select(low, high), starts, keep)
    refined = high - low
    while high - low < groups:
        if progress is not None:
            progress("branches", high - low, groups)
        new_low, new_high = max(0, low - _REACH), min(groups, high + _REACH)
        wider = evidence.select(new_low, new_high)
        length = new_high - new_low
        whole = length < _SHORT or length >= _GROWTH * refined or length == groups
        tail = min(_TAIL, high - low - 1)
        grown = []
        for h in hypotheses:
            path = h.path.extended(wider.time, low - new_low, tail)
            if whole:
                grown.append(wider.refine(path, _spline(wider.time, groups_per_knot), 12))
            else:
                grown.append(wider.judge(_refine_ends(wider, path, groups_per_knot)))
        hypotheses = _distinct(grown, keep)
        low, high = new_low, new_high
        refined = length if whole else refined
    if progress is not None:
        progress("branches", groups, groups)
    return hypotheses


def _spline(time: Array, groups_per_knot: int) -> Spline:
    return Spline(time[0], time[-1], max(2, round(len(time) / groups_per_knot)))


def _refine_ends(evidence: Evidence, path: Path, groups_per_knot: int) -> Path:
    """Refine both ends of a long path on their own; the middle stays."""
    groups, size = len(path.time), _SHORT // 2
    for window, joint in ((slice(0, size), size - 1), (slice(groups - size, groups), 0)):
        end = evidence.select(window.start, window.stop)
        piece = Path(path.time[window], path.R[window], path.omega[window])
        bent = end.refine(piece, _spline(end.time, groups_per_knot), 8).path
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
    found = []
    for _ in range(starts):
        axis = rng.normal(size=3)
        omega = axis / np.linalg.norm(axis) * rng.uniform(_SLOWEST, _FASTEST) / span
        rough = evidence.refine(Path.constant(time, omega), line, 8)
        found.append(evidence.refine(rough.path, curve, 8))
    return _distinct(found, keep)


def _distinct(hypotheses: list[Hypothesis], keep: int) -> list[Hypothesis]:
    """Return the best hypotheses that differ by more than gauge and mirror and are not hopeless."""
    kept: list[Hypothesis] = []
    for h in sorted(hypotheses, key=lambda h: h.cost):
        if kept and h.cost > 1.5 * kept[0].cost + 20:
            break
        if all(align(h.path.R, other.path.R)[0].mean() > _DISTINCT for other in kept):
            kept.append(h)
        if len(kept) == keep:
            break
    return kept
