from __future__ import annotations

import numpy as np
import pytest

from trapcli.motion.ambiguity import unwrap_directions


def test_lines_become_a_continuous_direction() -> None:
    phi = 2.8 + 7.0 * np.linspace(0, 1, 200) ** 2
    found = unwrap_directions(phi % np.pi, np.ones(200, bool))
    assert found == pytest.approx(phi)


def test_the_first_reliable_frame_fixes_the_mirror() -> None:
    phi = np.linspace(-2.5, -1.5, 30)
    reliable = np.ones(30, bool)
    reliable[:3] = False
    found = unwrap_directions(phi + np.pi * np.arange(30), reliable)
    assert 0 <= found[3] < np.pi
    assert found - phi == pytest.approx(np.full(30, np.pi))


def test_unknown_and_unreliable_frames_do_not_mislead() -> None:
    phi = np.linspace(0.2, 6.0, 120)
    lines = phi % np.pi
    reliable = np.ones(120, bool)
    rng = np.random.default_rng(0)
    wrong = rng.choice(np.arange(2, 118), 25, replace=False)
    lines[wrong] = rng.uniform(0, np.pi, 25)
    reliable[wrong] = False
    lines[60:64] = np.nan
    found = unwrap_directions(lines, reliable)
    assert np.isnan(found[60:64]).all()
    good = reliable & np.isfinite(lines)
    assert found[good] == pytest.approx(phi[good])


def test_a_single_outlier_that_claims_to_be_reliable_does_not_flip_the_rest() -> None:
    phi = np.full(40, 1.0)
    phi[20] += 1.5
    found = unwrap_directions(phi % np.pi, np.ones(40, bool))
    assert found[21:] == pytest.approx(np.ones(19))


def test_nothing_known() -> None:
    assert np.isnan(unwrap_directions(np.full(4, np.nan), np.zeros(4, bool))).all()
    assert len(unwrap_directions(np.empty(0), np.empty(0, bool))) == 0
