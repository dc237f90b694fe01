"""What eliminating an object and the frames' shifts leaves of the normal equations of a motion.

The unknowns are x, which bends the motion, two shifts of each frame, and the amplitudes of the object. A
shift meets one frame only, so that the shifts go first (Schur complement); then the object.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray

from trapcli.motion import triangular
from trapcli.threads import in_parallel

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


_SUPPORT = 4  # basis functions of a cubic spline that overlap


class ObjectBlock:
    """The object's normal matrix with the shifts eliminated, ``N − S Sᵀ``.

    With few shifts they are the smaller side (Woodbury), with many the object is.

    Parameters
    ----------
    halves:
        Inverses of the lower Cholesky factors of N's diagonal blocks, n × n in all, in Fortran's order.
    parts:
        S in parts of ``(n, any)`` columns, in Fortran's order.
    count:
        Columns of S in all.
    blocks:
        The blocks themselves, where `is_dense`.
    """

    def __init__(
        self, halves: list[Array], parts: Iterable[Array], count: int, blocks: list[Array] | None = None
    ) -> None:
        self._rest: Array | None = None
        if blocks is None:
            self._halves = halves
            self._leaning = self._forward(np.concatenate(list(parts), axis=1))
            rest = np.eye(count) - self._leaning.T @ self._leaning
            # a shift of all frames that the object follows leaves nothing but the object's own prior
            rest[np.diag_indices(count)] += 1e-14
            self._rest = triangular.cholesky(rest.T)
            return
        reduced = np.asfortranarray(scipy.linalg.block_diag(*blocks))
        for part in parts:
            triangular.less_square(reduced, part)
        self._halves = [triangular.inverse_factor(reduced)]

    @staticmethod
    def is_dense(n: int, count: int) -> bool:
        """Tell whether n amplitudes are fewer than `count` shifts."""
        return n <= count

    def solve(self, right: Array) -> Array:
        """Return ``(n, C)`` (N − S Sᵀ)⁻¹ times ``(n, C)`` columns."""
        half = self._forward(right)
        if self._rest is not None:
            half += self._leaning @ scipy.linalg.cho_solve(
                (self._rest, True), self._leaning.T @ half, check_finite=False
            )
        return self._multiplied(half, transposed=True)

    def _forward(self, right: Array) -> Array:
        return self._multiplied(right, transposed=False)

    def _multiplied(self, right: Array, transposed: bool) -> Array:
        ends = np.cumsum([len(half) for half in self._halves])[:-1]
        product = partial(triangular.multiplied, transposed=transposed)
        return np.concatenate(in_parallel(product, self._halves, np.split(right, ends)))


@dataclass(frozen=True)
class Eliminated:
    """Normal equations of a motion, without object and shifts.

    Attributes
    ----------
    hessian:
        ``(P, P)`` half the Hessian of the misfit by x.
    solution:
        ``(n, P)`` by how much the object follows x, with the sign changed; the shifts follow too.
    block:
        The object's own normal matrix.
    shift_covariance, carry:
        ``(G, 2, 2)`` covariance of the shifts for a known object; ``(G, 3, 2)`` the coupling of rotations and
        shifts, times it.
    """

    hessian: Array
    solution: Array
    block: ObjectBlock
    shift_covariance: Array
    carry: Array


def local_support(values: Array) -> tuple[Indices, Array]:
    """Return ``(N, 4)`` places and values of the basis functions that are not 0, of ``(N, size)`` values.

    At most four of a cubic spline, consecutive ones, are not 0 at a time.
    """
    first = np.minimum(np.argmax(values != 0, axis=1), values.shape[1] - _SUPPORT)
    places = first[:, None] + np.arange(_SUPPORT)
    return places, np.take_along_axis(values, places, axis=1)


def bent_blocks(values: Array, s: Indices, t: Indices, blocks: Array) -> Array:
    """Return ``Σ_p values[s]ᵀ blocks[p] values[t]``, ``(..., 3 · size, 3 · size)``.

    For ``(..., P, 3, 3)`` blocks and ``(N, size)`` values.
    """
    *leading, pairs, _, _ = blocks.shape
    size = values.shape[1]
    places, local = local_support(values)
    rows = size * places[s][:, :, None] + places[t][:, None]
    weights = local[s][:, :, None] * local[t][:, None]
    ends = _SUPPORT**2 * np.arange(pairs + 1)
    spread = scipy.sparse.csc_array((weights.ravel(), rows.ravel(), ends), shape=(size**2, pairs))
    total = spread @ np.moveaxis(blocks, -3, 0).reshape(pairs, -1)
    total = np.moveaxis(total.reshape(size, size, *leading, 3, 3), (0, 1), (-4, -2))
    return np.asarray(total.reshape(*leading, 3 * size, 3 * size))
