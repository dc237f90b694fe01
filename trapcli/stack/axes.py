"""Which axis of a stack is time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from trapcli.errors import ConfigError, InputError

_NAMES = {"T": "times", "Z": "slices", "C": "channels", "P": "positions", "I": "pages", "Q": "pages"}
_NO_DOUBT = frozenset("TIQ")


def frame_planes(
    name: str, axes: str, sizes: tuple[int, ...], *, time_axis: str = "", channel: int | None = None
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Find the planes of each frame and channel in a stack of planes with several axes.

    Time is what `time_axis` says, else T, else the only axis there is.

    Parameters
    ----------
    axes, sizes:
        Letter and length of each axis of the planes, slowest first.
    time_axis:
        Empty, a letter of `axes`, or several: all their planes in stored order.
    channel:
        The channel that was asked for: without one, channels alone could be times.

    Returns
    -------
    ((N, C) ndarray, tuple of str)
        Positions of the planes of frame n and channel c, and warnings.

    Raises
    ------
    ConfigError
        Where `time_axis` is no axis of this stack.
    InputError
        Where more than one axis could be time.
    """
    count = math.prod(sizes)
    long = [(axis, size) for axis, size in zip(axes, sizes, strict=True) if size > 1]
    letters = "".join(axis for axis, _ in long)
    time = time_axis.upper()
    if not set(time) <= set(axes):
        raise ConfigError(f"--time-axis {time_axis}: {name} has {_in_words(long)}, and no such axis")
    warnings: tuple[str, ...] = ()
    if not time:
        time = _obvious_time(name, long, channel)
        if time and time not in _NO_DOUBT:
            warnings = (f"its {_NAMES.get(time, f'axis {time}')} are taken as times",)
    others = [axis for axis in letters if axis not in time and axis != "C"]
    if others:
        raise InputError(
            f"{name}: has {_in_words(long)}; save the wanted one of its axes {', '.join(others)} alone, "
            f"or read all in stored order with --time-axis {letters.replace('C', '')}"
        )
    grid = np.arange(count).reshape([size for _, size in long])
    where = [position for position, axis in enumerate(letters) if axis in time]
    grid = np.moveaxis(grid, where, range(len(where)))
    frames = math.prod(grid.shape[: len(where)])
    return grid.reshape(frames, -1), warnings


def _obvious_time(name: str, long: list[tuple[str, int]], channel: int | None) -> str:
    letters = "".join(axis for axis, _ in long)
    if "T" in letters:
        return "T"
    if letters == "C" and channel is None:
        raise InputError(
            f"{name}: has {_in_words(long)} and one time; choose one with --channel, "
            "or read them as times with --time-axis C"
        )
    candidates = letters.replace("C", "")
    if len(candidates) > 1:
        raise InputError(
            f"{name}: has {_in_words(long)}; say which axis is time with --time-axis {candidates[0]}, "
            f"or read all in stored order with --time-axis {candidates}"
        )
    return candidates


def _in_words(long: list[tuple[str, int]]) -> str:
    words = [f"{size} {_NAMES[axis]}" if axis in _NAMES else f"axis {axis} of {size}" for axis, size in long]
    return ", ".join(words) or "a single frame"
