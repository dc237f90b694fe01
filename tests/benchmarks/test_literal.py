"""The paper's method as its text has it, against which time is measured, does find the paper's motion."""

from __future__ import annotations

import numpy as np
import pytest
from literal import Literal
from scipy.spatial.transform import Rotation

from trapcli.simulation.config import MotionConfig, PhantomConfig, SimulateConfig, StackConfig
from trapcli.simulation.render import Scene

INTERVAL = 0.0005  # of the paper
PIXEL = 0.2


def test_finds_the_motion_of_the_paper() -> None:
    stack = StackConfig(frames=24, height=128, width=128, pixel_size=PIXEL, frame_interval=INTERVAL)
    config = SimulateConfig(
        stack=stack, phantom=PhantomConfig(kind="paper"), motion=MotionConfig(kind="paper")
    )
    scene = Scene.from_config(config)
    found = Literal(scene.frames(), threads=1).motion()

    time = np.arange(1, 23) * INTERVAL
    # the paper's formulas; φ is between 0 and π, where the branch that is found begins
    np.testing.assert_allclose(found.phi, np.pi * time + np.pi / 3, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.omega_3 / INTERVAL, 0.5 + np.sqrt(0.5 + 5 * time), rtol=3e-3)
    alpha = found.alpha / INTERVAL / (1 + 10 * time**2)
    np.testing.assert_allclose(alpha, 1, atol=0.03)
    assert np.median(alpha) == pytest.approx(1, abs=0.005)

    truth = scene.truth()
    np.testing.assert_allclose(found.translation, (truth.T[:, :2] - truth.T[0, :2]) / PIXEL, atol=1e-5)
    turns = Rotation.from_matrix(truth.R[1].T @ truth.R[1:-1])
    error = (Rotation.from_matrix(found.rotation).inv() * turns).magnitude()
    assert error[-1] < 0.01 * turns.magnitude()[-1]
