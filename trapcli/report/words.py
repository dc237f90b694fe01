"""A result in words: what is known, how well, and what is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trapcli.result.motion import FLAG_MEANINGS, Array, Motion

_MOSTLY = 0.95  # share of valid frames from which a result is called good as a whole
_RANGES = 12
"""Most runs of frames that are listed."""


@dataclass(frozen=True)
class Headline:
    """The verdict: ``good``, ``fair`` or ``bad``, in a few words and in a sentence."""

    level: str
    title: str
    text: str


def headline(motion: Motion) -> Headline:
    """Say first whether the motion can be trusted."""
    if motion.truth:
        return Headline("good", "True motion of a simulation", "")
    count, total = int((motion.valid > 0).sum()), len(motion)
    text = motion.verdict.removeprefix("not trustworthy: ")
    if not motion.identifiable or not count:
        return Headline("bad", "Not trustworthy", text)
    where = f"all {total} frames" if count == total else f"{count} of {total} frames"
    good = count >= _MOSTLY * total
    title = "Trustworthy" if good else "Trustworthy in part"
    return Headline("good" if good else "fair", f"{title}: {where}", text)


def facts(motion: Motion) -> list[tuple[str, str]]:
    """Return names and values of what is known, over the valid frames."""
    rate = f"rad/{motion.time_unit}"
    rows = [("Frames", f"{len(motion)}, {_span(motion)}")]
    valid = motion.valid > 0
    if not valid.any():
        return rows
    speed = np.hypot(motion.alpha, motion.omega_3)
    known = valid & np.isfinite(speed)
    if known.any():
        edges = np.concatenate(
            [motion.time[:1], motion.time[1:] / 2 + motion.time[:-1] / 2, motion.time[-1:]]
        )
        turned = np.degrees(np.sum((speed * np.diff(edges))[known]))
        tilt = np.degrees(np.median(np.arctan2(np.abs(motion.omega_3), motion.alpha)[known]))
        rows += [
            ("Turned by", f"{'' if known.all() else 'at least '}{turned:.3g}° in all"),
            ("Rate of rotation", f"{np.median(speed[known]):.3g} {rate} in the median"),
            ("Rotation axis", f"{tilt:.3g}° out of the image plane in the median"),
        ]
    center = motion.center[valid & np.isfinite(motion.center).all(axis=1)]
    if len(center):
        reach = np.ptp(center, axis=0)
        rows.append(("Moved within", f"{reach[0]:.3g} × {reach[1]:.3g} {motion.length_unit}"))
    errors = (
        ("T", motion.T_errors, f" {motion.length_unit}"),
        ("φ", np.degrees(motion.phi_errors), "°"),
        ("ω₃", motion.omega_3_errors, f" {rate}"),
        ("α", motion.alpha_errors, f" {rate}"),
        ("R", np.degrees(motion.R_errors), "°"),
    )
    stated = [
        f"{name} {_typical(values, valid)}{unit}"
        for name, values, unit in errors
        if np.isfinite(values[valid]).any()
    ]
    if stated:
        rows.append(("Typical errors (1 σ)", ", ".join(stated)))
    return rows


def flagged(motion: Motion) -> list[tuple[str, int, str]]:
    """Return meaning, number of frames and their ranges for every flag that occurs and for invalid frames."""
    rows = []
    for flag, meaning in FLAG_MEANINGS.items():
        marked = (motion.flags & int(flag)) > 0
        if marked.any():
            rows.append((meaning, int(marked.sum()), _ranges(motion, marked)))
    invalid = motion.valid == 0
    if invalid.any():
        rows.append(("not valid", int(invalid.sum()), _ranges(motion, invalid)))
    return rows


def _span(motion: Motion) -> str:
    start, stop = motion.time[0], motion.time[-1]
    return f"from {start:.4g} to {stop:.4g} {motion.time_unit}"


def _typical(values: Array, valid: NDArray[np.bool_]) -> str:
    return f"{np.nanmedian(values[valid]):.2g}"


def _ranges(motion: Motion, marked: NDArray[np.bool_]) -> str:
    """List runs of frames by their numbers in the input: ``3, 7 to 12``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], marked, [0]]).astype(int))).reshape(-1, 2)
    runs = [(motion.frame[start], motion.frame[stop - 1]) for start, stop in edges[:_RANGES]]
    listed = ", ".join(f"{first}" if first == last else f"{first} to {last}" for first, last in runs)
    return listed + (f" and {len(edges) - _RANGES} more runs" if len(edges) > _RANGES else "")
