"""Which of what the frames show is the particle, and in which frames it is alone and whole.

The particle is what is largest. How far it reaches from its centre is the same in all frames, and so is the
integral of its attenuation: what stands out of the empty field farther away is something else and is erased;
where the integral is off, something lies before the particle, or a part of it has left the field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from trapcli.result.motion import Flag

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_REACH = 2  # of the mean in which something must stand out, to either side [cells]
_PATCH = 2 * _REACH + 1
_CLEAR = 6.0  # standard deviations of such a mean
_DEEP = 0.05  # or of the frames' highest attenuation
_FAINT = 2.0  # peak of something, in units of that level, below which it is nothing
_USUAL = 0.2  # share of the frames in which the particle reaches so far
_MARGIN = 3  # width of the doubtful ring around the particle [cells]
_TOUCHING = 0.02  # attenuation beyond that, as a share of all, that belongs to something else
_OFF = 0.01  # least error of the integral, as a share
_OFF_SCATTER = 8.0  # the same in standard deviations of what is usual
_RIM = 0.4  # error from that, in units of level times reach
_RIM_WIDTH = 2  # of the edge of a frame [cells]
_MOST_OFF = 0.3  # share of frames for which that tells nothing
_FEWEST = 8  # frames that tell all this
_NOISE_ROWS = 64  # of a frame that tell its noise
_RIVAL = 0.3  # attenuation of another particle, as a share of the particle's


@dataclass(frozen=True)
class _Look:
    """The P cells of a frame that stand out.

    Attributes
    ----------
    rows, columns:
        ``(P,)`` places.
    labels:
        ``(P,)`` which of several things each belongs to.
    values, distance:
        ``(P,)`` attenuation, and distance from the centre of what is largest.
    shape:
        ``(h, w)`` of the frame.
    """

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    labels: NDArray[np.int32]
    values: NDArray[Any]
    distance: NDArray[Any]
    shape: tuple[int, ...]

    @property
    def at_edge(self) -> bool:
        """Whether something stands out at the edge of the frame."""
        height, width = self.shape
        near = np.minimum(self.rows, height - 1 - self.rows) < _RIM_WIDTH
        near |= np.minimum(self.columns, width - 1 - self.columns) < _RIM_WIDTH
        return bool(near.any())

    def mask(self, chosen: Bools) -> Bools:
        """Return some of the ``(P,)`` cells as an ``(h, w)`` mask."""
        mask = np.zeros(self.shape, bool)
        mask[self.rows[chosen], self.columns[chosen]] = True
        return mask


@dataclass(frozen=True)
class Particle:
    """How the particle is told from what else is there, in frames that are averaged to cells.

    Attributes
    ----------
    level:
        Attenuation that stands out of the empty field.
    reach:
        Distance from its centre up to which there is particle [cells].
    whole, scatter:
        Integral of its attenuation, and by how much this usually is off; infinite where it varies anyway.
    """

    level: float
    reach: float
    whole: float
    scatter: float

    @classmethod
    def of(cls, images: Sequence[NDArray[Any]]) -> Self | None:
        """Learn from some ``(h, w)`` images what the particle is like; None where they don't tell."""
        if len(images) < _FEWEST:
            return None
        noise = float(np.median([_noise(image) for image in images]))
        peak = float(np.median([np.quantile(_smooth(image), 0.999) for image in images]))
        level = max(_CLEAR * noise / _PATCH, _DEEP * peak)
        looks = [look for image in images if (look := _look(image, level)) is not None]
        if len(looks) < _FEWEST:
            return None
        rings = int(np.hypot(*images[0].shape)) + 2
        seen = [np.bincount(look.distance.astype(int), minlength=rings) > 0 for look in looks]
        reach = float(np.argmin(np.mean(seen, axis=0) >= _USUAL))
        wholes = np.array([look.values[look.distance <= reach + _MARGIN].sum(dtype=float) for look in looks])
        whole = float(np.median(wholes))
        # its rim is seen down to the level, give or take half a cell
        scatter = max(1.4826 * float(np.median(np.abs(wholes - whole))), _RIM * level * reach)
        particle = cls(level, reach, whole, scatter)
        if np.mean([particle._is_off(value) for value in wholes]) > _MOST_OFF:
            return replace(particle, scatter=np.inf)
        return particle

    def foreign(self, image: NDArray[Any]) -> Bools | Flag | None:
        """Tell what of an ``(h, w)`` image is something else.

        Returns
        -------
        ndarray or Flag or None
            ``(h, w)`` cells to be erased; None where the particle is alone; why the frame can't be used.
        """
        look = _look(image, self.level)
        if look is None:
            return None
        far = look.distance > self.reach + _MARGIN
        if not far.any():
            foreign, touching, beyond = far, False, 0.0
        else:
            foreign = np.isin(look.labels, np.unique(look.labels[far]))
            touching = bool(foreign[look.distance <= self.reach].any())
            beyond = float(look.values[far].sum(dtype=float))
        whole = float(look.values.sum(dtype=float)) - beyond
        if touching and beyond > _TOUCHING * (whole + beyond):
            return Flag.OUTLIER
        if self._is_off(whole):
            return Flag.CLIPPED if whole < self.whole and look.at_edge else Flag.OUTLIER
        if touching or not far.any():
            return None
        return np.asarray(ndimage.binary_dilation(look.mask(foreign), iterations=_MARGIN))

    def _is_off(self, whole: float) -> bool:
        return abs(whole - self.whole) > max(_OFF * self.whole, _OFF_SCATTER * self.scatter)

    def has_rival(self, image: NDArray[Any]) -> bool:
        """Tell whether an ``(h, w)`` image shows another particle, apart and nearly as large."""
        look = _look(image, self.level)
        if look is None:
            return False
        far = look.distance > self.reach + _MARGIN
        return bool(look.values[far].sum() > _RIVAL * look.values[~far].sum())


def _look(image: NDArray[Any], level: float) -> _Look | None:
    """Return what stands out of an image; None where nothing does."""
    smooth = _smooth(image)
    clear = smooth > level
    labels, count = ndimage.label(clear)
    if not count:
        return None
    places = np.flatnonzero(clear)
    label, values = labels.ravel()[places], image.ravel()[places]
    largest = 1
    if count > 1:
        largest = int(np.argmax(np.bincount(label, values)[1:])) + 1
        # beside the particle, what is faint is the noise before dust
        highest = np.zeros(count + 1)
        np.maximum.at(highest, label, smooth.ravel()[places])
        highest[largest] = np.inf
        some = highest[label] >= _FAINT * level
        if not some.all():
            places, label, values = places[some], label[some], values[some]
    rows, columns = np.divmod(places, image.shape[1])
    weights = np.clip(values, 0, None) * (label == largest)
    total = max(float(weights.sum()), np.finfo(float).tiny)
    row, column = float(weights @ rows) / total, float(weights @ columns) / total
    return _Look(rows, columns, label, values, np.hypot(rows - row, columns - column), image.shape)


def _smooth(image: NDArray[Any]) -> NDArray[Any]:
    """Return means over `_PATCH` × `_PATCH` cells; the image goes on mirrored beyond its edge."""
    for _ in range(2):
        image = _summed(np.concatenate([image[_REACH - 1 :: -1], image, image[: -_REACH - 1 : -1]])).T
    return image / _PATCH**2


def _summed(image: NDArray[Any]) -> NDArray[Any]:
    """Return sums over `_PATCH` rows."""
    height = len(image) - 2 * _REACH
    total: NDArray[Any] = image[:height] + image[1 : height + 1]
    for first in range(2, _PATCH):
        total += image[first : height + first]
    return total


def _noise(image: NDArray[Any]) -> float:
    some = image[:: max(1, len(image) // _NOISE_ROWS)]
    second = some[:, 2:] - 2 * some[:, 1:-1] + some[:, :-2]
    return float(1.4826 * np.median(np.abs(second)) / np.sqrt(6))
