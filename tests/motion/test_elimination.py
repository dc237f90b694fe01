"""The object's normal matrix with the shifts eliminated, against a dense inverse."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from trapcli.motion.elimination import ObjectBlock


@pytest.mark.parametrize("count", [12, 80])
def test_few_and_many_shifts(count: int) -> None:
    rng = np.random.default_rng(0)
    roots = [rng.normal(size=(n, 60)) for n in (20, 19)]
    blocks = [root @ root.T for root in roots]
    whole = scipy.linalg.block_diag(*blocks)
    shifts = 0.9 * np.linalg.cholesky(whole) @ np.linalg.qr(rng.normal(size=(39, 39)))[0]
    shifts = np.concatenate([0.6 * shifts, 0.6 * shifts, shifts[:, :2] * 0.1], axis=1)[:, :count]
    factors = [np.linalg.cholesky(block) for block in blocks]
    parts = np.split(np.asfortranarray(shifts), [count // 3], axis=1)
    block = ObjectBlock(blocks, factors, parts, count)
    right = rng.normal(size=(39, 5))
    expected = np.linalg.solve(whole - shifts @ shifts.T, right)
    np.testing.assert_allclose(block.solve(right), expected, rtol=1e-8, atol=1e-10)
