"""Pixel values and the logarithm of the light they stand for."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.config import InputConfig, PreprocessConfig
from trapcli.errors import ConfigError, InputError
from trapcli.stack.frames import Frames
from trapcli.stack.opening import open_stack

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_SAMPLED = 96  # frames that a background is made of
_SAMPLED_BYTES = 128 << 20  # that they may take as they are stored
_PAIRS = 16  # frames that are looked at with the next one
_FEWEST = 16
_BAND_BYTES = 16 << 20  # of logarithms of all frames at a time


@dataclass(frozen=True)
class LogLight:
    """Logarithm of the light in one frame.

    Attributes
    ----------
    values:
        ``(H, W)``; half a step where there is no light.
    dark, bright:
        ``(H, W)`` pixels without light, and those as bright as a pixel can be; None where there are none.
    """

    values: NDArray[Any]
    dark: Bools | None
    bright: Bools | None

    @property
    def dark_share(self) -> float:
        """Share of the pixels."""
        return share(self.dark)

    @property
    def bright_share(self) -> float:
        """Share of the pixels."""
        return share(self.bright)


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

    dark: float | NDArray[Any]
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
        dark = _dark_level(frames, config, roi)
        if isinstance(dark, np.ndarray) and frames.dtype != np.float64:
            dark = dark.astype(np.float32)
        return cls(dark, highest)

    def log_light(self, image: NDArray[Any], out: NDArray[Any]) -> LogLight:
        """Write log(image − dark) to `out`, in its precision, and tell what it is worth."""
        counted = image.dtype.kind in "iub"
        with np.errstate(over="ignore"):  # what single precision can't hold is no light
            if isinstance(self.dark, np.ndarray) or self.dark:
                np.subtract(image, self.dark, out=out, dtype=out.dtype)
            else:
                np.copyto(out, image, casting="same_kind")
        bright = image >= self.highest if counted and image.max() >= self.highest else None
        dark = None
        if not (out.min() > 0 and (counted or out.max() < math.inf)):
            dark = np.asarray(out <= 0) if counted else ~(np.isfinite(out) & (out > 0))
            out[dark] = 0.5 if counted else _half_the_smallest(out[~dark])
        np.log(out, out=out)
        return LogLight(out, dark, bright)

    def logs(self, image: NDArray[Any], *, keep_bright: bool) -> NDArray[np.float32]:
        """Return log(image − dark), NaN in pixels without light and, unless kept, in bright ones."""
        light = self.log_light(image, np.empty(image.shape, np.float32))
        for mask in (light.dark, None if keep_bright else light.bright):
            if mask is not None:
                light.values[mask] = np.nan
        return light.values

    def sample(self, frames: Frames, most_flagged: float, most: int = _SAMPLED) -> Sample:
        """Look at frames spread over the stack, and whether the next ones are the same.

        Parameters
        ----------
        most_flagged:
            Share of pixels without light beyond which a frame is left out, and of bright ones beyond which
            it is overexposed and left out unless most frames are.
        most:
            Frames at most.
        """
        frame_bytes = frames.shape[1] * frames.shape[2] * frames.dtype.itemsize
        count = min(most, max(_FEWEST, _SAMPLED_BYTES // frame_bytes), len(frames))
        wanted = np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))
        followed = wanted[:: max(1, len(wanted) // _PAIRS)] + 1
        followed = followed[followed < len(frames)]
        images = np.empty((len(wanted), *frames.shape[1:]), frames.dtype)
        bright: list[float] = []
        repeats: list[bool] = []
        before, logs = np.empty(0), np.empty(frames.shape[1:], np.float32)
        both = np.union1d(wanted, followed)
        for position, image in zip(both, frames.pick(both), strict=True):
            if position in followed:
                repeats.append(np.array_equal(image, before))
            if position in wanted:
                before = images[len(bright)]
                before[:] = image
                light = self.log_light(image, logs)
                if light.dark_share <= most_flagged:
                    bright.append(light.bright_share)
        if not bright:
            raise InputError(
                f"{frames.info.source}: all frames are dark; give --attenuation if they are no raw images"
            )
        spoilt = np.array(bright) > most_flagged
        overexposed, repeated = float(spoilt.mean()), float(np.mean(repeats or [False]))
        images = images[: len(bright)]
        if overexposed <= 0.5 and spoilt.any():
            images = images[~spoilt]
        return Sample(self, images, overexposed, repeated)


@dataclass(frozen=True)
class Sample:
    """Frames spread over the stack.

    Attributes
    ----------
    counts:
        What their values mean.
    images:
        ``(K, H, W)`` pixel values, K ≤ 96, without dark frames, and without overexposed ones unless most are.
    overexposed:
        Share of the frames.
    repeated:
        Share of the frames that are the same, pixel by pixel, as the one before.
    """

    counts: Counts
    images: NDArray[Any]
    overexposed: float = 0.0
    repeated: float = 0.0

    @property
    def keep_bright(self) -> bool:
        """Whether most frames are overexposed, so that bright pixels tell something too."""
        return self.overexposed > 0.5

    def logs(self) -> Iterator[NDArray[np.float32]]:
        """Yield the ``(H, W)`` logarithms of the light; NaN in pixels that tell nothing."""
        return (self.counts.logs(image, keep_bright=self.keep_bright) for image in self.images)

    def bands(self) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        """Yield some rows and their ``(K, h, W)`` logarithms in all frames."""
        height = max(1, _BAND_BYTES // (4 * self.images[:, 0].size))
        for top in range(0, self.images.shape[1], height):
            rows = slice(top, top + height)
            dark = self.counts.dark[rows] if isinstance(self.counts.dark, np.ndarray) else self.counts.dark
            part = replace(self, counts=replace(self.counts, dark=dark), images=self.images[:, rows])
            yield rows, np.array(list(part.logs()))


def mean_image(frames: Frames, path: str, roi: tuple[int, ...], name: str) -> Array:
    """Return the mean of a file's frames, which must be as large as `frames`."""
    empty = open_stack(path, InputConfig(roi=roi))
    if empty.shape[1:] != frames.shape[1:]:
        size, wanted = ("{} x {}".format(*f.shape[1:]) for f in (empty, frames))
        raise InputError(f"{path}: the {name} is {size} pixels but the frames are {wanted}")
    total = np.zeros(empty.shape[1:])
    for block in empty.blocks():
        for image in block:
            total += image
    return total / len(empty)


def share(mask: Bools | None) -> float:
    """Return the share of the pixels in which a mask is true; without a mask, in none."""
    return 0.0 if mask is None else np.count_nonzero(mask) / mask.size


def _dark_level(frames: Frames, config: PreprocessConfig, roi: tuple[int, ...]) -> float | NDArray[Any]:
    level = config.dark_level
    if level is None:
        return mean_image(frames, config.dark, roi, "dark frame")
    if not (math.isfinite(level) and level >= 0):
        raise ConfigError(f"--dark {config.dark}: must be a pixel value of at least 0, or a file")
    return level


def _half_the_smallest(light: NDArray[Any]) -> float:
    """Return half the smallest light of floats, and no less than has a logarithm."""
    return max(float(light.min()) / 2, float(np.finfo(light.dtype).tiny)) if light.size else 1.0
