"""From attenuation to all that the joint estimate knows of the frames, reading each of them once.

A first look at some frames tells the noise and the object's radius, and with them how coarse the cells may be
that pixels are averaged to. Then frames come one by one: averaged in the thread that reads them, centred, cut
to the object and reduced to their low band. No frame is kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.motion.cells import Cells, cut_square
from trapcli.motion.centers import (
    Centers,
    Progress,
    Tracker,
    noise_between,
    object_radius,
    pixel_noise,
    spread,
)
from trapcli.motion.low_band import SQUARE, LowBand, LowBandReader
from trapcli.motion.reduced_map import BandReader
from trapcli.motion.types import ReducedMap
from trapcli.stack.ahead import read_ahead
from trapcli.stack.frames import Frames
from trapcli.threads import in_parallel

Array = NDArray[np.float64]

_SURVEY = 32  # frames that are looked at first
_SURVEY_PIXELS = 2 << 20  # that the noise is measured on
_COARSE = 256  # pixels across on which the radius is measured
_BLOCK_BYTES = 8 << 20
_LEAST_NOISE = 1e-3  # noise, as a share of the peak, below which the models' own errors dominate
_LEAST_VISIBLE = 5e-3  # share of the peak at which the object ends
_HIDDEN = 4.0  # noise, in units of that, from which on it hides a part that matters
_MOST_HIDDEN = 1.4  # radius of the object, in units of what the noise lets us see, at most


@dataclass(frozen=True)
class FrontEnd:
    """What the joint estimate knows of N frames."""

    centers: Centers
    reduced: ReducedMap
    low: LowBand


def read_front_end(
    attenuation: Frames,
    *,
    time: Array,
    pixel_size: float,
    line_band: float,
    fine_band: float,
    band: float = 0.0,
    progress: Progress | None = None,
) -> FrontEnd:
    """Read all frames once: centres, the reduced map and the low band about them.

    Parameters
    ----------
    attenuation:
        N attenuation projections.
    time:
        ``(N,)`` times.
    pixel_size:
        Edge of a pixel [length].
    line_band, fine_band:
        Highest spatial frequency of the reduced map and of the low band, times the object's radius.
    band:
        Highest spatial frequency of both [rad / length]; 0: as `line_band` and `fine_band` say.
    progress:
        Called as ``progress("frames", done, N)``.

    Returns
    -------
    FrontEnd
        The noise is at least 0.1 % of the peak, and the object ends where it falls below 0.5 % of it. NaN in
        blank frames.
    """
    look = _look(attenuation)
    n, shape = len(attenuation), attenuation.shape[1:]
    cells = Cells.for_radius(shape, look.radius)
    radius, b = look.radius * pixel_size, cells.binning
    tracker = Tracker(n, look.pixel_noise / b, look.reach / b)
    visible = look.visible * pixel_size
    lines = BandReader(n, visible, min(line_band / visible, band or np.inf), pixel_size, b)
    low = LowBandReader(n, radius, band or fine_band / radius, pixel_size, b)
    half = max(lines.half, low.half)
    whole = np.zeros((n, 2), int)
    with closing(read_ahead(_averaged(attenuation, cells))) as blocks:
        for block in blocks:
            for image in block:
                i = tracker.done
                if tracker.follow(image):
                    whole[i] = np.round(tracker.place[i])
                    square = cut_square(image, whole[i], half, tracker.level[i])
                    rest = (tracker.place[i] - whole[i]) * b * pixel_size
                    lines.read(i, _middle(square, lines.half), rest)
                    low.read(i, _middle(square, low.half), rest)
            if progress is not None:
                progress("frames", tracker.done, n)
    centers = tracker.centers(shape, pixel_size, cells)
    rest = centers.center - cells.to_pixels(whole) * pixel_size
    centers = replace(centers, radius=radius, noise=look.noise)
    return FrontEnd(centers, lines.about(rest, time, look.noise), low.about(rest, time, look.noise))


@dataclass(frozen=True)
class _Look:
    """What some frames tell.

    Attributes
    ----------
    pixel_noise, noise:
        Standard deviation of the noise of one pixel as measured, and as it is to be taken.
    reach, visible, radius:
        Distance from the centre up to which anything stands out of the noise, up to which the object does,
        and to which it may go on [pixels].
    """

    pixel_noise: float
    noise: float
    reach: float
    visible: float
    radius: float


def _look(attenuation: Frames) -> _Look:
    """Look at frames spread evenly over the stack."""
    shape = attenuation.shape[1:]
    cells = Cells(shape, max(1, min(shape) // _COARSE))
    few = max(4, _SURVEY_PIXELS // (shape[0] * shape[1]))
    noises: list[float] = []
    coarse: list[Array] = []
    wanted = spread(len(attenuation), _SURVEY)
    pairs = spread(len(attenuation), few) if few > len(wanted) else wanted[spread(len(wanted), few)]
    every = np.unique(np.concatenate([wanted, pairs, np.minimum(pairs + 1, len(attenuation) - 1)]))
    first, last = np.empty(0), -2
    for position, image in zip(every, attenuation.pick(every), strict=True):
        averaged = cells.average(image)
        if not np.isfinite(averaged).all():
            continue
        if position == last + 1:
            noises.append(noise_between(first, image))
        if position in pairs or not len(first):
            first, last = np.array(image), position
        if position in wanted:
            coarse.append(np.array(averaged, float))
    if not coarse:
        farthest = float(np.hypot(*shape))
        return _Look(0.0, 0.0, farthest, farthest, farthest)
    images = np.array(coarse)
    noise, b = float(np.median(noises or [pixel_noise(first[None])])), cells.binning
    peak = float(np.quantile(images, 0.9999) - np.median(images))
    faintest = _LEAST_VISIBLE * peak
    least = max(noise, faintest)
    hidden = max(float(np.log2(least / (_HIDDEN * faintest))), 0.0) if faintest > 0 else 0.0
    levels = sorted({noise, least, 2 * least} if hidden else {noise, least})
    radii = in_parallel(partial(object_radius, images), [level / b for level in levels])
    at = dict(zip(levels, (b * radius for radius in radii), strict=True))
    reach, visible = at[noise], at[least]
    # what the noise hides of the object goes on falling, as a Gaussian does, as it fell before
    inner = at.get(2 * least, visible)
    whole = float(np.sqrt(visible**2 + hidden * max(visible**2 - inner**2, 0.0)))
    # but no farther than the frame does
    radius = min(whole, _MOST_HIDDEN * visible, max(visible, min(shape) / 2 / SQUARE))
    return _Look(noise, max(noise, _LEAST_NOISE * peak), reach, visible, radius)


def _averaged(attenuation: Frames, cells: Cells) -> Iterator[list[NDArray[Any]]]:
    """Yield the frames as cells, block by block."""
    frame_bytes = attenuation.shape[1] * attenuation.shape[2] * attenuation.dtype.itemsize
    for block in attenuation.blocks(max(1, _BLOCK_BYTES // frame_bytes)):
        yield [cells.average(image) for image in block]


def _middle(square: Array, half: int) -> Array:
    """Return the square of 2 `half` + 1 cells in the middle of a larger one."""
    margin = (len(square) - 1) // 2 - half
    return square[margin : len(square) - margin, margin : len(square) - margin]
