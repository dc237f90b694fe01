"""docs/formats.md describes the format as it is, and its examples run."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import pytest

from trapcli.result.motion import FLAG_MEANINGS

PAGE = (Path(__file__).parents[2] / "docs" / "formats.md").read_text(encoding="utf-8")
EXAMPLES = [text for text in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "pandas" not in text]


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_run(example, make_motion, tmp_path, monkeypatch):
    make_motion().save(tmp_path / "result.h5")
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "docs/formats.md", "exec"), {})


def test_every_path_is_described():
    golden = Path(__file__).with_name("format-1.0.txt").read_text(encoding="utf-8")
    for path in re.findall(r"^(/\S*)", golden, re.MULTILINE):
        group, _, name = path.rpartition("/")
        assert f"`{path}`" in PAGE or f"`…/{name}`" in PAGE or (name == "time" and group), path


def test_every_flag_is_described():
    rows = re.findall(r"^\| (\d+) \|", PAGE, re.MULTILINE)
    assert [int(row) for row in rows] == [int(flag) for flag in FLAG_MEANINGS]


@pytest.mark.parametrize("language", ["matlab", "julia"])
def test_what_other_languages_read_is_there(language, make_motion, tmp_path):
    make_motion().save(tmp_path / "result.h5")
    (example,) = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    paths = re.findall(r"""["']/?(motion/[\w/]+)["']""", example)
    assert len(paths) >= 4
    with h5py.File(tmp_path / "result.h5") as file:
        for path in paths:
            assert "units" in file[path].attrs
