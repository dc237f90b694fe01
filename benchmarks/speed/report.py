"""The figure and the page of the benchmark of speed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

NAMES = {
    "yardstick": "a plain FFT of every frame",
    "front end": "trap-motion, front end",
    "estimate": "trap-motion estimate",
    "literal": "the paper as written",
}
COLORS = {"yardstick": "0.5", "front end": "C0", "estimate": "C1", "literal": "C3"}
BARS = {"front end": "≤ 1", "estimate": "≤ 4"}


def write_figure(results: dict[str, Any], path: Path) -> None:
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
    plan = results["plan"]
    names = list(results["one"])
    values = [1e3 * _least(results["one"][name], "seconds") for name in names]
    bars = left.barh(range(len(names)), values, color=[COLORS[name] for name in names])
    left.bar_label(bars, [f" {value:.3g}" for value in values])
    left.set_xlim(1, 3 * max(values))
    left.set_yticks(range(len(names)), [NAMES[name] for name in names])
    left.invert_yaxis()
    left.set_xscale("log")
    left.set_xlabel("ms per frame")
    left.set_title(f"{plan['frames']} frames of {plan['size']}²")
    for axes, key, label in ((middle, "by_frames", "frames of 128²"), (right, "by_size", "edge [pixels]")):
        points = sorted(results[key], key=int)
        for name in ("yardstick", "front end", "estimate"):
            scale = [int(p) if key == "by_frames" else plan["growth_count"] for p in points]
            seconds = [results[key][p][name]["seconds"] * n for p, n in zip(points, scale, strict=True)]
            axes.loglog([int(p) for p in points], seconds, "o-", color=COLORS[name])
        axes.set_xlabel(label)
        axes.set_ylabel("s")
        axes.set_xticks([int(p) for p in points], points)
        axes.minorticks_off()
    middle.set_title("by frames")
    right.set_title(f"by size, {plan['growth_count']} frames")
    figure.savefig(path, dpi=130)


def write_page(results: dict[str, Any], path: Path) -> None:
    plan, one = results["plan"], results["one"]
    lines = [
        "# Speed",
        "",
        "![Time per frame of trap-motion, of a plain FFT and of the paper as written; growth with the number",
        "of frames and with their size](images/speed.png)",
        "",
        f"The paper's object and motion: {plan['frames']} frames of {plan['size']} × {plan['size']} pixels, "
        "uint16 TIFF, noise of 1 %.",
        "All read the same file, one after the other, "
        f"{plan['rounds']} times in turn. The yardstick reads every",
        "frame and transforms it with `scipy.fft.rfft2` in single precision on all cores. Times are the",
        "least of all rounds, as what else runs can only add to them; ratios are those of these times, and",
        "of single rounds. The aim for the peak memory is 600 MB and 50 KB a frame.",
        "",
        f"On {results['threads']} cores of {results['machine']}.",
        f"The machine's load was {results['load']:.1f} before and {results['load_after']:.1f} after,",
        f"of which this benchmark itself makes up to {results['threads']}.",
        "",
        "| | ms per frame | over the yardstick | in single rounds | aim | peak memory |",
        "|---|---|---|---|---|---|",
    ]
    for name, costs in one.items():
        lines.append(_line(NAMES[name], costs, one["yardstick"], BARS.get(name, "")))
    raw = results["raw"]
    name = f"front end, {plan['growth_count']} raw frames with a background file"
    lines += [
        _line(name, raw["front end"], raw["yardstick"], ""),
        "",
        "The paper as written (`benchmarks/speed/literal.py`) finds T, φ, ω₃, α and R too: double precision,",
        "Φ for every direction, both equations of the paper with differences of neighbouring frames. Without",
        "noise it finds them (`tests/benchmarks/test_literal.py`: α within 3 %); with the noise of these",
        "frames its rates are of no use, only its time counts. It is timed on the first frames, and takes",
        f"{_least(one['literal'], 'seconds') / _least(one['estimate'], 'seconds'):.1f} times as long as "
        "`trap-motion estimate` for each",
        "of them (aim: 15).",
        *_aspire(results),
        "",
        "## Growth",
        "",
        "| frames of 128² | FFT [s] | front end [s] | estimate [s] | peak memory |",
        "|---|---|---|---|---|",
        *(_row(results["by_frames"][n], n, int(n)) for n in sorted(results["by_frames"], key=int)),
        "",
        f"| edge, {plan['growth_count']} frames | FFT [s] | front end [s] | estimate [s] | peak memory |",
        "|---|---|---|---|---|",
        *(_row(results["by_size"][s], s, plan["growth_count"]) for s in sorted(results["by_size"], key=int)),
        "",
        *_profile(results),
        "",
        "Made by `python benchmarks/speed/run.py`.",
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _line(name: str, costs: list[dict[str, float]], base: list[dict[str, float]], aim: str) -> str:
    ratio = _least(costs, "seconds") / _least(base, "seconds")
    single = sorted(c["seconds"] / b["seconds"] for c, b in zip(costs, base, strict=True))
    memory = max(cost["memory"] for cost in costs)
    return (
        f"| {name} | {1e3 * _least(costs, 'seconds'):.2f} | {ratio:.2f} | {single[0]:.2f} – {single[-1]:.2f} "
        f"| {aim} | {memory:.0f} MB |"
    )


def _least(costs: list[dict[str, float]], what: str) -> float:
    return min(cost[what] for cost in costs)


def _row(costs: dict[str, dict[str, float]], name: str, frames: int) -> str:
    times = " | ".join(
        f"{costs[key]['seconds'] * frames:.2f}" for key in ("yardstick", "front end", "estimate")
    )
    return f"| {name} | {times} | {costs['estimate']['memory']:.0f} MB |"


def _aspire(results: dict[str, Any]) -> list[str]:
    aspire = results.get("aspire")
    if not aspire:
        return []
    if "missing" in aspire:
        return ["", f"ASPIRE-Python could not be timed: {aspire['missing']}."]
    return [
        "",
        f"ASPIRE-Python {aspire['version']} takes {aspire['seconds']:.0f} s for the rotations of 60 frames.",
    ]


def _profile(results: dict[str, Any]) -> list[str]:
    total = sum(seconds for _, seconds in results["steps"])
    bounds = {
        "frames": "memory bandwidth: each pixel is read, converted and averaged once; then small products "
        "on some 150² cells",
        "branches": "arithmetic on lines and moments of some 50 groups of frames",
        "object model": "waves (non-uniform FFTs) and factorisations of the linear model; hardly grows with "
        "the frames, which are averaged in groups",
    }
    return [
        "## Where the time goes",
        "",
        "| stage | share | bound by |",
        "|---|---|---|",
        *(
            f"| {name} | {seconds / total:.0%} | {bounds.get(name, '')} |"
            for name, seconds in results["steps"]
        ),
    ]
