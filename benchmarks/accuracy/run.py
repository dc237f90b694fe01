"""Rotation error against noise: both methods of trap-motion, ASPIRE-Python, and the Cramér–Rao bound.

python benchmarks/accuracy/run.py [--quick] [--seeds N]

Writes benchmarks/accuracy/results.json, docs/images/accuracy.png and docs/benchmarks-accuracy.md.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time as clock
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from bound import bounds
from numpy.typing import NDArray
from peers import INPUTS, METHODS, QUICK_SETTINGS, SETTINGS, Aspire, chosen, install
from report import write_figure, write_page
from scenes import Images, Stack, render, scenes

from trapcli.config import MotionConfig
from trapcli.motion.joint import estimate_joint
from trapcli.motion.paper import estimate_paper
from trapcli.motion.path import align
from trapcli.result.motion import Motion
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]

NOISE = (0.001, 0.003, 0.01, 0.03, 0.05, 0.1, 0.2, 0.5)
ENOUGH = 0.5  # share of the frames that must have a rotation for an error to be stated
LOST = 60.0  # mean error [degrees] beyond which ASPIRE is not run at more noise

FOLDER = Path(__file__).parent
RESULTS = FOLDER / "results.json"
ROOT = FOLDER.parent.parent


@dataclass(frozen=True)
class Error:
    """What one method made of one noisy stack.

    Attributes
    ----------
    mean, worst:
        Over the frames [degrees], gauge and mirror removed; None where there is no rotation to judge.
    known:
        Share of the frames that have a rotation.
    trusted:
        Whether the program itself vouches for the result.
    seconds:
        Time taken; None where it was not taken alone.
    note:
        What the program says of the result.
    """

    mean: float | None
    worst: float | None
    known: float = 1.0
    trusted: bool = True
    seconds: float | None = None
    note: str = ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--quick", action="store_true", help="a smaller paper's scene, one setting of ASPIRE")
    parser.add_argument("--seeds", type=int, default=1, help="noise realisations per noise level")
    parser.add_argument("--report", action="store_true", help="only draw and write what results.json holds")
    options = parser.parse_args()
    if not options.report:
        _measure(options.quick, options.seeds)
    results = json.loads(RESULTS.read_text())
    write_figure(results, ROOT / "docs" / "images" / "accuracy.png")
    write_page(results, ROOT / "docs" / "benchmarks-accuracy.md")


def _measure(quick: bool, seeds: int) -> None:
    """Run everything; results are written after every noise level."""
    start = clock.perf_counter()
    aspire = install()
    results: dict[str, Any] = {
        "quick": quick,
        "seeds": seeds,
        "noise": list(NOISE),
        "aspire": {
            "version": None,
            "settings": QUICK_SETTINGS if quick else SETTINGS,
            "missing": aspire if isinstance(aspire, str) else None,
        },
        "machine": _machine(),
        "scenes": {},
    }
    for scene in scenes(quick):
        stack = render(scene)
        _tell(f"{scene.key}: bound")
        entry: dict[str, Any] = {
            "title": scene.title,
            "shape": list(stack.clean.shape),
            "pixel_size": stack.pixel_size,
            "radius": stack.radius,
            "turn": float(np.rad2deg(stack.turn)),
            "averaged": 2 * chosen(len(stack.clean))[1] + 1,
            "bound": bounds(stack, quick),
            "errors": {},
        }
        results["scenes"][scene.key] = entry
        lost: set[str] = set()
        for noise in NOISE:
            runs: dict[str, list[Error]] = {}
            for seed in range(seeds):
                frames = stack.noisy(noise, seed)
                for method, error in _all_methods(stack, frames, aspire, lost, results["aspire"]):
                    runs.setdefault(method, []).append(error)
                    _tell(f"{scene.key}, noise {100 * noise:g} %, seed {seed}, {method}: {_words(error)}")
            lost |= {
                method for method, errors in runs.items() if "/" in method and _mean(errors, LOST) >= LOST
            }
            entry["errors"][f"{noise:g}"] = {
                method: [asdict(e) for e in errors] for method, errors in runs.items()
            }
            results["minutes"] = (clock.perf_counter() - start) / 60
            RESULTS.write_text(json.dumps(results, indent=1) + "\n")


def _all_methods(
    stack: Stack, frames: Images, aspire: Aspire | str, lost: set[str], about: dict[str, Any]
) -> Iterator[tuple[str, Error]]:
    yield "paper", _own(estimate_paper, stack, frames)
    yield "auto", _own(estimate_joint, stack, frames)
    # both methods of ASPIRE share their common lines: a stack is left out where both are lost
    inputs = tuple(i for i in INPUTS if not all(f"{m}/{i}" in lost for m in METHODS))
    if isinstance(aspire, str) or not inputs:
        return
    try:
        found, about["version"] = aspire.estimate(stack, frames, about["settings"], inputs)
    except RuntimeError as error:
        _tell(str(error))
        return
    truth = stack.truth.R[chosen(len(frames))[0]]
    for name in (f"{m}/{i}" for i in inputs for m in METHODS):
        if name not in lost:
            errors = [_error(R, truth) for R in found.get(name, [])]
            yield name, min(errors, key=lambda e: e.mean or 0.0, default=Error(None, None, known=0.0))


def _own(estimate: Callable[..., Motion], stack: Stack, frames: Images) -> Error:
    start = clock.perf_counter()
    motion = estimate(
        Frames.from_array(frames), MotionConfig(), time=stack.truth.time, pixel_size=stack.pixel_size
    )
    return _error(
        motion.R,
        stack.truth.R,
        trusted=motion.identifiable,
        seconds=round(clock.perf_counter() - start, 2),
        note=motion.verdict,
    )


def _error(R: Array, truth: Array, **details: Any) -> Error:
    known = np.isfinite(R).all(axis=(1, 2))
    share = round(float(known.mean()), 4)
    if share < ENOUGH:
        return Error(None, None, known=share, **details)
    angles = np.rad2deg(align(R[known], truth[known])[0])
    return Error(float(angles.mean()), float(angles.max()), known=share, **details)


def _mean(errors: list[Error], unknown: float) -> float:
    return float(np.mean([unknown if e.mean is None else e.mean for e in errors]))


def _words(error: Error) -> str:
    if error.mean is None or error.worst is None:
        return "no rotation"
    took = "" if error.seconds is None else f", {error.seconds:.0f} s"
    return f"{error.mean:.3f}°, worst {error.worst:.3f}°{took}{'' if error.trusted else ', not trusted'}"


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _machine() -> dict[str, str]:
    """Say what the measurement ran on."""
    processor = platform.processor() or platform.machine()
    information = Path("/proc/cpuinfo")
    if information.exists():
        lines = information.read_text().splitlines()
        processor = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), processor)
    git = subprocess.run(
        ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    )
    threads = os.environ.get("OMP_NUM_THREADS", "unset")
    return {
        "processor": f"{processor}, {os.cpu_count()} cores, OMP_NUM_THREADS {threads}",
        "python": platform.python_version(),
        "trapcli": version("trapcli") + (f" ({git.stdout.strip()})" if git.returncode == 0 else ""),
        **{name: version(name) for name in ("numpy", "scipy", "finufft")},
    }


if __name__ == "__main__":
    main()
