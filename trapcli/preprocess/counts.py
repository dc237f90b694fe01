"""Pixel values and the logarithm of the light they stand for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.config import InputConfig, PreprocessConfig
from trapcli.errors import ConfigError, InputError
from trapcli.stack.frames import Frames
from trapcli.stack.opening import open_stack

Array = NDArray[np.float64]

_SAMPLED = 96  # frames that a background is made of
_SAMPLED_BYTES = 128 << 20  # that they may take in single precision
_PAIRS = 16  # of them that are looked at with the next one
_FEWEST = 16


@dataclass(frozen=True)
class LogLight:
    """Logarithm of the light in one frame.

    Attributes
    ----------
    values:
        ``(H, W)``; half a step where there is no light.
    dark, bright:
        ``(H, W)`` pixels without light, and those as bright as a pixel can be.
    """

    values: NDArray[Any]
    dark: NDArray[np.bool_]
    bright: NDArray[np.bool_]


@dataclass(frozen=True)
class Sample:
    """Frames spread over the stack.

    Attributes
    ----------
    logs:
        ``(K, H, W)`` logarithms of the light, K ≤ 112; NaN in pixels without light, and in bright ones unless
        most frames are overexposed.
    overexposed:
        Share of the frames.
    repeated:
        Share of the frames that are the same, pixel by pixel, as the one before.
    """

    logs: NDArray[np.float32]
    overexposed: float
    repeated: float


@dataclass(frozen=True)
class Counts:
    """What the pixel values of a stack mean.

    Attributes
    ----------
    dark:
        Pixel value without light; a number or ``(H, W)``.
    highest:
        Pixel value that no light exceeds; infinite for floats.
    """

    dark: float | Array
    highest: float

    @classmethod
    def of(cls, frames: Frames, config: PreprocessConfig, roi: tuple[int, ...]) -> Counts:
        """Read the dark level, a number or a file of dark frames; take the highest value from type and bits.

        Raises
        ------
        ConfigError
            For a dark level that is not a finite number of at least 0.
        InputError
            Where the dark frames can't be read or don't fit.
        """
        highest = math.inf
        if frames.dtype.kind in "iu":
            highest = float(np.iinfo(frames.dtype.str).max)
            if frames.info.bits:
                highest = min(highest, float(2**frames.info.bits - 1))
        return cls(_dark_level(frames, config, roi), highest)

    def log_light(self, image: NDArray[Any], dtype: np.dtype[Any]) -> LogLight:
        """Return log(image − dark)."""
        light = np.asarray(image, dtype=dtype) - np.asarray(self.dark, dtype=dtype)
        bright = np.asarray(image >= self.highest)
        if light.min() > 0 and light.max() < math.inf:
            return LogLight(np.log(light, out=light), np.zeros(light.shape, bool), bright)
        step = 0.5 if image.dtype.kind in "iub" else _smallest(image - self.dark)
        lit = np.isfinite(light) & (light > 0)
        return LogLight(np.log(np.where(lit, light, dtype.type(step))), ~lit, bright)

    def sample(self, frames: Frames, most_flagged: float) -> Sample:
        """Look at frames spread over the stack, some of them neighbours.

        Parameters
        ----------
        most_flagged:
            Share of pixels without light beyond which a frame is left out, and of bright ones beyond which
            it is overexposed and left out unless most frames are.
        """
        count = min(_SAMPLED, max(_FEWEST, _SAMPLED_BYTES // (4 * frames.shape[1] * frames.shape[2])))
        wanted = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int))
        followed = wanted[:: max(1, len(wanted) // _PAIRS)] + 1
        wanted = np.union1d(wanted, followed[followed < len(frames)])
        logs = np.empty((len(wanted), *frames.shape[1:]), np.float32)
        bright: list[NDArray[np.bool_]] = []
        repeats: list[bool] = []
        before, last = np.empty(0), -2
        for position, image in zip(wanted, frames.pick(wanted), strict=True):
            if position == last + 1:
                repeats.append(np.array_equal(image, before))
            before, last = np.array(image), position
            light = self.log_light(image, np.dtype(np.float32))
            if light.dark.mean() <= most_flagged:
                light.values[light.dark] = np.nan
                logs[len(bright)] = light.values
                bright.append(light.bright)
        if not bright:
            raise InputError(
                f"{frames.info.source}: all frames are dark; give --attenuation if they are no raw images"
            )
        spoilt = np.mean(bright, axis=(1, 2)) > most_flagged
        overexposed, repeated = float(spoilt.mean()), float(np.mean(repeats or [False]))
        logs = logs[: len(bright)]
        if overexposed <= 0.5:
            for image, mask in zip(logs, bright, strict=True):
                image[mask] = np.nan
            logs = logs[~spoilt] if spoilt.any() else logs
        return Sample(logs, overexposed, repeated)


def mean_image(frames: Frames, path: str, roi: tuple[int, ...], name: str) -> Array:
    """Return the mean of a file's frames, which must be as large as `frames`."""
    empty = open_stack(path, InputConfig(roi=roi))
    if empty.shape[1:] != frames.shape[1:]:
        size, wanted = ("{} x {}".format(*f.shape[1:]) for f in (empty, frames))
        raise InputError(f"{path}: the {name} is {size} pixels but the frames are {wanted}")
    total = np.zeros(empty.shape[1:])
    for block in empty.blocks():
        total += block.sum(axis=0, dtype=float)
    return total / len(empty)


def _dark_level(frames: Frames, config: PreprocessConfig, roi: tuple[int, ...]) -> float | Array:
    level = config.dark_level
    if level is None:
        return mean_image(frames, config.dark, roi, "dark frame")
    if not (math.isfinite(level) and level >= 0):
        raise ConfigError(f"--dark {config.dark}: must be a pixel value of at least 0, or a file")
    return level


def _smallest(light: NDArray[Any]) -> float:
    """Return half the smallest light of floats."""
    positive = light[np.isfinite(light) & (light > 0)]
    return float(positive.min()) / 2 if positive.size else 1.0
