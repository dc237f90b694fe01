"""Scenes whose object and motion are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pytest

from trapcli.config import from_dict
from trapcli.reconstruction.volume import Reconstruction
from trapcli.simulation.config import SimulateConfig
from trapcli.simulation.render import Scene
from trapcli.stack.frames import Frames


@dataclass(frozen=True)
class Example:
    scene: Scene

    @cached_property
    def frames(self) -> Frames:
        frames = self.scene.frames()
        return Frames.from_array(frames.to_array(), frames.info)

    @cached_property
    def motion(self):
        return self.scene.truth()

    @cached_property
    def mirrored(self) -> bool:
        """Whether the truth in its gauge is the mirror solution of the motion that was rendered."""
        rendered = self.scene.motion.rotations(self.scene.time)
        return bool(np.abs(rendered - self.motion.R).max() > 1e-9)

    @property
    def pixel_size(self) -> float:
        return self.scene.config.stack.pixel_size

    def density(self, points: np.ndarray) -> np.ndarray:
        """The object at ``(..., 3)`` points from its centre, in the gauge of the truth."""
        mirror = np.array([1.0, 1.0, -1.0 if self.mirrored else 1.0])
        return self.scene.phantom.density(points * mirror + self.scene.phantom.center)

    def volume(self, n: int, voxel: float) -> np.ndarray:
        """``[x3, x2, x1]`` density at the voxels."""
        axis = (np.arange(n) - n // 2) * voxel
        x3, x2, x1 = np.meshgrid(axis, axis, axis, indexing="ij")
        return np.stack([self.density(np.stack(p, axis=-1)) for p in zip(x1, x2, x3, strict=True)])

    def true(self, found: Reconstruction) -> np.ndarray:
        return self.volume(len(found.values), found.voxel_size)


@pytest.fixture(scope="session")
def example() -> Callable[..., Example]:
    """``example(kind, frames=…, size=…, noise=…, phantom=…, seed=…, **motion)``."""
    kept: dict[Any, Example] = {}

    def make(
        kind: str = "tumbling",
        *,
        frames: int = 120,
        size: int = 48,
        noise: float = 0.0,
        phantom: str = "blobs",
        seed: int = 1,
        drift: float = 0.1,
        **motion: float,
    ) -> Example:
        key = (kind, frames, size, noise, phantom, seed, drift, *sorted(motion.items()))
        if key not in kept:
            table = {
                "seed": seed,
                "stack": {
                    "frames": frames,
                    "height": size,
                    "width": size,
                    "pixel_size": 25.6 / size,
                    # the paper's motion takes half a second
                    "frame_interval": 0.5 / frames if kind == "paper" else 0.02,
                },
                "phantom": {"kind": phantom},
                "motion": {"kind": kind, "drift": drift, **motion},
                "camera": {"noise": noise},
            }
            kept[key] = Example(Scene.from_config(from_dict(SimulateConfig, table, "test")))
        return kept[key]

    return make
