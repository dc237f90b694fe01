"""One function that opens whatever a user points at."""

from __future__ import annotations

import os
import shutil
import stat
import sys
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.config import InputConfig
from trapcli.errors import InputError
from trapcli.stack import sequence
from trapcli.stack.frames import Frames
from trapcli.stack.source import Source, guard, select

_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_HDF5 = b"\x89HDF\r\n\x1a\n"
_MATROSKA = b"\x1a\x45\xdf\xa3"
_MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
_OTHERS = {
    b"\x89PNG": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
    b"GIF8": "a GIF",
    b"ZISRAWFILE": "a CZI file",
    b"\xda\xce\xbe\x0a": "an ND2 file",
    b"\x93NUMPY": "a NumPy array",
    b"PK\x03\x04": "a ZIP archive",
    b"\x1f\x8b": "a gzip archive",
    b"%PDF": "a PDF document",
}


def open_stack(text: str, config: InputConfig | None = None) -> Frames:
    """Open a video stack: a TIFF, a video, a dataset, a numbered sequence of TIFFs, or standard input.

    Parameters
    ----------
    text:
        Path of a file; a folder or a pattern such as ``frames/img_*.tif``; ``file.h5::/path`` for a dataset;
        or ``-`` for a TIFF on standard input.
    config:
        Which frames, region and channel, and what a frame interval and a pixel are.

    Returns
    -------
    Frames
        Read block by block; the file stays closed between passes.

    Raises
    ------
    ConfigError
        For options that make no sense.
    InputError
        For anything that can't be read in full.
    """
    config = config or InputConfig()
    if text == "-":
        return select(_Spool(config).source(), config)
    return select(_open_source(text, config), config)


def _open_source(text: str, config: InputConfig) -> Source:
    path = Path(text)
    if "::" in text and not os.path.exists(text):
        file, _, dataset = text.rpartition("::")
        return _open_source(file, replace(config, dataset=dataset))
    if sequence.is_pattern(path):
        return sequence.open_sequence(sequence.matching(path), text, config, _open_file)
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{text}: can't be read ({reason})") from None
    if stat.S_ISDIR(mode):
        return _open_folder(path, text, config)
    if not stat.S_ISREG(mode):
        raise InputError(f"{text}: is no regular file; give - to read a TIFF from a pipe on standard input")
    return _open_file(path, text, config)


def _open_folder(path: Path, name: str, config: InputConfig) -> Source:
    from trapcli.stack import dataset

    if dataset.is_zarr(path):
        source = dataset.open_zarr(path, name, config)
        return replace(source, info=replace(source.info, files=(path,)))
    return sequence.open_sequence(sequence.in_folder(path), name, config, _open_file)


def _open_file(path: Path, name: str, config: InputConfig) -> Source:
    """Open a file by what is in it; its ending says nothing."""
    if not path.is_file():
        raise InputError(f"{name}: is no regular file")
    # passes to come may find another working folder
    source = _open_content(path.absolute(), name, config)
    return replace(source, info=replace(source.info, files=(path, *source.info.files)))


def _open_content(path: Path, name: str, config: InputConfig) -> Source:
    with guard(name), path.open("rb") as file:
        start = file.read(16)
    if not start:
        raise InputError(f"{name}: is empty")
    if start.startswith(_TIFF):
        from trapcli.stack.tiff import open_tiff

        return open_tiff(path, name, config)
    if start.startswith(_HDF5):
        from trapcli.stack.dataset import open_hdf5

        return open_hdf5(path, name, config)
    if (
        (start[:4], start[8:12]) == (b"RIFF", b"AVI ")
        or start[4:8] in _MP4_BOXES
        or start.startswith(_MATROSKA)
    ):
        from trapcli.stack.video import open_video

        return open_video(path, name, config)
    kind = next((words for magic, words in _OTHERS.items() if start.startswith(magic)), "of no known kind")
    raise InputError(f"{name}: is {kind}; a TIFF, AVI, MP4, MOV, MKV or HDF5 file is needed")


class _Spool:
    """A TIFF on standard input, copied to a temporary file that goes with the last reference to this."""

    name = "standard input"

    def __init__(self, config: InputConfig) -> None:
        with guard(self.name):
            if sys.stdin is None or sys.stdin.closed or sys.stdin.isatty():
                raise InputError("standard input: nothing is redirected to it")
            descriptor, path = tempfile.mkstemp(prefix="trap-motion-", suffix=".tif")
            weakref.finalize(self, os.unlink, path)
            with os.fdopen(descriptor, "wb") as file:
                shutil.copyfileobj(sys.stdin.buffer, file)
        self._source = _open_file(Path(path), self.name, config)

    def source(self) -> Source:
        return replace(self._source, read=self._read)

    def _read(self, index: NDArray[np.int64], channel: int | None) -> Iterator[NDArray[Any]]:
        yield from self._source.read(index, channel)
