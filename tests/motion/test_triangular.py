"""Triangular factors against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

from trapcli.motion import triangular

RNG = np.random.default_rng(0)
ROOT = RNG.normal(size=(7, 12))
MATRIX = ROOT @ ROOT.T
COLUMNS = np.asfortranarray(RNG.normal(size=(7, 3)))
LOWER = np.asfortranarray(np.tril(RNG.normal(size=(7, 7))))


def test_the_factor_is_lower_and_gives_the_matrix() -> None:
    factor = triangular.cholesky(np.asfortranarray(MATRIX))
    np.testing.assert_allclose(factor @ factor.T, MATRIX, rtol=1e-12)
    assert not np.triu(factor, 1).any()


def test_the_inverse_factor_whitens() -> None:
    half = triangular.inverse_factor(np.asfortranarray(MATRIX))
    np.testing.assert_allclose(half @ MATRIX @ half.T, np.eye(7), atol=1e-12)
    np.testing.assert_allclose(np.tril(half.T @ half), triangular.squared(half), rtol=1e-12)


def test_what_is_not_positive_has_no_factor() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        triangular.cholesky(np.asfortranarray(np.diag([1.0, -1.0])))


def test_squares_are_taken_off_in_place() -> None:
    matrix = np.asfortranarray(MATRIX)
    assert triangular.less_square(matrix, COLUMNS) is matrix
    np.testing.assert_allclose(np.tril(matrix), np.tril(MATRIX - COLUMNS @ COLUMNS.T), rtol=1e-12)


@pytest.mark.parametrize("right", [COLUMNS, np.ascontiguousarray(COLUMNS)])
def test_products(right: np.ndarray) -> None:
    before = right.copy()
    np.testing.assert_allclose(triangular.multiplied(LOWER, right), LOWER @ right, rtol=1e-12)
    turned = triangular.multiplied(LOWER, right, transposed=True)
    np.testing.assert_allclose(turned, LOWER.T @ right, rtol=1e-12)
    assert np.array_equal(right, before)


def test_another_order_is_refused_not_misread() -> None:
    with pytest.raises(ValueError, match="Fortran"):
        triangular.multiplied(np.ascontiguousarray(LOWER), COLUMNS)
