"""Where a result comes from: program, configuration, inputs and libraries, for ``/motion/process``."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path

from trapcli.errors import InputError

PROGRAM = "trap-motion"
_BLOCK = 1 << 20  # bytes of a file that are read at once
LIBRARIES = (
    "numpy",
    "scipy",
    "h5py",
    "finufft",
    "tifffile",
    "imagecodecs",
    "opencv-python-headless",
)


def collect(
    *, command_line: str = "", configuration: str = "", inputs: Iterable[Path] = ()
) -> dict[str, str]:
    """Gather what is needed to repeat a run.

    Parameters
    ----------
    command_line:
        As typed in a shell; empty for a call from Python.
    configuration:
        The resolved configuration as TOML.
    inputs:
        Every file that was read; a folder stands for all files below it.

    Returns
    -------
    dict
        ``program``, ``version``, ``date`` (UTC, ISO 8601), ``command_line``, ``configuration``, ``inputs``
        (one line a file, as ``sha256sum`` writes and checks them) and ``libraries`` (one line each).

    Raises
    ------
    InputError
        Where an input can't be read.
    """
    return {
        "program": PROGRAM,
        "version": importlib.metadata.version("trapcli"),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command_line": command_line,
        "configuration": configuration,
        "inputs": "\n".join(checksum_line(file) for path in inputs for file in _files(path)),
        "libraries": "\n".join(_libraries()),
    }


def checksum_line(path: Path, name: str = "", wanted: Callable[[], bool] = lambda: True) -> str:
    r"""Return the line ``sha256sum`` writes for a file, which is read in blocks.

    Parameters
    ----------
    name:
        What to call the file, ``-`` for standard input that was stored in `path`; default: `path` itself.
    wanted:
        Asked before every block; once it is false, the rest of the file is left out.
    """
    checksum = hashlib.sha256()
    try:
        with path.open("rb", buffering=0) as file:
            while wanted() and (block := file.read(_BLOCK)):
                checksum.update(block)
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror or error})") from None
    name, digest = name or str(path), checksum.hexdigest()
    escaped = name.replace("\\", "\\\\").replace("\n", "\\n").replace("\r", "\\r")
    return f"{'' if escaped == name else chr(92)}{digest}  {escaped}"


def _files(path: Path) -> Iterator[Path]:
    if not path.is_dir():
        yield path
        return
    for folder, folders, names in os.walk(path):
        folders.sort()
        yield from (Path(folder) / name for name in sorted(names))


def _libraries() -> Iterator[str]:
    yield f"Python {platform.python_version()}"
    for name in LIBRARIES:
        try:
            yield f"{name} {importlib.metadata.version(name)}"
        except importlib.metadata.PackageNotFoundError:
            yield f"{name} (unknown version)"  # installed by a packager under another name
