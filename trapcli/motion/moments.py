"""Moments of the images as polynomials in R (Helgason–Ludwig consistency).

The moment of order n of a projection about its centre is a component of the object's moment tensor in lab
coordinates: ``M_ab(t) = Σ R_ia R_jb M_ij``, a, b ∈ {1, 2}. The tensors, 6 numbers for n = 2 and 10 for n = 3,
are unknown, enter linearly and are eliminated. Unlike common lines, moments see α where all viewing
directions lie on one great circle. Source: Basu and Bresler 2000, DOI 10.1109/83.846251 (unknown view
angles).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.low_band import LowBand
from trapcli.motion.path import cross_matrix

Array = NDArray[np.float64]

_GENERATORS = cross_matrix(np.eye(3))


@dataclass(frozen=True)
class MomentResiduals:
    """Misfit of the moments after the tensors have been eliminated.

    Attributes
    ----------
    cost, degrees:
        Misfit and its expectation.
    gradient:
        ``(G, 3)`` half the negative gradient by small rotations ε of each frame, ``R → R exp([ε]×)``.
    slopes:
        ``(G, C, 3)`` whitened derivatives of all components, tensors held.
    design:
        ``(G, C, U)`` whitened design of the U unknown tensor components.
    normal:
        ``(U, U)`` their normal matrix.
    """

    cost: float
    degrees: float
    gradient: Array
    slopes: Array
    design: Array
    normal: Array


class MomentTable:
    """Second and third moments of G frames with their covariances.

    Parameters
    ----------
    low:
        The frames' low-frequency content.
    model_error:
        Error of the moments besides pixel noise, as a share of their size: mass, background and centring that
        drift.
    """

    def __init__(self, low: LowBand, model_error: float) -> None:
        second_size = float(np.abs(low.second).mean())
        third_size = float(np.sqrt(np.mean(low.third**2))) + 0.5 * second_size
        self._orders = [
            _Order.create(2, low.second, low.second_covariance, model_error * second_size),
            _Order.create(3, low.third, low.third_covariance, model_error * third_size),
        ]

    def select(self, start: int, stop: int) -> MomentTable:
        """Return the table of consecutive frames."""
        part = object.__new__(MomentTable)
        part._orders = [order.select(start, stop) for order in self._orders]
        return part

    def cost(self, R: Array) -> float:
        """Return the misfit."""
        return float(sum(order.eliminate(order.design(order.lab(R)))[2] for order in self._orders))

    def residuals(self, R: Array) -> list[MomentResiduals]:
        """Return the misfit with its derivatives, for each order."""
        return [order.residuals(R) for order in self._orders]


@dataclass(frozen=True)
class _Order:
    """Moments of one order: whitened values, whitening, and a basis of the symmetric tensors."""

    components: list[tuple[int, ...]]
    basis: Array
    whitening: Array
    values: Array

    @classmethod
    def create(cls, order: int, moments: Array, covariance: Array, extra: float) -> _Order:
        components = list(itertools.combinations_with_replacement((0, 1), order))
        basis = np.zeros((0, *(3,) * order))
        for chosen in itertools.combinations_with_replacement(range(3), order):
            tensor = np.zeros((3,) * order)
            for place in set(itertools.permutations(chosen)):
                tensor[place] = 1.0
            basis = np.concatenate([basis, tensor[None]])
        total = covariance + extra**2 * np.eye(len(covariance))
        whitening = np.linalg.cholesky(np.linalg.inv(total)).T
        return cls(components, basis, whitening, moments @ whitening.T)

    def select(self, start: int, stop: int) -> _Order:
        return _Order(self.components, self.basis, self.whitening, self.values[start:stop])

    def lab(self, R: Array) -> Array:
        """Return the basis tensors in lab coordinates, ``(G, U, 3, 3[, 3])``."""
        tensor = np.broadcast_to(self.basis, (len(R), *self.basis.shape))
        for axis in range(2, self.basis.ndim + 1):
            tensor = np.moveaxis(np.einsum("gia,gu...i->gu...a", R, np.moveaxis(tensor, axis, -1)), -1, axis)
        return tensor

    def design(self, lab: Array) -> Array:
        """Return the whitened ``(G, C, U)`` components seen in the images."""
        return np.asarray(self.whitening @ np.swapaxes(self._seen(lab), 1, 2))

    def _seen(self, tensors: Array) -> Array:
        """Return the ``(..., C)`` components that the images show of ``(..., 3, 3[, 3])`` tensors."""
        places: tuple[Any, ...] = (..., *np.transpose(self.components))
        return np.asarray(tensors[places])

    def eliminate(self, design: Array) -> tuple[Array, Array, float, Array]:
        """Return the tensor, the residuals ``(G, C)``, their square and the normal matrix."""
        flat = design.reshape(-1, design.shape[-1])
        normal = flat.T @ flat
        normal += 1e-12 * np.trace(normal) * np.eye(len(normal))
        tensor = np.asarray(np.linalg.solve(normal, flat.T @ self.values.ravel()), float)
        residual = self.values - design @ tensor
        return tensor, residual, float(np.sum(residual**2)), normal

    def residuals(self, R: Array) -> MomentResiduals:
        lab = self.lab(R)
        design = self.design(lab)
        tensor, residual, cost, normal = self.eliminate(design)
        whole = np.tensordot(lab, tensor, (1, 0))
        # turning the frame by ε turns each slot of the tensor: dM = −Σ [ε] M
        change = np.zeros((3, *whole.shape))
        for axis in range(1, whole.ndim):
            turned = -np.einsum("eab,g...b->eg...a", _GENERATORS, np.moveaxis(whole, axis, -1))
            change += np.moveaxis(turned, -1, axis + 1)
        slopes = np.einsum("cd,egd->gce", self.whitening, self._seen(change))
        gradient = np.einsum("gce,gc->ge", slopes, residual)
        degrees = float(self.values.size - len(self.basis))
        return MomentResiduals(cost, degrees, gradient, slopes, design, normal)
