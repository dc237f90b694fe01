"""Attenuation J = −log(I / I₀) from raw intensities, block by block.

The background I₀ is the empty field as the camera sees it: measured, the median in time of a moving particle,
a surface fitted to what a particle that stays leaves free, or a surface through each frame's border. How much
brighter or darker a frame is as a whole, its free pixels tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.config import PreprocessConfig
from trapcli.errors import InputError
from trapcli.motion.cells import Cells
from trapcli.preprocess.counts import Counts, Sample, mean_image, share
from trapcli.preprocess.particle import Particle
from trapcli.preprocess.surface import (
    EmptyField,
    Light,
    averaged,
    axes,
    border,
    coarse,
    fit_empty_field,
    grid,
    median_field,
)
from trapcli.result.motion import Flag
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_FROM_ALL_FRAMES = ("auto", "median", "surface")  # backgrounds that many frames together tell
_FLAGGED = 0.01  # share of pixels without light, or too bright, beyond which a frame can't be judged
_LEAVES = 0.6  # share of the frames in which a pixel must be free for a median in time
_COVERED = 0.01  # share of the pixels that may be free less often
_RIVAL = 0.9  # share of the frames that show another particle, beyond which there are two
_IMPRINT = 0.05  # darkness of a median where the particle stays, as a share of its depth, that shows it
_FULL = 0.05  # share of free pixels below which little tells the empty field
_COARSE = 256  # least cells across a frame, where it has as many pixels, in which the particle is looked for
_LOOKS = 32  # frames that tell what the particle is like


@dataclass(frozen=True)
class _Background:
    """What is taken off the frames, and what is to be said about it.

    Attributes
    ----------
    attenuation:
        Turns the ``(H, W)`` logarithm of one frame's light into log I₀ − log I, NaN in all pixels where I₀
        isn't known in most, else 0 in those where it isn't; returns its means over the cells in which the
        particle is looked for.
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

    def project(self, logs: NDArray[Any], unknown: Bools | None) -> Flag | None:
        """Turn ``(H, W)`` logarithms of light into attenuation of nothing but the particle; tell why not.

        Parameters
        ----------
        unknown:
            ``(H, W)`` pixels that tell nothing.
        """
        look = self.attenuation(logs)
        if self.particle is None:
            return None
        cells = _cells(logs.shape)
        foreign = self.particle.foreign(look if unknown is None else _known(logs, unknown, cells))
        if isinstance(foreign, Flag):
            return foreign
        if foreign is not None:
            mask = foreign.repeat(cells.binning, 0).repeat(cells.binning, 1)
            logs[: mask.shape[0], : mask.shape[1]][mask] = 0
        return None


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

    def project(position: int, image: NDArray[Any], out: NDArray[Any]) -> None:
        """Write one projection to `out`, NaN where there is none, and note why."""
        light = counts.log_light(image, out)
        spoilt = light.dark if background.keep_bright else _either(light.dark, light.bright)
        if share(spoilt) > _FLAGGED:
            flag: Flag | None = Flag.BLANK if share(light.dark) > _FLAGGED else Flag.SATURATED
        else:
            flag = background.project(out, light.dark)
        if flag is not None:
            left_out[position] = flag
            out[:] = np.nan

    def read_blocks(size: int) -> Iterator[NDArray[Any]]:
        done = 0
        for block in frames.read_blocks(size):
            projections = np.empty(block.shape, dtype)
            for n, image in enumerate(block):
                project(done + n, image, projections[n])
            done += len(block)
            if np.count_nonzero(left_out == Flag.BLANK) > len(frames) / 2:
                raise InputError(
                    f"{frames.info.source}: most frames have pixels of 0 or less, which have no logarithm; "
                    "give --attenuation if they are attenuation already"
                )
            yield projections

    def read_some(positions: NDArray[np.integer[Any]]) -> Iterator[NDArray[Any]]:
        for n, image in zip(positions, frames.pick(positions), strict=True):
            projection = np.empty(image.shape, dtype)
            project(n, image, projection)
            yield projection

    info = replace(
        frames.info,
        notes=(*frames.info.notes, background.note),
        warnings=(*frames.info.warnings, *background.warnings),
    )
    return Projections(frames.shape, dtype, frames.index, info, read_blocks, read_some, left_out=left_out)


def _either(first: Bools | None, second: Bools | None) -> Bools | None:
    return first | second if first is not None and second is not None else first if second is None else second


def _cells(shape: tuple[int, ...]) -> Cells:
    """Return the cells in which the particle is looked for."""
    return Cells(shape, max(1, min(shape) // _COARSE))


def _known(attenuation: NDArray[Any], unknown: Bools, cells: Cells) -> NDArray[Any]:
    """Return means over cells; what is not known counts as empty."""
    return cells.average(np.where(unknown, 0, attenuation))


def _background(frames: Frames, source: str, roi: tuple[int, ...], counts: Counts) -> _Background:
    guessed = source in _FROM_ALL_FRAMES
    sample = counts.sample(frames, _FLAGGED) if guessed else counts.sample(frames, _FLAGGED, _LOOKS)
    found = _with_particle(_find_background(frames, source, roi, counts, sample), frames, sample)
    doubts = []
    if sample.keep_bright:
        doubts.append("most frames are overexposed, and what is thin can't be measured in them")
    elif sample.overexposed:
        doubts.append(f"about {max(0.01, sample.overexposed):.0%} of the frames are overexposed and left out")
    if sample.repeated:
        doubts.append(
            f"about {max(0.01, sample.repeated):.0%} of the frames repeat the one before; times are wrong"
        )
    return replace(found, warnings=(*found.warnings, *doubts), keep_bright=sample.keep_bright)


def _with_particle(found: _Background, frames: Frames, sample: Sample) -> _Background:
    """Add what the particle is like, and what is to be said of what else there is."""
    cells = _cells(frames.shape[1:])
    some = replace(sample, images=sample.images[:: len(sample.images) // _LOOKS or 1])
    looks = []
    for logs in some.logs():
        look = found.attenuation(logs)
        unknown = None if np.isfinite(look).all() else np.isnan(logs)
        if share(unknown) < 0.5:
            looks.append(look if unknown is None else _known(logs, unknown, cells))
    particle = Particle.of(looks)
    if particle is None:
        return found
    if np.mean([particle.has_rival(look) for look in looks]) > _RIVAL:
        raise InputError(f"{frames.info.source}: shows two particles that stay apart; choose one with --roi")
    foreign = [particle.foreign(look) for look in looks]
    spoilt = float(np.mean([isinstance(one, Flag) for one in foreign]))
    erased = float(np.mean([one is not None for one in foreign])) - spoilt
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
    frames: Frames, source: str, roi: tuple[int, ...], counts: Counts, sample: Sample
) -> _Background:
    shape = frames.shape[1:]
    if source == "border":
        return _Background(_above_border(shape, 2), "background: a surface through the border")
    if source == "none":
        return _Background(_above_border(shape, 0), "background: none, a flat field")
    if source not in _FROM_ALL_FRAMES:
        light = mean_image(frames, source, roi, "background") - counts.dark
        field = np.log(np.where(light > 0, light, np.nan))
        return _Background(_lit_by_border(field), f"background: {source}")
    fitted = fit_empty_field(sample)
    covered = float(np.mean(fitted.outside < _LEAVES))
    if source == "median" or (source == "auto" and covered <= _COVERED):
        field = median_field(sample)
        shown = _imprint(field, fitted)
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


def _median(field: NDArray[Any], covered: float) -> _Background:
    note = f"background: median in time; the particle leaves {1 - covered:.0%} of the frame most of the time"
    return _Background(_lit_by_border(field), note)


def _imprint(field: NDArray[Any], fitted: EmptyField) -> float:
    """Return the share of cells in which a field is darker than the fitted one where the particle stays."""
    stays = fitted.outside < _LEAVES
    missing = averaged(fitted.log_light - field, fitted.light.cells)
    if not stays.all():
        missing -= np.nanmedian(missing[~stays])
    return float(np.mean(stays & (missing > _IMPRINT * fitted.depth)))


def _nothing(logs: NDArray[Any]) -> NDArray[Any]:
    """Tell no attenuation before a background that isn't known."""
    logs[:] = np.nan
    return _cells(logs.shape).average(logs)


def _lit(field: NDArray[Any], light: Light) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return the attenuation before a background as bright as each frame."""
    unknown, pixels = np.flatnonzero(~np.isfinite(field)), Cells(field.shape)
    if len(unknown) > field.size / 2:
        return _nothing
    double = np.nan_to_num(field)
    single = double.astype(np.float32)

    looked = _cells(field.shape)
    halved = Cells(grid(looked), 2)

    def attenuation(logs: NDArray[Any]) -> NDArray[Any]:
        np.subtract(single if logs.dtype == np.float32 else double, logs, out=logs)
        np.put(logs, unknown, 0)
        look = looked.average(logs)
        told = light.fit(averaged(look, halved) if light.cells.binning > looked.binning else look)
        light.take_off(logs, told, pixels)
        np.put(logs, unknown, 0)
        if looked.binning > 1:
            light.take_off(look, told, looked)
        return look

    return attenuation


def _lit_by_border(field: NDArray[Any]) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return the attenuation before a background as bright as each frame's border."""
    cells = coarse(field.shape)
    return _lit(field, Light.over(border(grid(cells)) & np.isfinite(cells.average(field)), cells))


def _above_border(shape: tuple[int, ...], degree: int) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return the attenuation before a polynomial surface through each frame's border."""
    cells, looked = coarse(shape), _cells(shape)
    edge = border(grid(cells))
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    x2, x1 = np.meshgrid(*axes(cells), indexing="ij")
    basis = np.stack([x1[edge] ** i * x2[edge] ** j for i, j in powers], axis=1)
    rows, columns = (axis ** np.arange(degree + 1)[:, None] for axis in axes(Cells(shape)))

    def attenuation(logs: NDArray[Any]) -> NDArray[Any]:
        by_power: Array = np.zeros((degree + 1, degree + 1))
        by_power[tuple(np.transpose(powers))] = _fit(basis, np.exp(averaged(logs, cells)[edge].astype(float)))
        surface: NDArray[Any] = (by_power @ rows).T.astype(logs.dtype) @ columns.astype(logs.dtype)
        if not surface.min() > 0:
            surface[~(surface > 0)] = np.nan
        np.subtract(np.log(surface, out=surface), logs, out=logs)
        unknown = np.isnan(logs)
        if unknown.any():
            logs[unknown] = np.nan if share(unknown) > 0.5 else 0.0
        return looked.average(logs)

    return attenuation


def _fit(basis: Array, values: Array) -> Array:
    """Fit ``(P, B)`` functions to ``(P,)`` values, the second time without outliers."""
    keep = np.isfinite(values)
    coefficients = np.zeros(basis.shape[1])
    for _ in range(2):
        if keep.sum() < basis.shape[1]:
            break
        coefficients = np.asarray(np.linalg.lstsq(basis[keep], values[keep], rcond=None)[0], dtype=float)
        misfit = np.abs(values - basis @ coefficients)
        keep &= misfit <= 3 * np.median(misfit[keep]) + 1e-12
    return coefficients
