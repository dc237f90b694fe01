"""The stacks that are measured, each a configuration of ``trap-motion simulate``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.config import from_dict, merge
from trapcli.simulation.camera import Camera
from trapcli.simulation.config import SimulateConfig
from trapcli.simulation.render import Scene

Array = NDArray[np.float64]
Table = dict[str, Any]

NOISE = (0.001, 0.003, 0.01, 0.03, 0.05, 0.1, 0.2, 0.5)
"""Noise of the curves, as shares of the peak attenuation."""

_DURATION, _FIELD = 0.5, 25.6  # of the paper's motion [s], and edge of its frames [length]
_LOW_LIGHT = 2000.0  # electrons of a full well that make noise of 5 % of the peak


@dataclass(frozen=True)
class Row:
    """A stack, or several that differ by their seed, and how well its rotation is to be found.

    Attributes
    ----------
    key, title:
        On the command line and on the page.
    mean, worst:
        Largest mean error and largest error of any frame that is aimed at [degrees].
    table:
        What differs from the simulator's defaults, by seed.
    often:
        In how many seeds, where there are several.
    """

    key: str
    title: str
    mean: float
    worst: float | None
    table: Callable[[int], Table]
    often: str = ""

    @property
    def is_camera(self) -> bool:
        """Whether the stack holds raw intensities."""
        return self.table(0)["camera"].get("output") == "camera"


@dataclass(frozen=True)
class Curve:
    """A stack at every noise of `NOISE`."""

    key: str
    title: str
    table: Table

    def at(self, noise: float) -> Table:
        """Return its configuration for a noise."""
        return merge(self.table, {"camera": {"noise": noise}})


def scene(table: Table, seed: int) -> Scene:
    """Build what differs from the simulator's defaults by `table`; the seed is that of all that is random."""
    whole = merge(asdict(SimulateConfig()), table, {"seed": seed})
    return Scene.from_config(from_dict(SimulateConfig, whole, "benchmark"))


def noise_of(scene: Scene) -> float:
    """Return the noise of one pixel of the attenuation, as a share of its peak: root mean square."""
    sensor, config = scene.sensor, scene.config.camera
    if not isinstance(sensor, Camera):
        return config.noise
    dark = config.offset * sensor.highest
    rounding = (config.full_well / (sensor.highest - dark)) ** 2 / 12
    light = sensor.flat_field
    squares = []
    for n in np.linspace(0, len(scene.time) - 1, 8).astype(int):
        attenuation = config.optical_depth / sensor.peak * scene.attenuation(int(n))
        electrons = light * np.exp(-attenuation)
        inside = attenuation > 5e-3 * config.optical_depth
        squares.append(((electrons + config.read_noise**2 + rounding) / electrons**2)[inside])
    return float(np.sqrt(np.concatenate(squares).mean())) / config.optical_depth


def _paper(noise: float) -> Callable[[int], Table]:
    frames, pixels = 1000, 256
    stack = {
        "frames": frames, "height": pixels, "width": pixels, "pixel_size": _FIELD / pixels,
        "frame_interval": _DURATION / frames,
    }  # fmt: skip
    return lambda seed: {"stack": stack, "camera": {"noise": noise}}


def _axis(noise: float) -> Callable[[int], Table]:
    return lambda seed: merge(_AXIS, {"stack": {"frames": 300}, "camera": {"noise": noise}})


def _camera(**light: float) -> Callable[[int], Table]:
    """Return blobs and grains by turns, each in 16 and in 8 bits."""

    def table(seed: int) -> Table:
        kind, bits = ("blobs", "grain")[seed % 2], (16, 8)[seed // 2 % 2]
        return merge(
            _TUMBLING,
            {"stack": {"frames": 400}, "phantom": {"kind": kind}},
            {"camera": {"output": "camera", "bits": bits, **light}},
        )

    return table


_TUMBLING: Table = {
    "stack": {"frames": 200, "frame_interval": 0.02},
    "phantom": {"kind": "blobs"},
    "motion": {"kind": "tumbling", "total_angle": 240.0},
}
_AXIS: Table = {
    "stack": {"frames": 200, "frame_interval": 0.02},
    "phantom": {"kind": "blobs"},
    "motion": {"kind": "single-axis", "turns": 1.2},
}

CURVES = (
    Curve("tumbling", "Blobs that tumble by 240°", _TUMBLING),
    Curve("axis", "Blobs about one axis in the image plane, 1.2 turns of uneven speed", _AXIS),
    Curve("paper", "The paper's object and motion, 74°", {"stack": {"frames": 200}}),
)
ROWS = (
    Row("paper-1", "paper's object and motion, 1000 frames of 256², 1 %", 0.04, 0.15, _paper(0.01)),
    Row("paper-5", "the same, 5 %", 0.2, 0.7, _paper(0.05)),
    Row("paper-20", "the same, 20 %", 1.0, 4.0, _paper(0.2)),
    Row("axis-1", "one axis in the image plane, 1.2 turns, 300 frames of 128², 1 %", 0.1, 0.5, _axis(0.01)),
    Row("axis-5", "one axis, the same, 5 %", 0.6, 3.0, _axis(0.05)),
    Row("camera", "tumbling by 240°, 400 camera frames of 128²", 0.15, 0.5, _camera(), "20 of 20"),
    Row("camera-5", "tumbling, the same, noise of 5 %", 0.5, 2.0, _camera(full_well=_LOW_LIGHT), "19 of 20"),
    Row(
        "revolutions",
        "tumbling by 20 turns, 4000 frames of 128², 1 %",
        0.3,
        None,
        lambda seed: merge(
            _TUMBLING,
            {"stack": {"frames": 4000}, "motion": {"total_angle": 7200.0}, "camera": {"noise": 0.01}},
        ),
    ),
)
