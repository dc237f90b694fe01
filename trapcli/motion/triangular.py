"""Triangular factors of large symmetric matrices, by BLAS and LAPACK, while other threads go on.

SciPy's own wrappers hold the interpreter, so that two of them never work at once; the routines behind them,
which ``scipy.linalg.cython_lapack`` and ``cython_blas`` export, don't. Matrices are in Fortran's order; what
reads as their transpose is the same memory in C's.
"""

from __future__ import annotations

import ctypes
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cython_blas, cython_lapack

Array = NDArray[np.float64]


def cholesky(matrix: Array) -> Array:
    """Return the lower Cholesky factor of a symmetric matrix, which is overwritten.

    Raises
    ------
    numpy.linalg.LinAlgError
        Where the matrix is not positive definite.
    """
    info = _call(cython_lapack, "dpotrf", b"L", len(matrix), matrix, len(matrix), 0)
    if info:
        raise np.linalg.LinAlgError("matrix is not positive definite")
    for column in range(1, len(matrix)):
        matrix[:column, column] = 0.0
    return matrix


def inverse_factor(matrix: Array) -> Array:
    """Return the inverse of the lower Cholesky factor of a symmetric matrix, which is overwritten."""
    factor = cholesky(matrix)
    _call(cython_lapack, "dtrtri", b"L", b"N", len(factor), factor, len(factor), 0)
    return factor


def squared(half: Array) -> Array:
    """Return the lower triangle of ``halfᵀ half`` for a lower triangle, with the zeros above it."""
    square = half.copy(order="F")
    _call(cython_lapack, "dlauum", b"L", len(square), square, len(square), 0)
    return square


def less_square(matrix: Array, columns: Array) -> Array:
    """Return the lower triangle of ``matrix − columns columnsᵀ`` in place of that of the matrix.

    For an ``(n, n)`` matrix and ``(n, m)`` columns.
    """
    n, m = columns.shape
    _call(cython_blas, "dsyrk", b"L", b"N", n, m, -1.0, columns, n, 1.0, matrix, n)
    return matrix


def multiplied(half: Array, right: Array, *, transposed: bool = False) -> Array:
    """Return the product of an ``(n, n)`` lower triangle, or its transpose, and ``(n, m)`` columns."""
    product = np.array(right, order="F")
    n, m = product.shape
    turned = b"T" if transposed else b"N"
    _call(cython_blas, "dtrmm", b"L", b"L", turned, b"N", n, m, 1.0, half, n, product, n)
    return product


def _call(module: ModuleType, name: str, *arguments: bytes | int | float | Array) -> int:
    """Call a routine, and return its last argument, which where LAPACK is called says what went wrong."""
    kinds: dict[type, type[Any]] = {bytes: ctypes.c_char, int: ctypes.c_int, float: ctypes.c_double}
    told: list[Any] = []
    for argument in arguments:
        if isinstance(argument, np.ndarray):
            if not argument.flags.f_contiguous or argument.dtype != np.float64:
                raise ValueError(f"{name}: a matrix is not in Fortran's order")
            told.append(ctypes.c_void_p(argument.ctypes.data))
        else:
            told.append(ctypes.byref(kinds[type(argument)](argument)))
    capsule = module.__pyx_capi__[name]
    address = _PointerOf(capsule, _NameOf(capsule))
    ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(told))(address)(*told)
    return int(told[-1]._obj.value) if module is cython_lapack else 0


_NameOf = ctypes.pythonapi.PyCapsule_GetName
_NameOf.restype, _NameOf.argtypes = ctypes.c_char_p, [ctypes.py_object]
_PointerOf = ctypes.pythonapi.PyCapsule_GetPointer
_PointerOf.restype, _PointerOf.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
