"""The figure and the page about what `run.py` measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from bound import BAND
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from peers import REQUIREMENT, SETTINGS
from scenes import CURVES, NOISE, ROWS, Curve, Row, scene

COLUMNS = {
    "auto": "`auto`",
    "paper": "`paper`",
    "CLSync3N/single": "CLSync3N",
    "CLSyncVoting/single": "CLSyncVoting",
    "CLSync3N/averaged": "CLSync3N, averaged",
    "CLSyncVoting/averaged": "CLSyncVoting, averaged",
}
COLORS = {"auto": "#0060b0", "paper": "#d86000", "CLSync3N": "#2a9030", "CLSyncVoting": "#9040a0"}
LINEAR = 20.0  # degrees beyond which a bound, which takes angles for small, says nothing
FIELD = "auto+field"
"""The method that is given an image of the empty field as well."""
QUANTITIES = {"T": "T", "phi": "φ", "omega_3": "ω₃", "alpha": "α", "R": "R"}
Result = dict[str, Any]


def write_figure(results: Result, path: Path) -> None:
    """Draw error against noise, one panel a curve."""
    curves = [curve for curve in CURVES if _seeds(results, curve.key)]
    if not curves:
        return
    figure, axes = plt.subplots(1, len(curves), figsize=(5.4 * len(curves), 5.2), sharey=True, squeeze=False)
    for axis, curve in zip(axes[0], curves, strict=True):
        _panel(axis, results, curve)
    axes[0, 0].set_ylabel("rotation error [degrees]")
    figure.legend(handles=_legend(), loc="lower center", ncol=4, frameon=False, fontsize=8.5)
    figure.tight_layout(rect=(0, 0.11, 1, 1))
    figure.savefig(path, dpi=130)
    plt.close(figure)


def write_page(results: Result, path: Path) -> None:
    """Write the tables, what they mean and how they are made."""
    curves = [_curve(results, curve) for curve in CURVES if _seeds(results, curve.key)]
    parts = [_INTRODUCTION, _rows(results), _calibration(results), _NOISE, *curves, _BOUND, _how(results)]
    path.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")


# ---------------------------------------------------------------------- figure


def _panel(axis: Axes, results: Result, curve: Curve) -> None:
    x = 100 * np.array(NOISE)
    bounds = [_mean_bound(results, curve, n) for n in NOISE]
    for kind, style in (("mean", "--"), ("worst", ":")):
        expected = np.array([bound[kind] for bound in bounds])
        axis.plot(x[expected < LINEAR], expected[expected < LINEAR], style, color="black", lw=1.2)
    for method in COLUMNS:
        name, _, source = method.partition("/")
        color, line = COLORS[name], "--" if source == "averaged" else "-"
        averages = [_average(_runs(results, curve, n, method)) or 3 * (np.nan,) for n in NOISE]
        mean, worst, trusted = np.transpose(averages)
        axis.plot(x, mean, line, color=color, lw=2.2 if name == "auto" else 1.4, zorder=3)
        for chosen, fill in ((trusted == 1, color), (trusted < 1, "white")):
            axis.plot(x[chosen], mean[chosen], "o", color=color, mfc=fill, ms=5, zorder=4)
        if not source:
            axis.plot(x, worst, line, color=color, lw=0.8, alpha=0.6)
    axis.set(xscale="log", yscale="log", xlabel="noise [% of the peak attenuation]")
    axis.set_ylim(5e-3, 200)
    axis.set_xticks(x, [f"{n:g}" for n in x], fontsize=8.5)
    axis.minorticks_off()
    axis.set_yticks([0.01, 0.1, 1, 10, 100], ["0.01", "0.1", "1", "10", "100"])
    axis.grid(color="0.9")
    axis.set_title(curve.title, fontsize=9.5)


def _legend() -> list[Line2D]:
    def line(label: str, style: Any, color: str = "black", width: float = 1.4, **more: Any) -> Line2D:
        return Line2D([], [], linestyle=style, color=color, lw=width, label=label, **more)

    return [
        line("auto, mean over frames", "-", COLORS["auto"], 2.2, marker="o", ms=5),
        line("auto, worst frame", "-", COLORS["auto"], 0.8),
        line("paper, mean", "-", COLORS["paper"], marker="o", ms=5),
        line("paper, worst frame", "-", COLORS["paper"], 0.8),
        line("Cramér–Rao bound, mean", "--", width=1.2),
        line("bound, worst frame", ":", width=1.2),
        line("ASPIRE CLSync3N, mean", "-", COLORS["CLSync3N"], marker="o", ms=5),
        line("ASPIRE CLSyncVoting, mean", "-", COLORS["CLSyncVoting"], marker="o", ms=5),
        line("ASPIRE on averaged frames", "--", "0.4"),
        line("hollow: exit code 4 for some seeds", "", "0.4", marker="o", mfc="white", ms=5),
    ]


# --------------------------------------------------------------------- numbers


def _seeds(results: Result, name: str) -> list[int]:
    """Return the seeds for which there are runs."""
    return sorted({int(key.split("/")[1]) for key in results["runs"] if key.split("/")[0] == name})


def _runs(results: Result, curve: Curve, noise: float, method: str) -> list[Result]:
    keys = [f"{curve.key}/{seed}/{noise:g}/{method}" for seed in _seeds(results, curve.key)]
    return [results["runs"][key] for key in keys if key in results["runs"]]


def _seeds_of(results: Result, curve: Curve, noise: float, methods: list[str]) -> list[int]:
    """Return the seeds for which one of the methods has been run."""
    return [
        seed
        for seed in _seeds(results, curve.key)
        if any(f"{curve.key}/{seed}/{noise:g}/{method}" in results["runs"] for method in methods)
    ]


def _average(runs: list[Result]) -> tuple[float, float, float] | None:
    """Return the mean error, the worst of all, and the share that is trusted, where all have rotations."""
    if not runs or any(run["mean"] is None for run in runs):
        return None
    return (
        float(np.mean([run["mean"] for run in runs])),
        max(run["worst"] for run in runs),
        float(np.mean([run.get("trusted", True) for run in runs])),
    )


def _mean_bound(results: Result, curve: Curve, noise: float) -> dict[str, float]:
    keys = [f"{curve.key}/{seed}/{noise:g}" for seed in _seeds(results, curve.key)]
    bounds = [results["bounds"][key] for key in keys if key in results["bounds"]]
    return {
        kind: float(np.mean([bound[kind] for bound in bounds])) if bounds else np.nan
        for kind in ("mean", "worst")
    }


def _digits(value: float) -> str:
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}" if value < 10 else f"{value:.0f}"


# ------------------------------------------------------------------------ page


def _rows(results: Result) -> str:
    lines = [
        "| stack | aimed at | measured | within the aim | over the bound | trusted | processor time [s] |",
        "|---|---|---|---|---|---|---|",
        *(
            _row(results, row, way)
            for row in ROWS
            for way in (("auto", FIELD) if row.is_camera else ("auto",))
        ),
    ]
    return "\n".join(lines)


def _row(results: Result, row: Row, way: str) -> str:
    title = f"{row.title}, empty field given" if way == FIELD else row.title
    aim = f"{row.mean:g}°" + (f" ({row.worst:g}°)" if row.worst else "")
    aim += f" in {row.often}" if row.often else ""
    runs = {seed: results["runs"].get(f"{row.key}/{seed}/{way}") for seed in _seeds(results, row.key)}
    runs = {seed: run for seed, run in runs.items() if run}
    if not runs:
        return f"| {title} | {aim} | not run | | | | |"
    ratios = [_ratio(results, row, seed, run) for seed, run in runs.items()]
    runs = list(runs.values())
    known = [run for run in runs if run["mean"] is not None]
    means = sorted(run["mean"] for run in known)
    measured = "no rotation"
    if known:
        several = f"{_digits(means[0])}–" if len(known) > 1 else ""
        measured = f"{several}{_digits(means[-1])}° ({_digits(max(run['worst'] for run in known))}°)"
    within = [run for run in known if run["mean"] <= row.mean and run["worst"] <= (row.worst or np.inf)]
    over = np.median([ratio for ratio in ratios if ratio is not None]) if known else np.nan
    trusted = sum(bool(run.get("trusted")) for run in runs)
    seconds = [run["processor"] for run in runs if "processor" in run]
    took = f"{np.median(seconds):.0f}" if seconds else ""
    return (
        f"| {title} | {aim} | {measured} | {len(within)} of {len(runs)} | {over:.1f} "
        f"| {trusted} of {len(runs)} | {took} |"
    )


def _ratio(results: Result, row: Row, seed: int, run: Result) -> float | None:
    """Return the mean error in units of the bound's."""
    bound = results["bounds"].get(f"{row.key}/{seed}")
    return run["mean"] / bound["mean"] if bound and run["mean"] is not None else None


def _calibration(results: Result) -> str:
    """Say how many errors are within the stated ones, over the runs that are trusted."""
    cameras = {row.key for row in ROWS if row.is_camera}
    groups: dict[str, list[Result]] = {"attenuation": [], "camera": [], "camera, empty field given": []}
    for key, run in results["runs"].items():
        if run.get("trusted") and run["method"] in ("auto", FIELD):
            camera = "camera" if key.split("/")[0] in cameras else "attenuation"
            groups["camera, empty field given" if run["method"] == FIELD else camera].append(run["coverage"])
    lines = [
        "Do the stated errors come true? Shares of the errors within 1 and 2 σ, over the valid frames of all",
        "results of `auto` on this page that are trusted; 68 and 95 % would be right.",
        "",
        "| frames | results | " + " | ".join(QUANTITIES.values()) + " |",
        "|---" * (len(QUANTITIES) + 2) + "|",
    ]
    for name, found in groups.items():
        shares = [np.array([run[q] for run in found if q in run]).reshape(-1, 2) for q in QUANTITIES]
        cells = [
            " / ".join(f"{100 * x:.0f}" for x in s.mean(axis=0)) + " %" if len(s) else "" for s in shares
        ]
        lines.append(f"| {name} | {len(found)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _curve(results: Result, curve: Curve) -> str:
    seeds = _seeds(results, curve.key)
    made = scene(curve.table, 0).config.stack
    present = [m for m in COLUMNS if any(_runs(results, curve, n, m) for n in NOISE)]
    lines = [
        f"### {curve.title}",
        "",
        f"{made.frames} frames of {made.height} × {made.width}; objects, motions and noises: {len(seeds)}, "
        "the first of them for other methods than `auto`.",
        "",
        "| noise | Cramér–Rao bound | " + " | ".join(COLUMNS[m] for m in present) + " |",
        "|---" * (len(present) + 2) + "|",
    ]
    for noise in NOISE:
        mean, worst = _mean_bound(results, curve, noise).values()
        stated = f"{_digits(mean)} / {_digits(worst)}" if mean < LINEAR else "–"
        cells = [_cell(_runs(results, curve, noise, method)) for method in present]
        lines.append(f"| {100 * noise:g} % | {stated} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, *_better(results, curve)])


def _cell(runs: list[Result]) -> str:
    if not runs:
        return ""
    average = _average(runs)
    if average is None:
        return f"– ({sum(run['mean'] is None for run in runs)} of {len(runs)})"
    mean, worst, trusted = average
    doubted = "" if trusted == 1 else f" †{round(len(runs) * (1 - trusted))}"
    return f"{_digits(mean)} / {_digits(worst)}{doubted}"


def _better(results: Result, curve: Curve) -> list[str]:
    """Say by how much `auto` is better than the best of ASPIRE, on ASPIRE's frames."""
    lines = []
    for name, words in (("single", "single frames"), ("averaged", "frames averaged with their neighbours")):
        peers = [m for m in COLUMNS if m.endswith(f"/{name}")]
        ratios = []
        for noise in NOISE:
            theirs = [_average(_runs(results, curve, noise, m)) for m in peers]
            best = min((average[0] for average in theirs if average), default=None)
            shared = _seeds_of(results, curve, noise, peers)
            ours = [results["runs"].get(f"{curve.key}/{seed}/{noise:g}/auto", {}) for seed in shared]
            if best is not None and ours and all(run.get("mean_of_60") is not None for run in ours):
                mean = float(np.mean([run["mean_of_60"] for run in ours]))
                ratios.append(f"{best / mean:.3g} at {100 * noise:g} %")
        if ratios:
            lines.append(f"- from {words}: {', '.join(ratios)}")
    if not lines:
        return []
    return [
        "",
        "The error of ASPIRE's best on its 60 frames, over that of `auto` on the same, which has seen all",
        "frames (aim: 20):",
        "",
        *lines,
    ]


_INTRODUCTION = """# Accuracy

Errors are angles in degrees between the rotation found and the true one, after the best constant rotation of
the object and the better of the two mirror solutions: the mean over all frames and, in brackets or after a
stroke, the worst frame. `trap-motion estimate` gets the frames, with their frame interval and pixel size,
and nothing else; no empty field in particular. Noise is white, in percent of the highest attenuation, or
that of a camera: shot noise, read noise, 16 and 8 bits by turns, uneven light, dust, flicker. Objects,
motions and noise are random, another for every seed; with the camera, blobs and grains by turns.

“Over the bound” is the mean error in units of the [Cramér–Rao bound](#the-bound), the median where there are
several seeds. “Trusted”: exit code 0."""

_VERSION = REQUIREMENT.split("==")[1]
_NOISE = f"""## Error against noise

![Rotation error against noise for both methods of trap-motion and two of ASPIRE-Python, with the Cramér–Rao
bound](images/accuracy.png)

Mean over the frames and over the seeds / worst frame of all seeds. †n: in n seeds the program says that the
result is not to be trusted. – (n of m): in n of m seeds there is no rotation for at least half of the frames.
Empty: not run.

`CLSync3N` and `CLSyncVoting` of ASPIRE-Python ({_VERSION}), which know no time, get 60 evenly
spaced of the same frames, shifted by their true centres, cropped to the object and with no search for shifts;
once as single frames, once averaged with their neighbours, like the class averages that they are made
for. They run with {" and with ".join(f"at most {s}² pixels and `n_theta` {n}" for s, n in SETTINGS)};
the better one by true error counts. Once the mean error is above 15° they are not run at more noise."""

_BOUND = f"""## The bound

No unbiased estimate is better on average than the Cramér–Rao bound: the inverse of the Fisher information in
white noise, at the true object and motion, of everything that is unknown. Unknown are two shifts of every
frame; ω(t), a cubic spline with the fewest equal intervals that hold the true motion to a tenth of the bound,
which an estimate can't know beforehand; and the object, which may be anything inside its ball up to spatial
frequencies of {BAND:g} over its radius. Its spectrum is taken to be nowhere stronger than the strongest mode
that is seen: a motion that shows an object from few sides only would otherwise leave the rest of it so free
that no bound made sense. With a spectrum 100 times stronger or weaker, at 1 % and up to frequencies of 20,
the bound changes by 4 % for the tumbling blobs and by 18 % for the paper's motion. The mean and worst error
are averages of draws from the bound's covariance. With a camera, the noise is the root mean square over
the object, and the empty field is taken to be known. All is computed from exact projections, without the code
of the estimate, and a test holds it against differences of pixels. For the tumbling blobs at 1 % and the same
spline, frequencies up to 26 lower it by 4 %; with frequencies up to 16, those of an earlier version of the
estimate, the covariance that this states itself gives errors that are 1.5 % smaller. The sharp edges of
grains show at higher frequencies too, and the estimate uses those up to 28: for two grains of the camera's
row, seeds 7 and 9, these lower the bound from 0.057° to 0.050° and from 0.073° to 0.062°.

The estimate may err less than that: it does not take the object for anything whatever, but for what the mean
of all frames shows of it and for as smooth as their evidence says ([theory](theory.md)). For three scenes of
the camera's row at 5 % the errors that are stated would be 0.45 to 0.63 of what they are were the object
known."""


def _how(results: Result) -> str:
    runs = {key: run for key, run in results["runs"].items() if "commit" in run}
    machines = "; ".join(sorted({run["machine"] for run in runs.values()}))
    measured: dict[str, list[str]] = {}
    for key, run in runs.items():
        what = f"{key.split('/')[0]} with {run['method']}"
        if what not in (told := measured.setdefault(run["commit"], [])):
            told.append(what)
    commits = "\n".join(f"- {commit}: {', '.join(what)}" for commit, what in sorted(measured.items()))
    return f"""## How to repeat

```
python benchmarks/accuracy/run.py NAME … --seeds 0:4
```

NAME is one of a curve, {", ".join(f"`{each.key}`" for each in CURVES)}, or a row of the first table,
{", ".join(f"`{each.key}`" for each in ROWS)};
without one all are run. It installs ASPIRE into `benchmarks/accuracy/.venv-aspire` and writes
`benchmarks/accuracy/results.json`, which holds the verdict of every run, this page and its figure.

Measured on {machines}. The commit is the last one that changed the program itself:

{commits}"""
