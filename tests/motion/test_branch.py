"""Finding the motion without a starting value: the objective, its derivatives, and the search itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.motion.branch import Evidence, Hypothesis, distinct, find_branches, turned_back
from trapcli.motion.centers import Centers
from trapcli.motion.common_line import LineTable
from trapcli.motion.low_band import read_low_band
from trapcli.motion.moments import MomentTable
from trapcli.motion.path import Path, Spline, align
from trapcli.motion.reduced_map import reduce_frames
from trapcli.simulation.motions import SingleAxis, Tumbling
from trapcli.simulation.phantoms import Blobs
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
RADIUS, PIXELS, PIXEL = 5.0, 48, 0.3
FRAMES = 60
SIGMA = np.diag([1.0, 1.0, -1.0])


@dataclass(frozen=True)
class Scene:
    path: Path
    evidence: Evidence


def make_scene(motion: Tumbling | SingleAxis, noise: float, frames: int = FRAMES) -> Scene:
    """Render blobs with white noise, a share of the peak, and gather the evidence."""
    blobs = Blobs.random(np.random.default_rng(3), radius=RADIUS)
    time = np.linspace(0, 1, frames)
    R = motion.rotations(time)
    x = (np.arange(PIXELS) - PIXELS // 2) * PIXEL
    place = np.append(blobs.center[:2], 0.0)
    images = np.array([blobs.project(rotation, place, x, x) for rotation in R])
    sigma = noise * float(images.max())
    images += sigma * np.random.default_rng(1).normal(size=images.shape)
    centers = Centers(
        center=np.zeros((frames, 2)),
        errors=np.zeros((frames, 2)),
        mass=np.ones(frames),
        level=np.zeros(frames),
        noise=sigma,
        radius=RADIUS,
        clipped=np.zeros(frames, bool),
    )
    stack, band = Frames.from_array(images), 8 / RADIUS
    reduced = reduce_frames(stack, centers, time=time, pixel_size=PIXEL, band=band)
    low = read_low_band(stack, centers, time=time, band=band, pixel_size=PIXEL)
    evidence = Evidence(time, LineTable(reduced, 0.01), MomentTable(low, 0.002))
    return Scene(Path(time, R, motion.omega(time)), evidence)


@pytest.fixture(scope="module")
def tumbling() -> Scene:
    motion = Tumbling.random(np.random.default_rng(4), total_angle=200.0, duration=1.0)
    return make_scene(motion, 0.01)


@pytest.fixture(scope="module")
def single_axis() -> Scene:
    return make_scene(SingleAxis.from_turns(turns=0.6, duration=1.0), 0.01)


@pytest.fixture(scope="module")
def fast() -> Scene:
    """8 degrees from frame to frame, 480 in all, about an axis that goes around itself."""
    motion = Tumbling.random(np.random.default_rng(4), total_angle=480.0, duration=1.0)
    return make_scene(motion, 0.01)


def off(path: Path, truth: Path) -> float:
    """Return the mean angle [degrees] but for gauge and mirror."""
    return float(np.rad2deg(align(path.R, truth.R)[0].mean()))


@pytest.mark.parametrize("name", ["tumbling", "single_axis"])
def test_the_misfit_at_the_truth_is_that_of_the_noise(name: str, request: pytest.FixtureRequest) -> None:
    scene = request.getfixturevalue(name)
    judged = scene.evidence.judge(scene.path)
    # the robust misfit of lines is a little less than the noise's
    assert 0.7 < judged.lines < 1.1
    assert 0.6 < judged.moments < 1.3


def test_gauge_and_mirror_cost_nothing(tumbling: Scene) -> None:
    path = tumbling.path
    cost = tumbling.evidence.judge(path).cost
    turn = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    for R in (turn @ path.R, SIGMA @ path.R @ SIGMA):
        other = tumbling.evidence.judge(Path(path.time, R, path.omega))
        assert other.cost == pytest.approx(cost, rel=1e-4)


def test_the_gradient_is_half_the_slope_downhill(tumbling: Scene) -> None:
    evidence, spline = tumbling.evidence, Spline(0.0, 1.0, 3)
    rng = np.random.default_rng(0)
    path = tumbling.path.bent(spline, 0.02 * rng.normal(size=(spline.size, 3)))
    hessian, gradient = evidence._normal_equations(path.R, spline.values(path.time))
    assert hessian == pytest.approx(hessian.T, abs=1e-6 * np.abs(hessian).max())
    h = 1e-3
    for i in range(3 * spline.size):
        step = np.zeros(3 * spline.size)
        step[i] = h
        up, down = (evidence.judge(path.bent(spline, s * step.reshape(-1, 3))).cost for s in (1, -1))
        assert (down - up) / (4 * h) == pytest.approx(gradient[i], abs=5e-3 * np.abs(gradient).max())


def test_refining_never_goes_uphill_and_comes_home(tumbling: Scene) -> None:
    evidence, spline = tumbling.evidence, Spline(0.0, 1.0, 5)
    path = tumbling.path.bent(spline, 0.1 * np.random.default_rng(2).normal(size=(spline.size, 3)))
    start = evidence.judge(path)
    costs = [evidence.refine([path], spline, steps)[0].cost for steps in (0, 1, 2, 4, 12)]
    assert costs[0] == start.cost
    assert (np.diff(costs) <= 0).all()
    (found,) = evidence.refine([path], spline, 20)
    assert off(path, tumbling.path) > 3
    assert off(found.path, tumbling.path) < 1
    assert found.cost < evidence.judge(tumbling.path).cost


def test_paths_refined_at_once_are_those_refined_alone(tumbling: Scene) -> None:
    """They need different numbers of steps and of trials, and one is where it ends already."""
    evidence, spline = tumbling.evidence, Spline(0.0, 1.0, 3)
    rng = np.random.default_rng(5)
    bends = [size * rng.normal(size=(spline.size, 3)) for size in (0.02, 0.1, 0.3, 1.0)]
    paths = [tumbling.path.bent(spline, bend) for bend in bends]
    paths += [Path.constant(tumbling.path.time, omega) for omega in 4 * rng.normal(size=(3, 3))]
    paths += [evidence.refine(paths[:1], spline, 30)[0].path]
    together = evidence.refine(paths, spline, 6)
    assert len({round(h.cost) for h in together}) > 4
    for path, found in zip(paths, together, strict=True):
        (alone,) = evidence.refine([path], spline, 6)
        assert found.cost == pytest.approx(alone.cost, rel=1e-12)
        assert pytest.approx(alone.path.R, abs=1e-9) == found.path.R
        assert evidence.judge(found.path).cost == pytest.approx(found.cost, rel=1e-12)


def test_selection_is_evidence_of_fewer_groups(tumbling: Scene) -> None:
    part = tumbling.evidence.select(10, 30)
    path = Path(tumbling.path.time[10:30], tumbling.path.R[10:30], tumbling.path.omega[10:30])
    assert len(part.time) == len(part.lines) == 20
    assert 0.5 < part.judge(path).lines < 1.2


def test_hypotheses_are_distinct_and_sorted(tumbling: Scene) -> None:
    path = tumbling.path
    turn = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    bend = Rotation.from_rotvec(np.outer(np.linspace(-0.3, 0.3, FRAMES), [1, 0, 0])).as_matrix()
    paths = [path, Path(path.time, turn @ path.R, path.omega), Path(path.time, path.R @ bend, path.omega)]
    paths.append(Path(path.time, SIGMA @ path.R @ SIGMA, path.omega))
    costs = [10.0, 11.0, 12.0, 13.0]
    hypotheses = [Hypothesis(p, c, 1.0, 1.0) for p, c in zip(paths, costs, strict=True)]
    hypotheses.append(Hypothesis(path, 1000.0, 1.0, 1.0))
    assert [h.cost for h in distinct(hypotheses[::-1], 6)] == [10.0, 12.0]
    assert [h.cost for h in distinct(hypotheses, 1)] == [10.0]


@pytest.mark.parametrize("name", ["tumbling", "single_axis"])
def test_the_branch_is_found_without_a_starting_value(name: str, request: pytest.FixtureRequest) -> None:
    """To some degrees, from which the object model goes on; a wrong branch is tens of degrees off."""
    scene = request.getfixturevalue(name)
    calls: list[tuple[str, int, int]] = []
    found = find_branches(scene.evidence, window=30, starts=12, keep=3, progress=lambda *c: calls.append(c))
    assert off(found[0].path, scene.path) < 5
    assert found[0].cost == min(h.cost for h in found)
    assert found[0].lines < 1.2
    assert found[0].moments < 1.3
    assert calls[-1] == ("branches", FRAMES, FRAMES)
    assert np.abs(np.swapaxes(found[0].path.R, 1, 2) @ found[0].path.R - np.eye(3)).max() < 1e-9


def test_a_fast_motion_is_found_in_windows_of_fewer_frames(fast: Scene) -> None:
    found = find_branches(fast.evidence, window=50, turn=np.deg2rad(8.0), starts=12, keep=3)
    assert off(found[0].path, fast.path) < 5
    assert found[0].lines < 1.2


@pytest.mark.parametrize("places", [[20], [15, 40]])
def test_what_is_its_mirror_image_in_part_is_turned_back(tumbling: Scene, places: list[int]) -> None:
    path = tumbling.path
    for place in places:
        path = path.mirrored(place)
    assert off(path, tumbling.path) > 5
    evidence = tumbling.evidence
    found = turned_back(evidence, evidence.judge(path), np.deg2rad(200 / FRAMES))
    assert off(found.path, tumbling.path) < 1
    assert found.cost < evidence.judge(path).cost


def test_the_right_motion_is_left_as_it_is(tumbling: Scene) -> None:
    evidence = tumbling.evidence
    (right,) = evidence.refine([tumbling.path], Spline(0.0, 1.0, 8), 20)
    assert turned_back(evidence, right, np.deg2rad(200 / FRAMES)).cost > 0.99 * right.cost


def test_the_search_is_the_same_every_time(tumbling: Scene) -> None:
    first, second = (find_branches(tumbling.evidence, window=30, starts=4, keep=2) for _ in range(2))
    assert [h.cost for h in first] == [h.cost for h in second]
    assert np.array_equal(first[0].path.R, second[0].path.R)
