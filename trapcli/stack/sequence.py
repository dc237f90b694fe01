"""Stacks in several files: a folder or a pattern, in the order of their numbers."""

from __future__ import annotations

import dataclasses
import glob
import itertools
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.config import InputConfig
from trapcli.errors import InputError
from trapcli.stack.source import Source, guard

OpenFile = Callable[[Path, str, InputConfig], Source]


def is_pattern(path: Path) -> bool:
    """Whether `path` is a pattern such as ``img_*.tif`` rather than the name of a file."""
    return glob.has_magic(str(path)) and not os.path.lexists(path)


def matching(path: Path) -> list[Path]:
    """Return the files that match a pattern, in natural order."""
    return sorted(map(Path, glob.glob(str(path))), key=_natural)


def in_folder(path: Path) -> list[Path]:
    """Return the TIFF files of a folder, in natural order; hidden ones aren't meant."""
    with guard(str(path)):
        files = [file for file in path.iterdir() if file.suffix.lower() in (".tif", ".tiff")]
    return sorted((file for file in files if not file.name.startswith(".")), key=_natural)


def open_sequence(files: list[Path], name: str, config: InputConfig, open_file: OpenFile) -> Source:
    """Join the frames of `files`, each opened by `open_file`.

    Raises
    ------
    InputError
        Where there is no file, one can't be read, or they differ in the size or type of their frames.
    """
    if not files:
        raise InputError(f"{name}: no TIFF files there")
    whole = dataclasses.replace(config, allow_partial=False)
    sources = [open_file(file, str(file), whole) for file in files[:-1]]
    sources.append(open_file(files[-1], str(files[-1]), config))
    first = sources[0]
    for source in sources:
        if _kind(source) != _kind(first):
            raise InputError(f"{source.name}: has {_words(source)} where {first.name} has {_words(first)}")
    counts = [source.shape[0] for source in sources]
    ends = np.cumsum(counts)

    def read(index: NDArray[np.int64], channel: int | None) -> Iterator[NDArray[Any]]:
        which = np.searchsorted(ends, index, side="right")
        for position in np.unique(which):
            within = index[which == position] - (ends[position] - counts[position])
            yield from sources[position].read(within, channel)

    warnings = dict.fromkeys(warning for source in sources for warning in source.info.warnings)
    info = dataclasses.replace(
        first.info,
        source=f"{name} ({len(files)} files)",
        format=f"{first.info.format}, {len(files)} files",
        warnings=(*_gaps(files), *warnings),
        files=tuple(file for source in sources for file in source.info.files),
    )
    return Source(name, (int(ends[-1]), *first.shape[1:]), first.dtype, first.channels, info, read)


def _kind(source: Source) -> tuple[Any, ...]:
    return (*source.shape[1:], source.channels, source.dtype)


def _words(source: Source) -> str:
    colours = f", {source.channels} channels" if source.channels > 1 else ""
    return f"{source.shape[1]} x {source.shape[2]} {source.dtype}{colours}"


def _natural(path: Path) -> list[tuple[str, int, str]]:
    """Sort key: img_2 before img_10."""
    parts = re.findall(r"(\D*)(\d*)", str(path))
    return [(text, int(digits[:4000] or -1), digits) for text, digits in parts]


def _gaps(files: list[Path]) -> tuple[str, ...]:
    """Say where the numbering has a hole: frames are missing there, and times after it are wrong."""
    matches = [re.fullmatch(r"(.*?)(\d{1,18})(\D*)", file.name, re.ASCII | re.DOTALL) for file in files]
    if len(files) < 3 or any(match is None for match in matches):
        return ()
    if len({(match[1], match[3]) for match in matches if match}) > 1:
        return ()
    numbers = [int(match[2]) for match in matches if match]
    steps = [after - before for before, after in itertools.pairwise(numbers)]
    for before, step in zip(numbers, steps, strict=False):
        if step != min(steps):
            return (f"its numbers jump from {before} to {before + step}: frames are missing there",)
    return ()
