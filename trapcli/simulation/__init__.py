"""Test objects with closed-form projections, motions, and a camera: stacks whose true motion is known.

``Scene.from_config(SimulateConfig())`` gives the frames (`Scene.frames`) and their motion (`Scene.truth`).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.config import from_dict, merge
from trapcli.result.motion import Motion
from trapcli.simulation.config import PRESETS, SimulateConfig
from trapcli.simulation.render import Scene

__all__ = ["PRESETS", "Scene", "SimulateConfig", "simulate"]


def simulate(config: SimulateConfig | None = None, **overrides: Any) -> tuple[NDArray[np.generic], Motion]:
    """Render a stack and its true motion.

    Parameters
    ----------
    config:
        What to render; by default the paper's phantom and motion, 200 frames of 128 × 128.
    **overrides:
        Fields of `SimulateConfig` that differ from it; tables as dictionaries, for example
        ``simulate(seed=3, stack={"frames": 50}, phantom={"kind": "grain"})``.

    Returns
    -------
    frames:
        ``(N, H, W)`` array; for stacks that don't fit into memory use ``Scene.from_config(config).frames()``.
    motion:
        The truth in the gauge of the result file; times in s, lengths in the configuration's `pixel_unit`.

    Raises
    ------
    ConfigError
        For an unknown field or a value that makes no sense.
    """
    table = dataclasses.asdict(config or SimulateConfig())
    scene = Scene.from_config(from_dict(SimulateConfig, merge(table, overrides), "simulate"))
    return scene.frames().to_array(), scene.truth()
