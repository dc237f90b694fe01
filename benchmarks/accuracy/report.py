"""The figure and the page about what `run.py` measured."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

COLUMNS = {
    "auto": "`auto`",
    "paper": "`paper`",
    "CLSync3N/single": "CLSync3N",
    "CLSync3N/averaged": "CLSync3N, averaged",
    "CLSyncVoting/single": "CLSyncVoting",
    "CLSyncVoting/averaged": "CLSyncVoting, averaged",
}
COLORS = {"auto": "#0060b0", "paper": "#d86000", "CLSync3N": "#2a9030", "CLSyncVoting": "#9040a0"}
LINEAR = 20.0  # degrees beyond which a bound, which takes angles for small, says nothing


def write_figure(results: dict[str, Any], path: Path) -> None:
    """Draw error against noise, one panel a scene."""
    scenes = results["scenes"].values()
    figure, axes = plt.subplots(1, len(scenes), figsize=(4.4 * len(scenes), 4.9), sharey=True, squeeze=False)
    for axis, scene in zip(axes[0], scenes, strict=True):
        _panel(axis, scene, np.array(results["noise"]))
    axes[0, 0].set_ylabel("rotation error [degrees]")
    figure.legend(handles=_legend(), loc="lower center", ncol=5, frameon=False, fontsize=8.5)
    figure.tight_layout(rect=(0, 0.1, 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def write_page(results: dict[str, Any], path: Path) -> None:
    """Write the tables, what they mean and how they are made."""
    text = [_introduction(results)]
    for scene in results["scenes"].values():
        text += [_heading(scene), _table(scene, results["noise"]), _bound_text(scene["bound"])]
    text.append(_how(results))
    path.write_text("\n\n".join(text) + "\n")


# ---------------------------------------------------------------------- figure


def _panel(axis: Axes, scene: dict[str, Any], noise: np.ndarray) -> None:
    for kind, style in (("mean", "--"), ("worst", ":")):
        bound = scene["bound"][kind] * noise / 0.01
        axis.plot(100 * noise[bound < LINEAR], bound[bound < LINEAR], style, color="black", lw=1.2)
    for method in COLUMNS:
        name, _, source = method.partition("/")
        color, line = COLORS[name], "--" if source == "averaged" else "-"
        values = {n: _average(scene, n, method) for n in noise if _average(scene, n, method)}
        if not values:
            continue
        x = 100 * np.array(list(values))
        mean, worst, trusted = (np.array(v) for v in zip(*values.values(), strict=True))
        axis.plot(x, mean, line, color=color, lw=2.2 if name == "auto" else 1.4, zorder=3)
        for vouched, fill in ((True, color), (False, "white")):
            chosen = trusted == vouched
            axis.plot(x[chosen], mean[chosen], "o", color=color, mfc=fill, ms=5, zorder=4)
        if not source:
            axis.plot(x, worst, line, color=color, lw=0.8, alpha=0.6)
    axis.set(xscale="log", yscale="log", xlabel="noise [% of the peak attenuation]")
    axis.set_ylim(3e-3, 200)
    axis.set_xticks(100 * noise, [f"{100 * n:g}" for n in noise], fontsize=8.5)
    axis.minorticks_off()
    axis.set_yticks([0.01, 0.1, 1, 10, 100], ["0.01", "0.1", "1", "10", "100"])
    axis.grid(color="0.9")
    frames, height, width = scene["shape"]
    axis.set_title(
        f"{scene['title']}\n{frames} frames of {height} × {width}, {scene['turn']:.0f}°", fontsize=9.5
    )


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
        line("hollow: the program itself does not trust it", "", "0.4", marker="o", mfc="white", ms=5),
    ]


def _average(scene: dict[str, Any], noise: float, method: str) -> tuple[float, float, bool] | None:
    """Return the mean error, the worst error of all seeds, and whether all are trusted; None without any."""
    runs = scene["errors"].get(f"{noise:g}", {}).get(method, [])
    known = [r for r in runs if r["mean"] is not None]
    if not known:
        return None
    return (
        float(np.mean([r["mean"] for r in known])),
        max(r["worst"] for r in known),
        all(r["trusted"] for r in known),
    )


# ------------------------------------------------------------------------ page


def _introduction(results: dict[str, Any]) -> str:
    seeds, aspire = results["seeds"], results["aspire"]
    averaged = f", of {seeds} noise realisations" if seeds > 1 else ""
    peers = (
        f"""ASPIRE-Python {aspire["version"]} (`CLSync3N`, `CLSyncVoting`), which knows no time, gets 60
evenly spaced of the same frames, shifted by their true centres, cropped to the object and with no search for
shifts; once as single frames, once averaged with their neighbours, like the class averages that it is made
for. It runs with {_settings(aspire["settings"])}, and its defaults for all else. Of several
settings the one with the least true error counts. Once its mean error is above 60° it is not run at more
noise."""
        if not aspire["missing"]
        else f"ASPIRE-Python is left out: {aspire['missing']}."
    )
    return f"""# Rotation error against noise

![Rotation error against noise, three scenes](images/accuracy.png)

Errors are angles in degrees between the rotation found and the true one, after the best constant rotation of
the object and the better of the two mirror solutions: **mean over the frames / worst frame**{averaged}. Noise
is white, in percent of the highest attenuation of the stack. `auto` and `paper` are the two methods of
`trap-motion estimate`; they get the frames and their times, nothing else.

{peers}

† the program itself says that the result is not to be trusted. – no rotation for at least half of the frames.
Empty: not run."""


def _settings(settings: list[list[int]]) -> str:
    sizes = sorted({size for size, _ in settings}, reverse=True)
    thetas = sorted({n for _, n in settings})
    return (
        f"images of at most {' and '.join(str(s) for s in sizes)} pixels "
        f"and `n_theta` {' and '.join(str(n) for n in thetas)}"
    )


def _heading(scene: dict[str, Any]) -> str:
    frames, height, width = scene["shape"]
    title = scene["title"][0].upper() + scene["title"][1:]
    return (
        f"## {title}\n\n{frames} frames of {height} × {width}, turned by {scene['turn']:.0f}° in all. "
        f"Averaged: means of {scene['averaged']} frames."
    )


def _table(scene: dict[str, Any], noise: list[float]) -> str:
    present = [m for m in COLUMNS if any(m in runs for runs in scene["errors"].values())]
    rows = [
        "| noise | Cramér–Rao bound | " + " | ".join(COLUMNS[m] for m in present) + " |",
        "|---" * (len(present) + 2) + "|",
    ]
    for n in noise:
        bound = [scene["bound"][kind] * n / 0.01 for kind in ("mean", "worst")]
        cells = [_cell(scene, n, m) for m in present]
        stated = f"{_digits(bound[0])} / {_digits(bound[1])}" if bound[0] < LINEAR else "–"
        rows.append(f"| {100 * n:g} % | {stated} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _cell(scene: dict[str, Any], noise: float, method: str) -> str:
    if method not in scene["errors"].get(f"{noise:g}", {}):
        return ""
    average = _average(scene, noise, method)
    if average is None:
        return "–"
    mean, worst, trusted = average
    return f"{_digits(mean)} / {_digits(worst)}{'' if trusted else ' †'}"


def _digits(value: float) -> str:
    return f"{value:.3f}" if value < 0.1 else f"{value:.2f}" if value < 10 else f"{value:.0f}"


def _bound_text(bound: dict[str, Any]) -> str:
    change = {name: f"{100 * (value - 1):+.0f} %" for name, value in bound["factor"].items()}
    return f"""The bound: spatial frequencies up to {bound["band"]:g} over the object's radius (up to
{bound["band"] - 4:g}: {change["band_lower_by_4"]}); an unknown object of {bound["unknowns"]} amplitudes;
a spline of {bound["intervals"]} intervals (half as many: {change["knots_half_as_many"]}; twice as many:
{change["knots_twice_as_many"]}). The faint prior of the object is weighted as at 0.1 % of noise
(as at 10 %: {change["prior_at_noise_10_percent"]})."""


def _how(results: dict[str, Any]) -> str:
    machine = dict(results["machine"])
    processor = machine.pop("processor")
    versions = ", ".join(f"{name} {value}" for name, value in machine.items())
    command = "python benchmarks/accuracy/run.py" + (" --quick" if results["quick"] else "")
    if results["seeds"] > 1:
        command += f" --seeds {results['seeds']}"
    difference = (
        """This is the quick version;
without `--quick` the paper's scene has 1000 frames of 256 × 256, the bound a wider band, and ASPIRE the best
of four settings."""
        if results["quick"]
        else """With `--quick`
the paper's scene is smaller, the bound's band narrower, and ASPIRE has one setting."""
    )
    return f"""## The bound

No unbiased estimate of a path of this smoothness is better on average than the Cramér–Rao bound: the inverse
of the Fisher information of the path's spline in white noise, at the true object and motion, with the object
inside its ball and every frame's shift unknown. It is proportional to the noise. An estimate that assumes
more, such as a smoother path, can come out below it. The expected mean and worst error are those of draws
from its covariance, after the same alignment.

## How to repeat

```
{command}
```

It installs ASPIRE into `benchmarks/accuracy/.venv-aspire`, took {results["minutes"]:.0f} minutes here, and
writes `benchmarks/accuracy/results.json`, this page and its figure. {difference}

Machine: {processor}. Versions: {versions}."""
