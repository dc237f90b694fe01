"""Common lines of any two frames: where they are, how their angles turn, and what misfit along them costs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.motion.common_line import LineTable, _geometry, choose_pairs
from trapcli.motion.types import ReducedMap
from trapcli.simulation.phantoms import Blobs

Array = NDArray[np.float64]
Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]
FRAMES, RINGS, LINES = 8, 10, 48
RADIUS = 5.0


def random_rotations(count: int, seed: int) -> Array:
    return np.asarray(Rotation.random(count, rng=np.random.default_rng(seed)).as_matrix())


def along(angle: Array, mu: Array) -> Array:
    """Return ``(..., M, 2)`` frequencies on the lines of some angles."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)[..., None, :] * mu[:, None]


def exact_map(blobs: Blobs, R: Array, noise: float) -> ReducedMap:
    mu = 0.3 * np.arange(1, RINGS + 1)
    phi = np.arange(LINES) * np.pi / LINES
    samples = np.array([blobs.fourier(along(phi, mu), rotation).T for rotation in R])
    return ReducedMap(samples, mu, phi, np.arange(float(len(R))), noise, RADIUS)


@pytest.fixture(scope="module")
def R() -> Array:
    return random_rotations(FRAMES, 3)


@pytest.fixture(scope="module")
def peak(blobs: Blobs) -> float:
    return blobs.mass / (2 * np.pi)


@pytest.fixture(scope="module")
def pairs(R: Array) -> Pairs:
    """Pairs of frames, in both orders, whose viewing directions are well apart."""
    s, t = (index.ravel() for index in np.indices((FRAMES, FRAMES)))
    apart = np.abs(np.einsum("pi,pi->p", R[s][:, :, 2], R[t][:, :, 2])) < 0.9
    return s[apart], t[apart]


def turned(R: Array, frame: int, axis: int, angle: float) -> Array:
    changed = R.copy()
    changed[frame] = R[frame] @ Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
    return changed


def test_the_map_agrees_along_the_common_line(blobs: Blobs, peak: float) -> None:
    R = random_rotations(60, 7)
    s, t = np.arange(30), np.arange(30, 60)
    mu = np.linspace(-3, 3, 25)
    Q = np.swapaxes(R[s], 1, 2) @ R[t]
    q, p, (angle_s, angle_t) = _geometry(R, s, t)
    assert q == pytest.approx(Q[:, :, 2], abs=1e-15)
    assert p == pytest.approx(Q[:, 2, :], abs=1e-15)
    assert angle_s == pytest.approx(np.arctan2(Q[:, 0, 2], -Q[:, 1, 2]))
    assert angle_t == pytest.approx(np.arctan2(-Q[:, 2, 0], Q[:, 2, 1]))
    for i in range(30):
        in_s = blobs.fourier(along(angle_s[i], mu), R[s[i]])
        in_t = blobs.fourier(along(angle_t[i], mu), R[t[i]])
        assert np.abs(in_s - in_t).max() < 1e-10 * peak


def test_interpolation(blobs: Blobs, R: Array, peak: float) -> None:
    reduced = exact_map(blobs, R, 1.0)
    table = LineTable(reduced, 0.0)
    rng = np.random.default_rng(1)
    frame, angle = rng.integers(0, FRAMES, 200), rng.uniform(-7, 7, 200)
    exact = np.array([blobs.fourier(along(a, reduced.mu), R[f]) for f, a in zip(frame, angle, strict=True)])
    h = 1e-4
    before, after = (
        np.array([blobs.fourier(along(a + d, reduced.mu), R[f]) for f, a in zip(frame, angle, strict=True)])
        for d in (-h, h)
    )
    values, slopes = (x[:, :RINGS] + 1j * x[:, RINGS:] for x in table._interpolate(frame, angle))
    assert np.abs(values - exact).max() < 1e-5 * peak
    assert np.abs(slopes - (after - before) / (2 * h)).max() < 1e-3 * peak


def test_no_misfit_at_the_truth_and_much_away_from_it(
    blobs: Blobs, R: Array, pairs: Pairs, peak: float
) -> None:
    table = LineTable(exact_map(blobs, R, 0.01 * peak), 0.0)
    wrong = random_rotations(FRAMES, 4)
    assert table.cost(R, *pairs).max() < 1e-4
    assert np.median(table.cost(wrong, *pairs)) > 5 * table.degrees


def test_errors_of_the_centres_count_as_noise(blobs: Blobs, R: Array, pairs: Pairs, peak: float) -> None:
    exact, shake = exact_map(blobs, R, 0.01 * peak), 0.1
    shifts = shake * np.random.default_rng(6).standard_normal((FRAMES, 2))
    along_lines = shifts @ np.array([np.cos(exact.phi), np.sin(exact.phi)])
    shaken = dataclasses.replace(
        exact, samples=exact.samples * np.exp(1j * exact.mu[:, None] * along_lines[:, None])
    )
    unaware, aware = (LineTable(shaken, 0.0, centring) for centring in (0.0, shake))
    # both frames of a pair are shaken, but not seen to be on rings where noise prevails
    assert 0.2 < aware.cost(R, *pairs).mean() / aware.degrees < 2.0
    assert unaware.cost(R, *pairs).mean() > 4 * unaware.degrees


def test_a_turn_of_the_object_and_the_mirror_change_nothing(
    blobs: Blobs, R: Array, pairs: Pairs, peak: float
) -> None:
    table = LineTable(exact_map(blobs, R, 0.01 * peak), 0.0)
    elsewhere = turned(R, 2, 0, 0.3)
    cost = table.cost(elsewhere, *pairs)
    sigma = np.diag([1.0, 1.0, -1.0])
    for other in (random_rotations(1, 9) @ elsewhere, sigma @ elsewhere @ sigma):
        assert table.cost(other, *pairs) == pytest.approx(cost, rel=1e-4, abs=1e-4)


def test_the_gradient_is_half_the_slope_downhill(blobs: Blobs, R: Array, pairs: Pairs, peak: float) -> None:
    table = LineTable(exact_map(blobs, random_rotations(1, 1) @ R, 0.03 * peak), 0.01)
    R = R @ Rotation.from_rotvec(np.random.default_rng(2).normal(scale=0.1, size=(FRAMES, 3))).as_matrix()
    s, t = pairs
    found = table.residuals(R, s, t)
    assert found.cost == pytest.approx(table.cost(R, s, t))
    h = 2e-3
    for frame in range(FRAMES):
        for axis in range(3):
            up, down = (table.cost(turned(R, frame, axis, d), s, t) for d in (h, -h))
            expected = (s == frame) * found.gradient[:, axis] + (t == frame) * found.gradient[:, 3 + axis]
            error = np.abs((down - up) / (4 * h) - expected)
            assert error.max() < 2e-3 * np.abs(found.gradient).max()


def test_the_hessian_is_half_the_curvature_where_the_lines_agree(
    blobs: Blobs, R: Array, pairs: Pairs, peak: float
) -> None:
    # much noise: the robust misfit is quadratic then
    table = LineTable(exact_map(blobs, R, 10 * peak), 0.0)
    s, t = pairs
    hessian = table.residuals(R, s, t).hessian
    rng, h = np.random.default_rng(5), 2e-3
    for _ in range(10):
        direction = rng.normal(size=(FRAMES, 3))
        up, down = (table.cost(R @ Rotation.from_rotvec(d * direction).as_matrix(), s, t) for d in (h, -h))
        both = np.concatenate([direction[s], direction[t]], axis=1)
        expected = np.einsum("pi,pij,pj->p", both, hessian, both)
        assert np.abs((up + down) / (2 * h**2) - expected).max() < 5e-3 * expected.max()


def test_hessians_are_symmetric_and_not_negative(blobs: Blobs, R: Array, pairs: Pairs, peak: float) -> None:
    hessian = LineTable(exact_map(blobs, R, 0.01 * peak), 0.01).residuals(R, *pairs).hessian
    assert hessian == pytest.approx(np.swapaxes(hessian, 1, 2), rel=1e-6)
    values = np.linalg.eigvalsh(hessian)
    assert (values > -1e-6 * values.max()).all()


def test_several_paths_at_once(blobs: Blobs, R: Array, pairs: Pairs, peak: float) -> None:
    table = LineTable(exact_map(blobs, R, 0.01 * peak), 0.01)
    several = np.stack([R, random_rotations(FRAMES, 4)])
    found = table.residuals(several, *pairs)
    assert found.cost == pytest.approx(table.cost(several, *pairs))
    for i, one in enumerate(several):
        alone = table.residuals(one, *pairs)
        assert found.cost[i] == pytest.approx(alone.cost)
        assert found.gradient[i] == pytest.approx(alone.gradient)
        assert found.hessian[i] == pytest.approx(alone.hessian)


def test_equal_views_say_nothing(blobs: Blobs, R: Array, peak: float) -> None:
    """A turn about the optical axis, or none: every line is common, none must count as a good fit."""
    spin = Rotation.from_rotvec([0, 0, 0.7]).as_matrix()
    both = np.array([R[0], R[0] @ spin])
    table = LineTable(exact_map(blobs, both, 0.01 * peak), 0.0)
    s, t = np.array([0]), np.array([1])
    assert 0.99 * table.degrees < table.cost(both, s, t)[0] < 1.5 * table.degrees
    found = table.residuals(both, s, t)
    assert np.isfinite(found.gradient).all()
    assert np.abs(found.gradient).max() < 1e-2


def test_selection_keeps_frames(blobs: Blobs, R: Array, peak: float) -> None:
    table = LineTable(exact_map(blobs, R, 0.01 * peak), 0.0)
    part = table.select(2, 6)
    assert len(part) == 4
    wrong = random_rotations(FRAMES, 4)
    s, t = np.array([0, 1]), np.array([3, 2])
    assert np.array_equal(part.cost(wrong[2:6], s, t), table.cost(wrong, s + 2, t + 2))


@pytest.mark.parametrize(("groups", "per_group"), [(6, 12), (40, 12), (200, 5)])
def test_pairs_are_apart_and_unlike(groups: int, per_group: int) -> None:
    s, t = choose_pairs(groups, per_group, seed=1)
    assert (t - s >= 2).all()
    assert s.min() >= 0
    assert t.max() < groups
    assert len(np.unique(s * groups + t)) == len(s)
    assert len(s) <= 1.2 * per_group * groups
    if groups <= 2 * per_group:
        assert len(s) == (groups - 1) * (groups - 2) // 2
    else:
        assert len(s) > 0.7 * per_group * groups
        assert np.bincount(np.concatenate([s, t]), minlength=groups).min() > 0
        assert (t - s).max() > 0.9 * groups
    again = choose_pairs(groups, per_group, seed=1)
    assert np.array_equal(again, (s, t))
