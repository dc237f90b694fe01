"""Which of what the frames show is the particle, and in which frames it is alone and whole.

The particle is what is largest. How far it reaches from its centre is the same in all frames, and so is the
integral of its attenuation: what stands out of the empty field farther away is something else and is erased;
where the integral is off, something lies before the particle, or a part of it has left the field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from trapcli.result.motion import Flag

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_COARSE = 256  # pixels across on which is looked
_PATCH = 5  # edge of the mean in which something must stand out [coarse pixels]
_CLEAR = 6.0  # standard deviations of such a mean
_DEEP = 0.05  # or of the frames' highest attenuation
_FAINT = 2.0  # peak of something, in units of that level, below which it is nothing
_USUAL = 0.2  # share of the frames in which the particle reaches so far
_MARGIN = 3  # width of the doubtful ring around the particle [coarse pixels]
_TOUCHING = 0.02  # attenuation beyond that, as a share of all, that belongs to something else
_OFF = 0.01  # least error of the integral, as a share
_OFF_SCATTER = 8.0  # the same in standard deviations of what is usual
_RIM = 0.4  # error from that, in units of level times reach
_RIM_WIDTH = 2  # of the edge of a frame [coarse pixels]
_MOST_OFF = 0.3  # share of frames for which that tells nothing
_FEWEST = 8  # frames that tell all this
_RIVAL = 0.3  # attenuation of another particle, as a share of the particle's


@dataclass(frozen=True)
class _Look:
    """A coarse look at a frame."""

    image: Array
    inside: Bools
    labels: NDArray[np.int32]
    distance: Array

    @cached_property
    def whole(self) -> float:
        return float(self.image[self.inside].sum())

    @property
    def at_edge(self) -> bool:
        """Whether something stands out at the edge of the frame."""
        rim = np.ones(self.inside.shape, bool)
        rim[_RIM_WIDTH:-_RIM_WIDTH, _RIM_WIDTH:-_RIM_WIDTH] = False
        return bool((self.inside & rim).any())


@dataclass(frozen=True)
class Particle:
    """How the particle is told from what else is there.

    Attributes
    ----------
    binning:
        Pixels averaged to one, in each direction, for all that follows.
    level:
        Attenuation that stands out of the empty field.
    reach:
        Distance from its centre up to which there is particle.
    whole, scatter:
        Integral of its attenuation, and by how much this usually is off; infinite where it varies anyway.
    """

    binning: int
    level: float
    reach: float
    whole: float
    scatter: float

    @classmethod
    def of(cls, projections: Sequence[NDArray[Any]]) -> Self | None:
        """Learn from some ``(H, W)`` frames what the particle is like; None where they don't tell."""
        binning = max(1, min(projections[0].shape) // _COARSE)
        coarse = [_coarse(image, binning) for image in projections if np.isfinite(image).mean() > 0.5]
        if len(coarse) < _FEWEST:
            return None
        noise = float(np.median([_noise(image) for image in coarse]))
        peak = float(np.median([np.quantile(_smooth(image), 0.999) for image in coarse]))
        level = max(_CLEAR * noise / _PATCH, _DEEP * peak)
        looks = [look for image in coarse if (look := _look(image, level)) is not None]
        if len(looks) < _FEWEST:
            return None
        rings = int(np.hypot(*coarse[0].shape)) + 2
        seen = [np.bincount(look.distance[look.inside].astype(int), minlength=rings) > 0 for look in looks]
        reach = float(np.argmin(np.mean(seen, axis=0) >= _USUAL))
        wholes = np.array(
            [look.image[look.inside & (look.distance <= reach + _MARGIN)].sum() for look in looks]
        )
        whole = float(np.median(wholes))
        # its rim is seen down to the level, give or take half a pixel
        scatter = max(1.4826 * float(np.median(np.abs(wholes - whole))), _RIM * level * reach)
        particle = cls(binning, level, reach, whole, scatter)
        if np.mean([particle._is_off(value) for value in wholes]) > _MOST_OFF:
            return replace(particle, scatter=np.inf)
        return particle

    def alone(self, image: NDArray[Any], unknown: Bools | None = None) -> NDArray[Any] | Flag:
        """Return the ``(H, W)`` frame with nothing but the particle; where that can't be had, why.

        Parameters
        ----------
        unknown:
            ``(H, W)`` pixels that tell nothing.
        """
        told = image if unknown is None or not unknown.any() else np.where(unknown, np.nan, image)
        look = _look(_coarse(told, self.binning), self.level)
        if look is None:
            return image
        far = look.inside & (look.distance > self.reach + _MARGIN)
        foreign = np.isin(look.labels, np.unique(look.labels[far])) if far.any() else far
        touching = bool(foreign[look.distance <= self.reach].any())
        if touching and look.image[far].sum() > _TOUCHING * look.whole:
            return Flag.OUTLIER
        whole = float(look.image[look.inside & ~far].sum())
        if self._is_off(whole):
            return Flag.CLIPPED if whole < self.whole and look.at_edge else Flag.OUTLIER
        if touching or not far.any():
            return image
        mask = (
            ndimage.binary_dilation(foreign, iterations=_MARGIN)
            .repeat(self.binning, 0)
            .repeat(self.binning, 1)
        )
        alone = image.copy()
        alone[: mask.shape[0], : mask.shape[1]][mask] = 0
        return alone

    def _is_off(self, whole: float) -> bool:
        return abs(whole - self.whole) > max(_OFF * self.whole, _OFF_SCATTER * self.scatter)

    def has_rival(self, image: NDArray[Any]) -> bool:
        """Tell whether an ``(H, W)`` frame shows another particle, apart and nearly as large."""
        look = _look(_coarse(image, self.binning), self.level)
        if look is None:
            return False
        far = look.inside & (look.distance > self.reach + _MARGIN)
        return bool(look.image[far].sum() > _RIVAL * look.image[look.inside & ~far].sum())


def _look(image: Array, level: float) -> _Look | None:
    """Return what stands out of a coarse image; None where nothing does."""
    smooth = _smooth(image)
    labels, count = ndimage.label(smooth > level)
    if not count:
        return None
    every = np.arange(1, count + 1)
    largest = int(every[np.argmax(ndimage.sum_labels(image, labels, every))])
    # beside the particle, what is faint is the noise before dust
    faint = ndimage.maximum(smooth, labels, every) < _FAINT * level
    labels[np.isin(labels, every[faint & (every != largest)])] = 0
    row, column = ndimage.center_of_mass(np.clip(image, 0, None), labels, largest)
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    return _Look(image, labels > 0, labels, np.hypot(rows - row, columns - column))


def _coarse(image: NDArray[Any], binning: int) -> Array:
    """Return means over squares of pixels; what is not known counts as empty."""
    if binning > 1:
        height, width = (size // binning for size in image.shape)
        image = image[: height * binning, : width * binning]
        if np.isnan(image).any():
            image = np.nan_to_num(image)
        rows = np.add.reduce(image.reshape(height, binning, -1), axis=1).reshape(-1, binning)
        image = (rows @ np.full(binning, 1 / binning**2, rows.dtype)).reshape(height, width)
    return np.nan_to_num(np.asarray(image, dtype=np.float64))


def _smooth(image: Array) -> Array:
    return np.asarray(ndimage.uniform_filter(image, _PATCH))


def _noise(image: Array) -> float:
    second = image[:, 2:] - 2 * image[:, 1:-1] + image[:, :-2]
    return float(1.4826 * np.median(np.abs(second)) / np.sqrt(6))
