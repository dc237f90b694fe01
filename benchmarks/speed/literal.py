"""The paper's first-order step as its text has it: what one would write first.

Every frame is transformed with zeros around it, in double precision; derivatives in space and time are
differences, and the function Φ is evaluated for every direction of a grid. The rate α, which takes second and
third derivatives, is left out.
"""

from __future__ import annotations

from collections import deque

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

DIRECTIONS = 180
BAND = 0.25  # of the frequencies that are kept, on either axis


class Literal:
    """φ and ω₃ (``propD1``) of all frames but the first and the last."""

    def __init__(self, frames: Frames, threads: int) -> None:
        self.frames, self.threads = frames, threads
        height, width = frames.shape[1:]
        self.x2, self.x1 = np.arange(height) - height // 2, np.arange(width) - width // 2
        self.padded = (2 * height, 2 * width)
        k2, k1 = (2 * np.pi * scipy.fft.fftshift(scipy.fft.fftfreq(size)) for size in self.padded)
        self.rows, self.columns = (
            slice(round(size * (1 - BAND) / 2), round(size * (1 + BAND) / 2)) for size in self.padded
        )
        self.k2, self.k1 = k2[self.rows], k1[self.columns]
        self.step = (k2[1] - k2[0], k1[1] - k1[0])

    def rates(self) -> Array:
        """Return ``(N - 2, 2)`` φ and ω₃ per frame."""
        maps: deque[ComplexArray] = deque(maxlen=3)
        found = []
        for block in self.frames.blocks():
            for image in block:
                maps.append(self.reduced(image.astype(float)))
                if len(maps) == 3:
                    found.append(self.first_order(*maps))
        return np.array(found)

    def reduced(self, image: Array) -> ComplexArray:
        """Return the reduced map of one frame (``eqRecMapReduced``) on its band."""
        mass = image.sum()
        center = np.array([image.sum(axis=0) @ self.x1, image.sum(axis=1) @ self.x2]) / mass
        spectrum = scipy.fft.fft2(image.astype(complex), self.padded, workers=self.threads)
        band = scipy.fft.fftshift(spectrum)[self.rows, self.columns]
        # the origin is the middle pixel, and the centre is moved there
        shift1, shift2 = center - (self.x1[0], self.x2[0])
        return band * np.exp(1j * (self.k2[:, None] * shift2 + self.k1 * shift1))

    def first_order(
        self, before: ComplexArray, now: ComplexArray, after: ComplexArray
    ) -> tuple[float, float]:
        """Return φ and ω₃ where Φ is least."""
        rate = (after - before) / 2
        slope2, slope1 = np.gradient(now, *self.step)
        mu = np.linspace(0, 0.9 * min(-self.k1[0], -self.k2[0]), 128)
        best = (np.inf, 0.0, 0.0)
        for phi in np.arange(DIRECTIONS) * np.pi / DIRECTIONS:
            v1, v2 = np.cos(phi), np.sin(phi)
            place = [mu * v2 / self.step[0] + len(self.k2) // 2, mu * v1 / self.step[1] + len(self.k1) // 2]
            t, s1, s2 = (map_coordinates(a, place, order=1) for a in (rate, slope1, slope2))
            turned = mu * (v1 * s2 - v2 * s1)
            omega_3 = np.vdot(turned, t).real / np.vdot(turned, turned).real
            best = min(best, (float(np.sum(np.abs(t - omega_3 * turned) ** 2)), float(phi), float(omega_3)))
        return best[1:]
