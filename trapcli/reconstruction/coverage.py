"""Which directions of the object's Fourier space the frames see.

A frame sees the plane across its viewing direction, and a smooth motion all that the plane sweeps over: a
direction u is seen where ⟨u, R e₃⟩ changes its sign from one frame to the next.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

Array = NDArray[np.float64]

DIRECTIONS = 8_000
"""Evenly spread directions that are judged; their share is exact to about 0.2 %."""
LIMITED = 0.95
"""Share of directions seen below which a view counts as limited."""

_GAP = np.deg2rad(15.0)  # turn of the viewing direction from frame to frame beyond which nothing is swept


@dataclass(frozen=True)
class Coverage:
    """What the frames see of Fourier space.

    Attributes
    ----------
    direction:
        ``(D, 3)`` unit vectors in object coordinates, evenly spread over half the sphere: u and −u are one.
    times_seen:
        ``(D,)`` how often each direction was swept over.
    share:
        Share of directions seen at least once, and so of all Fourier space.
    missing_angle:
        Half the opening angle of the widest cone that is not seen [rad].
    missing_axis:
        ``(3,)`` its axis in object coordinates; NaN where all is seen.
    """

    direction: Array
    times_seen: NDArray[np.int64]
    share: float
    missing_angle: float
    missing_axis: Array

    @property
    def limited(self) -> bool:
        """Whether so much is missing that the volume must show it."""
        return self.share < LIMITED

    @property
    def warning(self) -> str:
        """What to know about a limited view, in a sentence; empty where the view is complete."""
        if not self.limited:
            return ""
        x1, x2, x3 = self.missing_axis
        return (
            f"limited view: the motion shows {100 * self.share:.0f} % of Fourier space; the rest is guessed, "
            f"at its widest a cone of {np.rad2deg(self.missing_angle):.0f} degrees about the object's axis "
            f"({x1:.2f}, {x2:.2f}, {x3:.2f}), along which the volume is blurred"
        )


def cover(R: Array, *, directions: int = DIRECTIONS) -> Coverage:
    """Judge the coverage of Fourier space.

    Parameters
    ----------
    R:
        ``(N, 3, 3)`` rotations in the order of time, lab to object; frames without a rotation are NaN.
    """
    half = _half_sphere(directions)
    view = R[np.isfinite(R).all(axis=(1, 2)), :, 2]
    seen = np.zeros(len(half), np.int64)
    for before, after in itertools.pairwise(view):
        if before @ after >= np.cos(_GAP):
            seen += (half @ before >= 0) != (half @ after >= 0)
    share = float(np.mean(seen > 0))
    axis, angle = np.full(3, np.nan), 0.0
    if share == 0:
        axis, angle = half[0], np.pi / 2
    elif share < 1:
        both = np.concatenate([half[seen > 0], -half[seen > 0]])
        missing = half[seen == 0]
        distance, _ = KDTree(both).query(missing)
        widest = int(np.argmax(distance))
        axis, angle = missing[widest], 2 * float(np.arcsin(min(1.0, distance[widest] / 2)))
    return Coverage(half, seen, share, angle, axis)


def _half_sphere(count: int) -> Array:
    """Return evenly spread points with x3 > 0 (Fibonacci's lattice)."""
    i = np.arange(count) + 0.5
    x3 = 1 - i / count
    turn = np.pi * (1 + np.sqrt(5)) * i
    across = np.sqrt(1 - x3**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), x3], axis=1)
