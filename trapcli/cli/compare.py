"""``trap-motion compare``: errors of a result against the truth."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from trapcli.cli.options import PATH, Console, console_options, json_option, print_json, print_text

if TYPE_CHECKING:
    from trapcli.result.comparison import Comparison

LABELS = {
    "T": "T",
    "T_offset_removed": "T, mean offset removed",
    "phi": "phi",
    "omega_3": "omega_3",
    "alpha": "alpha",
    "alpha_relative": "alpha, relative",
    "R": "R, equal at first frame",
    "R_aligned": "R, best aligned",
}


@click.command()
@click.argument("result", type=PATH)
@click.argument("truth", type=PATH)
@click.option("--trim", default=0, metavar="N", help="Leave out the first and the last N frames.")
@json_option
@console_options
def command(result: Path, truth: Path, trim: int, as_json: bool, console: Console) -> None:
    """Print the errors of T, phi, omega_3, alpha and R in RESULT against TRUTH.

    Differences that no method can know are removed first: the mirror solution, the offset of T and the
    orientation of the object at the first frame. Frames that are not valid are left out. Where RESULT states
    1-sigma errors, the last two columns say how many errors lie within one and two of them (68 % and 95 %
    where they are true).
    """
    from trapcli.errors import InputError
    from trapcli.result.comparison import compare
    from trapcli.result.motion import Motion

    estimated, true = Motion.load(result), Motion.load(truth)
    try:
        comparison = compare(estimated, true, trim=trim)
    except InputError as error:
        raise InputError(f"{result} and {truth}: {error}") from None
    for note in comparison.notes:
        console.warn(note)
    if as_json:
        print_json(dataclasses.asdict(comparison))
    else:
        print_text(_table(comparison))


def _table(comparison: Comparison) -> str:
    rows: list[tuple[str, ...]] = [
        ("error", "unit", "frames", "mean", "median", "max", "in 1 sigma", "in 2 sigma")
    ]
    for name, errors in comparison.errors.items():
        sizes = (_number(value) for value in (errors.mean, errors.median, errors.max))
        shares = (_percent(value) for value in (errors.within_1_sigma, errors.within_2_sigma))
        rows.append((LABELS[name], errors.unit, str(errors.count), *sizes, *shares))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [
        "  ".join(
            cell.ljust(width) if i < 2 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
    frames = f"{comparison.compared} of {comparison.common} common frames are valid in both"
    return "\n".join([frames + (", mirror solution" if comparison.mirrored else ""), "", *lines])


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.0f} %"
