"""The frames of a result, read again as its own configuration tells."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Sequence

import numpy as np

from trapcli.config import EstimateConfig, from_dict
from trapcli.errors import InputError
from trapcli.report.figures import Projection
from trapcli.result.motion import Motion
from trapcli.stack import open_stack
from trapcli.stack.frames import Frames

_STORED = "configuration in the result"


def read_projections(stack: str, motion: Motion, numbers: Sequence[int]) -> list[Projection]:
    """Read single frames of a stack, for `trapcli.report.figures`.

    Parameters
    ----------
    numbers:
        Their numbers in the input.

    Raises
    ------
    InputError
        Where one can't be read.
    """
    config = configuration(motion).input
    projections = []
    for frame in dict.fromkeys(numbers):
        try:
            frames = open_stack(stack, dataclasses.replace(config, frames=f"{frame}:{frame + 1}"))
        except InputError as error:
            raise InputError(f"frame {frame} can't be shown: {error}") from None
        projections.append(Projection(int(frame), frames.to_array()[0], pixel_size(frames, motion)))
    return projections


def open_again(stack: str, motion: Motion) -> tuple[Frames, EstimateConfig]:
    """Open all frames of a result, with the configuration it was made with.

    Raises
    ------
    InputError
        Where they can't be read, or are others than those of the result.
    """
    config = configuration(motion)
    frames = open_stack(stack, config.input)
    if not np.array_equal(frames.index, motion.frame):
        raise InputError(
            f"{stack}: gives {len(frames)} frames, the result is of {len(motion)}; "
            "give the stack that was estimated"
        )
    return frames, config


def configuration(motion: Motion) -> EstimateConfig:
    """Return the configuration that is stored in a result.

    Raises
    ------
    ConfigError
        Where it holds what this version doesn't know.
    InputError
        Where it is no TOML.
    """
    try:
        stored = tomllib.loads(motion.provenance.get("configuration", ""))
    except (ValueError, RecursionError):
        raise InputError(f"{_STORED}: can't be read") from None
    return from_dict(EstimateConfig, stored, _STORED)


def choose(motion: Motion, count: int) -> list[int]:
    """Return evenly spread positions among the frames of a result."""
    chosen = np.linspace(0, len(motion) - 1, count).round().astype(int)
    return list(dict.fromkeys(chosen.tolist()))


def pixel_size(frames: Frames, motion: Motion) -> float | None:
    """Return the edge of a pixel in the length unit of the result; None where it isn't known."""
    return 1.0 if motion.length_unit == "pixel" else frames.info.pixel_size
