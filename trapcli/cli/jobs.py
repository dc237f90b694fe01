"""One input of ``trap-motion estimate``: what is to be done, and what becomes of it, in any process."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trapcli.config import GUESSED_BACKGROUNDS, EstimateConfig, to_toml
from trapcli.errors import InputError, OutputError, TrapError
from trapcli.threads import share_memory

if TYPE_CHECKING:
    from trapcli.result.motion import Motion
    from trapcli.stack import Frames

DONE, FAILED, NOT_TRUSTWORTHY = 0, 1, 4
STANDARD_INPUT = "-"

_FOLDER = threading.Lock()  # the working folder belongs to a process, not to its threads


@dataclass(frozen=True)
class Job:
    """One input and what is to be made of it."""

    source: str
    output: Path
    config: EstimateConfig
    command_line: str
    overwrite: bool = False
    finished: bool = False
    """The result is there already, from an earlier run."""


@dataclass(frozen=True)
class Outcome:
    """What became of a job: an exit code, a message where it isn't 0, a summary where there is a result."""

    code: int
    message: str = ""
    summary: dict[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    traceback: str = ""


def run_job(job: Job, progress: Callable[[str, int, int], None] | None = None) -> Outcome:
    """Estimate and save one motion; whatever goes wrong becomes part of the outcome."""
    from trapcli.result.motion import Motion

    try:
        if job.finished:
            return _outcome(job, Motion.load(job.output))
        return _estimate(job, progress)
    except TrapError as error:
        return Outcome(error.exit_code, str(error), traceback=traceback.format_exc())
    except Exception as error:  # a fault of the program with one input must not stop the others
        reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        message = f"{job.source}: unexpected fault ({reason}); please report it with what -vv shows"
        return Outcome(FAILED, message, traceback=traceback.format_exc())


def run_job_in(folder: str, job: Job) -> Outcome:
    """Do a job in the working folder of who gave it, as a worker of a cluster may have to do twice.

    A worker that was killed after it wrote the result has not told so: what it wrote is kept.
    """
    with _FOLDER:
        try:
            with contextlib.chdir(folder):
                if _is_written(job):
                    return run_job(replace(job, finished=True))
                outcome = run_job(job)
                late = outcome.code == OutputError.exit_code and _is_written(job)
                return run_job(replace(job, finished=True)) if late else outcome
        except OSError as error:
            reason = f"the worker can't enter the folder {folder} ({error.strerror or error})"
            return Outcome(InputError.exit_code, f"{job.source}: {reason}; it needs the same file system")


def is_up_to_date(job: Job) -> bool:
    """Whether the result is complete, made with the same options, and newer than its input."""
    from trapcli.result.motion import Motion

    try:
        motion = Motion.load(job.output)
        source = Path(job.source)
        older = source.exists() and source.stat().st_mtime > job.output.stat().st_mtime
    except (InputError, OSError):
        return False
    return not older and motion.provenance.get("configuration") == to_toml(job.config)


def _is_written(job: Job) -> bool:
    return not job.overwrite and job.output.is_file() and is_up_to_date(job)


def _estimate(job: Job, progress: Callable[[str, int, int], None] | None) -> Outcome:
    from trapcli.stack import open_stack

    share_memory()
    frames = open_stack(job.source, job.config.input)
    with _checksums(job, frames) as checksums:
        from trapcli.pipeline import estimate  # takes a while: checksums are taken meanwhile

        motion = estimate(frames, config=job.config, progress=progress)
    origin = {"command_line": job.command_line, "inputs": checksums()}
    replace(motion, provenance=motion.provenance | origin).save(job.output, overwrite=job.overwrite)
    return _outcome(job, motion)


@contextlib.contextmanager
def _checksums(job: Job, frames: Frames) -> Iterator[Callable[[], str]]:
    """Take the checksums of the files that are read while the block runs; yield what returns their lines."""
    from trapcli.result import provenance
    from trapcli.stack import open_stack
    from trapcli.threads import processors

    preprocess = job.config.preprocess
    given = [] if preprocess.background in GUESSED_BACKGROUNDS else [preprocess.background]
    if preprocess.dark_level is None:
        given.append(preprocess.dark)
    files = frames.info.files
    for path in given * (not preprocess.attenuation):
        files = (*files, *open_stack(path).info.files)
    names = (STANDARD_INPUT if job.source == STANDARD_INPUT else "", *[""] * len(files))
    stopped = threading.Event()

    def lines() -> str:
        wanted = (lambda: not stopped.is_set(),) * len(files)
        return "\n".join(map(provenance.checksum_line, files, names, wanted))

    if processors() == 1:
        yield lines
        return
    with ThreadPoolExecutor(1, initializer=_give_way) as thread:
        told = thread.submit(lines)
        try:
            yield told.result
        except BaseException:
            stopped.set()
            raise


def _give_way() -> None:
    """Let this thread, where the system can, have only what the others leave of the processors."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)


def _outcome(job: Job, motion: Motion) -> Outcome:
    import numpy as np

    valid = motion.valid > 0
    # alpha isn't known where it is too small to be seen
    speed = np.hypot(np.nan_to_num(motion.alpha), motion.omega_3)

    def median(series: Any) -> float | None:
        known = series[valid & np.isfinite(series)]
        return float(np.median(known)) if len(known) else None

    summary = {
        "input": job.source,
        "output": str(job.output),
        "method": job.config.motion.method,
        "frames": len(motion),
        "valid": float(valid.mean()),
        "identifiable": bool(motion.identifiable),
        "verdict": motion.verdict,
        "time_unit": motion.time_unit,
        "length_unit": motion.length_unit,
        "duration": float(motion.time[-1] - motion.time[0]),
        "median_speed": median(speed),
        "median_alpha": median(motion.alpha),
        "median_omega_3": median(motion.omega_3),
        "median_residual": median(motion.residual),
    }
    warnings = tuple(motion.provenance.get("warnings", "").splitlines())
    if motion.identifiable and valid.any():
        return Outcome(DONE, summary=summary, warnings=warnings)
    message = f"{job.source}: not trustworthy: {motion.verdict.removeprefix('not trustworthy: ')}"
    return Outcome(NOT_TRUSTWORTHY, message, summary, warnings)
