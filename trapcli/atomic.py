"""Outputs appear whole or not at all: written under a temporary name in the same folder, then renamed."""

from __future__ import annotations

import os
import re
import secrets
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from trapcli.errors import OutputError

# the host is part of the name: folders may be shared with machines whose process numbers mean nothing here
_PREFIX = f".trap-motion-{re.sub(r'[^A-Za-z0-9.]', '_', socket.gethostname())[:64]}-"
_TEMPORARY = re.compile(re.escape(_PREFIX) + r"(\d+)-[0-9a-f]{8}(\.\w+)?")


def check_output(path: Path | str, overwrite: bool) -> Path:
    """Refuse an output that can't or mustn't be written, before any work is done for it.

    Returns
    -------
    Path
        The file that will be written: `path` with symbolic links followed.

    Raises
    ------
    OutputError
        Where `path` exists and `overwrite` is False, isn't a regular file, or its folder can't be written.
    """
    try:
        target = Path(os.path.realpath(path))
        mode = target.stat().st_mode
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: can't be written ({_reason(error)})") from None
    else:
        if stat.S_ISDIR(mode):
            raise OutputError(f"{path}: is a folder; give the name of a file")
        if not stat.S_ISREG(mode):
            raise OutputError(f"{path}: is not a regular file; give another name")
        if not overwrite:
            raise OutputError(f"{path}: exists already; choose another name or pass --overwrite")
    if not target.parent.is_dir():
        raise OutputError(f"{path}: the folder {target.parent} doesn't exist; create it first")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: the folder {target.parent} is not writable")
    return target


@contextmanager
def atomic_path(path: Path | str, overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary path to write to, which becomes `path` when the body ends well and vanishes otherwise.

    The temporary file lies in the folder of `path`, exists (empty), and ends like `path`. Files that killed
    processes left behind there are removed. Without `overwrite`, a file that came to `path` meanwhile stays.

    Raises
    ------
    OutputError
        As `check_output` does, and for any `OSError` of the body (a full disk, for example).
    """
    target = check_output(path, overwrite)
    remove_stale(target.parent)
    suffix = target.suffix if re.fullmatch(r"\.\w+", target.suffix) else ""
    temporary = target.parent / f"{_PREFIX}{os.getpid()}-{secrets.token_hex(4)}{suffix}"
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        _sync(temporary)
        if overwrite:
            os.replace(temporary, target)
        else:
            _publish_new(temporary, target)
        _sync(target.parent)
    except OSError as error:
        raise OutputError(f"{path}: can't be written ({_reason(error)})") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def remove_stale(folder: Path) -> None:
    """Remove the temporary files in `folder` of processes of this machine that no longer run."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = _TEMPORARY.fullmatch(entry.name)
            if match and not _runs(int(match[1])) and entry.is_file(follow_symlinks=False):
                with suppress(OSError):
                    os.unlink(entry.path)


def _publish_new(temporary: Path, target: Path) -> None:
    """Rename unless `target` exists; unlike a rename, a link never replaces what came there meanwhile."""
    try:
        os.link(temporary, target)
    except OSError as error:
        if isinstance(error, FileExistsError) or target.exists():
            raise OutputError(
                f"{target}: was created by another process; choose another name or pass --overwrite"
            ) from None
        os.replace(temporary, target)  # a file system without hard links


def _sync(path: Path) -> None:
    if path.is_dir() and os.name != "posix":  # Windows opens no folders
        return
    descriptor = os.open(path, os.O_RDONLY if os.name == "posix" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _runs(process: int) -> bool:
    if os.name != "posix":  # there, signal 0 would be an interrupt
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
