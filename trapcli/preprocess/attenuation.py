"""Attenuation J = −log(I / I₀) from raw intensities, block by block.

The background I₀ is the empty field as the camera sees it: measured, the median in time of a moving particle,
a surface fitted to what a particle that stays leaves free, or a surface through each frame's border. How much
brighter or darker a frame is as a whole, its free pixels tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.config import PreprocessConfig
from trapcli.errors import InputError
from trapcli.preprocess.counts import Counts, mean_image
from trapcli.preprocess.particle import Particle
from trapcli.preprocess.surface import EmptyField, Light, border, fit_empty_field, median_field
from trapcli.result.motion import Flag
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]

_FLAGGED = 0.01  # share of pixels without light, or too bright, beyond which a frame can't be judged
_LEAVES = 0.6  # share of the frames in which a pixel must be free for a median in time
_COVERED = 0.01  # share of the pixels that may be free less often
_RIVAL = 0.9  # share of the frames that show another particle, beyond which there are two
_IMPRINT = 0.05  # darkness of a median where the particle stays, as a share of its depth, that shows it
_FULL = 0.05  # share of free pixels below which little tells the empty field


@dataclass(frozen=True)
class _Background:
    """What is taken off the frames, and what is to be said about it.

    Attributes
    ----------
    attenuation:
        Gives ``(H, W)`` log I₀ − log I for the logarithm of one frame's light, which it may overwrite; NaN
        where I₀ isn't known.
    keep_bright:
        Whether overexposed frames are kept, because most are.
    particle:
        Tells the particle from what else the frames show; None where that isn't known.
    """

    attenuation: Callable[[NDArray[Any]], NDArray[Any]]
    note: str
    warnings: tuple[str, ...] = ()
    keep_bright: bool = False
    particle: Particle | None = None


@dataclass(frozen=True)
class Projections(Frames):
    """Attenuation projections of raw frames.

    Attributes
    ----------
    left_out:
        ``(N,)`` uint16, `Flag` that says why a frame holds NaN; 0 for the others, and until it has been read.
    """

    left_out: NDArray[np.uint16] = field(kw_only=True)


def to_attenuation(frames: Frames, config: PreprocessConfig, *, roi: tuple[int, ...] = ()) -> Frames:
    """Return the attenuation projections of raw frames, computed as they are read.

    Parameters
    ----------
    frames:
        Raw intensities; with `config.attenuation` what is wanted already, and returned as it is.
    config:
        Where the background comes from: the path of a file (the mean of its frames), ``median`` in time,
        ``surface`` (fitted to all that the particle leaves free, with the specks that stay in place),
        ``border`` (a surface through each frame's border), ``none`` (a flat field as bright as that) or
        ``auto`` (``median`` where the particle leaves its place, else ``surface``). `config.dark` is taken
        off frames and background.
    roi:
        Region of the background and dark files that the frames show: (top, bottom, left, right).

    Returns
    -------
    Frames
        `Projections`; float32, or float64 where the input is. Pixels without light count as half a step above
        none. What stays apart from the particle is erased. A frame is all NaN where more than 1 % of it has
        no light, or is as bright as a pixel can be while most frames are not, or where something lies before
        the particle or a part of it is missing. `StackInfo.notes` says which background was taken and why,
        `StackInfo.warnings` what is doubtful.

    Raises
    ------
    ConfigError
        For a dark level that is no level.
    InputError
        Where background or dark frames can't be read or don't fit, a median shows the particle itself, or
        there are two particles; while reading, where most frames hold no light.
    """
    if config.attenuation:
        return frames
    counts = Counts.of(frames, config, roi)
    background = _background(frames, config.background, roi, counts)
    dtype = np.dtype(np.float64 if frames.dtype == np.float64 else np.float32)

    left_out = np.zeros(len(frames), np.uint16)

    def judged(image: NDArray[Any]) -> NDArray[Any] | Flag:
        """Return one projection, or why there is none."""
        light = counts.log_light(image, dtype)
        spoilt = light.dark if background.keep_bright else light.dark | light.bright
        if _share(spoilt) > _FLAGGED:
            return Flag.BLANK if _share(light.dark) > _FLAGGED else Flag.SATURATED
        attenuation = _attenuation(light.values, background).astype(dtype, copy=False)
        return background.particle.alone(attenuation, light.dark) if background.particle else attenuation

    def projection(position: int, image: NDArray[Any]) -> NDArray[Any]:
        """Return one projection, NaN where there is none, and note why."""
        found = judged(image)
        if isinstance(found, Flag):
            left_out[position] = found
            return np.full(image.shape, np.nan, dtype)
        return found

    def read_blocks(size: int) -> Iterator[NDArray[Any]]:
        done = 0
        for block in frames.read_blocks(size):
            projections = np.empty(block.shape, dtype)
            for n, image in enumerate(block):
                projections[n] = projection(done + n, image)
            done += len(block)
            if np.count_nonzero(left_out == Flag.BLANK) > len(frames) / 2:
                raise InputError(
                    f"{frames.info.source}: most frames have pixels of 0 or less, which have no logarithm; "
                    "give --attenuation if they are attenuation already"
                )
            yield projections

    def read_some(positions: NDArray[np.integer[Any]]) -> Iterator[NDArray[Any]]:
        return (projection(n, image) for n, image in zip(positions, frames.pick(positions), strict=True))

    info = replace(
        frames.info,
        notes=(*frames.info.notes, background.note),
        warnings=(*frames.info.warnings, *background.warnings),
    )
    return Projections(frames.shape, dtype, frames.index, info, read_blocks, read_some, left_out=left_out)


def _attenuation(logs: NDArray[Any], background: _Background) -> NDArray[Any]:
    """Return log I₀ − log I, 0 in pixels of unknown background; NaN where that is unknown in most."""
    attenuation = background.attenuation(logs)
    unknown = np.isnan(attenuation)
    if unknown.any():
        attenuation[unknown] = np.nan if _share(unknown) > 0.5 else 0.0
    return attenuation


def _share(mask: NDArray[np.bool_]) -> float:
    return np.count_nonzero(mask) / mask.size


def _background(frames: Frames, source: str, roi: tuple[int, ...], counts: Counts) -> _Background:
    sample = counts.sample(frames, _FLAGGED)
    found = _with_particle(_find_background(frames, source, roi, counts, sample.logs), frames, sample.logs)
    keep = sample.overexposed > 0.5
    doubts = []
    if keep:
        doubts.append("most frames are overexposed, and what is thin can't be measured in them")
    elif sample.overexposed:
        doubts.append(f"about {max(0.01, sample.overexposed):.0%} of the frames are overexposed and left out")
    if sample.repeated:
        doubts.append(
            f"about {max(0.01, sample.repeated):.0%} of the frames repeat the one before; times are wrong"
        )
    return replace(found, warnings=(*found.warnings, *doubts), keep_bright=keep)


def _with_particle(found: _Background, frames: Frames, sample: NDArray[np.float32]) -> _Background:
    """Add what the particle is like, and what is to be said of what else there is."""
    # the logarithms have served their purpose, and are large
    projections = [_attenuation(logs, found) for logs in sample[:: len(sample) // 32 or 1]]
    particle = Particle.of(projections)
    if particle is None:
        return found
    if np.mean([particle.has_rival(image) for image in projections]) > _RIVAL:
        raise InputError(f"{frames.info.source}: shows two particles that stay apart; choose one with --roi")
    alone = [particle.alone(image) for image in projections]
    spoilt = float(np.mean([isinstance(a, Flag) for a in alone]))
    erased = float(np.mean([a is not b for a, b in zip(alone, projections, strict=True)])) - spoilt
    doubts = []
    if spoilt:
        doubts.append(
            f"about {max(0.01, spoilt):.0%} of the frames are left out: something lies before the particle, "
            "or a part of it has left the field"
        )
    if erased:
        doubts.append(f"about {max(0.01, erased):.0%} of the frames show something else too, which is erased")
    return replace(found, particle=particle, warnings=(*found.warnings, *doubts))


def _find_background(
    frames: Frames, source: str, roi: tuple[int, ...], counts: Counts, sample: NDArray[np.float32]
) -> _Background:
    if source == "border":
        return _Background(partial(_above_border, degree=2), "background: a surface through the border")
    if source == "none":
        return _Background(partial(_above_border, degree=0), "background: none, a flat field")
    if source not in ("auto", "median", "surface"):
        light = mean_image(frames, source, roi, "background") - counts.dark
        field = np.log(np.where(light > 0, light, np.nan))
        return _Background(_lit(field, Light.over(border(field.shape))), f"background: {source}")
    fitted = fit_empty_field(sample)
    covered = float(np.mean(fitted.outside < _LEAVES))
    if source == "median" or (source == "auto" and covered <= _COVERED):
        field = median_field(sample)
        shown = _imprint(field, fitted, sample)
        if shown <= _COVERED:
            return _median(field, covered)
        if source == "median":
            raise InputError(
                f"{frames.info.source}: the particle stays over {max(covered, shown):.0%} of the frame, so "
                "its median shows it; give --background surface, or a file of the empty field"
            )
    note = (
        f"background: a surface of degree {fitted.degree} and {fitted.specks} specks; "
        f"the particle stays over {covered:.0%} of the frame"
    )
    unsure = "the particle fills the frame, so its background is a guess; give one as a file"
    filled = bool((fitted.outside > 0).mean() < _FULL)
    return _Background(_lit(fitted.log_light, fitted.light), note, (unsure,) * filled)


def _median(field: Array, covered: float) -> _Background:
    note = f"background: median in time; the particle leaves {1 - covered:.0%} of the frame most of the time"
    return _Background(_lit(field, Light.over(border(field.shape))), note)


def _imprint(field: Array, fitted: EmptyField, sample: NDArray[np.float32]) -> float:
    """Return the share of pixels in which a field is darker than the fitted one where the particle stays."""
    stays = fitted.outside < _LEAVES
    missing = fitted.log_light - field
    if not stays.all():
        missing -= np.nanmedian(missing[~stays])
    depth = np.nanquantile(fitted.log_light - sample, 0.999)
    return float(np.mean(stays & (missing > _IMPRINT * depth)))


def _lit(field: Array, light: Light) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return the attenuation before a background as bright as each frame."""
    single = field.astype(np.float32)

    def attenuation(logs: NDArray[Any]) -> NDArray[Any]:
        ratio: NDArray[Any] = np.subtract(single if logs.dtype == np.float32 else field, logs, out=logs)
        ratio -= light.of(light.fit(ratio), ratio.shape)
        return ratio

    return attenuation


def _above_border(logs: NDArray[Any], degree: int) -> NDArray[Any]:
    return np.asarray(_border_surface(logs, degree) - logs)


def _border_surface(logs: NDArray[Any], degree: int) -> Array:
    """Fit a polynomial surface through a frame's border, the second time without outliers."""
    image = np.exp(logs.astype(float))
    height, width = image.shape
    x2, x1 = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    basis = np.stack([x1**i * x2**j for i, j in powers], axis=-1)
    edge = border((height, width))
    values, columns = image[edge], basis[edge]
    keep = np.isfinite(values)
    coefficients = np.zeros(len(powers))
    for _ in range(2):
        if keep.sum() < len(powers):
            break
        coefficients = np.linalg.lstsq(columns[keep], values[keep], rcond=None)[0]
        misfit = np.abs(values - columns @ coefficients)
        keep &= misfit <= 3 * np.median(misfit[keep]) + 1e-12
    surface = basis @ coefficients
    return np.asarray(np.log(np.where(surface > 0, surface, np.nan)))
