"""``trap-motion info`` says what a file is, and nothing that isn't in it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

from trapcli.cli.main import run
from trapcli.stack.tiff import write_tiff

FRAMES = np.arange(5 * 6 * 8, dtype=np.uint16).reshape(5, 6, 8)


def info(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stop:
        run(["info", *arguments])
    captured = capsys.readouterr()
    assert isinstance(stop.value.code, int)
    return stop.value.code, captured.out, captured.err


@pytest.fixture
def stack(tmp_path: Path) -> Path:
    path = tmp_path / "a stack.tif"
    write_tiff(
        path,
        [FRAMES],
        shape=FRAMES.shape,
        dtype="u2",
        frame_interval=0.02,
        pixel_size=0.1,
        pixel_unit="µm",
    )
    return path


def test_in_words(stack: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = info(capsys, str(stack))
    assert (code, err) == (0, "")
    lines = dict(line.split(":", 1) for line in out.splitlines())
    assert {key: value.strip() for key, value in lines.items()} == {
        "input": str(stack),
        "format": "ImageJ TIFF",
        "frames": "5",
        "size": "6 rows x 8 columns",
        "type": "uint16",
        "frame interval": "0.02 s (50 per s)",
        "pixel size": "0.1 µm",
    }


def test_as_json(stack: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = info(capsys, "--json", str(stack))
    assert (code, err) == (0, "")
    assert json.loads(out) == {
        "input": str(stack),
        "format": "ImageJ TIFF",
        "frames": 5,
        "height": 6,
        "width": 8,
        "type": "uint16",
        "bits": 16,
        "frame_interval": 0.02,
        "time_unit": "s",
        "pixel_size": 0.1,
        "pixel_unit": "µm",
        "lossy": False,
        "warnings": [],
    }


def test_what_is_not_in_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, FRAMES, imagej=True, photometric="minisblack", metadata={"axes": "ZYX"})
    _, out, _ = info(capsys, str(path))
    assert out.count("not in the file") == 2
    assert "warning:        its slices are taken as times" in out
    _, out, _ = info(capsys, str(path), "--json")
    values = json.loads(out)
    assert [values[key] for key in ("frame_interval", "time_unit", "pixel_size", "pixel_unit")] == [None] * 4


def test_errors_are_one_line(stack: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stack.write_bytes(stack.read_bytes()[:-100])
    code, out, err = info(capsys, str(stack), "--json")
    assert (code, out) == (3, "")
    assert err.count("\n") == 1
    assert "a stack.tif" in err
    assert "--allow-partial" in err
    code, out, _ = info(capsys, str(stack), "--allow-partial")
    assert code == 0
    assert "warning:        it is truncated" in out


def test_options_that_choose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "stack.tif"
    frames = FRAMES.reshape(5, 2, 3, 8)
    tifffile.imwrite(path, frames, imagej=True, photometric="minisblack", metadata={"axes": "TZYX"})
    assert info(capsys, str(path))[0] == 3
    assert "frames:         10" in info(capsys, str(path), "--time-axis", "TZ")[1]
    assert info(capsys, str(path), "--time-axis", "P")[0] == 2
    tifffile.imwrite(path, frames, imagej=True, photometric="minisblack", metadata={"axes": "TCYX"})
    assert info(capsys, str(path))[0] == 3
    assert "frames:         5" in info(capsys, str(path), "--channel", "1")[1]


def test_a_pipe(stack: Path) -> None:
    with stack.open("rb") as file:
        done = subprocess.run(
            [sys.executable, "-c", "from trapcli.cli.main import run; run()", "info", "-", "--json"],
            stdin=file,
            capture_output=True,
            check=True,
        )
    assert json.loads(done.stdout)["frames"] == 5
    assert done.stderr == b""
