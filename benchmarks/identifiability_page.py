"""The page of the benchmark of identifiability."""

from __future__ import annotations

import platform
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

Results = dict[str, dict[str, Any]]

WIDTH = 118

ABOUT = """
Simulated attenuation with white noise in units of its peak; blobs without symmetry where no object
is named. Errors: α, its median relative error; angle, the error of the angle accumulated over all
frames; R, the mean rotation error after the best constant rotation of the object; tilt and turn,
those of the axis and of the whole angle. In brackets the highest value wanted. A stack is refused
where `identifiable` is false: exit code 4.
"""

NOT_TOLD = """
Layered spheres that tumble; still objects; bodies of revolution about their axis at any tilt, made
of blobs or of sharp ellipsoids; tumbling bodies of revolution; objects with a 3- to 6-fold axis
that turn about it in the image plane. 80 to 160 frames of 64² to 96², noise 0.5 to 10 %, with
drift.
"""

TOLD = """
Blobs, grains and the paper's object, tumbling or about one axis at a random tilt, with drift; 80 to
200 frames of 64² to 96², noise 0.5 to 10 %. An answer should be within 5 of its standard deviations
in every frame; without a warning in its verdict also within 3°, counted from the first frame.
"""

KINDS = (
    "sphere, tumbling",
    "still",
    "turns about its axis, tilted",
    "ellipsoids of revolution",
    "revolution, tumbling",
    "turns about its axis in the image plane",
)
"""Parts of the titles of scenes that don't tell the rotation."""

NAMES = {"T": "T", "phi": "φ", "omega_3": "ω₃", "alpha": "α", "R": "R"}
"""Quantities whose errors are stated."""

WORDS = {
    "alpha": "α {:.2f} %",
    "angle": "angle {:.2f}°",
    "R": "R {:.3f}°",
    "tilt": "tilt {:.2f}°",
    "turn": "turn {:.3f} %",
}


def write_page(results: Results, path: Path) -> None:
    """Write the tables of what `results` holds."""
    fixed = {name: row for name, row in results.items() if "identifiable-" not in name}
    known = [row for name, row in results.items() if name.startswith("identifiable-")]
    unknown = [row for name, row in results.items() if name.startswith("unidentifiable-")]
    lines = [
        "# What can be known, and whether the program knows it",
        "",
        *wrap(" ".join(ABOUT.split()), WIDTH),
        "",
        "| stack | measured | |",
        "|---|---|---|",
        *(_line(row) for row in fixed.values()),
        "",
        *_refused(unknown),
        "",
        *_answered(known),
        "",
        f"Made by `python benchmarks/identifiability.py` (Python {platform.python_version()}, "
        f"NumPy {np.__version__}, {platform.machine()}).",
        "",
    ]
    path.write_text("\n".join(lines))


def _line(row: dict[str, Any]) -> str:
    bars: dict[str, float] = row["bars"]
    if "trusted" in bars:
        return f"| {row['title']} | {row['verdict']} | {_mark(row['trusted'] == 0)} |"
    if not row["trusted"]:
        return f"| {row['title']} | refused: {row['verdict']} | ✗ |"
    measured = [f"{WORDS[name].format(row[name])} ({bar:g})" for name, bar in bars.items()]
    return (
        f"| {row['title']} | {', '.join(measured)} | {_mark(all(row[n] <= bar for n, bar in bars.items()))} |"
    )


def _mark(met: bool) -> str:
    return "✓" if met else "✗"


def _refused(rows: list[dict[str, Any]]) -> list[str]:
    """Say how many of the scenes that tell nothing were refused."""
    answered = [row for row in rows if row["trusted"]]
    return [
        "## Random scenes that don't tell the rotation",
        "",
        *wrap(" ".join(NOT_TOLD.split()), WIDTH),
        "",
        "| scenes | measured | refused | holding a rotation all the same |",
        "|---|---|---|---|",
        *(_kind(kind, [row for row in rows if kind in row["title"]]) for kind in KINDS),
        *_listed("Answered all the same", answered),
    ]


def _answered(rows: list[dict[str, Any]]) -> list[str]:
    """Say how many answers keep their promise."""
    answers = [row for row in rows if row["trusted"]]
    sure = [row for row in answers if not row["warned"]]
    far = [row for row in answers if row["sigmas"] > 5 or (not row["warned"] and row["worst"] > 3)]
    errors = [row["R"] for row in answers]
    text = [
        "## Random scenes that do",
        "",
        *wrap(" ".join(TOLD.split()), WIDTH),
        "",
        f"{len(rows)} scenes: {len(sure)} answered without a warning, {len(answers) - len(sure)} with the "
        f"warning that errors exceed 1°, {len(rows) - len(answers)} refused.",
    ]
    if errors:
        text += [
            f"Rotation error of the answers: median {np.median(errors):.2f}°, largest {max(errors):.2f}°."
        ]
        text += [f"{len(answers) - len(far)} of {len(answers)} answers keep the promise."]
        text += _covered([row["coverage"] for row in answers if "coverage" in row])
    return [
        *text,
        *_listed("Answers that do not", far),
        *_listed("Refused", [r for r in rows if not r["trusted"]]),
    ]


def _covered(shares: list[dict[str, list[float]]]) -> list[str]:
    """Say how often errors are as small as is stated: the mean over stacks, each by its valid frames."""
    if not shares:
        return []
    mean = {name: np.mean([share[name] for share in shares if name in share], axis=0) for name in NAMES}
    return [
        "",
        f"| {len(shares)} answers, errors within | " + " | ".join(NAMES.values()) + " |",
        "|---" * (1 + len(NAMES)) + "|",
        *(
            f"| {n + 1} σ | " + " | ".join(f"{100 * mean[name][n]:.0f} %" for name in NAMES) + " |"
            for n in range(2)
        ),
    ]


def _kind(kind: str, rows: list[dict[str, Any]]) -> str:
    refused = [row for row in rows if not row["trusted"]]
    return f"| {kind} | {len(rows)} | {len(refused)} | {sum(row['rotations'] > 0 for row in refused)} |"


def _listed(title: str, rows: list[dict[str, Any]]) -> list[str]:
    if not rows:
        return []
    table = [
        "",
        f"{title}:",
        "",
        "| scene | worst frame | in standard deviations | verdict |",
        "|---|---|---|---|",
    ]
    for row in rows:
        worst = f"{row['worst']:.1f}° | {row['sigmas']:.1f}" if "worst" in row else "– | –"
        table.append(f"| {row['title']} | {worst} | {row['verdict']} |")
    return table
