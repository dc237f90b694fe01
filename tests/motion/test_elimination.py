"""The object without shifts, and blocks bent by splines, against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from trapcli.motion.elimination import ObjectBlock, bent_blocks
from trapcli.motion.path import Spline
from trapcli.motion.triangular import inverse_factor


@pytest.mark.parametrize("count", [12, 80])
def test_few_and_many_shifts(count: int) -> None:
    rng = np.random.default_rng(0)
    roots = [rng.normal(size=(n, 60)) for n in (20, 19)]
    blocks = [root @ root.T for root in roots]
    whole = scipy.linalg.block_diag(*blocks)
    shifts = 0.9 * np.linalg.cholesky(whole) @ np.linalg.qr(rng.normal(size=(39, 39)))[0]
    shifts = np.concatenate([0.6 * shifts, 0.6 * shifts, shifts[:, :2] * 0.1], axis=1)[:, :count]
    halves = [inverse_factor(np.asfortranarray(block)) for block in blocks]
    parts = np.split(np.asfortranarray(shifts), [count // 3], axis=1)
    block = ObjectBlock(halves, parts, count, blocks if ObjectBlock.is_dense(39, count) else None)
    right = rng.normal(size=(39, 5))
    expected = np.linalg.solve(whole - shifts @ shifts.T, right)
    np.testing.assert_allclose(block.solve(right), expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("leading", [(), (2, 3)])
@pytest.mark.parametrize("intervals", [1, 9])
def test_bent_blocks(leading: tuple[int, ...], intervals: int) -> None:
    rng = np.random.default_rng(1)
    spline, time = Spline(0.0, 1.0, intervals), np.linspace(0, 1, 31)
    values = spline.values(time)
    s, t = rng.integers(0, 31, (2, 50))
    blocks = rng.normal(size=(*leading, 50, 3, 3))
    bends = np.kron(values[:, None], np.eye(3))  # (N, 3, 3 · size)
    expected = np.sum(np.swapaxes(bends[s], 1, 2) @ blocks @ bends[t], axis=-3)
    np.testing.assert_allclose(bent_blocks(values, s, t, blocks), expected, atol=1e-12)
