"""The table of ``trap-motion estimate --summary``: one row an input, for a spreadsheet."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path

from trapcli.atomic import atomic_path, check_output
from trapcli.cli.jobs import DONE, NOT_TRUSTWORTHY, Job, Outcome
from trapcli.cli.options import refuse_input
from trapcli.errors import OutputError

STATUS = {DONE: "trustworthy", NOT_TRUSTWORTHY: "not trustworthy"}
COLUMNS = (
    "input",
    "output",
    "status",
    "exit_code",
    "verdict",
    "frames",
    "valid",
    "method",
    "time_unit",
    "length_unit",
    "duration",
    "median_speed",
    "median_alpha",
    "median_omega_3",
    "median_residual",
    "warnings",
)


def check_summary(path: Path, jobs: Sequence[Job], *, overwrite: bool, resume: bool) -> None:
    """Refuse a table that can't or mustn't be written; a resumed run may replace that of an earlier one.

    Raises
    ------
    OutputError
        Where it is an input or a result, exists already, or can't be written.
    """
    for job in jobs:
        refuse_input(path, Path(job.source))
        if os.path.realpath(path) == os.path.realpath(job.output):
            raise OutputError(f"{path}: is to be the result of {job.source}; choose another name")
    check_output(path, overwrite or (resume and _is_summary(path)))


def write_summary(path: Path, jobs: Sequence[Job], outcomes: Sequence[Outcome]) -> None:
    """Write the table; what isn't known is an empty cell, failed inputs have their message as verdict.

    Raises
    ------
    OutputError
        Where it can't be written.
    """
    with (
        atomic_path(path, overwrite=True) as temporary,
        temporary.open("w", encoding="utf-8", errors="surrogateescape", newline="") as file,
    ):
        table = csv.DictWriter(file, COLUMNS, extrasaction="ignore", lineterminator="\n")
        table.writeheader()
        for job, outcome in zip(jobs, outcomes, strict=True):
            known = {"input": job.source, "verdict": outcome.message, **outcome.summary}
            status = STATUS.get(outcome.code, "failed")
            warnings = "; ".join(outcome.warnings)
            table.writerow({**known, "status": status, "exit_code": outcome.code, "warnings": warnings})


def _is_summary(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.readline(1000).decode("utf-8", "replace").rstrip().split(",") == list(COLUMNS)
    except OSError:
        return False
