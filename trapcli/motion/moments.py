"""Moments of the images as polynomials in R (Helgason–Ludwig consistency).

The moment of order n of a projection about its centre is a component of the object's moment tensor in lab
coordinates: ``M_ab(t) = Σ R_ia R_jb M_ij``, a, b ∈ {1, 2}. The tensors, 6 numbers for n = 2 and 10 for n = 3,
are unknown, enter linearly and are eliminated. Unlike common lines, moments see α where all viewing
directions lie on one great circle. Source: Basu and Bresler 2000, DOI 10.1109/83.846251 (unknown view
angles).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

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
        ``(...)`` misfit and its expectation.
    gradient:
        ``(..., G, 3)`` half the negative gradient by small rotations ε of each frame, ``R → R exp([ε]×)``.
    slopes:
        ``(..., G, C, 3)`` whitened derivatives of all components, tensors held.
    design:
        ``(..., G, C, U)`` whitened design of the U unknown tensor components.
    normal:
        ``(..., U, U)`` their normal matrix.
    """

    cost: Array
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
    standing:
        ``(G, S)`` series of which each component may hold any share, and the object doesn't; None for none.
    """

    def __init__(self, low: LowBand, model_error: float, standing: Array | None = None) -> None:
        second_size = float(np.abs(low.second).mean())
        third_size = float(np.sqrt(np.mean(low.third**2))) + 0.5 * second_size
        self._orders = [
            _Order.create(2, low.second, low.second_covariance, model_error * second_size, standing),
            _Order.create(3, low.third, low.third_covariance, model_error * third_size, standing),
        ]

    def select(self, start: int, stop: int) -> MomentTable:
        """Return the table of consecutive frames."""
        part = object.__new__(MomentTable)
        part._orders = [order.select(start, stop) for order in self._orders]
        return part

    def cost(self, R: Array) -> Array:
        """Return the ``(...)`` misfits of ``(..., G, 3, 3)`` rotations."""
        return np.asarray(sum(order.eliminate(order.design(R))[2] for order in self._orders))

    def residuals(self, R: Array) -> list[MomentResiduals]:
        """Return the misfits with their derivatives, for each order."""
        return [order.residuals(R) for order in self._orders]


@dataclass(frozen=True)
class _Order:
    """Moments of one order n: whitened values and whitening.

    Attributes
    ----------
    components:
        ``(C, n)`` slots of the tensor components that the images show.
    basis:
        ``(U, 3ⁿ)`` basis of the symmetric tensors.
    turning:
        ``(3ⁿ, 3 · C)`` whitened change of what the images show of a tensor in lab coordinates by ε.
    whitening, values:
        ``(C, C)``; ``(G, C)`` whitened moments.
    standing:
        ``(G, C, V)`` whitened design of V unknowns that are no part of the object.
    """

    components: NDArray[np.intp]
    basis: Array
    turning: Array
    whitening: Array
    values: Array
    standing: Array

    @classmethod
    def create(
        cls, order: int, moments: Array, covariance: Array, extra: float, series: Array | None = None
    ) -> _Order:
        components = np.array(list(itertools.combinations_with_replacement((0, 1), order)))
        basis = np.zeros((0, *(3,) * order))
        for chosen in itertools.combinations_with_replacement(range(3), order):
            tensor = np.zeros((3,) * order)
            for place in set(itertools.permutations(chosen)):
                tensor[place] = 1.0
            basis = np.concatenate([basis, tensor[None]])
        total = covariance + extra**2 * np.eye(len(covariance))
        whitening = np.linalg.cholesky(np.linalg.inv(total)).T
        unit = np.eye(3**order).reshape(-1, *(3,) * order)
        # turning the frame by ε turns each slot of the tensor: dM = −Σ [ε] M
        change = np.zeros((*unit.shape, 3))
        for axis in range(1, unit.ndim):
            turned = -np.einsum("eab,g...b->g...ae", _GENERATORS, np.moveaxis(unit, axis, -1))
            change += np.moveaxis(turned, -2, axis)
        turning = np.einsum("cd,gde->gce", whitening, change[:, *components.T])
        series = np.zeros((len(moments), 0)) if series is None else series
        standing = np.einsum("gs,cd->gcsd", series, whitening)
        return cls(
            components,
            basis.reshape(len(basis), -1),
            turning.reshape(len(unit), -1),
            whitening,
            moments @ whitening.T,
            standing.reshape(*moments.shape, -1),
        )

    def select(self, start: int, stop: int) -> _Order:
        return replace(self, values=self.values[start:stop], standing=self.standing[start:stop])

    def design(self, R: Array) -> Array:
        """Return the whitened ``(..., G, C, U + V)`` components seen in the images, and what stands."""
        axes = np.swapaxes(R, -1, -2)
        products = np.ones((*R.shape[:-2], len(self.components), 1))
        for slot in self.components.T:
            products = products[..., None] * axes[..., slot, None, :]
            products = products.reshape(*products.shape[:-2], -1)
        seen = self.whitening @ (products @ self.basis.T)
        standing = np.broadcast_to(self.standing, (*seen.shape[:-1], self.standing.shape[-1]))
        return np.concatenate([seen, standing], axis=-1)

    def lab(self, R: Array, tensor: Array) -> Array:
        """Return ``(..., G, 3ⁿ)`` symmetric tensors of ``(..., U)`` components in lab coordinates."""
        flat = (tensor @ self.basis)[..., None, :]
        for _ in self.components.T:
            # the first slot is turned and becomes the last
            turned = np.swapaxes(flat.reshape(*flat.shape[:-1], 3, -1), -1, -2) @ R
            flat = turned.reshape(*turned.shape[:-2], -1)
        return flat

    def eliminate(self, design: Array) -> tuple[Array, Array, Array, Array]:
        """Return the tensors, the residuals ``(..., G, C)``, their squares and the normal matrices."""
        unknowns = design.shape[-1]
        flat = design.reshape(*design.shape[:-3], -1, unknowns)
        across = np.swapaxes(flat, -1, -2)
        normal = across @ flat
        normal += 1e-12 * np.trace(normal, axis1=-2, axis2=-1)[..., None, None] * np.eye(unknowns)
        tensor = np.asarray(np.linalg.solve(normal, (across @ self.values.ravel())[..., None]), float)
        residual = self.values.ravel() - (flat @ tensor)[..., 0]
        cost = np.asarray(np.sum(residual**2, axis=-1))
        return tensor[..., 0], residual.reshape(design.shape[:-1]), cost, normal

    def residuals(self, R: Array) -> MomentResiduals:
        design = self.design(R)
        tensor, residual, cost, normal = self.eliminate(design)
        slopes = (self.lab(R, tensor[..., : len(self.basis)]) @ self.turning).reshape(*residual.shape, 3)
        gradient = np.einsum("...gce,...gc->...ge", slopes, residual)
        degrees = float(self.values.size - design.shape[-1])
        return MomentResiduals(cost, degrees, gradient, slopes, design, normal)
