"""The paper's method as its text has it: what one would write first.

Every frame is transformed with zeros around it, in double precision. Derivatives in time are central
differences of three frames. Those in k are differences of the map, and not transforms of frames times
coordinates, of which the third order would take ten a frame. Φ, as a sum of squares, is evaluated for every
direction of a grid, with differences on the transform's own grid. What belongs to one line alone, the third
order above all, takes differences of points close to it, which a cubic spline interpolates in place of
Whittaker and Shannon's formula.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial.transform import Rotation

from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

DIRECTIONS = 180
BAND = 0.25  # of the frequencies that are kept, on either axis
POINTS = 128  # μ on a line


class Motion(NamedTuple):
    """The motion in pixels and frames, of all N frames or of all but the first and the last.

    `translation` is ``(N, 2)``, from that of the first frame; `rotation` is ``(N - 2, 3, 3)``, from 1; all
    else is ``(N - 2,)``. The sign of v, and so which of two mirror images moves, is as it comes.
    """

    translation: Array
    phi: Array
    omega_3: Array
    alpha: Array
    rotation: Array


class Derivatives(NamedTuple):
    """Derivatives of J̃ in t, v and n = v⊥ at all μ of a line, ``(M,)`` each: tnn is ∂tD²⟦n, n⟧."""

    t: ComplexArray
    v: ComplexArray
    n: ComplexArray
    vn: ComplexArray
    nn: ComplexArray
    nnn: ComplexArray
    tn: ComplexArray
    tnn: ComplexArray
    ttn: ComplexArray


class Literal:
    """T (``prop:COM``), φ and ω₃ (``propD1``), α (``propD3``) and R (``eqDefOmega``)."""

    def __init__(self, frames: Frames, threads: int) -> None:
        self.frames, self.threads = frames, threads
        self.padded = (2 * frames.shape[1], 2 * frames.shape[2])
        self.half = tuple(round(size * BAND / 2) for size in self.padded)
        # negative places count from the end, where negative frequencies are
        self.band = np.ix_(*(np.arange(-half, half) for half in self.half))
        self.step = tuple(2 * np.pi / size for size in self.padded)
        self.small = min(self.step) / 4
        self.mu = np.linspace(0, 0.9 * min(np.multiply(self.half, self.step)), POINTS)

    def motion(self) -> Motion:
        maps: deque[ComplexArray] = deque(maxlen=3)
        centers, found = [], []
        for block in self.frames.blocks():
            for image in block:
                center, reduced = self.reduced(image.astype(float))
                centers.append(center)
                maps.append(reduced)
                if len(maps) == 3:
                    found.append(self.first_order(*maps))
        lines, directions, heights = zip(*found, strict=True)
        phi, omega_3 = np.unwrap(directions, period=np.pi), np.array(heights)
        rates = zip(omega_3, np.gradient(phi), np.gradient(omega_3), strict=True)
        squares = [self.third_order(line, *rest) for line, rest in zip(lines, rates, strict=True)]
        alpha = np.sqrt(np.maximum(squares, 0.0))
        omega = np.stack([alpha * np.cos(phi), alpha * np.sin(phi), omega_3], axis=1)
        return Motion(centers[0] - np.array(centers), phi, omega_3, alpha, integrated(omega))

    def reduced(self, image: Array) -> tuple[Array, ComplexArray]:
        """Return the centre (x₁, x₂) of one frame, and its reduced map (``eqRecMapReduced``) as a spline."""
        rows, columns = image.sum(axis=1), image.sum(axis=0)
        center2, center1 = (s @ np.arange(len(s)) / s.sum() for s in (rows, columns))
        k2, k1 = (np.arange(-half, half) * step for half, step in zip(self.half, self.step, strict=True))
        band = scipy.fft.fft2(image, self.padded, workers=self.threads)[self.band]
        band = band * np.exp(1j * k2 * center2)[:, None] * np.exp(1j * k1 * center1)
        return np.array([center1, center2]), spline_filter(band, output=complex)

    def first_order(self, *maps: ComplexArray) -> tuple[Derivatives, float, float]:
        """Return the line where Φ is least, its φ, and ω₃."""
        before, now, after = maps
        rate = (after - before) / 2
        slope2, slope1 = np.gradient(now, *self.step)
        best = (np.inf, 0.0)
        for phi in np.arange(DIRECTIONS) * np.pi / DIRECTIONS:
            v1, v2 = np.cos(phi), np.sin(phi)
            place = self.place(self.mu * v1, self.mu * v2)
            # linear interpolation tells the direction to within the grid's step
            t, s1, s2 = (map_coordinates(a, place, order=1) for a in (rate, slope1, slope2))
            best = min(best, (self.fit(t, v1 * s2 - v2 * s1)[1], float(phi)))
        phi = best[1]
        # the least of a parabola between the directions of the grid, then of a narrower one
        for apart in (np.pi / DIRECTIONS, 0.1 * np.pi / DIRECTIONS):
            lines = [self.line(maps, phi + n * apart) for n in (-1, 0, 1)]
            left, middle, right = (self.fit(line.t, line.n)[1] for line in lines)
            phi += apart * (left - right) / (2 * (left - 2 * middle + right))
        line = self.line(maps, phi)
        return line, phi, self.fit(line.t, line.n)[0]

    def fit(self, rate: ComplexArray, slope: ComplexArray) -> tuple[float, float]:
        """Return the ω₃ that fits best on a line, and Φ."""
        turned = self.mu * slope
        omega_3 = np.vdot(turned, rate).real / np.vdot(turned, turned).real
        return float(omega_3), float(np.sum(np.abs(rate - omega_3 * turned) ** 2))

    def place(self, k1: Array, k2: Array) -> list[Array]:
        return [k / step + half for k, step, half in zip((k2, k1), self.step, self.half, strict=True)]

    def line(self, maps: tuple[ComplexArray, ...], phi: float) -> Derivatives:
        """Return the derivatives at μv: differences on five lines beside it, of three points each."""
        h, v1, v2 = self.small, np.cos(phi), np.sin(phi)
        along = self.mu + h * np.arange(-1, 2)[:, None]
        across = h * np.arange(-2, 3)[:, None, None]
        place = self.place(along * v1 - across * v2, along * v2 + across * v1)
        before, now, after = (map_coordinates(a, place, prefilter=False) for a in maps)
        rate, acceleration = (after - before) / 2, after - 2 * now + before
        slopes = (now[3] - now[1]) / (2 * h)
        return Derivatives(
            t=rate[2, 1],
            v=(now[2, 2] - now[2, 0]) / (2 * h),
            n=slopes[1],
            vn=(slopes[2] - slopes[0]) / (2 * h),
            nn=(now[3, 1] - 2 * now[2, 1] + now[1, 1]) / h**2,
            nnn=(now[4, 1] - 2 * now[3, 1] + 2 * now[1, 1] - now[0, 1]) / (2 * h**3),
            tn=(rate[3, 1] - rate[1, 1]) / (2 * h),
            tnn=(rate[3, 1] - 2 * rate[2, 1] + rate[1, 1]) / h**2,
            ttn=(acceleration[3, 1] - acceleration[1, 1]) / (2 * h),
        )

    def third_order(self, d: Derivatives, omega_3: float, sigma: float, omega_3_rate: float) -> float:
        """Return α² by the normal equations for it and α'/α (``eq:RecSymmetryThirdOrder``)."""
        mu, both = self.mu, omega_3 + sigma
        bracket = (
            mu**2 * omega_3 * (omega_3 - sigma) * d.nnn
            + 2 * mu * (omega_3 * sigma * d.vn - omega_3_rate * d.nn)
            + 2 * (omega_3**2 * d.n + omega_3_rate * d.v)
            - mu * (3 * omega_3 - sigma) * d.tnn
            + 2 * d.ttn
        )
        a0 = mu * both / 4 * bracket
        a02 = mu * both / 2 * d.n
        a1 = both / 2 * (mu * omega_3 * d.nn - omega_3 * d.v - d.tn)
        matrix = np.stack([a02, mu * a1], axis=1)
        adjoint = matrix.conj().T
        return float(np.linalg.solve((adjoint @ matrix).real, -(adjoint @ a0).real)[0])


def integrated(omega: Array) -> Array:
    """Return R of every frame, where Rᵀ R' = [ω]×."""
    R = [Rotation.identity()]
    for turn in Rotation.from_rotvec((omega[1:] + omega[:-1]) / 2):
        R.append(R[-1] * turn)
    return np.array([rotation.as_matrix() for rotation in R])
