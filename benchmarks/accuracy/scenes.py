"""The stacks that are measured: clean frames, the true motion, and noise to add."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.result.motion import Motion
from trapcli.simulation.render import simulate

Array = NDArray[np.float64]
Images = NDArray[np.float32]

VISIBLE = 5e-3
"""Share of the peak attenuation at which the object ends."""

_DURATION = 0.5  # of the paper's motion [s]
_FIELD = 25.6  # edge of the paper's frames [length]


@dataclass(frozen=True)
class Scene:
    """What to render.

    Attributes
    ----------
    key, title:
        In the results and in words.
    overrides:
        What differs from the simulator's defaults.
    """

    key: str
    title: str
    overrides: dict[str, Any]


@dataclass(frozen=True)
class Stack:
    """A rendered scene.

    Attributes
    ----------
    clean:
        ``(N, H, W)`` frames without noise.
    truth:
        True motion; lengths in the unit of `pixel_size`.
    pixel_size:
        Edge of a pixel [length].
    peak:
        Highest attenuation of the stack.
    radius:
        Distance from the centre at which the object ends, in all frames [length].
    turn:
        Angle turned in all [rad].
    """

    clean: Images
    truth: Motion
    pixel_size: float
    peak: float
    radius: float
    turn: float

    def noisy(self, noise: float, seed: int) -> Images:
        """Return the frames with white noise of `noise` peaks."""
        rng = np.random.default_rng(seed)
        frames = rng.standard_normal(self.clean.shape, dtype=np.float32)
        frames *= np.float32(noise * self.peak)
        frames += self.clean
        return frames


def scenes(quick: bool) -> tuple[Scene, ...]:
    """Return the three scenes; `quick` makes the paper's smaller."""
    frames, pixels = (300, 128) if quick else (1000, 256)
    paper = {
        "frames": frames,
        "height": pixels,
        "width": pixels,
        "pixel_size": _FIELD / pixels,
        "frame_interval": _DURATION / (frames - 1),
    }
    return (
        Scene("paper", "the paper's object and motion", {"stack": paper}),
        Scene(
            "single-axis",
            "blobs about one axis in the image plane, uneven speed",
            {
                "stack": {"frames": 300, "frame_interval": 0.02},
                "phantom": {"kind": "blobs"},
                "motion": {"kind": "single-axis", "turns": 1.2},
            },
        ),
        Scene(
            "tumbling",
            "tumbling blobs",
            {
                "stack": {"frames": 400, "frame_interval": 0.02},
                "phantom": {"kind": "blobs"},
                "motion": {"kind": "tumbling", "total_angle": 240.0},
            },
        ),
    )


def render(scene: Scene) -> Stack:
    """Render a scene without noise."""
    image, truth = simulate(seed=0, **scene.overrides)
    clean = image.astype(np.float32, copy=False)
    pixel_size = scene.overrides["stack"].get("pixel_size", 0.2)
    peak = float(clean.max())
    steps = np.swapaxes(truth.R[:-1], 1, 2) @ truth.R[1:]
    return Stack(
        clean=clean,
        truth=truth,
        pixel_size=pixel_size,
        peak=peak,
        radius=_radius(clean, truth.center, pixel_size, VISIBLE * peak),
        turn=float(Rotation.from_matrix(steps).magnitude().sum()),
    )


def _radius(clean: Images, center: Array, pixel_size: float, least: float) -> float:
    height, width = clean.shape[1:]
    x1 = (np.arange(width) - width // 2) * pixel_size
    x2 = (np.arange(height) - height // 2) * pixel_size
    farthest = 0.0
    for image, (c1, c2) in zip(clean, center, strict=True):
        rows, columns = np.nonzero(image > least)
        farthest = max(farthest, float(np.hypot(x1[columns] - c1, x2[rows] - c2).max()))
    return farthest
