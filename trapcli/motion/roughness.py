"""How fast ω(t) may change, found from the data: a penalty on its roughness, chosen by its evidence.

Where the motion is bent by cubic splines, ω is nearly a quadratic one. Differences of its coefficients,
second ones or higher, are taken to be Gaussian (Eilers and Marx 1996, DOI 10.1214/ss/1038425655) with a
covariance of their own: a particle may turn unevenly about one axis and steadily about the others. The
covariance is the one under which the data are likeliest, the motion integrated out in the quadratic
approximation of the misfit: one search finds its size, expectation and maximization its shape (Dempster,
Laird and Rubin 1977, DOI 10.1111/j.2517-6161.1977.tb01600.x). Errors then hold what the penalty may have
smoothed away (Wahba 1983, DOI 10.1111/j.2517-6161.1983.tb01239.x).

Where frames tell little, the covariance that makes them likeliest is often none at all, and errors would not
hold what they leave open. So each standard deviation is taken to be as likely beforehand as any other (Gelman
2006, DOI 10.1214/06-BA117A).

Of which order the differences are is told by the evidence as well: the smoother ω is, the more of its wiggles
are noise, and the fewer numbers describe it.

Thermal motion kicks a particle anew all the time: R goes on a random walk, and ω is white. Second differences
of white noise are correlated as the squares of the second difference are; how much of that there is, is told
by the evidence too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.optimize import minimize_scalar

from trapcli.motion.path import Path, Spline, cross_matrix

Array = NDArray[np.float64]

_RANGE = (-8.0, 8.0)  # decades of the weight about the one that is as stiff as the misfit
_LOOSER = 1.0, 1e-3  # shares of the weight that suits all directions alike, from which shapes are sought
_ROUNDS, _MORE_ROUNDS = 20, 6  # of expectation and maximization, at first and each time that the motion moved
_UNIFORM = 1.0  # differences of each axis fewer, as each standard deviation of theirs is as likely beforehand
_ALIKE = 1.0  # differences that are taken as seen beforehand, alike in all directions
_KICKS = 1e1, 1e3, 1e5, 1e7  # that are tried, one after the other until the data get less likely
_SURE = 6.0  # change of minus twice a log-likelihood that counts
_ORDERS = 2, 3, 4  # of the differences that are tried, in the same way


@dataclass(frozen=True)
class Roughness:
    """``weight · dᵀ shape d``, summed over the differences d of the coefficients of ω.

    Paths hold the grid, followed by a number of other times, `after`.

    Attributes
    ----------
    spline:
        What bends the path.
    axes:
        Lab axes about which the path is bent, A out of 0, 1, 2; P coefficients in all.
    order:
        Of the differences.
    weight:
        In units of the misfit for differences [rad].
    shape:
        ``(A, A)`` inverse of the covariance of differences, with a determinant of 1; None for a covariance
        that is alike in all directions.
    kicks:
        Variance of what is white in ω, in units of that of second differences.
    """

    spline: Spline
    axes: tuple[int, ...] = (0, 1, 2)
    order: int = _ORDERS[0]
    weight: float = 0.0
    shape: Array | None = None
    kicks: float = 0.0

    def penalty(self, path: Path, after: int) -> float:
        """Return what the path's roughness counts."""
        return self.weight * float(np.sum(self._weighted(self._bend(path, after)) ** 2))

    def uphill(self, path: Path, after: int) -> Array:
        """Return ``(P,)`` half the gradient of the penalty by the spline's coefficients."""
        design, bend = self._weighted(self._design(path, after)), self._weighted(self._bend(path, after))
        return np.asarray(self.weight * design.T @ bend)

    def curvature(self, path: Path, after: int) -> Array:
        """Return ``(P, P)`` half the Hessian of the penalty."""
        design = self._weighted(self._design(path, after))
        return np.asarray(self.weight * design.T @ design)

    def formed(self, hessian: Array, downhill: Array, path: Path, after: int) -> Roughness:
        """Return the roughness of the order, and with the kicks, that make the data likeliest.

        Arguments are those of `weighed`. A motion that is smooth to a higher order isn't kicked.
        """

        def surprise(one: Roughness) -> float:
            design, bend = one._design(path, after), one._bend(path, after)
            return one._alike(hessian, downhill, design, bend)._surprise(hessian, downhill, design, bend)

        def likelier(forms: Iterable[Roughness], best: Roughness, least: float) -> tuple[Roughness, float]:
            for one in forms:
                tried = surprise(one)
                if tried > least + _SURE:
                    break
                if tried < least - _SURE:
                    best, least = one, tried
            return best, least

        smoother = (replace(self, order=order) for order in _ORDERS[1:])
        best, least = likelier(smoother, self, surprise(self))
        if best.order > self.order:
            return best
        return likelier((replace(self, kicks=kicks) for kicks in _KICKS), self, least)[0]

    def weighed(self, hessian: Array, downhill: Array, path: Path, after: int) -> Roughness:
        """Return the roughness with the weight and shape under which the data are likeliest.

        The search goes on from the shape that there is.

        Parameters
        ----------
        hessian, downhill:
            ``(P, P)``, positive definite, and ``(P,)``: bending by x changes the misfit,
            minus twice a log-likelihood, by ``xᵀ hessian x − 2 downhill · x``.
        """
        told = hessian, downhill, self._design(path, after), self._bend(path, after)
        if self.shape is not None:
            return self._shaped(_MORE_ROUNDS, *told)
        alike = self._alike(*told)
        if len(self.axes) == 1:
            return alike
        # stiff in all directions, or loose: the way from one to the other is long
        starts = (replace(alike, weight=share * alike.weight) for share in _LOOSER)
        found = (start._shaped(_ROUNDS, *told) for start in starts)
        stiff = _UNIFORM * len(self.axes)
        return min(found, key=lambda one: one._surprise(*told) + stiff * np.log(one.weight))

    def _alike(self, hessian: Array, downhill: Array, design: Array, bend: Array) -> Roughness:
        """Return the roughness that is alike in all directions, with the likeliest weight."""
        alike = replace(self, shape=None)
        design, bend = alike._weighted(design), alike._weighted(bend)
        curvature, pull, square = design.T @ design, design.T @ bend, float(bend @ bend)
        told = len(self.axes) * (self._rank(hessian) - _UNIFORM)
        unit = float(np.trace(hessian) / np.trace(curvature))

        def surprise(decade: float) -> float:
            weight = unit * 10.0**decade
            rest = _unexplained(hessian + weight * curvature, downhill - weight * pull)
            return float(weight * square + rest - told * np.log(weight))

        best: Any = minimize_scalar(surprise, bounds=_RANGE, method="bounded", options={"xatol": 0.05})
        return replace(alike, weight=unit * 10.0 ** float(best.x))

    def _surprise(self, hessian: Array, downhill: Array, design: Array, bend: Array) -> float:
        """Return minus twice the logarithm of the evidence, but for what does not depend on roughness."""
        root = np.sqrt(self.weight)
        design, bend = root * self._weighted(design), root * self._weighted(bend)
        rest = _unexplained(hessian + design.T @ design, downhill - design.T @ bend)
        return float(bend @ bend) + rest - _volume(design)

    def _shaped(self, rounds: int, hessian: Array, downhill: Array, design: Array, bend: Array) -> Roughness:
        """Return the roughness after some rounds of expectation and maximization."""
        one = self
        for _ in range(rounds):
            one = one._likelier(hessian, downhill, design, bend)
        return one

    def _likelier(self, hessian: Array, downhill: Array, design: Array, bend: Array) -> Roughness:
        """Return the roughness with the covariance that differences are expected to have."""
        design, bend = self._weighted(design), self._weighted(bend)
        factor = scipy.linalg.cholesky(
            hessian + self.weight * design.T @ design, lower=True, check_finite=False
        )
        step = scipy.linalg.cho_solve((factor, True), downhill - self.weight * design.T @ bend)
        spread = scipy.linalg.solve_triangular(factor, design.T, lower=True, check_finite=False)
        axes = len(self.axes)
        expected = (bend + design @ step).reshape(-1, axes)
        spread = spread.reshape(-1, axes)
        back = np.linalg.inv(self._root)
        covariance = back @ (expected.T @ expected + spread.T @ spread) @ back.T
        covariance += _ALIKE / self._rank(hessian) * np.trace(covariance) / axes * np.eye(axes)
        covariance /= max(self._rank(hessian) - _UNIFORM, 1.0) + _ALIKE
        size = float(np.linalg.det(covariance)) ** (1 / axes)
        return replace(self, weight=1 / size, shape=size * np.linalg.inv(covariance))

    def _rank(self, hessian: Array) -> float:
        """Return how many differences of each component the P coefficients decide.

        A constant rotation, and an ω whose differences vanish, cost nothing.
        """
        return max(len(hessian) / len(self.axes) - self.order - 1, 1.0)

    @property
    def _root(self) -> Array:
        """``(A, A)`` matrix B with ``shape = BᵀB``."""
        axes = len(self.axes)
        return np.eye(axes) if self.shape is None else np.asarray(np.linalg.cholesky(self.shape).T)

    def _weighted(self, differences: Array) -> Array:
        """Return ``(T, A, ...)`` differences, or derivatives of them, as ``(T A, ...)`` that are alike."""
        alike = np.einsum("ij,tj...->ti...", self._root, differences, optimize=True)
        return np.asarray(alike.reshape(-1, *differences.shape[2:]))

    def _bend(self, path: Path, after: int) -> Array:
        """Return the ``(T, A)`` differences of ω along the axes."""
        return np.asarray(self._difference @ self._omega(path, after)[:, list(self.axes)])

    def _design(self, path: Path, after: int) -> Array:
        """Return ``(T, A, P)`` derivatives of the differences by the spline's coefficients."""
        grid, omega, axes = self.spline.grid, self._omega(path, after), list(self.axes)
        change = np.einsum("mb,ij->mibj", self.spline.slopes(grid), np.eye(3))
        # δω = δ' + ω × δ
        change += np.einsum("mij,mb->mibj", cross_matrix(omega), self.spline.values(grid))
        rough = np.tensordot(self._difference, change[:, axes][..., axes], (1, 0))
        return np.asarray(rough.reshape(*rough.shape[:2], -1))

    @property
    def _difference(self) -> Array:
        grid = self.spline.grid
        return np.asarray((grid[1] - grid[0]) * _differences(self.spline.intervals, self.order, self.kicks))

    def _omega(self, path: Path, after: int) -> Array:
        last = len(path.time) - after
        return path.omega[last - len(self.spline.grid) : last]


@lru_cache(maxsize=8)
def _differences(intervals: int, order: int, kicks: float) -> Array:
    """Return the matrix that takes what is on a spline's grid to differences, and makes these independent."""
    grid = np.arange(2 * intervals + 1) / 2
    knots = np.arange(-2.0, intervals + 3.0)
    basis = BSpline.design_matrix(np.minimum(grid, intervals * (1 - 1e-12)), knots, 2).toarray()
    difference = np.diff(np.eye(intervals + 2), order, axis=0)
    independent = difference @ np.linalg.pinv(basis)
    if kicks:
        covariance = np.eye(len(difference)) + kicks * difference @ difference.T
        factor = scipy.linalg.cholesky(covariance, lower=True)
        independent = scipy.linalg.solve_triangular(factor, independent, lower=True)
    return np.asarray(independent)


def _unexplained(curvature: Array, downhill: Array) -> float:
    """Return what is left of a misfit at its least, and the logarithm of its curvature's determinant."""
    factor = scipy.linalg.cholesky(curvature, lower=True, check_finite=False)
    gained = scipy.linalg.solve_triangular(factor, downhill, lower=True, check_finite=False)
    return 2 * float(np.log(np.diag(factor)).sum()) - float(gained @ gained)


def _volume(design: Array) -> float:
    """Return the logarithm of the determinant of ``designᵀ design``; a turn of 1 rad counts 1 as well."""
    # not by that product, of which rounding would leave little where ω is smooth
    factor = np.linalg.qr(np.concatenate([design, np.eye(design.shape[1])]), mode="r")
    return 2 * float(np.log(np.abs(np.diag(factor))).sum())
