"""``trap-motion export``: one row per frame, on stdout or in a file."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from trapcli.cli.main import run
from trapcli.result.motion import Motion

# fmt: off
COLUMNS = [
    "frame", "time", "T1", "T2", "T1_errors", "T2_errors", "center1", "center2", "phi",
    "phi_errors", "omega_1", "omega_2", "omega_3", "omega_3_errors", "alpha", "alpha_errors",
    "R11", "R12", "R13", "R21", "R22", "R23", "R31", "R32", "R33", "R1_errors", "R2_errors",
    "R3_errors", "quaternion_x", "quaternion_y", "quaternion_z", "quaternion_w", "valid", "flags",
    "residual", "time_unit", "length_unit",
]
# fmt: on


@pytest.fixture
def motion(make_motion):
    """More frames than are written at once, with a gap."""
    motion = make_motion(2500)
    phi, R = motion.phi.copy(), motion.R.copy()
    phi[7], R[7] = np.nan, np.nan
    return dataclasses.replace(motion, phi=phi, R=R, frame=motion.frame + 5)


@pytest.fixture
def path(motion, tmp_path):
    motion.save(tmp_path / "result.h5")
    return tmp_path / "result.h5"


def call(*arguments):
    with pytest.raises(SystemExit) as end:
        run([str(argument) for argument in arguments])
    return end.value.code


def test_csv_on_stdout(path, motion, capfdbinary):
    assert call("export", path) == 0
    rows = list(csv.DictReader(io.StringIO(capfdbinary.readouterr().out.decode())))
    assert list(rows[0]) == COLUMNS
    assert len(rows) == 2500
    numbers = {name: np.array([float(row[name] or "nan") for row in rows]) for name in COLUMNS[:-2]}
    np.testing.assert_array_equal(numbers["frame"], motion.frame)
    np.testing.assert_array_equal(numbers["T2"], motion.T[:, 1])
    np.testing.assert_array_equal(numbers["phi"], motion.phi)
    np.testing.assert_array_equal(numbers["R23"], motion.R[:, 1, 2])
    assert rows[7]["phi"] == rows[7]["omega_1"] == rows[7]["R11"] == rows[7]["quaternion_w"] == ""
    assert rows[0]["phi_errors"] == ""
    assert (rows[0]["time_unit"], rows[0]["length_unit"]) == ("s", "µm")


def test_json(path, motion, capfdbinary):
    assert call("export", path, "--format", "json") == 0
    exported = json.loads(capfdbinary.readouterr().out, parse_constant=pytest.fail)
    assert len(exported["frames"]) == 2500
    assert list(exported["frames"][0]) == list(exported["units"]) == COLUMNS[:-2]
    assert exported["frames"][7]["phi"] is None
    assert exported["frames"][2000]["alpha"] == motion.alpha[2000]
    assert exported["units"]["omega_3"] == "rad/s"
    assert exported["units"]["center1"] == "µm"
    assert exported["identifiable"] is True


def test_one_frame_is_valid_json(make_motion, tmp_path, capfdbinary):
    make_motion(1).save(tmp_path / "one.h5")
    assert call("export", tmp_path / "one.h5", "--format", "json") == 0
    assert len(json.loads(capfdbinary.readouterr().out)["frames"]) == 1


def test_output_file(path, tmp_path, capfdbinary):
    out = tmp_path / "rows.csv"
    assert call("export", path, "-o", out) == 0
    assert capfdbinary.readouterr().out.decode() == f"{out}\n"
    assert len(out.read_text(encoding="utf-8").splitlines()) == 2501


def test_existing_output_is_kept(path, tmp_path, capfdbinary):
    out = tmp_path / "rows.csv"
    out.write_text("precious")
    assert call("export", path, "-o", out) == 5
    assert out.read_text() == "precious"
    assert b"--overwrite" in capfdbinary.readouterr().err
    assert call("export", path, "-o", out, "--overwrite") == 0
    assert out.read_text(encoding="utf-8").startswith("frame,time")


def test_never_onto_the_result(path, tmp_path):
    (tmp_path / "other.csv").symlink_to(path)
    for name in ("result.h5", "other.csv"):
        assert call("export", path, "-o", tmp_path / name, "--overwrite") == 5
    assert len(Motion.load(path)) == 2500


def test_not_a_result(tmp_path, capfdbinary):
    (tmp_path / "a.h5").write_text("frame,time\n")
    assert call("export", tmp_path / "a.h5") == 3
    out, err = capfdbinary.readouterr()
    assert out == b""
    assert err.count(b"\n") == 1


def test_unknown_format(path, capfdbinary):
    assert call("export", path, "--format", "xlsx") == 2
    assert b"xlsx" in capfdbinary.readouterr().err


def test_no_archive_on_a_terminal(path, tmp_path):
    """A terminal shows text; the archive goes to files and pipes."""
    script = "import sys; from trapcli.cli.main import run; run(sys.argv[1:])"
    pty = pytest.importorskip("pty", reason="no terminals of this kind here")
    main, terminal = pty.openpty()
    done = subprocess.run(
        [sys.executable, "-c", script, "export", path, "--format", "npz"],
        stdout=terminal, stderr=subprocess.PIPE, check=False,
    )  # fmt: skip
    os.close(terminal)
    os.close(main)
    assert done.returncode == 2
    assert b"-o" in done.stderr
    piped = subprocess.run(
        [sys.executable, "-c", script, "export", path, "--format", "npz"], capture_output=True, check=True
    )
    with np.load(io.BytesIO(piped.stdout)) as archive:
        assert len(archive["R"]) == 2500
