"""``trap-motion estimate`` on many inputs: the table of all, runs that go on later, processes, a cluster."""

from __future__ import annotations

import csv
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from trapcli.cli.jobs import Job, run_job_in
from trapcli.cli.main import run
from trapcli.config import EstimateConfig, MotionConfig, PreprocessConfig
from trapcli.result.motion import Motion

PROGRAM = [sys.executable, "-c", "from trapcli.cli.main import run; run()"]
PAPER = ("--attenuation", "--method", "paper")
Call = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clean stack of 16 frames of 32 × 32 pixels."""
    folder = tmp_path_factory.mktemp("tiny")
    arguments = ["simulate", "-n", "16", "--size", "32", "--spacing", "0.7", "-o", folder / "tiny.tif"]
    subprocess.run([*PROGRAM, *arguments], check=True, capture_output=True)
    return folder / "tiny.tif"


@pytest.fixture
def stacks(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], list[str]]:
    """``stacks(n)``: n good stacks in the working folder, which is empty else."""

    def make(count: int) -> list[str]:
        names = [f"s{n:03}.tif" for n in range(count)]
        for name in names:
            shutil.copy(tiny, name)
        return names

    monkeypatch.chdir(tmp_path)
    return make


@pytest.fixture
def estimate(capfd: pytest.CaptureFixture[str]) -> Call:
    """Run the command in this process: ``code, stdout, stderr``."""

    def call(*arguments: Any) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as done:
            run(["estimate", *PAPER, *map(str, arguments)])
        captured = capfd.readouterr()
        assert isinstance(done.value.code, int)
        return done.value.code, captured.out, captured.err

    return call


def spoil(names: list[str]) -> None:
    """Make them a text, a cut stack and nothing at all."""
    text, cut, missing = map(Path, names)
    text.write_text("no image")
    cut.write_bytes(cut.read_bytes()[:4000])
    missing.unlink()


def rows(path: str = "all.csv") -> list[dict[str, str]]:
    with open(path, encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def times() -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in Path().glob("s*.h5")}


# the table


def test_the_table_has_a_row_for_every_input(stacks: Any, tiny: Path, estimate: Call) -> None:
    names = stacks(3)
    still = np.repeat(tifffile.imread(tiny)[:1], 16, axis=0)
    tifffile.imwrite("s000.tif", still, photometric="minisblack")
    Path("s002.tif").write_text("no image")
    code, out, err = estimate(*names, "--summary", "all.csv")
    assert (code, out) == (1, "s000.h5\ns001.h5\n")
    assert err.splitlines()[-1] == "trap-motion: 1 of 3 inputs failed"
    bad, good, failed = rows()
    assert [row["input"] for row in (bad, good, failed)] == names
    assert (good["status"], good["exit_code"], good["output"]) == ("trustworthy", "0", "s001.h5")
    assert good["verdict"] == Motion.load("s001.h5").verdict
    assert (good["frames"], good["valid"], good["time_unit"]) == ("16", "1.0", "s")
    exact = np.hypot(1, 0.5 + np.sqrt(0.5 + 5 * 0.02))
    assert float(good["median_speed"]) == pytest.approx(exact, rel=0.05)
    assert (bad["status"], bad["exit_code"]) == ("not trustworthy", "4")
    assert (failed["status"], failed["exit_code"], failed["output"]) == ("failed", "3", "")
    assert failed["verdict"].startswith("s002.tif: ")
    assert (failed["frames"], failed["median_speed"]) == ("", "")


def test_an_existing_table_is_refused_before_any_work(stacks: Any, estimate: Call) -> None:
    names = stacks(2)
    Path("all.csv").write_text("precious")
    for more in ((), ("--resume",)):
        code, out, err = estimate(*names, "--summary", "all.csv", *more)
        assert (code, out, err.count("\n")) == (5, "", 1)
    for path in ("s000.tif", "s001.h5"):
        assert estimate(*names, "--summary", path, "--overwrite")[0] == 5
    assert Path("all.csv").read_text() == "precious"
    assert times() == {}


@pytest.mark.parametrize("jobs", [1, 2])
def test_resume_does_only_what_is_missing(stacks: Any, tiny: Path, estimate: Call, jobs: int) -> None:
    names = stacks(4)
    Path("s001.tif").write_text("no image")
    assert estimate(*names, "--summary", "all.csv", "--jobs", jobs)[0] == 1
    before = times()
    shutil.copy(tiny, "s001.tif")
    code, out, err = estimate(*names, "--summary", "all.csv", "--jobs", jobs, "--resume", "-v")
    assert (code, len(out.splitlines())) == (0, 4)
    assert err.count("kept") == 3
    after = times()
    assert {name for name in after if after[name] != before.get(name)} == {"s001.h5"}
    assert [row["status"] for row in rows()] == ["trustworthy"] * 4


def test_one_bar_for_all(stacks: Any, estimate: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    names = stacks(3)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    for jobs in (1, 2):
        code, out, err = estimate(*names, "--jobs", jobs, "--overwrite")
        assert (code, out) == (0, "s000.h5\ns001.h5\ns002.h5\n")
        assert "stacks:" in err
        assert "3/3" in err
    assert estimate(*names, "--overwrite", "-q")[2] == ""


# a cluster


class Cluster:
    """A Dask scheduler and workers on this machine, as its own programs start them."""

    def __init__(self, folder: Path, workers: int) -> None:
        self.file = folder / "scheduler.json"
        self._folder = folder
        self._scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-jupyter")
        until = time.monotonic() + 60
        while not self.file.exists():
            assert time.monotonic() < until, (folder / "log").read_text()
            time.sleep(0.05)
        self.address = json.loads(self.file.read_text())["address"]
        self.workers = [self._worker() for _ in range(workers)]

    def _start(self, *arguments: str) -> subprocess.Popen[bytes]:
        # the configuration of who runs this has no say
        environment = {**os.environ, "DASK_CONFIG": str(self._folder / "none"), "OMP_NUM_THREADS": "1"}
        dask = Path(sys.executable).with_name("dask")
        command = [dask, *arguments, "--no-dashboard", "--scheduler-file", self.file]
        with (self._folder / "log").open("ab") as log:
            return subprocess.Popen(
                command, cwd=self._folder, env=environment, stdout=log, stderr=log, start_new_session=True
            )

    def _worker(self) -> subprocess.Popen[bytes]:
        return self._start("worker", "--nthreads", "1", "--no-nanny", "--death-timeout", "120")

    def kill_one(self) -> None:
        """Kill a worker without a word, and start another."""
        victim = self.workers.pop(random.randrange(len(self.workers)))
        victim.kill()
        victim.wait()
        self.workers.append(self._worker())

    def close(self) -> None:
        for process in [*self.workers, self._scheduler]:
            process.kill()
            process.wait()


@contextmanager
def started(command: list[str]) -> Iterator[subprocess.Popen[str]]:
    """Give a running program, which is killed where the test fails."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        try:
            yield running
        finally:
            running.kill()


@contextmanager
def cluster_of(workers: int, folder: Path) -> Iterator[Cluster]:
    pytest.importorskip("distributed", reason="Dask isn't installed")
    cluster = Cluster(folder, workers)
    try:
        yield cluster
    finally:
        cluster.close()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    with cluster_of(1, tmp_path_factory.mktemp("cluster")) as cluster:
        yield cluster


@pytest.mark.slow
def test_workers_do_what_processes_do(cluster: Cluster, stacks: Any, estimate: Call) -> None:
    names = stacks(3)
    Path("s001.tif").write_text("no image")
    options = ("--scheduler", cluster.address, "-q", "--summary", "all.csv")  # workers may come later
    code, out, err = estimate(*names, *options)
    assert (code, out) == (1, "s000.h5\ns002.h5\n")
    assert [line.split(":")[1].strip() for line in err.splitlines()] == ["s001.tif", "1 of 3 inputs failed"]
    assert [row["exit_code"] for row in rows()] == ["0", "3", "0"]
    before = times()
    local = Motion.load("s000.h5").provenance
    assert local["inputs"].endswith("  s000.tif")
    assert estimate("s000.tif", "s002.tif", "--resume")[0] == 0
    assert times() == before
    assert estimate("s000.tif", "--overwrite", *options[:2])[0] == 0
    assert times() != before


@pytest.mark.parametrize("address", ["nonsense", "http://localhost:80", "localhost", "tcp://127.0.0.1:1"])
def test_no_scheduler(stacks: Any, estimate: Call, monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    pytest.importorskip("distributed", reason="Dask isn't installed")
    monkeypatch.setattr("trapcli.cli.workers._PATIENCE", 0.5)
    names = stacks(1)
    code, out, err = estimate(*names, "--scheduler", address)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert address in err


def test_what_does_not_go_with_a_scheduler(
    stacks: Any, estimate: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = stacks(1)
    for arguments in ((*names, "--jobs", 2), (*names, "--threads", 2), ("-", "-o", "a.h5")):
        code, _, err = estimate(*arguments, "--scheduler", "tcp://127.0.0.1:1")
        assert (code, err.count("\n")) == (2, 1)
    monkeypatch.setitem(sys.modules, "dask", None)
    code, _, err = estimate(*names, "--scheduler", "tcp://127.0.0.1:1")
    assert (code, err.count("\n")) == (2, 1)
    assert "trapcli[cluster]" in err


def test_a_job_that_is_done_twice_keeps_its_result(stacks: Any, tmp_path: Path) -> None:
    (name,) = stacks(1)
    config = EstimateConfig(preprocess=PreprocessConfig(attenuation=True), motion=MotionConfig("paper"))
    job = Job(name, Path("s000.h5"), config, "")
    elsewhere = os.getcwd()
    assert run_job_in(str(tmp_path), job).code == 0
    before = times()
    assert run_job_in(str(tmp_path), job).code == 0
    assert times() == before
    assert os.getcwd() == elsewhere
    Path("s000.h5").write_text("precious")
    assert run_job_in(str(tmp_path), job).code == 5
    outcome = run_job_in(str(tmp_path / "nowhere"), job)
    assert outcome.code == 3
    assert "same file system" in outcome.message


# hundreds


def check_hundreds(names: list[str], bad: list[str], done: subprocess.CompletedProcess[str]) -> None:
    """197 results, 3 inputs named, exit code 1; --resume then does these three only."""
    good = [name for name in names if name not in bad]
    assert done.returncode == 1, done.stderr
    assert done.stdout.split() == [name.replace(".tif", ".h5") for name in good]
    lines = done.stderr.splitlines()
    assert [line.split(":")[1].strip() for line in lines] == [*bad, "3 of 200 inputs failed"]
    assert [row["input"] for row in rows() if row["status"] == "failed"] == bad
    assert sum(row["status"] == "trustworthy" for row in rows()) == 197
    before = times()
    assert len(before) == 197
    for name in bad:
        shutil.copy(good[0], name)
    again = [*PROGRAM, "estimate", *names, *PAPER, "--resume", "--summary", "all.csv", "--jobs", "2"]
    done = subprocess.run(again, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert {name: made for name, made in times().items() if name in before} == before
    assert len(times()) == 200
    assert {path.suffix for path in Path().iterdir()} == {".tif", ".h5", ".csv"}
    assert not list(Path().glob(".trap-motion-*"))


@pytest.mark.slow
def test_hundreds_of_stacks(stacks: Any) -> None:
    names = stacks(200)
    bad = ["s007.tif", "s100.tif", "s199.tif"]
    spoil(bad)
    command = [*PROGRAM, "estimate", *names, *PAPER, "--jobs", "2", "--summary", "all.csv"]
    check_hundreds(names, bad, subprocess.run(command, capture_output=True, text=True, check=False))


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_hundreds_of_stacks_on_workers_that_are_killed(
    stacks: Any, tmp_path_factory: pytest.TempPathFactory
) -> None:
    names = stacks(200)
    bad = ["s007.tif", "s100.tif", "s199.tif"]
    spoil(bad)
    random.seed(8)
    with cluster_of(2, tmp_path_factory.mktemp("killed")) as cluster:
        where = ("--scheduler", cluster.address, "-q", "--summary", "all.csv")
        command = [*PROGRAM, "estimate", *names, *PAPER, *where]
        with started(command) as running:
            for results in range(15, 180, 20):
                while len(times()) < results and running.poll() is None:
                    time.sleep(0.02)
                assert running.poll() is None
                cluster.kill_one()
            out, err = running.communicate(timeout=600)
    check_hundreds(names, bad, subprocess.CompletedProcess(command, running.returncode, out, err))


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_cluster_can_be_interrupted(cluster: Cluster, stacks: Any) -> None:
    names = stacks(60)
    command = [*PROGRAM, "estimate", *names, *PAPER, "--scheduler", cluster.address]
    with started(command) as running:
        while not times() and running.poll() is None:
            time.sleep(0.02)
        running.send_signal(signal.SIGINT)
        _, err = running.communicate(timeout=30)
    assert (running.returncode, err.strip()) == (130, "trap-motion: interrupted")
    time.sleep(1)
    assert len(times()) < 60
