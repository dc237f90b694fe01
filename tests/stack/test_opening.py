"""Whatever a user points at: one line that names it, no traceback, no waiting."""

from __future__ import annotations

import gc
import io
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from trapcli.errors import InputError
from trapcli.stack import open_stack

FRAMES = np.random.default_rng(0).integers(0, 255, (5, 6, 8)).astype("uint8")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"frame,phi\n0,1.5\n", "no known kind"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), "a PNG image"),
        (b"\xff\xd8\xff\xe0" + bytes(50), "a JPEG image"),
        (b"PK\x03\x04" + bytes(50), "a ZIP archive"),
        (b"II", "no known kind"),
        (b"RIFF\x00\x00\x00\x00WAVE", "no known kind"),
        (b"RIFF\x10\x00\x00\x00AVI ", "truncated"),
        (b"\x89HDF\r\n\x1a\n", "can't be read"),
        (b"\x1a\x45\xdf\xa3", "truncated"),
        (b"\x1a\x45\xdf\xa3" + b"\xff" * 40, "codec|damaged"),
        (b"\0\0\0\x08ftyp", "never finished"),
        (os.urandom(4000), "no known kind"),
    ],
)
def test_files_that_are_no_stacks(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "stack.tif"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        open_stack(str(path))
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_things_that_are_no_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name, words in (
        ("missing.tif", "No such file"),
        ("pipe", "no regular file"),
        (".", "no TIFF files"),
        ("missing/stack.tif", "No such file"),
        ("missing.h5::/data", "No such file"),
        ("x" * 300 + "::/data", "name too long"),
        ("x" * 300, "name too long"),
        ("nul\0byte", "null"),
    ):
        with pytest.raises(InputError, match=words):
            open_stack(str(tmp_path / name) if name != "." else str(tmp_path))
    with pytest.raises(InputError):
        open_stack("")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_no_permission(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, FRAMES, photometric="minisblack")
    path.chmod(0)
    with pytest.raises(InputError, match="Permission denied"):
        open_stack(str(path))


@pytest.mark.parametrize(
    "name", ["a b.tif", "größe µ.tif", "-o.tif", "new\nline.tif", "a::b.tif", b"\xff\xfe.tif"]
)
def test_strange_names(tmp_path: Path, name: str | bytes) -> None:
    path = tmp_path / os.fsdecode(name)
    tifffile.imwrite(path, FRAMES, photometric="minisblack")
    np.testing.assert_array_equal(open_stack(str(path)).to_array(), FRAMES)


class Stream:
    """Stands for ``sys.stdin``."""

    closed = False

    def __init__(self, content: bytes, terminal: bool = False) -> None:
        self.buffer = io.BytesIO(content)
        self.isatty = lambda: terminal


@pytest.fixture
def spool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_standard_input(spool: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = io.BytesIO()
    tifffile.imwrite(content, FRAMES, photometric="minisblack")
    monkeypatch.setattr(sys, "stdin", Stream(content.getvalue()))
    stack = open_stack("-")
    assert stack.info.source == "standard input"
    for _ in range(2):
        np.testing.assert_array_equal(stack.to_array(), FRAMES)
    passing = stack.blocks(2)
    del stack
    np.testing.assert_array_equal(np.concatenate(list(passing)), FRAMES)
    del passing
    gc.collect()
    assert list(spool.iterdir()) == []


@pytest.mark.parametrize(
    ("stdin", "words"),
    [
        (None, "nothing is redirected"),
        (Stream(b"", terminal=True), "nothing is redirected"),
        (Stream(b""), "is empty"),
        (Stream(b"text"), "no known kind"),
    ],
)
def test_standard_input_that_is_no_stack(
    spool: Path, monkeypatch: pytest.MonkeyPatch, stdin: Any, words: str
) -> None:
    monkeypatch.setattr(sys, "stdin", stdin)
    with pytest.raises(InputError, match=f"standard input: .*{words}"):
        open_stack("-")
    gc.collect()
    assert list(spool.iterdir()) == []
