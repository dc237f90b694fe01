"""``trap-motion estimate``: the motion of the particle in one or many stacks."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import CancelledError, Executor, Future, as_completed
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click

from trapcli.cli.jobs import (
    DONE,
    FAILED,
    NOT_TRUSTWORTHY,
    STANDARD_INPUT,
    Job,
    Outcome,
    is_up_to_date,
    run_job,
    run_job_in,
)
from trapcli.cli.options import (
    PATH,
    Console,
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
from trapcli.cli.progress import Overall
from trapcli.cli.summary import check_summary, write_summary
from trapcli.config import EstimateConfig
from trapcli.errors import ConfigError, OutputError


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
@click.option("--jobs", type=click.IntRange(1, 1024), metavar="N", help="Inputs at a time.  [default: 1]")
@click.option(
    "--threads",
    type=click.IntRange(1, 1024),
    metavar="N",
    help="Threads that work on one input.  [default: as many as there are cores for it]",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Let the workers of this Dask scheduler do it; they share the files.",
)
@click.option("--resume", is_flag=True, help="Keep results that are there and up to date.")
@click.option("--summary", type=PATH, metavar="FILE", help="Table (CSV) of what became of each input.")
@overwrite_option
@json_option
@console_options
def command(
    inputs: tuple[str, ...],
    output: Path | None,
    config: Path | None,
    jobs: int | None,
    threads: int | None,
    scheduler: str | None,
    resume: bool,
    summary: Path | None,
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
    if scheduler is not None and (jobs is not None or threads is not None or STANDARD_INPUT in inputs):
        raise ConfigError("--scheduler: goes with neither --jobs nor --threads nor standard input")
    if threads is not None:  # read when the numerical libraries are loaded, here and in processes of --jobs
        os.environ["OMP_NUM_THREADS"] = str(threads)
    resolved = resolve_config(EstimateConfig, config, _tables(options))
    if output and len(inputs) > 1:
        raise ConfigError("-o: is for a single input; results of several lie beside them")
    planned = [
        Job(source, output or _output_for(source), resolved, command_line(), overwrite) for source in inputs
    ]
    planned = _checked(planned, resume)
    if summary:
        check_summary(summary, planned, overwrite=overwrite, resume=resume)
    outcomes: list[Outcome] = []
    overall = Overall(len(planned), console)
    with closing(overall), closing(_outcomes(planned, jobs or 1, scheduler, console, overall)) as done:
        for job, outcome in zip(planned, done, strict=True):
            with overall.aside():
                _report(job, outcome, as_json, console)
            outcomes.append(outcome)
            if outcome.code == ConfigError.exit_code:  # no input can make sense of such options
                return outcome.code
    if summary:
        write_summary(summary, planned, outcomes)
    return _code(outcomes, console)


def _code(outcomes: Sequence[Outcome], console: Console) -> int:
    codes = [outcome.code for outcome in outcomes]
    if len(codes) == 1:
        return codes[0]
    failed = sum(code not in (DONE, NOT_TRUSTWORTHY) for code in codes)
    if failed:
        console.error(f"{failed} of {len(codes)} inputs failed")
        return FAILED
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
            job = replace(job, finished=is_up_to_date(job))
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


def _outcomes(
    jobs: Sequence[Job], count: int, scheduler: str | None, console: Console, overall: Overall
) -> Generator[Outcome]:
    """Do the jobs and yield what becomes of each, in order."""
    if scheduler is not None:
        from trapcli.cli.workers import cluster

        with cluster(scheduler, console) as executor:
            yield from _executed(jobs, executor, partial(run_job_in, os.getcwd()), overall)
    elif count > 1 and len(jobs) > 1:
        from trapcli.cli.workers import ProcessExecutor

        with ProcessExecutor(min(count, len(jobs))) as executor:
            yield from _executed(jobs, executor, run_job, overall)
    elif len(jobs) > 1:
        for job in jobs:
            outcome = run_job(job, overall.stage)
            overall.advance()
            yield outcome
    else:
        with console.progress() as progress:
            outcome = run_job(jobs[0], progress)
        yield outcome


def _executed(
    jobs: Sequence[Job], executor: Executor, work: Callable[[Job], Outcome], overall: Overall
) -> Generator[Outcome]:
    """Let an executor do what isn't finished; what it fails at is one job."""
    futures = {n: executor.submit(work, job) for n, job in enumerate(jobs) if not job.finished}
    try:
        completed = as_completed(futures.values())
        for n, job in enumerate(jobs):
            if job.finished:
                overall.advance()
                yield run_job(job)
                continue
            while not futures[n].done():
                next(completed)
                overall.advance()
            yield _result(job, futures[n])
    finally:  # not one by one: Dask's executor may be setting the result of one that is cancelled here
        executor.shutdown(wait=False)


def _result(job: Job, future: Future[Outcome]) -> Outcome:
    try:
        return future.result()
    except CancelledError:
        reason = "was given up by the scheduler"
    except Exception as error:  # of the executor: run_job raises none
        reason = " ".join(str(error).split())[:300] or type(error).__name__
    return Outcome(FAILED, f"{job.source}: {reason}; --resume tries it again")


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
