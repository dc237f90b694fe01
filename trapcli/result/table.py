"""`Motion` as a table of one row per frame, for CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from trapcli.result.hdf5 import quaternions
from trapcli.result.motion import Motion

Cell = float | int | str
ROWS_AT_ONCE = 1000


def units(motion: Motion) -> dict[str, str]:
    """Return the unit of every numeric column, in order."""
    length, rate = motion.length_unit, f"rad/{motion.time_unit}"
    return {
        "frame": "frame",
        "time": motion.time_unit,
        **dict.fromkeys(("T1", "T2", "T1_errors", "T2_errors", "center1", "center2"), length),
        **dict.fromkeys(("phi", "phi_errors"), "rad"),
        **dict.fromkeys(("omega_1", "omega_2", "omega_3", "omega_3_errors", "alpha", "alpha_errors"), rate),
        **dict.fromkeys((f"R{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)), "1"),
        **dict.fromkeys(("R1_errors", "R2_errors", "R3_errors"), "rad"),
        **dict.fromkeys((f"quaternion_{c}" for c in "xyzw"), "1"),
        **dict.fromkeys(("valid", "flags", "residual"), "1"),
    }


def csv_blocks(motion: Motion) -> Iterator[str]:
    """Yield CSV text with a header; NaN is an empty cell.

    The column names are the same for all files, so the units of time and length, which are not, stand in the
    last two columns.
    """
    yield ",".join([*units(motion), "time_unit", "length_unit"]) + "\n"
    for block in _blocks(motion):
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        for row in block:
            cells = ["" if isinstance(cell, float) and math.isnan(cell) else cell for cell in row]
            writer.writerow([*cells, motion.time_unit, motion.length_unit])
        yield text.getvalue()


def json_blocks(motion: Motion) -> Iterator[str]:
    """Yield JSON text ``{"units": …, "identifiable": …, "verdict": …, "frames": [one object a frame]}``.

    NaN and infinity are null.
    """
    names = list(units(motion))
    head = {"units": units(motion), "identifiable": motion.identifiable, "verdict": motion.verdict}
    yield json.dumps(head)[:-1] + ', "frames": ['
    separator = "\n"
    for block in _blocks(motion):
        rows = (dict(zip(names, map(_finite, row), strict=True)) for row in block)
        yield separator + ",\n".join(json.dumps(row, allow_nan=False) for row in rows)
        separator = ",\n"
    yield "\n]}\n"


def _blocks(motion: Motion) -> Iterator[Iterator[tuple[Cell, ...]]]:
    """Yield the rows block by block, in the order of `units`."""
    columns: list[NDArray[Any]] = [
        motion.frame,
        motion.time,
        *motion.T.T,
        *motion.T_errors.T,
        *motion.center.T,
        motion.phi,
        motion.phi_errors,
        motion.omega_1,
        motion.omega_2,
        motion.omega_3,
        motion.omega_3_errors,
        motion.alpha,
        motion.alpha_errors,
        *motion.R.reshape(-1, 9).T,
        *motion.R_errors.T,
        *quaternions(motion.R).T,
        motion.valid,
        motion.flags,
        motion.residual,
    ]
    for start in range(0, len(motion), ROWS_AT_ONCE):
        yield zip(*(column[start : start + ROWS_AT_ONCE].tolist() for column in columns), strict=True)


def _finite(cell: Cell) -> Cell | None:
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell
