"""What can be known of a motion, and whether the program knows it: docs/benchmarks-identifiability.md.

python benchmarks/identifiability.py [PATTERN ...] [--again] [--cell FILE] [--report]

Measures the rows whose names match a pattern such as 'tilt-*' (all, without one) and that
benchmarks/identifiability.json doesn't hold yet, and writes the page anew.
"""

from __future__ import annotations

import argparse
import json
import sys
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from identifiability_page import NAMES, write_page
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import trapcli
from trapcli.config import from_dict
from trapcli.motion.path import align
from trapcli.result.comparison import compare, match, rotation_difference, wrap
from trapcli.result.motion import Flag, Motion
from trapcli.simulation.config import SimulateConfig
from trapcli.simulation.motions import Drift, RigidMotion, SingleAxis, Tumbling, true_motion
from trapcli.simulation.phantoms import Blobs, Grain, Phantom
from trapcli.simulation.render import Scene
from trapcli.stack import open_stack
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]

FOLDER = Path(__file__).parent
RESULTS = FOLDER / "identifiability.json"
PAGE = FOLDER.parent / "docs" / "benchmarks-identifiability.md"
CELL = FOLDER.parent / "../shared/data/fdtd_cell_tilted.tif"

PIXEL, INTERVAL = 0.2, 0.01
IDENTIFIABLE, UNIDENTIFIABLE = 200, 50
IMAGE_X = np.array([1.0, 0.0, 0.0])


@dataclass(frozen=True)
class Row:
    """One stack to estimate.

    Attributes
    ----------
    name:
        In the results.
    title:
        In words.
    make:
        Renders the frames, with frame interval and pixel size, and the true motion.
    bars:
        Highest value of what is measured; ``trusted`` is 0 where the program must refuse.
    method:
        As of ``--method``.
    """

    name: str
    title: str
    make: Callable[[], tuple[Frames, Motion]]
    bars: dict[str, float] = field(default_factory=dict)
    method: str = "auto"


def simulated(frames: int, pixels: int, noise: float, seed: int = 1, **tables: Any) -> Row:
    """Return a row without name of a scene that the simulator knows by a name."""
    return Row("", "", lambda: _render(_config(frames, pixels, noise, seed, **tables)))


def _config(frames: int, pixels: int, noise: float, seed: int, **tables: Any) -> SimulateConfig:
    stack = {
        "frames": frames,
        "height": pixels,
        "width": pixels,
        "pixel_size": PIXEL,
        "frame_interval": INTERVAL,
    }
    if tables.get("phantom", {}).get("kind") == "paper":
        stack["pixel_size"] = 25.6 / pixels
    table = {"seed": seed, "stack": stack, "camera": {"noise": noise}, **tables}
    return from_dict(SimulateConfig, table, "benchmark")


def _render(
    config: SimulateConfig, phantom: Phantom | None = None, motion: RigidMotion | None = None
) -> tuple[Frames, Motion]:
    scene = Scene.from_config(config)
    scene = replace(scene, phantom=phantom or scene.phantom, motion=motion or scene.motion)
    frames = scene.frames()
    return Frames.from_array(frames.to_array(), frames.info), scene.truth()


def fixed_rows(cell: Path) -> Iterator[Row]:
    """Yield the rows that have a bar of their own."""
    one, refuse = {"alpha": 0.3, "angle": 1.0}, {"trusted": 0.0}
    blobs: dict[str, Any] = {"kind": "blobs"}

    def axis(turns: float = 1.2, tilt: float = 0.0) -> dict[str, Any]:
        return {"phantom": blobs, "motion": {"kind": "single-axis", "turns": turns, "tilt": tilt}}

    def named(name: str, title: str, bars: dict[str, float], row: Row, method: str = "auto") -> Row:
        return replace(row, name=name, title=title, bars=bars, method=method)

    plane = "one axis in the image plane, uneven speed, 300 frames of 128²"
    yield named("axis", f"{plane}, 1.2 turns, noise 1 %", one, simulated(300, 128, 0.01, **axis()))
    yield named(
        "axis-noise", "the same, noise 5 %", {"alpha": 1.5, "angle": 5.0}, simulated(300, 128, 0.05, **axis())
    )
    yield named(
        "axis-short",
        "the same, 0.4 turns, noise 1 %",
        {"alpha": 1.0, "angle": 2.0},
        simulated(300, 128, 0.01, **axis(0.4)),
    )
    for tilt in range(0, 91, 5):
        title = f"1.2 turns about an axis tilted by {tilt}°, 200 frames of 128², noise 1 %"
        yield named(
            f"tilt-{tilt:02d}", title, {"R": 0.2}, simulated(200, 128, 0.01, **axis(tilt=float(tilt)))
        )
    yield named(
        "degenerate-third",
        "tumbling that is degenerate for its middle third, 300 frames of 128², noise 1 %",
        {"R": 0.2},
        simulated(300, 128, 0.01, phantom=blobs, motion={"kind": "degenerate-third"}),
    )
    special = simulated(
        300, 128, 0.01, phantom={"kind": "paper"}, motion={"kind": "paper-special", "total_angle": 300.0}
    )
    yield named(
        "special",
        "the paper's object and special example, 300 frames of 128², noise 1 %",
        {"R": 0.2},
        special,
    )
    clean = simulated(
        300, 128, 0.0, phantom={"kind": "paper"}, motion={"kind": "paper-special", "total_angle": 300.0}
    )
    yield named("special-paper", "the same without noise, `--method paper`", refuse, clean, "paper")
    for name, title, phantom, motion in (
        ("sphere", "a sphere, tumbling", "sphere", "tumbling"),
        ("still", "a still object", "blobs", "still"),
        ("revolution", "a body of revolution about its axis", "revolution", "single-axis"),
    ):
        row = simulated(100, 64, 0.01, phantom={"kind": phantom}, motion={"kind": motion, "azimuth": 0.0})
        yield named(name, f"{title}, 100 frames of 64², noise 1 %", refuse, row)
    if cell.exists():
        bars = {"tilt": 0.6, "turn": 0.5, "R": 0.8}
        yield Row("cell", "a cell by wave optics, one turn, axis tilted by 11.46°", lambda: _cell(cell), bars)


def _cell(path: Path) -> tuple[Frames, Motion]:
    """Read the phase images of one even turn about an axis tilted by 0.2 rad."""
    frames = open_stack(str(path))
    time = np.arange(len(frames)) * INTERVAL
    axis = np.array([0.0, np.cos(0.2), np.sin(0.2)])
    motion = SingleAxis(axis=axis, rate=2 * np.pi / (len(frames) * INTERVAL))
    info = replace(frames.info, frame_interval=INTERVAL, time_unit="s")
    return replace(frames, info=info), true_motion(motion, np.zeros(3), time)


# ---------------------------------------------------------------------- random scenes


def random_identifiable(index: int) -> Row:
    """Return a scene whose motion the frames tell."""
    rng = np.random.default_rng([1, index])
    frames, pixels = int(rng.integers(80, 201)), int(rng.choice([64, 80, 96]))
    noise = float(np.exp(rng.uniform(np.log(0.005), np.log(0.1))))
    phantom = str(rng.choice(["blobs", "grain", "paper"]))
    motion: dict[str, Any] = {"kind": "tumbling", "total_angle": float(rng.uniform(150, 450))}
    if rng.random() < 0.5:
        motion = {
            "kind": "single-axis",
            "turns": float(rng.uniform(0.5, 1.5)),
            "azimuth": float(rng.uniform(-180, 180)),
            "tilt": float(rng.choice([0.0, rng.uniform(-75, 75)])),
            "unevenness": float(rng.uniform(0, 0.5)),
        }
    motion["drift"] = float(rng.uniform(0, 0.2))
    how = " ".join(f"{k} {v:.3g}" if isinstance(v, float) else str(v) for k, v in motion.items())
    title = f"{phantom}, {how}, {frames} frames of {pixels}², noise {100 * noise:.2g} %"
    row = simulated(frames, pixels, noise, 1000 + index, phantom={"kind": phantom}, motion=motion)
    return replace(row, name=f"identifiable-{index:03d}", title=title, bars={"sigmas": 5.0, "worst": 3.0})


def random_unidentifiable(index: int) -> Row:
    """Return a scene whose rotation the frames do not tell, for one of six reasons."""
    rng = np.random.default_rng([2, index])
    frames, pixels = int(rng.integers(80, 161)), int(rng.choice([64, 80, 96]))
    noise = float(np.exp(rng.uniform(np.log(0.005), np.log(0.1))))
    duration, radius = (frames - 1) * INTERVAL, 0.7 * 0.5 * pixels * PIXEL
    drift = Drift.random(rng, amplitude=float(rng.uniform(0, 0.2)) * radius, duration=duration)
    turns = float(rng.uniform(0.5, 1.5))
    tumbling = Tumbling.random(rng, total_angle=360 * turns, duration=duration, drift=drift)
    tilt = float(rng.uniform(-90, 90))
    spin = SingleAxis.from_turns(turns=turns, duration=duration, tilt=tilt, drift=drift)
    in_plane = SingleAxis.from_turns(turns=turns, duration=duration, drift=drift)
    fold = int(rng.integers(3, 7))
    still = replace(spin, rate=0.0)
    phantom: Phantom
    motion: RigidMotion
    match index % 6:
        case 0:
            what, phantom, motion = "layered sphere, tumbling", _layers(rng, radius), tumbling
        case 1:
            kind = str(rng.choice(["blobs", "grain"]))
            anything = (
                Grain.random(rng, radius=radius) if kind == "grain" else Blobs.random(rng, radius=radius)
            )
            what, phantom, motion = f"{kind}, still", anything, still
        case 2:
            phantom, motion = _body_of_revolution(rng, radius, spin.axis), spin
            what = f"body of revolution, {turns:.2f} turns about its axis, tilted by {tilt:.0f}°"
        case 3:
            phantom, motion = _body_of_revolution(rng, radius, IMAGE_X), tumbling
            what = f"body of revolution, tumbling by {360 * turns:.0f}°"
        case 4:
            phantom, motion = _symmetric(rng, radius, in_plane.axis, fold), in_plane
            what = f"{fold}-fold object, {turns:.2f} turns about its axis in the image plane"
        case _:
            phantom, motion = _rods(rng, radius, spin.axis), spin
            what = f"ellipsoids of revolution, {turns:.2f} turns about their axis, tilted by {tilt:.0f}°"
    title = f"{what}, {frames} frames of {pixels}², noise {100 * noise:.2g} %"
    config = _config(frames, pixels, noise, 2000 + index)
    return Row(
        f"unidentifiable-{index:03d}", title, lambda: _render(config, phantom, motion), {"trusted": 0.0}
    )


def _layers(rng: np.random.Generator, radius: float) -> Grain:
    edges = radius * np.array([1.0, rng.uniform(0.7, 0.95), rng.uniform(0.2, 0.6)])
    return Grain(np.array([1.0, -0.5, 0.4]), np.zeros((3, 3)), np.eye(3) / edges[:, None, None] ** 2, 2)


def _body_of_revolution(rng: np.random.Generator, radius: float, axis: Array) -> Blobs:
    x, y, z = axis
    return Blobs.coaxial(rng, count=int(rng.integers(3, 8)), radius=radius, axis=(x, y, z))


def _rods(rng: np.random.Generator, radius: float, axis: Array) -> Grain:
    """Return ellipsoids of revolution on a common axis."""
    count = int(rng.integers(2, 5))
    along = rng.uniform(0.2, 0.5, count)
    across = rng.uniform(0.2, 0.5, count)
    outer = np.outer(axis, axis)
    form = outer / along[:, None, None] ** 2 + (np.eye(3) - outer) / across[:, None, None] ** 2
    place = np.linspace(-0.5, 0.5, count)[:, None] * axis
    return Grain(rng.uniform(0.4, 1.0, count), radius * place, form / radius**2, 2)


def _symmetric(rng: np.random.Generator, radius: float, axis: Array, fold: int) -> Blobs:
    """Return blobs that a turn by 360° / `fold` about the axis leaves as they are."""
    part = Blobs.random(rng, count=4, radius=radius)
    turns = Rotation.from_rotvec(2 * np.pi / fold * np.arange(fold)[:, None] * axis).as_matrix()
    position = np.einsum("fij,bj->fbi", turns, part.position).reshape(-1, 3)
    covariance = np.einsum("fij,bjk,flk->fbil", turns, part.covariance, turns).reshape(-1, 3, 3)
    whole = Blobs(np.tile(part.amplitude, fold), position, covariance)
    scale = radius / whole.radius
    return Blobs(whole.amplitude, scale * whole.position, scale**2 * whole.covariance)


# ---------------------------------------------------------------------- measuring


def measure(row: Row) -> dict[str, Any]:
    """Estimate and compare with the truth."""
    frames, truth = row.make()
    start = clock.perf_counter()
    found = trapcli.estimate(frames, attenuation=True, method=row.method)
    seconds = clock.perf_counter() - start
    measured: dict[str, Any] = {
        "title": row.title,
        "bars": row.bars,
        "trusted": float(found.identifiable),
        "warned": float(not found.identifiable or "1 sigma" in found.verdict),
        "verdict": found.verdict,
        "seconds": round(seconds, 1),
        "valid": float(found.valid.mean()),
        "rotations": float(np.isfinite(found.R).all(axis=(1, 2)).mean()),
        "silent": float((found.flags & np.uint16(Flag.THIRD_ORDER_SILENT) > 0).mean()),
    }
    measured |= {name: round(float(value), 4) for name, value in _errors(found, truth).items()}
    if found.identifiable:
        measured["coverage"] = _coverage(found, truth)
    return measured


def _coverage(found: Motion, truth: Motion) -> dict[str, list[float]]:
    """Return the shares of errors within one and two of the stated ones, over the valid frames."""
    errors = compare(found, truth).errors
    shares = {name: [errors[name].within_1_sigma, errors[name].within_2_sigma] for name in NAMES}
    return {name: np.round(share, 4).tolist() for name, share in shares.items() if np.isfinite(share).all()}


def _errors(found: Motion, truth: Motion) -> dict[str, float]:
    """Return errors: angles in degrees, α in %, and the largest in units of the errors that are stated."""
    known = np.isfinite(found.R).all(axis=(1, 2)) & (truth.valid > 0)
    if known.sum() < 2:
        return {}
    matched = match(replace(found, valid=known.astype(np.uint8)), truth)
    a, b = matched.result, matched.truth
    turned = rotation_difference(a.R, b.R)
    degrees = np.rad2deg(np.linalg.norm(turned, axis=1))
    values = {
        "worst": float(np.nanmax(degrees)),
        "R": float(np.rad2deg(align(a.R[known], b.R[known])[0].mean())),
    }
    with np.errstate(divide="ignore", invalid="ignore"):
        pulls = {
            "sigmas": np.abs(turned) / a.R_errors,
            "sigmas_phi": np.abs(wrap(a.phi - b.phi)) / a.phi_errors,
            "sigmas_omega_3": np.abs(a.omega_3 - b.omega_3) / a.omega_3_errors,
            "sigmas_alpha": np.abs(a.alpha - b.alpha) / a.alpha_errors,
            "sigmas_T": np.abs(a.T - b.T) / a.T_errors,
        }
        values |= {name: float(np.max(p[np.isfinite(p)], initial=0.0)) for name, p in pulls.items()}
        relative = 100 * np.abs(a.alpha / b.alpha - 1)
    if np.isfinite(relative).any():
        values["alpha"] = float(np.median(relative[np.isfinite(relative)]))
    speed = [np.hypot(m.alpha, m.omega_3)[known] for m in (a, b)]
    angle, true_angle = (np.rad2deg(np.trapezoid(s, a.time[known])) for s in speed)
    values |= {
        "angle": abs(angle - true_angle),
        "turn": 100 * abs(angle / true_angle - 1) if true_angle else 0.0,
    }
    tilts = [np.rad2deg(np.median(np.arctan2(m.omega_3, m.alpha)[known])) for m in (a, b)]
    return values | {"tilt": abs(tilts[0] - tilts[1])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("patterns", nargs="*", default=["*"])
    parser.add_argument("--again", action="store_true", help="also rows that have been measured")
    parser.add_argument("--cell", type=Path, default=CELL, help="the wave-optics simulation of a cell")
    parser.add_argument("--results", type=Path, default=RESULTS, help="elsewhere: no page is written")
    parser.add_argument("--report", action="store_true", help="only write the page")
    options = parser.parse_args()
    results = json.loads(options.results.read_text()) if options.results.exists() else {}
    rows = [
        *fixed_rows(options.cell),
        *map(random_unidentifiable, range(UNIDENTIFIABLE)),
        *map(random_identifiable, range(IDENTIFIABLE)),
    ]
    for row in rows:
        wanted = any(fnmatch(row.name, pattern) for pattern in options.patterns)
        if options.report or not wanted or (row.name in results and not options.again):
            continue
        results[row.name] = measured = measure(row)
        print(row.name, json.dumps(measured, ensure_ascii=False), file=sys.stderr, flush=True)
        options.results.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n")
    if options.results == RESULTS:
        write_page({row.name: results[row.name] for row in rows if row.name in results}, PAGE)


if __name__ == "__main__":
    main()
