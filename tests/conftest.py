"""Fixtures for all tests."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from trapcli.result.motion import Motion

MakeMotion = Callable[..., Motion]

# a shell's background jobs ignore interrupts, and so would the programs that tests start and interrupt
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def make_motion() -> MakeMotion:
    """``make_motion(n, **changes)``: n frames of a motion known in closed form, with any field replaced."""

    def make(n: int = 40, **changes: Any) -> Motion:
        a, b, step = 0.7, 1.1, 0.05
        t = step * np.arange(n)
        # R = exp(a t e3×) exp(b t e1×), so that ω = (b, a sin bt, a cos bt)
        spin = Rotation.from_rotvec(np.outer(t, [0, 0, a]))
        roll = Rotation.from_rotvec(np.outer(t, [b, 0, 0]))
        T = np.stack([3 * np.sin(t), 2 - 2 * np.cos(t)], axis=1)
        unknown = np.full(n, np.nan)
        motion = Motion(
            time=t,
            frame=np.arange(n),
            T=T,
            center=np.array([5.0, -4.0]) - T,
            phi=np.arctan2(a * np.sin(b * t), b),
            omega_3=a * np.cos(b * t),
            alpha=np.hypot(b, a * np.sin(b * t)),
            R=(spin * roll).as_matrix(),
            T_errors=np.full((n, 2), np.nan),
            phi_errors=unknown,
            omega_3_errors=unknown,
            alpha_errors=unknown,
            R_errors=np.full((n, 3), np.nan),
            valid=np.ones(n, np.uint8),
            flags=np.zeros(n, np.uint16),
            residual=np.full(n, 0.01),
            verdict="the motion is determined",
            time_unit="s",
            length_unit="µm",
            provenance={"program": "trap-motion", "version": "0.1.0"},
        )
        return dataclasses.replace(motion, **changes)

    return make
