"""From attenuation to pixel values: plain attenuation with white noise, or a camera's raw intensities."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.simulation.config import CameraConfig

Array = NDArray[np.float64]
Image = NDArray[Any]

BRIGHTNESS = 0.8
"""Brightness of the empty field's centre as a share of the full well, so that flicker doesn't saturate."""

_HEADROOM = 1.1
"""Highest attenuation that integers hold, in peaks: the peak is an estimate from some frames."""
_PEDESTAL = 5.0
"""Value of zero attenuation in noisy integers, in standard deviations, so that no noise is cut off at 0."""


class Sensor(ABC):
    """Turns attenuation into pixel values; the random numbers of a frame come from the caller."""

    @property
    @abstractmethod
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels."""

    @property
    @abstractmethod
    def bits(self) -> int:
        """Significant bits of a pixel."""

    @abstractmethod
    def record(self, attenuation: Array, rng: np.random.Generator) -> Image:
        """Return the ``(H, W)`` frame that shows the ``(H, W)`` attenuation J."""


@dataclass(frozen=True)
class Attenuation(Sensor):
    """J itself plus white Gaussian noise; integers hold `scale` · J + `pedestal`, rounded.

    Attributes
    ----------
    config:
        Its `dtype` and `noise`.
    peak:
        Peak of the attenuation.
    """

    config: CameraConfig
    peak: float

    @property
    def dtype(self) -> np.dtype[Any]:
        """As configured."""
        return np.dtype(self.config.dtype)

    @property
    def bits(self) -> int:
        """All of the type."""
        return 8 * self.dtype.itemsize

    @property
    def sigma(self) -> float:
        """Standard deviation of the noise, in the unit of J."""
        return self.config.noise * self.peak

    @property
    def scale(self) -> float:
        """Pixel value of one unit of J; 1 for floats."""
        if self.dtype.kind == "f":
            return 1.0
        span = _HEADROOM * self.peak + 2 * _PEDESTAL * self.sigma
        return float(np.iinfo(self.dtype).max) / span

    @property
    def pedestal(self) -> float:
        """Pixel value of zero attenuation; not 0 for noisy integers only."""
        return 0.0 if self.dtype.kind == "f" else _PEDESTAL * self.sigma * self.scale

    def record(self, attenuation: Array, rng: np.random.Generator) -> Image:
        """Return J with its noise in the type of the file."""
        values = attenuation
        if self.config.noise:
            values = values + self.sigma * rng.standard_normal(values.shape)
        if self.dtype.kind == "f":
            return values.astype(self.dtype)
        return _rounded(values * self.scale + self.pedestal, np.iinfo(self.dtype).max, self.dtype)


@dataclass(frozen=True)
class Camera(Sensor):
    """Raw intensities I₀(x) f(t) exp(−s J) with shot noise, read noise and a finite number of bits.

    Attributes
    ----------
    config:
        The camera.
    peak:
        Peak of the attenuation, which `optical_depth` refers to.
    shape:
        ``(H, W)``.
    seed:
        Of the static specks.
    """

    config: CameraConfig
    peak: float
    shape: tuple[int, int]
    seed: np.random.SeedSequence

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 or, for 12 and 16 bits, uint16."""
        return np.dtype(np.uint8 if self.config.bits == 8 else np.uint16)

    @property
    def bits(self) -> int:
        """As configured."""
        return self.config.bits

    @property
    def highest(self) -> int:
        """Highest pixel value."""
        return (1 << self.config.bits) - 1

    @cached_property
    def flat_field(self) -> Array:
        """``(H, W)`` illumination I₀ [electrons], darker in the corners and under specks."""
        height, width = self.shape
        row = np.arange(height)[:, None] - height // 2
        column = np.arange(width)[None, :] - width // 2
        corner = (height // 2) ** 2 + (width // 2) ** 2
        light = 1.0 - self.config.vignetting * (row**2 + column**2) / corner
        rng = np.random.default_rng(self.seed)
        for _ in range(self.config.dust):
            at_row, at_column = rng.uniform(0, height), rng.uniform(0, width)
            size, depth = rng.uniform(0.8, 2.5), rng.uniform(0.1, 0.6)
            square = (row + height // 2 - at_row) ** 2 + (column + width // 2 - at_column) ** 2
            light *= 1.0 - depth * np.exp(-square / (2 * size**2))
        return BRIGHTNESS * self.config.full_well * light

    def record(self, attenuation: Array, rng: np.random.Generator) -> Image:
        """Return the frame in pixel values."""
        config = self.config
        flicker = max(0.0, 1.0 + config.flicker * rng.standard_normal())
        light = np.exp(-config.optical_depth / self.peak * attenuation)
        light *= flicker * self.flat_field
        electrons = rng.poisson(light) + config.read_noise * rng.standard_normal(self.shape)
        dark = config.offset * self.highest
        return _rounded(
            dark + electrons * ((self.highest - dark) / config.full_well), self.highest, self.dtype
        )


def _rounded(values: Array, highest: int, dtype: np.dtype[Any]) -> Image:
    return np.clip(np.rint(values), 0, highest).astype(dtype)
