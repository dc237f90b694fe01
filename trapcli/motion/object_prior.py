"""What an object may be like before it is known: a random field that the frames' mean power describes.

It is taken for a sum of blobs of one size with random amplitudes, which follow how much of it lies at a
distance from its centre. That is told by the mean of all frames, whatever the motion; how large and how
strong the blobs are is told by the evidence (MacKay 1992, DOI 10.1162/neco.1992.4.3.415). Amplitudes that the
frames do not determine then stay near 0 and add no noise to the motion.

Once the motion is known, the evidence tells in which places there is more of the object than elsewhere: the
variance of amplitudes there becomes the mean square of those that the frames determine (MacKay 1992, as
above). Most of a ball about an object is empty, and what is empty needs no amplitudes.

What lies inside edges has a power that falls as k⁻⁴, that of a random medium of two densities as
(1 + w²k²)⁻² (Debye, Anderson and Brumberger 1957, DOI 10.1063/1.1722830). That of smooth objects falls late
and then fast: as a Gaussian, say. Where it is taken to fall faster than it does, sharp objects seem to turn
less than they do; where slower, amplitudes are free to follow the noise. Blobs have the one power or the
other, which the evidence tells as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from trapcli.motion.low_band import LowBand

Array = NDArray[np.float64]

_RESOLUTION = 0.08  # of the radial density, in radii of the object
_SHELLS = 101
_LEAST = 0.01  # of the largest radial density: what may lie where none is seen
_VICINITY = 0.1  # over which the variance of amplitudes is told together, in radii of the object
_BEFOREHAND = 0.02  # amplitudes in each vicinity that count as told, of the variance that was there


@dataclass(frozen=True)
class Prior:
    """Amplitudes of blobs, of a Gaussian distribution.

    Attributes
    ----------
    distance, density:
        ``(M,)`` distances from the centre [length] and the variance of amplitudes there, up to a factor.
    width:
        Length w on which a blob falls off, as exp(−r / w) / r if it is sharp, else exp(−r² / 2 w²) [length].
    power:
        Variance of a mode of the object at k = 0.
    sharp:
        Whether the power is that of edges rather than of smooth objects.
    looseness:
        Variance over the likeliest one, if what the object itself adds to the misfit is to count.
    place, share, vicinity:
        ``(L, 3)`` places [length] and the variance there, in units of that at their distance; over which
        length it is told [length]. None where only distances count.
    """

    distance: Array
    density: Array
    width: float
    power: float
    sharp: bool = True
    looseness: float = np.inf
    place: Array | None = None
    share: Array | None = None
    vicinity: float = 0.0

    @classmethod
    def of(cls, low: LowBand, *, sharp: bool = True) -> Prior:
        """Return a prior with the radial density that the frames show, and blobs as small as may be."""
        distance = np.linspace(0.0, low.radius, _SHELLS)
        density = np.abs(radial_density(low, distance))
        # an object may be hollow, or dark at its rim and bright inside
        density = np.maximum.accumulate(density[::-1])[::-1]
        power = float(np.max(np.mean(np.abs(low.modes) ** 2, axis=0)))
        return cls(distance, np.maximum(density / density[0], _LEAST), 0.0, power, sharp)

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
        variance = self._at_distance(position)
        if self.place is not None and self.share is not None:
            variance = variance * (_near(position, self.place, 0.5 * self.vicinity) @ self.share)
        return np.asarray(variance / variance.mean())

    def placed(self, low: LowBand, position: Array, square: Array, spread: Array) -> Prior:
        """Return the prior with the variance that each vicinity is told to have.

        Parameters
        ----------
        low:
            Says how large the object is.
        position:
            ``(n, 3)`` places of amplitudes, opposite ones at opposite ends.
        square, spread:
            ``(n,)`` squares of the likeliest amplitudes and variances that the frames leave them.
        """
        vicinity, before = _VICINITY * low.radius, self.variance(position)
        near = _near(position, position, vicinity)

        def together(values: Array) -> Array:
            # even and odd amplitudes stay apart only where opposite places are alike
            return np.asarray(near @ (0.5 * (values + values[::-1])) + _BEFOREHAND)

        after = before * together(square / before) / together(1 - spread / before)
        share = after / self._at_distance(position)
        power = self.power * float(after.mean())  # the variance before is 1 on the average
        return replace(self, power=power, place=position, share=share, vicinity=vicinity)

    def _at_distance(self, position: Array) -> Array:
        return np.asarray(np.interp(np.linalg.norm(position, axis=1), self.distance, self.density))

    def spectrum(self, k: Array) -> Array:
        """Return standard deviations of modes at spatial frequencies of length `k` [rad / length]."""
        square = (self.width * k) ** 2
        return np.asarray(np.sqrt(self.power) * (1 / (1 + square) if self.sharp else np.exp(-0.5 * square)))


def radial_density(low: LowBand, distance: Array) -> Array:
    """Return the mean density on spheres about the centre, up to a factor, smoothed.

    The mean of all frames has the Fourier transform F of that of the object turned into all directions, which
    is ``∫ F(k) sinc(k r) k² dk``; the modes lie as densely as ``k dk``.
    """
    k = np.hypot(low.k[:, 0], low.k[:, 1])
    mean = low.modes.mean(axis=0).real * np.exp(-0.5 * (_RESOLUTION * low.radius * k) ** 2)
    return np.asarray(np.sinc(np.outer(distance, k) / np.pi) @ (k * mean))


def _near(position: Array, place: Array, length: float) -> Array:
    """Return ``(n, L)`` weights of places about positions, Gaussian of a standard deviation, of sum 1."""
    weight = cdist(position, place, "sqeuclidean")
    weight *= -0.5 / length**2
    np.exp(weight, out=weight)
    weight /= weight.sum(axis=1, keepdims=True)
    return np.asarray(weight)
