"""Time and memory of trap-motion against a plain FFT of every frame, the paper as written, and ASPIRE-Python.

python benchmarks/speed/run.py [--quick] [--aspire]

Writes benchmarks/speed/results.json, docs/images/speed.png and docs/benchmarks-speed.md.
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
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from report import write_figure, write_page

FOLDER = Path(__file__).parent
ROOT = FOLDER.parent.parent
RESULTS = FOLDER / "results.json"
PROGRAM = str(Path(sys.executable).parent / "trap-motion")
THREADS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
LITERAL_FRAMES = 24
_FIELD = 25.6  # edge of a frame [µm], of which the object takes a half
ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": str(THREADS)}


@dataclass(frozen=True)
class Plan:
    """How much is measured.

    Attributes
    ----------
    frames, size:
        Of the stack that everything works on; a frame is `size` × `size`.
    rounds:
        How often everything is measured, in turn.
    growth_frames, growth_sizes:
        Frames of 128 × 128 in which the growth of the time is measured; sizes of `growth_count` frames.
    """

    frames: int
    size: int
    rounds: int
    growth_frames: tuple[int, ...]
    growth_sizes: tuple[int, ...]
    growth_count: int


FULL = Plan(1000, 1024, 3, (100, 300, 1000, 3000, 10000), (128, 256, 512, 1024, 2048), 200)
QUICK = Plan(200, 1024, 2, (100, 300, 1000), (128, 256, 512, 1024), 100)


@dataclass(frozen=True)
class Cost:
    """Seconds per frame and peak memory [MB] of one run."""

    seconds: float
    memory: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--quick", action="store_true", help="fewer and smaller stacks, for a few minutes")
    parser.add_argument("--aspire", action="store_true", help="time ASPIRE-Python as well; installs it")
    parser.add_argument("--report", action="store_true", help="only draw and write what results.json holds")
    options = parser.parse_args()
    if not options.report:
        RESULTS.write_text(json.dumps(_measure(QUICK if options.quick else FULL, options.aspire), indent=1))
    results = json.loads(RESULTS.read_text())
    write_figure(results, ROOT / "docs" / "images" / "speed.png")
    write_page(results, ROOT / "docs" / "benchmarks-speed.md")


def _measure(plan: Plan, aspire: bool) -> dict[str, Any]:
    results: dict[str, Any] = {
        "plan": asdict(plan),
        "threads": THREADS,
        "machine": f"{_processor()}, Python {platform.python_version()}, NumPy {version('numpy')}",
        "load": os.getloadavg()[0],
    }
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        _tell(f"{plan.frames} frames of {plan.size}")
        stack = _simulate(place, plan.frames, plan.size)
        results["one"] = _compare(stack, plan)
        results["steps"] = _steps(stack)
        stack.unlink()
        _tell("raw frames")
        results["raw"] = _raw(place, plan)
        _tell("growth")
        results["by_frames"] = {n: _growth(place, n, 128) for n in plan.growth_frames}
        results["by_size"] = {s: _growth(place, plan.growth_count, s) for s in plan.growth_sizes}
        if aspire:
            _tell("ASPIRE")
            results["aspire"] = _aspire()
    results["load_after"] = os.getloadavg()[0]
    return results


def _compare(stack: Path, plan: Plan) -> dict[str, list[dict[str, float]]]:
    """Measure everything in turn, so that whatever else the machine does meets all alike."""
    costs: dict[str, list[dict[str, float]]] = {}
    for _ in range(plan.rounds):
        for name, cost in (
            ("yardstick", _work("yardstick", stack)),
            ("front end", _work("front-end", stack)),
            ("estimate", _estimate(stack, plan.frames)),
            ("literal", _work("literal", stack, "--frames", f"0:{LITERAL_FRAMES}")),
        ):
            costs.setdefault(name, []).append(asdict(cost))
    return costs


def _raw(place: Path, plan: Plan) -> dict[str, list[dict[str, float]]]:
    """Measure the front end on raw frames, with their background in a file."""
    stack, background = place / "raw.tif", place / "empty.tif"
    scene = ["--preset", "camera", "-n", str(plan.growth_count), "--background-out", str(background)]
    field = ["--bits", "16", "--size", str(plan.size), "--spacing", str(_FIELD / plan.size)]
    _run([PROGRAM, "simulate", *scene, *field, "-o", str(stack), "--overwrite"])
    costs: dict[str, list[dict[str, float]]] = {"yardstick": [], "front end": []}
    for _ in range(plan.rounds):
        costs["yardstick"].append(asdict(_work("yardstick", stack)))
        costs["front end"].append(asdict(_work("front-end", stack, "--background", str(background))))
    stack.unlink()
    return costs


def _growth(place: Path, frames: int, size: int) -> dict[str, dict[str, float]]:
    stack = _simulate(place, frames, size)
    costs = {
        "yardstick": asdict(_work("yardstick", stack)),
        "front end": asdict(_work("front-end", stack)),
        "estimate": asdict(_estimate(stack, frames)),
    }
    stack.unlink()
    return costs


def _steps(stack: Path) -> list[tuple[str, float]]:
    """Return the share of the estimate's time that each stage takes."""
    code = (
        "import sys, json, time, trapcli\n"
        "from trapcli.stack import open_stack\n"
        "told = []\n"
        "note = lambda stage, done, total: told.append((stage, time.perf_counter()))\n"
        "start = time.perf_counter()\n"
        "trapcli.estimate(open_stack(sys.argv[1]), attenuation=True, progress=note)\n"
        "end = time.perf_counter()\n"
        "stages = list(dict(told))\n"
        "last = dict(told)\n"
        "times = [start, *(last[s] for s in stages), end]\n"
        "names = [*stages, 'object model']\n"
        "print(json.dumps([(n, (b - a)) for n, a, b in zip(names, times, times[1:])]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(stack)], env=ENVIRONMENT, check=True, capture_output=True, text=True
    )
    return [(str(name), float(seconds)) for name, seconds in json.loads(done.stdout)]


def _simulate(place: Path, frames: int, size: int) -> Path:
    """Write the paper's object and motion with noise of 1 %, uint16."""
    path = place / f"{frames}-{size}.tif"
    interval, spacing = str(0.5 / frames), str(_FIELD / size)
    scene = ["--preset", "paper", "--dtype", "uint16", "--noise", "0.01", "-n", str(frames)]
    sampling = ["--size", str(size), "--spacing", spacing, "--frame-interval", interval]
    _run([PROGRAM, "simulate", *scene, *sampling, "-o", str(path), "--overwrite"])
    return path


def _work(what: str, stack: Path, *options: str) -> Cost:
    command = [sys.executable, str(FOLDER / "work.py"), what, str(stack), "--threads", str(THREADS), *options]
    output, _, memory = _run(command)
    return Cost(float(output), memory)


def _estimate(stack: Path, frames: int) -> Cost:
    result = stack.with_suffix(".h5")
    command = [PROGRAM, "estimate", str(stack), "--attenuation", "-o", str(result), "--overwrite"]
    _, seconds, memory = _run(command, accepted=(0, 4))
    return Cost(seconds / frames, memory)


def _run(command: list[str], accepted: tuple[int, ...] = (0,)) -> tuple[str, float, float]:
    """Return what a command prints, its seconds, and its peak memory [MB]."""
    start = clock.perf_counter()
    process = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True)
    assert process.stdout
    output = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in accepted:
        raise RuntimeError(f"{' '.join(command)}: exit code {process.returncode}")
    unit = 1e6 if sys.platform == "darwin" else 1e3
    return output, clock.perf_counter() - start, usage.ru_maxrss / unit


def _aspire() -> dict[str, Any]:
    """Time CLSync3N on 60 frames of the paper's object, in the environment of benchmarks/accuracy."""
    sys.path.append(str(FOLDER.parent / "accuracy"))
    from bound import visible_radius
    from peers import REQUIREMENT, SETTINGS, install, squares
    from scenes import ROWS, scene

    found = install()
    if isinstance(found, str):
        return {"missing": found}
    stack = {"frames": 300, "height": 128, "width": 128, "pixel_size": _FIELD / 128}
    made = scene({**ROWS[0].table(0), "stack": stack, "camera": {"noise": 0.0}}, 0)
    images = squares(made.frames().to_array(), made.truth().center, _FIELD / 128, visible_radius(made))
    start = clock.perf_counter()
    found.rotations({"single": images["single"]}, SETTINGS[1:])
    return {"version": REQUIREMENT.split("==")[1], "seconds": clock.perf_counter() - start}


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.machine()


def _tell(what: str) -> None:
    print(what, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
