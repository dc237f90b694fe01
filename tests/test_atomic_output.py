"""An output appears whole or not at all, and what was there before stays until then."""

from __future__ import annotations

import errno
import os
import subprocess
from pathlib import Path

import pytest

from trapcli import atomic
from trapcli.atomic import atomic_path, check_output
from trapcli.errors import InputError, OutputError


def test_the_output_appears_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "out.tif"
    with atomic_path(path) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".tif"
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]
    mask = os.umask(0)
    os.umask(mask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~mask


def fail(path: Path, error: BaseException, overwrite: bool) -> None:
    with atomic_path(path, overwrite) as temporary:
        temporary.write_text("half")
        raise error


@pytest.mark.parametrize(
    "error",
    [InputError("x"), KeyboardInterrupt(), ValueError(), OSError(errno.ENOSPC, "No space left on device")],
)
def test_nothing_remains_of_a_failure(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "out.h5"
    path.write_text("old")
    expected = OutputError if isinstance(error, OSError) else type(error)
    with pytest.raises(expected) as caught:
        fail(path, error, overwrite=True)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    if expected is OutputError:
        assert str(caught.value) == f"{path}: can't be written (No space left on device)"


def test_overwriting_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"
    path.write_text("old")
    with pytest.raises(OutputError, match="--overwrite"), atomic_path(path):
        pass
    with atomic_path(path, overwrite=True) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"


def test_a_file_that_came_meanwhile_stays(tmp_path: Path) -> None:
    path = tmp_path / "out.h5"

    def race() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("mine")
            path.write_text("theirs")

    with pytest.raises(OutputError, match="another process"):
        race()
    assert path.read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [path]


def test_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    path = tmp_path / "out.h5"
    with atomic_path(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"
    with pytest.raises(OutputError, match="another process"), atomic_path(tmp_path / "b.h5") as temporary:
        (tmp_path / "b.h5").touch()


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    target = tmp_path / "folder" / "data.h5"
    target.parent.mkdir()
    target.write_text("old")
    link = tmp_path / "out.h5"
    link.symlink_to(target)
    with atomic_path(link, overwrite=True) as temporary:
        assert temporary.parent == target.parent
        temporary.write_text("new")
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_what_can_not_be_an_output(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name, words in (
        (".", "is a folder"),
        ("pipe", "not a regular file"),
        ("missing/out.h5", "create it first"),
        ("x" * 300, "can't be written"),
        ("nul\0byte", "can't be written"),
        ("loop", "can't be written"),
    ):
        with pytest.raises(OutputError, match=words):
            check_output(f"{tmp_path}/{name}", overwrite=True)
    with pytest.raises(OutputError, match="not a regular file"):
        check_output("/dev/null", overwrite=True)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_is_locked(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(OutputError, match="not writable"):
        check_output(tmp_path / "out.h5", overwrite=False)


def test_remains_of_killed_processes_are_removed(tmp_path: Path) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    prefix = atomic._PREFIX
    stale = tmp_path / f"{prefix}{ended.pid}-0123abcd.h5"
    kept = [
        tmp_path / f"{prefix}{os.getppid()}-0123abcd.h5",
        tmp_path / f".trap-motion-elsewhere-{ended.pid}-0123abcd.h5",
        tmp_path / f"{prefix}{ended.pid}-notes.txt",
    ]
    for path in (stale, *kept):
        path.touch()
    with atomic_path(tmp_path / "out.h5"):
        pass
    assert not stale.exists()
    assert all(path.exists() for path in kept)
