"""What ``trap-motion simulate`` renders, and the presets."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from trapcli.errors import ConfigError

PHANTOMS = ("paper", "blobs", "grain", "sphere", "revolution")
MOTIONS = ("paper", "tumbling", "single-axis", "paper-special", "degenerate-third", "still")
OUTPUTS = ("attenuation", "camera")
ATTENUATION_TYPES = ("float32", "float64", "uint16", "uint8")
CAMERA_BITS = (8, 12, 16)


@dataclass(frozen=True)
class StackConfig:
    """Size and sampling of the stack."""

    frames: int = 200
    """Number of frames."""
    height: int = 128
    """Rows of a frame."""
    width: int = 128
    """Columns of a frame."""
    pixel_size: float = 0.2
    """Edge of a pixel in `pixel_unit`."""
    pixel_unit: str = "µm"
    """Unit of all lengths."""
    frame_interval: float = 0.0025
    """Time between frames [s]."""

    def __post_init__(self) -> None:
        _check("stack.frames", self.frames, 1, 10**6)
        _check("stack.height", self.height, 8, 1 << 14)
        _check("stack.width", self.width, 8, 1 << 14)
        _check("stack.pixel_size", self.pixel_size, 1e-12, 1e12)
        _check("stack.frame_interval", self.frame_interval, 1e-12, 1e12)
        if not self.pixel_unit:
            raise ConfigError("stack.pixel_unit: must not be empty")


@dataclass(frozen=True)
class PhantomConfig:
    """The object."""

    kind: str = "paper"
    """``paper``, ``blobs``, ``grain``, ``sphere`` or ``revolution`` (a body of revolution about x1)."""
    radius: float = 0.0
    """Radius of the object [pixel_unit]; 0: 0.7 of half the shorter edge of the image. Not for ``paper``."""
    count: int = 0
    """Number of blobs, or of a grain's inclusions; 0: 12 blobs, 6 on an axis, 4 to 8 inclusions."""
    oversampling: int = 2
    """Points per pixel edge averaged for ``grain`` and ``sphere``, whose edges are sharp."""

    def __post_init__(self) -> None:
        _one_of("phantom.kind", self.kind, PHANTOMS)
        _check("phantom.radius", self.radius, 0.0, 1e12)
        _check("phantom.count", self.count, 0, 1000)
        _check("phantom.oversampling", self.oversampling, 1, 8)


@dataclass(frozen=True)
class MotionConfig:
    """The motion; a parameter that the chosen kind doesn't have is ignored."""

    kind: str = "paper"
    """``paper``, ``tumbling``, ``single-axis``, ``paper-special``, ``degenerate-third`` or ``still``."""
    total_angle: float = 240.0
    """Angle turned in all [degrees] by ``tumbling``, ``paper-special`` and, outside, ``degenerate-third``."""
    turns: float = 1.2
    """Turns about the axis of ``single-axis`` and ``degenerate-third``."""
    azimuth: float = 30.0
    """Angle of that axis in the image, from the columns' towards the rows' direction [degrees]."""
    tilt: float = 0.0
    """Angle of the axis of ``single-axis`` out of the image plane [degrees]."""
    unevenness: float = 0.3
    """Share by which the speed about that axis goes up and down, below 1."""
    drift: float = 0.1
    """Size of the smooth random translation, in radii of the object; ``paper`` has its own."""
    diffusion: float = 0.0
    """Thermal rotation from frame to frame: standard deviation about each axis [degrees]."""
    shaking: float = 0.0
    """Thermal translation, another one in every frame: standard deviation, in radii of the object."""

    def __post_init__(self) -> None:
        _one_of("motion.kind", self.kind, MOTIONS)
        _check("motion.total_angle", self.total_angle, 0.0, 1e6)
        _check("motion.turns", self.turns, -1e4, 1e4)
        _check("motion.azimuth", self.azimuth, -360.0, 360.0)
        _check("motion.tilt", self.tilt, -90.0, 90.0)
        _check("motion.unevenness", self.unevenness, 0.0, 0.99)
        _check("motion.drift", self.drift, 0.0, 100.0)
        _check("motion.diffusion", self.diffusion, 0.0, 180.0)
        _check("motion.shaking", self.shaking, 0.0, 100.0)


@dataclass(frozen=True)
class CameraConfig:
    """From attenuation to pixel values."""

    output: str = "attenuation"
    """``attenuation``: the projections themselves; ``camera``: raw intensities, I₀ · flicker · exp(−s J)."""
    dtype: str = "float32"
    """Type of the pixels for ``attenuation``; integers span its range. Not for ``camera``."""
    noise: float = 0.0
    """Standard deviation of white noise over the peak attenuation. Only for ``attenuation``."""
    bits: int = 12
    """Bits of a pixel of the camera: 8, 12 or 16."""
    optical_depth: float = 0.5
    """s J where the attenuation peaks."""
    full_well: float = 20000.0
    """Electrons of a pixel at the highest pixel value; shot noise is Poisson."""
    read_noise: float = 5.0
    """Standard deviation of the read noise [electrons]."""
    offset: float = 0.01
    """Pixel value without light, as a share of the highest value."""
    vignetting: float = 0.2
    """Share of the light that is missing in the corners."""
    dust: int = 8
    """Number of static dark specks."""
    flicker: float = 0.01
    """Relative standard deviation of the lamp's brightness from frame to frame."""

    def __post_init__(self) -> None:
        _one_of("camera.output", self.output, OUTPUTS)
        _one_of("camera.dtype", self.dtype, ATTENUATION_TYPES)
        _one_of("camera.bits", self.bits, CAMERA_BITS)
        _check("camera.noise", self.noise, 0.0, 100.0)
        _check("camera.optical_depth", self.optical_depth, 1e-6, 20.0)
        _check("camera.full_well", self.full_well, 1.0, 1e9)
        _check("camera.read_noise", self.read_noise, 0.0, 1e6)
        _check("camera.offset", self.offset, 0.0, 0.5)
        _check("camera.vignetting", self.vignetting, 0.0, 1.0)
        _check("camera.dust", self.dust, 0, 10**4)
        _check("camera.flicker", self.flicker, 0.0, 0.5)
        if self.output == "camera" and self.noise:
            raise ConfigError(
                "camera.noise: is for attenuation; a camera's noise follows from full_well and read_noise"
            )


@dataclass(frozen=True)
class SimulateConfig:
    """All of ``trap-motion simulate``; by default the paper's example at a size that runs in seconds."""

    seed: int = 0
    """Seed of everything random; the same seed gives the same stack."""
    stack: StackConfig = field(default_factory=StackConfig)
    phantom: PhantomConfig = field(default_factory=PhantomConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)

    def __post_init__(self) -> None:
        _check("seed", self.seed, 0, 1 << 63)


PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "stack": {"frames": 1000, "height": 1024, "width": 1024, "pixel_size": 0.05, "frame_interval": 0.0005}
    },
    "single-axis": {
        "stack": {"frames": 300, "frame_interval": 0.02},
        "phantom": {"kind": "blobs"},
        "motion": {"kind": "single-axis"},
        "camera": {"noise": 0.01},
    },
    "tumbling": {
        "stack": {"frames": 400, "frame_interval": 0.02},
        "phantom": {"kind": "grain"},
        "motion": {"kind": "tumbling"},
        "camera": {"noise": 0.01},
    },
    "camera": {
        "stack": {"frames": 400, "frame_interval": 0.02},
        "phantom": {"kind": "grain"},
        "motion": {"kind": "tumbling"},
        "camera": {"output": "camera"},
    },
}
"""Tables by name; ``configs/simulate-<name>.toml`` explains the same values line by line."""


def _check(name: str, value: float, low: float, high: float) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigError(f"{name}: must lie between {low:g} and {high:g}, not {value!r}")


def _one_of(name: str, value: object, known: tuple[object, ...]) -> None:
    if value not in known:
        raise ConfigError(f"{name}: must be one of {', '.join(map(str, known))}, not {value!r}")
