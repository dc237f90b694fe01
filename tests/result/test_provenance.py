"""Provenance: checksums that sha256sum confirms, dates in UTC, versions."""

from __future__ import annotations

import shutil
import subprocess
from datetime import UTC, datetime

import pytest

from trapcli.errors import InputError
from trapcli.result.provenance import checksum_line, collect

EMPTY = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
ABC = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_known_digests(tmp_path):
    (tmp_path / "empty").touch()
    (tmp_path / "abc").write_text("abc")
    assert checksum_line(tmp_path / "empty") == f"{EMPTY}  {tmp_path}/empty"
    assert checksum_line(tmp_path / "abc", "-") == f"{ABC}  -"


def test_a_checksum_no_longer_wanted_is_left_off(tmp_path):
    path = tmp_path / "long"
    path.write_bytes(bytes(5 << 20))
    asked = []

    def wanted():
        asked.append(True)
        return len(asked) < 3

    checksum_line(path, wanted=wanted)
    assert len(asked) == 3


def test_folders_stand_for_their_files(tmp_path):
    (tmp_path / "stack" / "b").mkdir(parents=True)
    for name in ("b/2.tif", "b/10.tif", "a.tif"):
        (tmp_path / "stack" / name).write_text("abc")
    lines = collect(inputs=[tmp_path / "stack"])["inputs"].splitlines()
    assert [line.split("  ")[1] for line in lines] == [
        f"{tmp_path}/stack/{name}" for name in ("a.tif", "b/10.tif", "b/2.tif")
    ]


@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="needs sha256sum")
def test_sha256sum_confirms(tmp_path):
    names = ["plain.tif", "with space.tif", "ü.tif", "new\nline.tif", "back\\slash.tif"]
    for name in names:
        (tmp_path / name).write_text(name)
    inputs = collect(inputs=[tmp_path / name for name in names])["inputs"]
    check = subprocess.run(
        ["sha256sum", "--check", "--strict"], input=inputs, capture_output=True, text=True, check=True
    )
    assert check.stdout.count(": OK") == len(names)


def test_missing_input(tmp_path):
    with pytest.raises(InputError, match=r"none\.tif: can't be read"):
        collect(inputs=[tmp_path / "none.tif"])


def test_who_when_and_how():
    made = collect(command_line="trap-motion estimate a.tif", configuration="[input]\n")
    assert made["program"] == "trap-motion"
    assert made["command_line"] == "trap-motion estimate a.tif"
    assert made["configuration"] == "[input]\n"
    date = datetime.fromisoformat(made["date"])
    assert abs((datetime.now(UTC) - date).total_seconds()) < 60
    libraries = dict(line.split(" ", 1) for line in made["libraries"].splitlines())
    assert {"Python", "numpy", "h5py"} <= libraries.keys()
