"""What an object may be like before it is known: a random field that the frames' mean power describes.

It is taken for a sum of blobs of one size with random amplitudes, which follow how much of it lies at a
distance from its centre. That is told by the mean of all frames, whatever the motion; how large and how
strong the blobs are is told by the evidence (MacKay 1992, DOI 10.1162/neco.1992.4.3.415). Amplitudes that the
frames do not determine then stay near 0 and add no noise to the motion.

What lies inside edges has a power that falls as k⁻⁴, that of a random medium of two densities as
(1 + w²k²)⁻² (Debye, Anderson and Brumberger 1957, DOI 10.1063/1.1722830). Blobs have this power: where it is
taken to fall faster, sharp objects seem to turn less than they do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.low_band import LowBand

Array = NDArray[np.float64]

_RESOLUTION = 0.08  # of the radial density, in radii of the object
_SHELLS = 101
_LEAST = 0.01  # of the largest radial density: what may lie where none is seen


@dataclass(frozen=True)
class Prior:
    """Amplitudes of blobs, of a Gaussian distribution.

    Attributes
    ----------
    distance, density:
        ``(M,)`` distances from the centre [length] and the variance of amplitudes there, up to a factor.
    width:
        Length w on which a blob falls off, as exp(−r / w) / r [length].
    power:
        Variance of a mode of the object at k = 0.
    looseness:
        Variance over the likeliest one, if what the object itself adds to the misfit is to count.
    """

    distance: Array
    density: Array
    width: float
    power: float
    looseness: float = np.inf

    @classmethod
    def of(cls, low: LowBand) -> Prior:
        """Return a prior with the radial density that the frames show, and blobs as small as may be."""
        distance = np.linspace(0.0, low.radius, _SHELLS)
        density = np.abs(radial_density(low, distance))
        # an object may be hollow, or dark at its rim and bright inside
        density = np.maximum.accumulate(density[::-1])[::-1]
        power = float(np.max(np.mean(np.abs(low.modes) ** 2, axis=0)))
        return cls(distance, np.maximum(density / density[0], _LEAST), 0.0, power)

    @classmethod
    def vague(cls, low: LowBand, width: float, noise: Array) -> Prior:
        """Return a prior that is alike everywhere and expects at least what is seen.

        Of blobs of a `width` [length]; with the ``(K,)`` variances of the modes' noise.
        """
        seen = np.mean(np.abs(low.modes) ** 2, axis=0)
        power = np.maximum(seen - noise, 0.01 * noise) * (1 + np.sum((width * low.k) ** 2, axis=1)) ** 2
        return cls(np.zeros(1), np.ones(1), width, float(power.max()))

    def variance(self, position: Array) -> Array:
        """Return ``(n,)`` variances of the amplitudes at ``(n, 3)`` places, 1 on the average."""
        variance = np.interp(np.linalg.norm(position, axis=1), self.distance, self.density)
        return np.asarray(variance / variance.mean())

    def spectrum(self, k: Array) -> Array:
        """Return standard deviations of modes at spatial frequencies of length `k` [rad / length]."""
        return np.asarray(np.sqrt(self.power) / (1 + (self.width * k) ** 2))


def radial_density(low: LowBand, distance: Array) -> Array:
    """Return the mean density on spheres about the centre, up to a factor, smoothed.

    The mean of all frames has the Fourier transform F of that of the object turned into all directions, which
    is ``∫ F(k) sinc(k r) k² dk``; the modes lie as densely as ``k dk``.
    """
    k = np.hypot(low.k[:, 0], low.k[:, 1])
    mean = low.modes.mean(axis=0).real * np.exp(-0.5 * (_RESOLUTION * low.radius * k) ** 2)
    return np.asarray(np.sinc(np.outer(distance, k) / np.pi) @ (k * mean))
