"""``trap-motion estimate`` on files: results, names, settings, several inputs, bad input, interruption."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from trapcli.cli.main import run
from trapcli.cli.options import resolve_config
from trapcli.config import EstimateConfig
from trapcli.result.motion import Motion

PROGRAM = [sys.executable, "-c", "from trapcli.cli.main import run; run()"]
PAPER = ("--attenuation", "--method", "paper")
Call = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small clean stack, ``sim.tif``, and its truth."""
    folder = tmp_path_factory.mktemp("scene")
    arguments = ["simulate", "-n", "40", "--size", "64", "--spacing", "0.4", "-o", folder / "sim.tif"]
    subprocess.run([*PROGRAM, *arguments], check=True, capture_output=True)
    return folder


@pytest.fixture
def stack(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """``sim.tif`` in the working folder, alone."""
    shutil.copy(scene / "sim.tif", tmp_path / "sim.tif")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "sim.tif"


@pytest.fixture
def estimate(capfd: pytest.CaptureFixture[str]) -> Call:
    """Run the command in this process: ``code, stdout, stderr``."""

    def call(*arguments: Any) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as done:
            run(["estimate", *map(str, arguments)])
        captured = capfd.readouterr()
        assert isinstance(done.value.code, int)
        return done.value.code, captured.out, captured.err

    return call


def shell(*arguments: Any, **options: Any) -> subprocess.CompletedProcess[Any]:
    """Run the program in a process of its own."""
    command = [*PROGRAM, *map(str, arguments)]
    return subprocess.run(command, **{"capture_output": True, "text": True, "check": False, **options})


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


# results


def test_the_whole_workflow_in_a_shell(scene: Path, stack: Path) -> None:
    done = shell("estimate", "sim.tif", *PAPER)
    assert (done.returncode, done.stdout, done.stderr) == (0, "sim.h5\n", "")
    truth = scene / "truth.h5"
    compared = shell("compare", "sim.h5", truth, "--trim", 4, "--json")
    errors = json.loads(compared.stdout)["errors"]
    assert errors["T"]["unit"] == "µm"
    assert errors["T"]["max"] < 1e-4
    assert errors["R"]["max"] < 0.1  # degrees
    drawn = shell("plot", "sim.h5", "--truth", truth, "--stack", "sim.tif")
    assert (drawn.returncode, drawn.stdout) == (0, "sim.png\n")
    rows = shell("export", "sim.h5").stdout.splitlines()
    assert len(rows) == 41
    assert rows[1].split(",")[-2:] == ["s", "µm"]


def test_json(stack: Path, estimate: Call) -> None:
    code, out, err = estimate("sim.tif", *PAPER, "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    truth_speed = np.hypot(1 + 10 * 0.05**2, 0.5 + np.sqrt(0.5 + 5 * 0.05))
    assert found.pop("median_speed") == pytest.approx(truth_speed, rel=0.01)
    assert found["frames"] == 40
    assert {key: found[key] for key in ("input", "output", "method", "valid", "identifiable")} == {
        "input": "sim.tif",
        "output": "sim.h5",
        "method": "paper",
        "valid": 1.0,
        "identifiable": True,
    }
    assert (found["time_unit"], found["length_unit"]) == ("s", "µm")
    assert found["verdict"] == Motion.load("sim.h5").verdict


def test_what_is_needed_to_repeat_the_run_is_stored(
    stack: Path, estimate: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["trap-motion", "estimate", "sim.tif", "--frames", "2:38"])
    assert estimate("sim.tif", *PAPER, "--frames", "2:38", "-o", "a.h5")[0] == 0
    stored = Motion.load("a.h5").provenance
    assert stored["command_line"] == "trap-motion estimate sim.tif --frames 2:38"
    assert stored["inputs"] == f"{hashlib.sha256(stack.read_bytes()).hexdigest()}  sim.tif"
    assert tomllib.loads(stored["configuration"])["input"]["frames"] == "2:38"
    assert estimate("sim.tif", "--config", "a.h5", "-o", "b.h5")[0] == 0
    again = Motion.load("b.h5")
    assert again.provenance["configuration"] == stored["configuration"]
    np.testing.assert_array_equal(again.alpha, Motion.load("a.h5").alpha)


def test_option_beats_file_beats_default(stack: Path, estimate: Call) -> None:
    Path("own.toml").write_text(
        '[input]\nframe_interval = 2.0\nframes = "0:30"\n[motion]\nmethod = "paper"\n'
        "[preprocess]\nattenuation = true\n"
    )
    assert estimate("sim.tif", "--config", "own.toml", "--fps", 4)[0] == 0
    motion = Motion.load("sim.h5")
    np.testing.assert_allclose(motion.time, np.arange(30) / 4)
    motion_table = tomllib.loads(motion.provenance["configuration"])["motion"]
    assert motion_table == {"method": "paper", "window": 0, "band": 0.0, "knots": 0}


def test_the_presets_are_valid() -> None:
    folder = Path(__file__).parents[2] / "configs"
    assert resolve_config(EstimateConfig, folder / "default.toml", {}) == EstimateConfig()
    presets = list(folder.glob("estimate-*.toml"))
    assert len(presets) >= 2
    for preset in presets:
        assert resolve_config(EstimateConfig, preset, {}) != EstimateConfig()


def test_region_and_pixel_size(scene: Path, stack: Path, estimate: Call) -> None:
    size = ("--pixel-size", 0.8, "--pixel-unit", "nm")
    assert estimate("sim.tif", *PAPER, "--roi", "2,62,6,64", *size)[0] == 0
    motion, truth = Motion.load("sim.h5"), Motion.load(scene / "truth.h5")
    assert motion.length_unit == "nm"
    np.testing.assert_allclose(motion.T, truth.T * 2, atol=1e-3)
    # the middle of the region is 0.8 · (row, column) (32, 35) − (32, 32)
    np.testing.assert_allclose(motion.center, truth.center * 2 - [0.8 * 3, 0], atol=1e-3)


def test_a_measured_background(scene: Path, stack: Path, estimate: Call) -> None:
    J = tifffile.imread(stack)
    J = 0.5 * J / J.max()
    field = 3000 * (1 + 0.3 * np.random.default_rng(0).random((64, 64)))
    tifffile.imwrite("raw.tif", (field * np.exp(-J)).astype("f4"), photometric="minisblack")
    tifffile.imwrite("empty.tif", field.astype("f4"), photometric="minisblack")
    assert estimate("raw.tif", "--background", "empty.tif", "--method", "paper")[0] == 0
    motion, truth = Motion.load("raw.h5"), Motion.load(scene / "truth.h5")
    np.testing.assert_allclose(motion.omega_3[4:-4] / 0.0025, truth.omega_3[4:-4], rtol=0.02)
    files = [line.split("  ")[1] for line in motion.provenance["inputs"].splitlines()]
    assert files == ["raw.tif", "empty.tif"]


def test_standard_input(stack: Path) -> None:
    with stack.open("rb") as file:
        done = shell("estimate", "-", *PAPER, "-o", "piped.h5", stdin=file)
    assert (done.returncode, done.stdout, done.stderr) == (0, "piped.h5\n", "")
    inputs = Motion.load("piped.h5").provenance["inputs"]
    assert inputs == f"{hashlib.sha256(stack.read_bytes()).hexdigest()}  -"


def test_a_still_object_is_no_success(stack: Path, estimate: Call) -> None:
    tifffile.imwrite("still.tif", np.repeat(tifffile.imread(stack)[:1], 30, axis=0), photometric="minisblack")
    code, out, err = estimate("still.tif", *PAPER)
    assert (code, out) == (4, "still.h5\n")
    assert err.startswith("trap-motion: still.tif: not trustworthy: ")
    assert err.count("\n") == 1
    motion = Motion.load("still.h5")
    assert not motion.identifiable
    assert not motion.valid.any()
    code, out, _ = estimate("still.tif", *PAPER, "--json", "--overwrite")
    assert (code, json.loads(out)["identifiable"]) == (4, False)


def test_warnings_of_the_input_are_shown(stack: Path, estimate: Call) -> None:
    data = tifffile.imread(stack)
    tifffile.imwrite("slices.tif", data, imagej=True, metadata={"axes": "ZYX"})
    code, out, err = estimate("slices.tif", *PAPER)
    assert (code, out) == (0, "slices.h5\n")
    assert err.startswith("trap-motion: warning: slices.tif: its slices")
    assert estimate("slices.tif", *PAPER, "--overwrite", "-q")[2] == ""


# names


def test_unusual_names(stack: Path) -> None:
    sources = ["two words.tif", "Größe µ.tif", "-dash.tif", "100 %03d [a].tif", "a\nb.tif"]
    for name in sources:
        os.link("sim.tif", name)
    locale = {**os.environ, "LANG": "C", "LC_ALL": "C"}
    done = shell("estimate", *PAPER, "--", *sources, env=locale, text=False)
    assert (done.returncode, done.stderr) == (0, b"")
    results = [name.replace(".tif", ".h5") for name in sources]
    assert done.stdout == b"".join(os.fsencode(name) + b"\n" for name in results)
    assert all(Motion.load(name).identifiable for name in results)


def test_folders_patterns_and_datasets_have_a_name(stack: Path, estimate: Call) -> None:
    data = tifffile.imread(stack)
    Path("run.1").mkdir()
    for n, frame in enumerate(data):
        tifffile.imwrite(f"run.1/img_{n}.tif", frame)
    with h5py.File("scan.nxs", "w") as file:
        file["entry/data"] = data
    for source, output in (
        ("run.1", "run.1.h5"),
        ("run.1/img_*.tif", "run.1/img.h5"),
        ("run.1/*.tif", "run.1.h5"),
        ("scan.nxs", "scan.h5"),
        ("scan.nxs::/entry/data", "scan-entry-data.h5"),
    ):
        assert estimate(source, *PAPER, "--overwrite") == (0, f"{output}\n", "")
        assert len(Motion.load(output)) == 40
    files = Motion.load("run.1.h5").provenance["inputs"].splitlines()
    assert len(files) == 40
    for source in ("*.tif", ".", "-", ""):
        code, out, err = estimate(source, *PAPER)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert "-o" in err


# outputs that exist


def test_existing_output_is_refused_before_any_work(stack: Path, estimate: Call) -> None:
    Path("sim.h5").write_text("precious")
    stack.write_bytes(b"")  # reading it would be another error
    code, out, err = estimate("sim.tif", *PAPER)
    assert (code, out, err.count("\n")) == (5, "", 1)
    assert "--overwrite" in err
    assert Path("sim.h5").read_text() == "precious"
    code, _, _ = estimate("sim.tif", *PAPER, "--overwrite")
    assert code == 3
    assert Path("sim.h5").read_text() == "precious"


def test_never_onto_an_input(stack: Path, estimate: Call) -> None:
    before = stack.read_bytes()
    Path("link.h5").symlink_to("sim.tif")
    os.link("sim.tif", "empty.tif")
    for output in ("sim.tif", "link.h5", "empty.tif"):
        code, out, err = estimate("sim.tif", *PAPER, "--background", "empty.tif", "-o", output, "--overwrite")
        assert (code, out, err.count("\n")) == (5, "", 1)
    assert stack.read_bytes() == before


@pytest.mark.parametrize("output", [".", "nowhere/a.h5", "sim.tif/a.h5", "/dev/null"])
def test_outputs_that_cannot_be(stack: Path, estimate: Call, output: str) -> None:
    code, out, err = estimate("sim.tif", *PAPER, "-o", output)
    assert (code, out, err.count("\n")) == (5, "", 1)
    assert names(stack.parent) == {"sim.tif"}


def test_resume_keeps_what_is_up_to_date(stack: Path, estimate: Call) -> None:
    assert estimate("sim.tif", *PAPER)[0] == 0
    made = Path("sim.h5").stat().st_mtime_ns
    code, out, err = estimate("sim.tif", *PAPER, "--resume", "-v")
    assert (code, out) == (0, "sim.h5\n")
    assert "kept" in err
    assert Path("sim.h5").stat().st_mtime_ns == made
    code, out, err = estimate("sim.tif", *PAPER, "--frames", "0:30", "--resume")
    assert (code, out, err.count("\n")) == (5, "", 1)
    later = time.time() + 10
    os.utime("sim.tif", (later, later))
    assert estimate("sim.tif", *PAPER, "--resume")[0] == 5
    assert estimate("sim.tif", *PAPER, "--resume", "--overwrite")[0] == 0
    assert Path("sim.h5").stat().st_mtime_ns != made
    Path("sim.h5").write_text("precious")
    assert estimate("sim.tif", *PAPER, "--resume")[0] == 5
    assert Path("sim.h5").read_text() == "precious"


# bad input


def _bad_files(stack: Path) -> None:
    data = tifffile.imread(stack)
    whole = stack.read_bytes()
    axes = {"axes": "TYX"}
    tifffile.imwrite("one.tif", data[:1], imagej=True, metadata=axes)
    tifffile.imwrite("two.tif", data[:2], imagej=True, metadata=axes)
    tifffile.imwrite("blank.tif", np.zeros((20, 32, 32), "u2"), imagej=True, metadata=axes)
    tifffile.imwrite("flat.tif", np.full((20, 32, 32), 900, "u2"), imagej=True, metadata=axes)
    tifffile.imwrite("nan.tif", np.full((20, 32, 32), np.nan, "f4"), imagej=True, metadata=axes)
    Path("empty.tif").touch()
    Path("header.tif").write_bytes(whole[:8])
    Path("cut.tif").write_bytes(whole[: len(whole) * 6 // 10])
    Path("text.tif").write_text("no image")
    Path("notes.xyz").write_text("no video")
    Path("folder").mkdir()
    with h5py.File("none.nxs", "w") as file:
        file["data"] = np.zeros((0, 8, 8), "u2")


BAD = [
    *("one.tif", "two.tif", "blank.tif", "flat.tif", "nan.tif", "empty.tif", "header.tif", "cut.tif"),
    *("text.tif", "notes.xyz", "folder", "none.nxs", "none.nxs::/missing"),
    *("missing.tif", "nowhere/missing.tif", "folder/img_*.tif"),
]


@pytest.mark.parametrize("method", ["paper", "auto"])
def test_bad_files_end_with_one_line_and_3(stack: Path, estimate: Call, method: str) -> None:
    _bad_files(stack)
    before = names(stack.parent)
    for source in BAD:
        for options in ((), ("--attenuation",)):
            if (source, options) == ("flat.tif", ("--attenuation",)):
                continue  # attenuation everywhere: an object larger than the frame
            code, out, err = estimate(source, "--method", method, *options)
            assert (code, out, err.count("\n")) == (3, "", 1), (source, options, err)
            assert source.split("::")[0].rstrip("*") in err or "folder" in err
            assert "unexpected" not in err
    assert names(stack.parent) == before


def test_part_of_a_truncated_file(stack: Path, estimate: Call) -> None:
    whole = stack.read_bytes()
    stack.write_bytes(whole[: len(whole) * 6 // 10])
    code, _, err = estimate("sim.tif", *PAPER)
    assert code == 3
    assert "--allow-partial" in err
    code, out, err = estimate("sim.tif", *PAPER, "--allow-partial")
    assert (code, out) == (0, "sim.h5\n")
    assert "truncated" in err
    assert len(Motion.load("sim.h5")) == 24


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--method", "magic"], "magic"),
        (["--frames", "a:b"], "--frames"),
        (["--frames", "::0"], "--frames"),
        (["--roi", "1,2,3"], "TOP,BOTTOM"),
        (["--roi", "5,5,0,9"], "--roi"),
        (["--channel", "-1"], "--channel"),
        (["--frame-interval", "0"], "--frame-interval"),
        (["--frame-interval", "soon"], "--frame-interval"),
        (["--fps", "0"], "--fps"),
        (["--fps", "nan"], "--fps"),
        (["--fps", "25", "--frame-interval", "0.04"], "exclude"),
        (["--pixel-size", "-2", "--pixel-unit", "µm"], "--pixel-size"),
        (["--pixel-size", "2"], "--pixel-unit"),
        (["--jobs", "0"], "--jobs"),
        (["--config", "unknown.toml"], "window"),
        (["--config", "value.toml"], "value.toml"),
        (["--config", "broken.toml"], "TOML"),
        (["--config", "method.toml"], "magic"),
        (["--config", "missing.toml"], "missing.toml"),
        (["--config", "sim.tif"], "sim.tif"),
        (["--bogus"], "--bogus"),
        (["other.tif", "-o", "a.h5"], "single input"),
        (["sim.tif"], "sim.h5"),
    ],
)
def test_options_that_make_no_sense_end_with_one_line_and_2(
    stack: Path, estimate: Call, options: list[str], words: str
) -> None:
    Path("unknown.toml").write_text("[motion]\nwidnow = 9\n")
    Path("value.toml").write_text("[motion]\nwindow = 'nine'\n")
    Path("broken.toml").write_text("[motion\n")
    Path("method.toml").write_text("[motion]\nmethod = 'magic'\n")
    before = names(stack.parent)
    code, out, err = estimate("sim.tif", *options)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert words in err
    assert names(stack.parent) == before


def test_a_fault_of_the_program_is_one_line(
    stack: Path, estimate: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("by design")

    monkeypatch.setattr("trapcli.pipeline.estimate", broken)
    code, out, err = estimate("sim.tif", *PAPER)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "sim.tif: unexpected fault (ZeroDivisionError: by design)" in err
    code, _, err = estimate("sim.tif", *PAPER, "-vv")
    assert "Traceback" in err


# several inputs


@pytest.mark.parametrize("jobs", [1, 2])
def test_one_bad_input_among_several(stack: Path, estimate: Call, jobs: int) -> None:
    for name in ("b.tif", "d.tif"):
        os.link("sim.tif", name)
    Path("c.tif").write_text("no image")
    inputs = ("sim.tif", "b.tif", "missing.tif", "c.tif", "d.tif")
    code, out, err = estimate(*inputs, *PAPER, "--jobs", jobs)
    assert (code, out) == (1, "sim.h5\nb.h5\nd.h5\n")
    lines = err.splitlines()
    assert len(lines) == 3
    assert "missing.tif" in lines[0]
    assert "c.tif" in lines[1]
    assert lines[2] == "trap-motion: 2 of 5 inputs failed"
    assert names(stack.parent) == {"sim.tif", "b.tif", "c.tif", "d.tif", "sim.h5", "b.h5", "d.h5"}
    np.testing.assert_array_equal(Motion.load("b.h5").alpha, Motion.load("sim.h5").alpha)


def test_several_as_json_lines(stack: Path, estimate: Call) -> None:
    os.link("sim.tif", "b.tif")
    code, out, _ = estimate("sim.tif", "b.tif", *PAPER, "--json")
    assert code == 0
    assert [json.loads(line)["output"] for line in out.splitlines()] == ["sim.h5", "b.h5"]


def test_options_that_no_input_can_have_stop_at_once(stack: Path, estimate: Call) -> None:
    os.link("sim.tif", "b.tif")
    code, out, err = estimate("sim.tif", "b.tif", *PAPER, "--frames", "x")
    assert (code, out, err.count("\n")) == (2, "", 1)


def test_nothing_is_done_where_one_output_exists(stack: Path, estimate: Call) -> None:
    os.link("sim.tif", "b.tif")
    Path("b.h5").write_text("precious")
    code, out, _ = estimate("sim.tif", "b.tif", *PAPER)
    assert (code, out) == (5, "")
    assert not Path("sim.h5").exists()


def test_an_input_that_kills_its_process(stack: Path) -> None:
    os.link("sim.tif", "b.tif")
    program = (
        "import os, signal, trapcli.cli.workers as w\n"
        "def work(job):\n"
        "    if job == 'bad': os.kill(os.getpid(), signal.SIGSEGV)\n"
        "    return job.upper()\n"
        "if __name__ == '__main__':\n"
        "    with w.ProcessExecutor(2) as executor:\n"
        "        futures = [executor.submit(work, job) for job in ('a', 'bad', 'c', 'd')]\n"
        "        print([future.exception() or future.result() for future in futures])\n"
    )
    Path("program.py").write_text(program)
    done = subprocess.run([sys.executable, "program.py"], capture_output=True, text=True, check=False)
    died = "LostWorkerError('the process that worked on it died')"
    assert (done.stdout, done.stderr) == (f"['A', {died}, 'C', 'D']\n", "")


# interruption and the terminal


@pytest.mark.skipif(os.name != "posix", reason="shell")
def test_closed_streams(stack: Path) -> None:
    program = " ".join(f"'{part}'" for part in PROGRAM)
    paper = " ".join(PAPER)
    for redirection in (">&-", "2>&-", "<&-"):
        script = f"{program} estimate sim.tif {paper} --overwrite {redirection}"
        assert subprocess.run(["bash", "-c", script], check=False, stdout=subprocess.DEVNULL).returncode == 0
    done = subprocess.run(
        ["bash", "-c", f"{program} estimate - -o a.h5 <&-"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (3, "", 1)


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("jobs", ["1", "2"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_nothing_behind(stack: Path, jobs: str, number: int) -> None:
    for n in range(30):
        os.link("sim.tif", f"{n}.tif")
    inputs = [f"{n}.tif" for n in range(30)]
    process = subprocess.Popen(
        [*PROGRAM, "estimate", *inputs, *PAPER, "--jobs", jobs],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    assert process.stdout
    first = process.stdout.readline()
    os.killpg(process.pid, number)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert err.strip() == "trap-motion: interrupted"
    done = [first.strip(), *out.split()]
    results = {path.name for path in stack.parent.iterdir() if path.suffix != ".tif"}
    # a result may be complete whose name was not printed any more
    assert set(done) <= results
    assert len(results) < 30
    for name in results:
        assert Motion.load(name).identifiable


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="signals")
def test_an_interrupt_is_heeded_where_exceptions_are_ignored() -> None:
    program = (
        "import os, signal, time, weakref\n"
        "from trapcli.cli.workers import _heed_interrupts\n"
        "_heed_interrupts()\n"
        "class Thing: pass\n"
        "thing = Thing()\n"
        "reference = weakref.ref(thing, lambda _: (os.kill(os.getpid(), signal.SIGTERM), time.sleep(0.1)))\n"
        "try:\n"
        "    del thing\n"
        "    time.sleep(20)\n"
        "except KeyboardInterrupt: print('interrupted')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("interrupted\n", "")


def test_progress_is_drawn_on_a_terminal_only(
    stack: Path, estimate: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    code, out, err = estimate("sim.tif", *PAPER)
    assert (code, out) == (0, "sim.h5\n")
    assert "centers" in err
    assert estimate("sim.tif", *PAPER, "-q", "--overwrite")[2] == ""


def test_help_is_quick_and_needs_no_numpy() -> None:
    program = (
        "import sys; sys.argv = ['trap-motion', 'estimate', '--help']\n"
        "from trapcli.cli.main import run\n"
        "try: run()\n"
        "finally: assert 'numpy' not in sys.modules"
    )
    before = os.times()
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    after = os.times()
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    assert (done.returncode, done.stderr) == (0, "")
    assert "--background" in done.stdout
    assert spent < 0.3


@pytest.mark.skipif(os.name != "posix", reason="pipes of a shell")
def test_head_and_a_full_device(scene: Path, stack: Path) -> None:
    assert shell("estimate", "sim.tif", *PAPER, "-q").returncode == 0
    program = " ".join(f"'{part}'" for part in PROGRAM)
    script = f"{program} export sim.h5 --format json | head -c 20; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == '{"units": {"frame": 0\n'
    assert done.stderr == ""
    if os.path.exists("/dev/full"):
        with open("/dev/full", "w") as full:
            done = shell("export", "sim.h5", capture_output=False, stdout=full, stderr=subprocess.PIPE)
        assert done.returncode == 5
        assert done.stderr.count("\n") == 1
