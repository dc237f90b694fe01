"""Rotation error against noise: both methods of trap-motion, ASPIRE-Python, and the Cramér–Rao bound.

python benchmarks/accuracy/run.py [NAME ...] [--seeds 0:3] [--method auto] [--again]

NAME is a curve or a row of `scenes`; without one all are measured, curves with all methods, rows with `auto`.
What results.json holds already is not measured again. Writes benchmarks/accuracy/results.json,
docs/images/accuracy.png and docs/benchmarks-accuracy.md.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time as clock
from dataclasses import asdict, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from bound import bound, information, visible_radius
from numpy.typing import NDArray
from peers import INPUTS, METHODS, Aspire, chosen, install, squares
from report import FIELD, write_figure, write_page
from scenes import CURVES, NOISE, ROWS, Table, noise_of, scene

import trapcli
from trapcli.errors import InputError
from trapcli.motion.path import align
from trapcli.result.comparison import compare
from trapcli.result.motion import Motion
from trapcli.simulation.render import Scene
from trapcli.stack.frames import Frames
from trapcli.stack.tiff import write_tiff

Array = NDArray[np.float64]
Result = dict[str, Any]

ENOUGH = 0.5  # share of the frames that must have a rotation for an error to be stated
LOST = 15.0  # mean error [degrees] beyond which ASPIRE is not run at more noise
PEERS = tuple(f"{method}/{name}" for name in INPUTS for method in METHODS)
ALL = ("paper", "auto", FIELD, *PEERS)
QUANTITIES = ("T", "phi", "omega_3", "alpha", "R")

FOLDER = Path(__file__).parent
RESULTS = FOLDER / "results.json"
ROOT = FOLDER.parent.parent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    names = [c.key for c in CURVES] + [r.key for r in ROWS]
    parser.add_argument("name", nargs="*", choices=[*names, []], help="curves and rows; none: all")
    parser.add_argument("--seeds", default="0:1", metavar="A:B", help="seeds A to B − 1 of each")
    parser.add_argument("--method", nargs="*", metavar="M", choices=ALL, default=ALL, help=", ".join(ALL))
    parser.add_argument("--again", action="store_true", help="measure anew what has been measured")
    parser.add_argument("--report", action="store_true", help="only draw and write what results.json holds")
    options = parser.parse_args()
    results: Result = json.loads(RESULTS.read_text()) if RESULTS.exists() else {"bounds": {}, "runs": {}}
    if not options.report:
        _origin()  # now: the working tree may change while this runs
        first, last = (int(seed) for seed in options.seeds.split(":"))
        for name in options.name or names:
            for seed in range(first, last):
                _measure(results, name, seed, options.method, options.again)
    write_figure(results, ROOT / "docs" / "images" / "accuracy.png")
    write_page(results, ROOT / "docs" / "benchmarks-accuracy.md")


def _measure(results: Result, name: str, seed: int, methods: list[str], again: bool) -> None:
    """Measure a curve or a row."""
    row = next((r for r in ROWS if r.key == name), None)
    if row is not None:
        _bounds(results, {f"{name}/{seed}": row.table(seed)}, seed)
        ways = ("auto", FIELD) if row.is_camera else ("auto",)
        _stack(results, f"{name}/{seed}", row.table(seed), seed, [m for m in methods if m in ways], again)
        return
    curve = next(c for c in CURVES if c.key == name)
    _bounds(results, {f"{name}/{seed}/{noise:g}": curve.at(noise) for noise in NOISE}, seed)
    lost = {FIELD}
    for noise in NOISE:
        place = f"{name}/{seed}/{noise:g}"
        _stack(results, place, curve.at(noise), seed, [m for m in methods if m not in lost], again)
        lost |= {m for m in PEERS if _is_lost(results["runs"].get(f"{place}/{m}"))}


def _stack(results: Result, place: str, table: Table, seed: int, methods: list[str], again: bool) -> None:
    """Run methods on one stack; results are written after every run."""

    def keep(found: dict[str, Result]) -> None:
        for method, result in found.items():
            results["runs"][f"{place}/{method}"] = result
            print(f"{place}/{method}: {_words(result)}", file=sys.stderr, flush=True)
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")

    missing = [m for m in methods if again or f"{place}/{m}" not in results["runs"]]
    if missing:
        found = scene(table, seed)
        frames = replace(Frames.from_array(found.frames().to_array()), info=found.frames().info)
        for method in missing:
            if method not in PEERS:
                keep({method: _own(method, found, frames)})
        keep(_aspire([m for m in missing if m in PEERS], found, frames))


def _bounds(results: Result, tables: dict[str, Table], seed: int) -> None:
    """Compute the bounds of stacks that differ by their noise."""
    missing = {place: scene(table, seed) for place, table in tables.items() if place not in results["bounds"]}
    if not missing:
        return
    first = next(iter(missing.values()))
    noises = [noise_of(found) for found in missing.values()]
    for place, noise, told in zip(missing, noises, information(first, noises), strict=True):
        results["bounds"][place] = {**asdict(bound(first, told)), "unknowns": told.unknowns, "noise": noise}
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")


def _own(method: str, scene: Scene, frames: Frames) -> Result:
    """Run a method of trap-motion as a user would."""
    start = clock.process_time()
    attenuation = scene.config.camera.output == "attenuation"
    try:
        with tempfile.TemporaryDirectory() as folder:
            background = None
            if method == FIELD:
                background, image = f"{folder}/empty.tif", scene.background()
                write_tiff(Path(background), [image[None]], shape=(1, *image.shape), dtype=image.dtype)
            motion = trapcli.estimate(
                frames, method=method.partition("+")[0], attenuation=attenuation, background=background
            )
    except InputError as error:
        return {**_error(np.full((len(frames), 3, 3), np.nan), scene), "verdict": str(error), **_origin()}
    seconds = clock.process_time() - start
    index, _ = chosen(len(frames))
    return {
        **_error(motion.R, scene),
        "mean_of_60": _error(motion.R[index], scene, index)["mean"],
        "method": method,
        "trusted": motion.identifiable,
        "verdict": motion.verdict,
        "valid": float(motion.valid.mean()),
        "coverage": _coverage(motion, scene),
        "processor": round(seconds, 1),
        **_origin(),
    }


def _aspire(methods: list[str], scene: Scene, frames: Frames) -> dict[str, Result]:
    """Run ASPIRE's methods on 60 of the frames, given the true centres."""
    if not methods:
        return {}
    aspire = install()
    if not isinstance(aspire, Aspire):
        print(aspire, file=sys.stderr)
        return {}
    truth = scene.truth()
    index, _ = chosen(len(frames))
    radius, pixel_size = visible_radius(scene), scene.config.stack.pixel_size
    images = squares(frames.to_array(), truth.center, pixel_size, radius)
    # both methods share their common lines
    found = aspire.rotations({name: images[name] for name in INPUTS if any(name in m for m in methods)})
    unknown = {"mean": None, "worst": None, "known": 0.0}
    return {
        method: min((_error(R, scene, index) for R in found.get(method, [])), key=_mean, default=unknown)
        for method in methods
    }


def _is_lost(found: Result | None) -> bool:
    return found is not None and _mean(found) > LOST


def _mean(found: Result) -> float:
    return 180.0 if found["mean"] is None else float(found["mean"])


def _error(R: Array, scene: Scene, index: NDArray[np.intp] | None = None) -> Result:
    """Return mean and largest angle over the frames [degrees], gauge and mirror removed."""
    truth = scene.truth().R if index is None else scene.truth().R[index]
    known = np.isfinite(R).all(axis=(1, 2))
    if known.mean() < ENOUGH:
        return {"mean": None, "worst": None, "known": float(known.mean())}
    angles = np.rad2deg(align(R[known], truth[known])[0])
    return {"mean": float(angles.mean()), "worst": float(angles.max()), "known": float(known.mean())}


def _coverage(motion: Motion, scene: Scene) -> dict[str, tuple[float, float]]:
    """Return the shares of errors within one and two of the stated ones, over the valid frames."""
    errors = compare(motion, scene.truth()).errors
    shares = {name: (errors[name].within_1_sigma, errors[name].within_2_sigma) for name in QUANTITIES}
    return {name: share for name, share in shares.items() if np.isfinite(share).all()}


def _words(found: Result) -> str:
    if found["mean"] is None:
        return f"no rotation; {found.get('verdict', '')}"
    took = f", {found['processor']:.0f} s; {found['verdict']}" if "processor" in found else ""
    return f"{found['mean']:.3f}°, worst {found['worst']:.3f}°{took}"


@cache
def _origin() -> dict[str, str]:
    """Say which program was measured, and on what."""
    git = ["git", "-C", str(ROOT)]
    last = [*git, "log", "-1", "--format=%h", "--", "trapcli"]
    changed = [*git, "status", "--porcelain", "--", "trapcli"]
    commit, changes = (
        subprocess.run(command, capture_output=True, text=True).stdout.strip() for command in (last, changed)
    )
    processor = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.exists():
        lines = information.read_text().splitlines()
        processor = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), processor)
    versions = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "finufft"))
    threads = os.environ.get("OMP_NUM_THREADS", "all")
    return {
        "commit": (commit or "unknown") + (", changed" if changes else ""),
        "machine": f"{processor}, {threads} threads, Python {platform.python_version()}, {versions}",
    }


if __name__ == "__main__":
    main()
