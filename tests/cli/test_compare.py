"""``trap-motion compare``: a table for people, JSON for scripts."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from trapcli.cli.main import run


@pytest.fixture
def files(make_motion, tmp_path):
    """A result whose φ is off by 0.01 rad and whose stated error is 0.02 rad, and the truth."""
    truth = make_motion(truth=True)
    result = dataclasses.replace(truth, truth=False, phi=truth.phi + 0.01, phi_errors=np.full(40, 0.02))
    result.save(tmp_path / "result.h5")
    truth.save(tmp_path / "truth.h5")
    return str(tmp_path / "result.h5"), str(tmp_path / "truth.h5")


def call(*arguments):
    with pytest.raises(SystemExit) as end:
        run(list(arguments))
    return end.value.code


def test_table(files, capsys):
    assert call("compare", *files) == 0
    out, err = capsys.readouterr()
    rows = {line[:24].strip(): line[24:].split() for line in out.splitlines()}
    assert rows["phi"][:5] == ["rad", "40", "0.01", "0.01", "0.01"]
    assert rows["phi"][5:] == ["100", "%", "100", "%"]
    assert rows["T"][0] == "µm"
    assert rows["R, best aligned"][0] == "deg"
    assert "40 of 40" in out
    assert err == ""


def test_json(files, capsys):
    assert call("compare", *files, "--json", "--trim", "3") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["common"] == result["compared"] == 34
    assert result["mirrored"] is False
    assert result["errors"]["phi"]["median"] == pytest.approx(0.01)
    assert result["errors"]["phi"]["unit"] == "rad"
    assert result["errors"]["alpha"]["within_1_sigma"] is None


def test_notes_go_to_stderr(files, make_motion, tmp_path, capsys):
    make_motion(length_unit="pixel").save(tmp_path / "pixels.h5")
    arguments = ("compare", str(tmp_path / "pixels.h5"), files[1])
    assert call(*arguments) == 0
    assert "--pixel-size" in capsys.readouterr().err
    assert call(*arguments, "-q") == 0
    assert capsys.readouterr().err == ""


def test_missing_file(files, tmp_path, capsys):
    assert call("compare", files[0], str(tmp_path / "none.h5")) == 3
    out, err = capsys.readouterr()
    assert out == ""
    assert err == f"trap-motion: {tmp_path}/none.h5: no such file\n"


def test_wrong_pair_names_both_files(files, make_motion, tmp_path, capsys):
    make_motion(frame=np.arange(40) + 1000).save(tmp_path / "other.h5")
    assert call("compare", str(tmp_path / "other.h5"), files[1]) == 3
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "other.h5" in err
    assert "truth.h5" in err


def test_trim_too_large(files, capsys):
    assert call("compare", *files, "--trim", "20") == 2
    assert "--trim 20" in capsys.readouterr().err
