"""The forward operator of rigid motion in Fourier space, its adjoint and its normal operator.

A projection's Fourier transform about the centre is a plane through the object's (``eqSetMapFourier``; Elbau
et al. 2020, Inverse Problems 36): F₂J(t, k) ∝ F₃u(R(t) Pᵀk). For an object given on a lattice, sums over all
frames are non-uniform Fourier transforms, and the normal operator is a convolution.
"""

from __future__ import annotations

from typing import Any

import finufft
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from trapcli.threads import processors

Array = NDArray[np.float64]
Real = NDArray[np.floating[Any]]
Complex = NDArray[np.complexfloating[Any, Any]]

_DOUBLE_PRECISION = 1e-12
_SINGLE_PRECISION = 2e-5
_FEW = 25_000  # values and halves of lattice points up to which a second thread costs what it gains
_SPARE = 1.25  # finer grid of the transforms in single precision, which saves memory


def slice_points(R: Array, k: Array, spacing: float = 1.0) -> list[Array]:
    """Return where the modes of the frames lie in the object's Fourier space.

    Parameters
    ----------
    R:
        ``(G, 3, 3)`` rotations, lab to object.
    k:
        ``(K, 2)`` spatial frequencies of a frame [rad / length].
    spacing:
        Of the object's lattice [length].

    Returns
    -------
    list
        Three ``(G · K,)`` arrays: R Pᵀk along each axis of the object [rad / lattice spacing].
    """
    points = (R[:, :, :2] @ k.T) * spacing
    return [np.ascontiguousarray(points[:, axis].ravel()) for axis in range(3)]


def conjugate_share(k: Array) -> Array:
    """Return ``(K,)`` how many modes each stands for: k = 0 is its own conjugate, every other one is two."""
    return np.where((k == 0).all(axis=1), 1.0, 2.0)


def project(points: list[Array], lattice: Real | Complex, accuracy: float = _DOUBLE_PRECISION) -> Complex:
    """Return ``Σ_b lattice[b] exp(−i⟨point, b⟩)``, the modes of an object on a lattice.

    Parameters
    ----------
    points:
        Three ``(M,)`` arrays, see `slice_points`.
    lattice:
        ``(..., n, n, n)`` in the order x1, x2, x3; lattice point b = 0 at index n // 2. Single or double
        precision decides that of the result.
    accuracy:
        Relative to the largest modes, in double precision.

    Returns
    -------
    ndarray
        ``(..., M)`` complex.
    """
    single = lattice.dtype in (np.float32, np.complex64)
    kind = np.complex64 if single else np.complex128
    return np.asarray(
        finufft.nufft3d2(
            *_in_precision(points, single),
            lattice.astype(kind, copy=False),
            isign=-1,
            **_options(single, lattice[..., 0, 0, 0].size * points[0].size, lattice.size, accuracy),
        )
    )


def back_project(points: list[Array], values: Complex, size: int) -> Real:
    """Return ``Re Σ values exp(i⟨point, b⟩)`` at the lattice points b, the adjoint of `project`.

    Parameters are those of `gather`.

    Returns
    -------
    ndarray
        ``(size, size, size)`` in the order x1, x2, x3.
    """
    return np.asarray(gather(points, values, size).real)


def gather(points: list[Array], values: Complex, size: int, accuracy: float = _DOUBLE_PRECISION) -> Complex:
    """Return ``Σ values exp(i⟨point, b⟩)`` at the lattice points b.

    Parameters
    ----------
    values:
        ``(M,)`` complex; single or double precision decides that of the result.
    size:
        Lattice points along an edge; b = 0 is at index size // 2.
    accuracy:
        Relative to the largest sum, in double precision.

    Returns
    -------
    ndarray
        ``(size, size, size)`` in the order x1, x2, x3, complex.
    """
    single = values.dtype == np.complex64
    lattice: Complex = finufft.nufft3d1(
        *_in_precision(points, single),
        values,
        (size,) * 3,
        isign=1,
        **_options(single, values.size, size**3, accuracy),
    )
    return lattice


def _in_precision(points: list[Array], single: bool) -> list[Real]:
    return [p.astype(np.float32 if single else np.float64, copy=False) for p in points]


def _options(single: bool, values: int, lattice: int, accuracy: float) -> dict[str, Any]:
    threads = processors() if values + lattice / 2 > _FEW else 1
    if single:
        return {"eps": _SINGLE_PRECISION, "upsampfac": _SPARE, "nthreads": threads}
    return {"eps": accuracy, "upsampfac": 2.0, "nthreads": threads}


class NormalOperator:
    """``Σ weight exp(i⟨point, b − b'⟩)`` as a convolution on a cube of n points an edge.

    Parameters
    ----------
    kernel:
        ``(2n, 2n, 2n)`` the sum at differences of lattice points, 0 at index n: ``back_project(points,
        weights, 2 * n)``, added up over any number of blocks.
    """

    def __init__(self, kernel: Real) -> None:
        self.size = len(kernel) // 2
        self._spectrum = scipy.fft.rfftn(
            scipy.fft.ifftshift(kernel).astype(np.float32, copy=False), workers=processors()
        ).real.copy()

    def __call__(self, lattice: Real) -> Real:
        """Return the ``(n, n, n)`` product with an ``(n, n, n)`` lattice."""
        n, workers = self.size, processors()
        spectrum = scipy.fft.rfftn(lattice, (2 * n,) * 3, workers=workers)
        spectrum *= self._spectrum
        product = scipy.fft.irfftn(spectrum, (2 * n,) * 3, workers=workers, overwrite_x=True)
        return np.ascontiguousarray(product[:n, :n, :n])


def circulant_density(kernel: Real) -> Real:
    """Return how densely Fourier space is seen: eigenvalues of the nearest circulant to `NormalOperator`.

    The optimal circulant of T. Chan 1988 (DOI 10.1137/0909051): the kernel times a triangle, wrapped.

    Returns
    -------
    ndarray
        ``(n, n, n // 2 + 1)``, not negative, in the order of ``scipy.fft.rfftn``.
    """
    n = len(kernel) // 2
    triangle = (1 - np.abs(np.arange(-n, n)) / n).astype(np.float32)
    wrapped = kernel * triangle * triangle[:, None] * triangle[:, None, None]
    for axis in range(3):
        low, high = np.split(wrapped, 2, axis=axis)
        wrapped = low + high  # differences j − n and j are the same modulo n
    return np.asarray(np.maximum(scipy.fft.rfftn(wrapped, workers=processors()).real, 0.0))
