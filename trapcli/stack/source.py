"""What a file has to offer (`Source`), and the selection from it that the program works on (`Frames`)."""

from __future__ import annotations

import logging
import math
import re
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.config import InputConfig
from trapcli.errors import ConfigError, InputError, TrapError
from trapcli.stack.frames import Frames, StackInfo

MAX_FRAME_BYTES = 1 << 30
"""Largest frame that is read: a file of some kilobytes can declare one of terabytes."""

MAX_FRAMES = 4_000_000
"""Most frames of an input: a file of some kilobytes can declare billions."""

# ITU-R BT.601, with which codecs separate brightness from colour: errors of the latter cancel
_LUMA = np.array([0.299, 0.587, 0.114])

PARTIAL_HINT = "copy or save it again, or use what can be read of it with --allow-partial"


@dataclass(frozen=True)
class Source:
    """All N frames of an input, before selection.

    Attributes
    ----------
    name:
        The input as the user wrote it.
    shape:
        ``(N, H, W)``.
    dtype:
        Type of the pixels, native byte order.
    channels:
        Colours or channels of a pixel; 1 for grey values.
    read:
        ``read(index, channel)`` yields the frames at the ascending positions `index`: ``(H, W)`` of one
        channel, or ``(H, W, channels)`` where `channel` is None and there are several. The next frame may
        overwrite it.
    colour_tolerance:
        Colours that differ by no more than this many counts are grey: lossy codecs store grey with errors.
    """

    name: str
    shape: tuple[int, int, int]
    dtype: np.dtype[Any]
    channels: int
    info: StackInfo
    read: Callable[[NDArray[np.int64], int | None], Iterator[NDArray[Any]]]
    colour_tolerance: int = 0

    def __post_init__(self) -> None:
        if self.dtype.kind not in "biuf":
            raise InputError(f"{self.name}: holds {self.dtype} pixels; integers or real numbers are needed")
        if min(self.shape[1:]) < 1:
            raise InputError(f"{self.name}: its frames have {self.shape[1]} x {self.shape[2]} pixels")
        if self.shape[0] < 1:
            raise InputError(f"{self.name}: has no frames")
        check_frame_count(self.name, self.shape[0])
        frame_bytes = self.shape[1] * self.shape[2] * self.channels * self.dtype.itemsize
        check_frame_bytes(self.name, frame_bytes)


def check_frame_bytes(name: str, size: int) -> None:
    """Refuse a frame that is too large to be one."""
    if size > MAX_FRAME_BYTES:
        raise InputError(
            f"{name}: declares frames of {size / 2**30:.3g} GiB; the limit is {MAX_FRAME_BYTES >> 30} GiB; "
            "it is damaged, or no video of a particle"
        )


def check_frame_count(name: str, count: int) -> None:
    """Refuse a number of frames that is too large to be true."""
    if count > MAX_FRAMES:
        raise InputError(f"{name}: declares {count} frames; the limit is {MAX_FRAMES}, or it is damaged")


def select(source: Source, config: InputConfig) -> Frames:
    """Apply the options of `config`: frames, region, channel, and calibration.

    Raises
    ------
    ConfigError
        For options that make no sense for any input.
    InputError
        Where nothing is selected, the region leaves the frame, the colours differ, or no frame can be read.
    """
    index = np.arange(source.shape[0])[_frame_slice(config.frames)]
    if not len(index):
        raise InputError(
            f"{source.name}: --frames {config.frames} selects none of its {source.shape[0]} frames"
        )
    rows, columns = _region(source, config.roi)
    channel = _channel(source, config.channel)

    def read(wanted: NDArray[np.int64]) -> Generator[NDArray[Any]]:
        frames = source.read(wanted, channel)
        for position in wanted:
            with guard(source.name):
                frame = next(frames, None)
            if frame is None:
                raise InputError(f"{source.name}: frame {position} can't be read; {PARTIAL_HINT}")
            yield _grey(source, frame[rows, columns])

    def read_blocks(size: int) -> Generator[NDArray[Any]]:
        frames = read(index)
        for start in range(0, len(index), size):
            shape = (min(size, len(index) - start), rows.stop - rows.start, columns.stop - columns.start)
            block = np.empty(shape, source.dtype)
            for row, frame in zip(block, frames, strict=False):
                row[...] = frame
            yield block

    def read_some(positions: NDArray[np.integer[Any]]) -> Iterator[NDArray[Any]]:
        return (frame.copy() for frame in read(index[positions]))

    # an unreadable codec or unequal colours are found here rather than halfway through
    with closing(read_blocks(1)) as first:
        next(first)
    shape = (len(index), rows.stop - rows.start, columns.stop - columns.start)
    return Frames(shape, source.dtype, index, calibrated(source.info, config), read_blocks, read_some)


def _frame_slice(text: str) -> slice:
    if not text:
        return slice(None)
    match = re.fullmatch(r"\s*(-?\d{1,18})?\s*:\s*(-?\d{1,18})?\s*(?::\s*(\d{1,18})?\s*)?", text, re.ASCII)
    if not match:
        raise ConfigError(f"--frames {text}: must be START:STOP or START:STOP:STEP, for example 0:500 or ::2")
    start, stop, step = (None if part is None else int(part) for part in match.groups())
    if step == 0:
        raise ConfigError(f"--frames {text}: the step must be at least 1")
    return slice(start, stop, step)


def _region(source: Source, roi: tuple[int, ...]) -> tuple[slice, slice]:
    _, height, width = source.shape
    if not roi:
        return slice(0, height), slice(0, width)
    text = ",".join(map(str, roi))
    if len(roi) != 4 or min(roi) < 0 or roi[0] >= roi[1] or roi[2] >= roi[3]:
        raise ConfigError(f"--roi {text}: must be TOP,BOTTOM,LEFT,RIGHT with TOP < BOTTOM and LEFT < RIGHT")
    top, bottom, left, right = roi
    if bottom > height or right > width:
        raise InputError(
            f"{source.name}: --roi {text} leaves the frames of {height} rows and {width} columns"
        )
    return slice(top, bottom), slice(left, right)


def _channel(source: Source, channel: int | None) -> int | None:
    if channel is None:
        return None
    if channel < 0:
        raise ConfigError(f"--channel {channel}: channels are counted from 0")
    if channel >= source.channels:
        raise InputError(f"{source.name}: has no channel {channel}; its {source.channels} are counted from 0")
    return channel if source.channels > 1 else None


def _grey(source: Source, frame: NDArray[Any]) -> NDArray[Any]:
    if frame.ndim == 2:
        return frame
    first = frame[..., 0]
    if all(
        np.array_equal(first, frame[..., k], equal_nan=first.dtype.kind == "f")
        for k in range(1, frame.shape[2])
    ):
        return first
    if source.colour_tolerance and np.ptp(frame, axis=2).max() <= source.colour_tolerance:
        luma: NDArray[Any] = np.rint(frame @ _LUMA).astype(frame.dtype)
        return luma
    raise InputError(
        f"{source.name}: its {source.channels} channels differ; "
        f"choose one with --channel 0 to {source.channels - 1}"
    )


def calibrated(info: StackInfo, config: InputConfig) -> StackInfo:
    """Let the frame interval and the pixel size of `config` beat those of the file.

    Raises
    ------
    ConfigError
        Where one isn't positive, or a size is given without its unit.
    InputError
        Where a unit is given and the size isn't known.
    """
    for option, value in (("--frame-interval", config.frame_interval), ("--pixel-size", config.pixel_size)):
        if value is not None and not (0 < value < math.inf):
            raise ConfigError(f"{option} {value}: must be a positive number")
    if config.frame_interval is not None:
        info = replace(info, frame_interval=config.frame_interval, time_unit="s")
    if config.pixel_size is not None:
        if not config.pixel_unit:
            raise ConfigError(f"--pixel-size {config.pixel_size}: needs --pixel-unit too, for example µm")
        return replace(info, pixel_size=config.pixel_size, pixel_unit=config.pixel_unit)
    if config.pixel_unit is not None:
        if info.pixel_size is None:
            raise InputError(
                f"{info.source}: doesn't say how large a pixel is; give --pixel-size with --pixel-unit"
            )
        info = replace(info, pixel_unit=config.pixel_unit)
    return info


class _Messages(logging.Handler):
    """What tifffile logs in this thread."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._thread = threading.get_ident()
        self.errors: list[str] = []
        self.warnings: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread:
            text = re.sub(r"^<[^>]*>\s*", "", record.getMessage())[:200]
            (self.errors if record.levelno >= logging.ERROR else self.warnings).append(text)


@contextmanager
def guard(name: str, *, strict: bool = True) -> Iterator[_Messages]:
    """Turn whatever the libraries raise, or only log, into an `InputError` that names the input.

    With `strict` False, logged errors are collected and nothing else.
    """
    logger = logging.getLogger("tifffile")
    messages = _Messages()
    logger.addHandler(messages)
    try:
        yield messages
    except TrapError:
        raise
    except MemoryError:
        raise InputError(f"{name}: needs more memory than there is") from None
    except Exception as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        lines = reason.strip().splitlines() or [type(error).__name__]
        raise InputError(f"{name}: can't be read ({lines[0][:200]})") from error
    finally:
        logger.removeHandler(messages)
    if strict and messages.errors:
        raise InputError(f"{name}: damaged ({messages.errors[0]}); {PARTIAL_HINT}")
