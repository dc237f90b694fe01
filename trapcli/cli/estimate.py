"""``trap-motion estimate``: the motion of the particle in one or many stacks."""

from __future__ import annotations

import os
import re
import traceback
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from trapcli.cli.options import (
    PATH,
    Console,
    Progress,
    command_line,
    config_option,
    console_options,
    json_option,
    overwrite_option,
    print_json,
    print_path,
    refuse_input,
    resolve_config,
)
from trapcli.config import EstimateConfig, to_toml
from trapcli.errors import ConfigError, InputError, OutputError, TrapError

if TYPE_CHECKING:
    from trapcli.result.motion import Motion
    from trapcli.stack import Frames

DONE, SOME_FAILED, NOT_TRUSTWORTHY = 0, 1, 4
STANDARD_INPUT = "-"
BACKGROUNDS = ("auto", "median", "surface", "border", "none")


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


def _roi(_context: click.Context, _option: click.Parameter, value: str | None) -> tuple[int, ...] | None:
    """Read ``TOP,BOTTOM,LEFT,RIGHT``."""
    if value is None:
        return None
    if not re.fullmatch(r"\d{1,9}(,\d{1,9}){3}", value, re.ASCII):
        raise click.BadParameter(f"{value!r} is no region; give TOP,BOTTOM,LEFT,RIGHT in pixels")
    return tuple(int(part) for part in value.split(","))


@click.command()
@click.argument("inputs", metavar="INPUT...", nargs=-1, required=True)
@click.option("-o", "--output", type=PATH, help="Result of a single input.  [default: INPUT with .h5]")
@click.option(
    "--background",
    metavar="FILE|auto|median|surface|border|none",
    help="The empty field: an image or stack of it, the median in time, a surface fitted to what the "
    "particle leaves free, a surface through each frame's border, or none.  [default: auto]",
)
@click.option("--dark", metavar="LEVEL|FILE", help="Pixel value without light, or dark frames.  [default: 0]")
@click.option(
    "--attenuation",
    is_flag=True,
    default=None,
    help="The frames are attenuation or phase projections already: no background, no logarithm.",
)
@click.option("--frame-interval", type=float, metavar="S", help="Seconds between frames.")
@click.option("--fps", type=float, metavar="F", help="Frames per second.")
@click.option("--pixel-size", type=float, metavar="P", help="Edge of a pixel.")
@click.option("--pixel-unit", metavar="U", help="Unit of the pixel size, for example µm.")
@click.option("--frames", metavar="START:STOP[:STEP]", help="Use these frames only, counted from 0.")
@click.option("--roi", callback=_roi, metavar="TOP,BOTTOM,LEFT,RIGHT", help="Use this region only.")
@click.option("--channel", type=int, metavar="N", help="Channel of a colour input, counted from 0.")
@click.option("--time-axis", metavar="AXES", help="Axis that is time where there are several: T, Z or TZ.")
@click.option("--dataset", metavar="PATH", help="Dataset of an HDF5 or Zarr input.")
@click.option(
    "--allow-partial", is_flag=True, default=None, help="Use the readable frames of a truncated file."
)
@click.option(
    "--method",
    type=click.Choice(["auto", "paper"]),
    help="auto: one noise-weighted fit to all frames; paper: infinitesimal common lines.  [default: auto]",
)
@config_option
@click.option("--jobs", type=click.IntRange(1, 1024), default=1, metavar="N", help="Inputs at a time.")
@click.option("--resume", is_flag=True, help="Keep results that are there and up to date.")
@overwrite_option
@json_option
@console_options
def command(
    inputs: tuple[str, ...],
    output: Path | None,
    config: Path | None,
    jobs: int,
    resume: bool,
    overwrite: bool,
    as_json: bool,
    console: Console,
    **options: Any,
) -> int:
    """Recover how the particle in INPUT moved.

    INPUT is a TIFF, a video (AVI, MP4, MOV, MKV), a folder or a quoted pattern of TIFFs, file.h5::/dataset,
    or - for a TIFF on standard input. Each input gives one result, INPUT with the ending .h5 beside it; a
    folder FOLDER gives FOLDER.h5, 'a/img_*.tif' a/img.h5, 'a/*.tif' a.h5, file.h5::/x file-x.h5.

    The paths of the results go to stdout. Exit code 4: a result is written, but the frames do not tell the
    motion; 1: some of several inputs failed.
    """
    resolved = resolve_config(EstimateConfig, config, _tables(options))
    if output and len(inputs) > 1:
        raise ConfigError("-o: is for a single input; results of several lie beside them")
    planned = [
        Job(source, output or _output_for(source), resolved, command_line(), overwrite) for source in inputs
    ]
    planned = _checked(planned, resume)
    codes = []
    with closing(_outcomes(planned, jobs, console)) as outcomes:
        for job, outcome in zip(planned, outcomes, strict=True):
            _report(job, outcome, as_json, console)
            codes.append(outcome.code)
            if outcome.code == ConfigError.exit_code:  # no input can make sense of such options
                return outcome.code
    if len(codes) == 1:
        return codes[0]
    failed = sum(code not in (DONE, NOT_TRUSTWORTHY) for code in codes)
    if failed:
        console.error(f"{failed} of {len(codes)} inputs failed")
        return SOME_FAILED
    return max(codes)


def _tables(options: dict[str, Any]) -> dict[str, Any]:
    """Sort the options into the tables of the configuration."""
    rate = options["fps"]
    if rate is not None:
        if options["frame_interval"] is not None:
            raise ConfigError("--fps and --frame-interval exclude each other")
        if not 0 < rate < float("inf"):
            raise ConfigError(f"--fps {rate}: must be a positive number")
        options["frame_interval"] = 1 / rate
    names = ("frames", "roi", "channel", "time_axis", "dataset", "frame_interval", "pixel_size", "pixel_unit")
    return {
        "input": {name: options[name] for name in (*names, "allow_partial")},
        "preprocess": {name: options[name] for name in ("attenuation", "background", "dark")},
        "motion": {"method": options["method"]},
    }


def _output_for(source: str) -> Path:
    """Name the result of an input; see the help."""
    if source == STANDARD_INPUT:
        raise ConfigError("-: standard input has no name; give the result one with -o")
    path = Path(source)
    if os.path.exists(path):
        name = source.rstrip("/") + ".h5" if path.is_dir() else str(path.with_suffix(".h5"))
    elif "::" in source:
        file, _, dataset = source.rpartition("::")
        name = "-".join([str(Path(file).with_suffix("")), *dataset.strip("/").split("/")]) + ".h5"
    elif re.search(r"[*?[]", source):
        name = re.split(r"[*?[]", source)[0].rstrip("_-. /") + ".h5"
    else:
        name = str(path.with_suffix(".h5")) if path.name else source
    if Path(name).name in ("", ".h5", "..h5", "...h5"):
        raise ConfigError(f"{source}: is no name for a result; give one with -o")
    return Path(name)


def _checked(jobs: Sequence[Job], resume: bool) -> list[Job]:
    """Refuse outputs that can't or mustn't be written before any work is done; find what is done already."""
    from trapcli.atomic import check_output

    targets: dict[Path, Job] = {}
    checked = []
    for job in jobs:
        if not job.output.parent.is_dir() and job.output == _output_for(job.source):
            checked.append(job)  # there is no input either
            continue
        preprocess = job.config.preprocess
        refuse_input(job.output, Path(job.source), Path(preprocess.background), Path(preprocess.dark))
        if resume and job.output.is_file():
            job = replace(job, finished=_is_up_to_date(job))
            if not job.finished and not job.overwrite:
                reason = "isn't what these options make of this input; pass --overwrite to replace it"
                raise OutputError(f"{job.output}: {reason}")
        target = check_output(job.output, job.overwrite or job.finished)
        if target in targets:
            raise ConfigError(
                f"{targets[target].source} and {job.source}: would both become {job.output}; "
                "estimate them one at a time with -o"
            )
        targets[target] = job
        checked.append(job)
    return checked


def _is_up_to_date(job: Job) -> bool:
    """Whether the result is complete, made with the same options, and newer than its input."""
    from trapcli.result.motion import Motion

    try:
        motion = Motion.load(job.output)
        source = Path(job.source)
        older = source.exists() and source.stat().st_mtime > job.output.stat().st_mtime
    except (InputError, OSError):
        return False
    return not older and motion.provenance.get("configuration") == to_toml(job.config)


def _outcomes(jobs: Sequence[Job], count: int, console: Console) -> Generator[Outcome]:
    """Do the jobs and yield what becomes of each, in order."""
    if count == 1 or len(jobs) == 1:
        for job in jobs:
            with console.progress() as progress:
                outcome = run_job(job, progress)
            yield outcome
        return
    from trapcli.cli.workers import in_processes

    with closing(in_processes(run_job, jobs, min(count, len(jobs)))) as outcomes:
        for job, done in zip(jobs, outcomes, strict=True):
            yield done or Outcome(SOME_FAILED, f"{job.source}: the process that worked on it died")


def run_job(job: Job, progress: Progress | None = None) -> Outcome:
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
        return Outcome(SOME_FAILED, message, traceback=traceback.format_exc())


def _estimate(job: Job, progress: Progress | None) -> Outcome:
    from trapcli.pipeline import estimate
    from trapcli.stack import open_stack

    frames = open_stack(job.source, job.config.input)
    motion = estimate(frames, config=job.config, progress=progress)
    motion = replace(motion, provenance=motion.provenance | _origin(job, frames))
    motion.save(job.output, overwrite=job.overwrite)
    return _outcome(job, motion)


def _origin(job: Job, frames: Frames) -> dict[str, str]:
    """Return the command line and the checksums of the files that were read."""
    from trapcli.result import provenance
    from trapcli.stack import open_stack

    preprocess = job.config.preprocess
    given = [] if preprocess.background in BACKGROUNDS else [preprocess.background]
    if preprocess.dark_level is None:
        given.append(preprocess.dark)
    files = frames.info.files
    for path in given * (not preprocess.attenuation):
        files = (*files, *open_stack(path).info.files)
    names = (STANDARD_INPUT if job.source == STANDARD_INPUT else "", *[""] * len(files))
    lines = [provenance.checksum_line(file, name) for file, name in zip(files, names, strict=False)]
    return {"command_line": job.command_line, "inputs": "\n".join(lines)}


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


def _report(job: Job, outcome: Outcome, as_json: bool, console: Console) -> None:
    for warning in outcome.warnings:
        console.warn(f"{job.source}: {warning}")
    if outcome.summary:
        if as_json:
            print_json(outcome.summary)
        else:
            print_path(job.output)
    if outcome.message:
        console.error(outcome.message)
    if outcome.traceback and console.verbosity > 1:
        click.echo(outcome.traceback, err=True)
    if outcome.code == DONE:
        again = "kept " if job.finished else ""
        console.detail(f"{job.source}: {again}{outcome.summary['verdict']}")
