"""How fast ω(t) may change, found from the data: a penalty on its roughness, chosen by its evidence.

The second differences of ω on a fine grid are taken to be Gaussian with a variance of their own, as in a
smoothing spline; the variance is the one under which the data are likeliest, the motion integrated out in the
quadratic approximation of the misfit. Errors then hold what the penalty may have smoothed away (Wahba 1983,
DOI 10.1111/j.2517-6161.1983.tb01239.x).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from trapcli.motion.path import Path, Spline, cross_matrix

Array = NDArray[np.float64]

_RANGE = (-8.0, 8.0)  # decades of the weight about the one that is as stiff as the misfit
_FREE = 3  # for each axis: a constant rotation and an ω that is linear in time cost nothing


@dataclass(frozen=True)
class Roughness:
    """``weight · |second differences of ω|²``, on the grid of a spline that bends the path.

    Paths hold the grid, followed by a number of other times, `after`.

    Attributes
    ----------
    spline:
        What bends the path.
    axes:
        Lab axes about which the path is bent, out of 0, 1, 2; P coefficients in all.
    weight:
        In units of the misfit for second differences [rad].
    """

    spline: Spline
    axes: tuple[int, ...] = (0, 1, 2)
    weight: float = 0.0

    def penalty(self, path: Path, after: int) -> float:
        """Return what the path's roughness counts."""
        return self.weight * float(np.sum(self._bend(path, after) ** 2))

    def uphill(self, path: Path, after: int) -> Array:
        """Return ``(P,)`` half the gradient of the penalty by the spline's coefficients."""
        return np.asarray(self.weight * self._design(path, after).T @ self._bend(path, after))

    def curvature(self, path: Path, after: int) -> Array:
        """Return ``(P, P)`` half the Hessian of the penalty."""
        design = self._design(path, after)
        return np.asarray(self.weight * design.T @ design)

    def weighed(self, hessian: Array, downhill: Array, path: Path, after: int) -> Roughness:
        """Return the roughness with the weight under which the data are likeliest.

        Parameters
        ----------
        hessian, downhill:
            ``(P, P)``, positive definite, and ``(P,)``: bending by x changes the misfit,
            minus twice a log-likelihood, by ``xᵀ hessian x − 2 downhill · x``.
        """
        bend, design = self._bend(path, after), self._design(path, after)
        curvature, pull, square = design.T @ design, design.T @ bend, float(bend @ bend)
        rank = max(len(hessian) - _FREE * len(self.axes), 1)
        unit = float(np.trace(hessian) / np.trace(curvature))

        def surprise(decade: float) -> float:
            weight = unit * 10.0**decade
            factor = scipy.linalg.cholesky(hessian + weight * curvature, lower=True, check_finite=False)
            gained = scipy.linalg.solve_triangular(
                factor, downhill - weight * pull, lower=True, check_finite=False
            )
            volume = 2 * float(np.log(np.diag(factor)).sum())
            return float(weight * square - gained @ gained + volume - rank * np.log(weight))

        best: Any = minimize_scalar(surprise, bounds=_RANGE, method="bounded", options={"xatol": 0.05})
        return replace(self, weight=unit * 10.0 ** float(best.x))

    def _bend(self, path: Path, after: int) -> Array:
        return np.asarray((self._difference() @ self._omega(path, after)).ravel())

    def _design(self, path: Path, after: int) -> Array:
        """Return the derivatives of the second differences by the spline's coefficients."""
        grid, omega = self.spline.grid, self._omega(path, after)
        change = np.einsum("mb,ij->mibj", self.spline.slopes(grid), np.eye(3))
        # δω = δ' + ω × δ
        change += np.einsum("mij,mb->mibj", cross_matrix(omega), self.spline.values(grid))
        rough = np.tensordot(self._difference(), change[..., list(self.axes)], (1, 0))
        return np.asarray(rough.reshape(3 * len(rough), -1))

    def _difference(self) -> Array:
        grid = self.spline.grid
        return np.asarray((grid[1] - grid[0]) * np.diff(np.eye(len(grid)), 2, axis=0))

    def _omega(self, path: Path, after: int) -> Array:
        last = len(path.time) - after
        return path.omega[last - len(self.spline.grid) : last]
