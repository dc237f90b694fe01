"""Attenuation J = −log(I / I₀) from raw intensities, block by block.

The background I₀ is the empty field as the camera sees it: measured, the median in time of a moving object,
or a smooth surface through each frame's border. How much brighter or darker a frame is as a whole, its
border tells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from trapcli.config import InputConfig, PreprocessConfig
from trapcli.errors import InputError
from trapcli.stack.frames import Frames
from trapcli.stack.opening import open_stack

Array = NDArray[np.float64]
Background = Callable[[NDArray[Any]], NDArray[Any]]
"""Gives I₀ for a block of frames, broadcastable to it."""

_SAMPLED = 64  # frames of a median
_BORDER = 0.04  # width of the border, as a share of the shorter edge
_GHOST = 0.25  # depth of what a median may keep, as a share of the object's
_DARK_PIXELS = 0.01  # share of pixels without light beyond which a frame can't be judged


def to_attenuation(frames: Frames, config: PreprocessConfig, *, roi: tuple[int, ...] = ()) -> Frames:
    """Return the attenuation projections of raw frames, computed as they are read.

    Parameters
    ----------
    frames:
        Raw intensities, dark level 0; with `config.attenuation` what is wanted already, and returned as it
        is.
    config:
        Where the background comes from: the path of a file (the mean of its frames), ``median``, ``border``,
        ``none`` (a flat field as bright as each frame's border) or ``auto`` (``median`` unless the object
        stays in it, else ``border``).
    roi:
        Region of the background file that the frames show: (top, bottom, left, right).

    Returns
    -------
    Frames
        float32, or float64 where the input is. Pixels without light count as half a step above none; a frame
        with more than 1 % of them is all NaN.

    Raises
    ------
    InputError
        Where the background can't be read or doesn't fit; while reading, where most frames hold no light.
    """
    if config.attenuation:
        return frames
    background = _background(frames, config.background, roi)
    dtype = np.dtype(np.float64 if frames.dtype == np.float64 else np.float32)

    def read_blocks(size: int) -> Iterator[NDArray[Any]]:
        dark = 0
        for block in frames.read_blocks(size):
            attenuation = _minus_log(block, background(block), dtype)
            dark += int(np.isnan(attenuation[:, 0, 0]).sum())
            if dark > len(frames) / 2:
                raise InputError(
                    f"{frames.info.source}: most frames have pixels of 0 or less, which have no logarithm; "
                    "give --attenuation if they are attenuation already"
                )
            yield attenuation

    return replace(frames, dtype=dtype, read_blocks=read_blocks)


def _background(frames: Frames, source: str, roi: tuple[int, ...]) -> Background:
    if source in ("border", "none"):
        degree = 2 if source == "border" else 0
        return lambda block: _border_surface(block, degree)
    if source not in ("auto", "median"):
        field = _from_file(frames, source, roi)
        return lambda block: _scaled(field, block)
    sample = _sample(frames)
    field = np.median(sample, axis=0)
    if source == "auto" and _keeps_object(field, sample):
        return lambda block: _border_surface(block, 2)
    return lambda block: _scaled(field, block)


def _from_file(frames: Frames, path: str, roi: tuple[int, ...]) -> Array:
    """Return the mean of a background file's frames."""
    empty = open_stack(path, InputConfig(roi=roi))
    if empty.shape[1:] != frames.shape[1:]:
        sizes = " but ".join("{} x {}".format(*f.shape[1:]) for f in (empty, frames))
        raise InputError(f"{path}: the background is {sizes.replace(' but ', ' pixels but the frames are ')}")
    total = np.zeros(empty.shape[1:])
    for block in empty.blocks():
        total += block.sum(axis=0, dtype=float)
    return total / len(empty)


def _sample(frames: Frames) -> Array:
    """Return at most 64 frames spread over the stack, equally bright at the border, without dark ones."""
    wanted = np.unique(np.linspace(0, len(frames) - 1, min(_SAMPLED, len(frames))).round().astype(int))
    kept: list[NDArray[Any]] = []
    done = 0
    for block in frames.blocks():
        inside = wanted[(wanted >= done) & (wanted < done + len(block))] - done
        for image in np.asarray(block[inside], dtype=float):
            brightness = float(np.median(image[_border(image.shape)]))
            if brightness > 0:
                kept.append(image / brightness)
        done += len(block)
    if not kept:
        raise InputError(
            f"{frames.info.source}: all frames are dark; give --attenuation if they are no raw images"
        )
    return np.array(kept)


def _keeps_object(field: Array, sample: Array) -> bool:
    """Tell whether a median in time still shows the object, because that does not leave its place."""

    def depth(images: Array) -> float:
        attenuation = np.abs(_minus_log(images, _border_surface(images, 2), np.dtype(float)))
        # specks are small, an object is not
        size = max(3, min(field.shape) // 12)
        return float(np.median(uniform_filter(attenuation, (0, size, size)).max(axis=(1, 2))))

    return depth(field[None]) > _GHOST * depth(sample)


def _minus_log(block: NDArray[Any], background: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return −log(I / I₀); frames with too many pixels without light become NaN."""
    step = 0.5 if block.dtype.kind in "iub" else _smallest(block)
    light = np.asarray(block, dtype=dtype)
    field = np.broadcast_to(np.asarray(background, dtype=dtype), light.shape)
    lit = np.isfinite(light) & (light > 0)
    known = np.isfinite(field) & (field > 0)
    ratio = np.divide(np.where(lit, light, step), field, out=np.ones_like(light), where=known)
    attenuation: NDArray[Any] = -np.log(ratio)
    dark = (known & ~lit).mean(axis=(1, 2)) > _DARK_PIXELS
    attenuation[dark | (known.mean(axis=(1, 2)) < 0.5)] = np.nan
    return attenuation


def _smallest(block: NDArray[Any]) -> float:
    """Return half the smallest light in a block of floats."""
    positive = block[np.isfinite(block) & (block > 0)]
    return float(positive.min()) / 2 if positive.size else 1.0


def _border(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    width = max(2, round(_BORDER * min(shape)))
    border = np.ones(shape, bool)
    border[width:-width, width:-width] = False
    return border


def _scaled(field: Array, block: NDArray[Any]) -> Array:
    """Return the background as bright as the border of each frame."""
    border = _border(field.shape) & (field > 0)
    if not border.any():
        return field[None]
    brightness = np.median(block[:, border] / field[border], axis=1)
    brightness = np.where(brightness > 0, brightness, 1.0)
    return np.asarray(brightness[:, None, None] * field)


def _border_surface(block: NDArray[Any], degree: int) -> Array:
    """Fit a polynomial surface through the border of each frame, the second time without outliers."""
    height, width = block.shape[1:]
    x2, x1 = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    basis = np.stack([x1**i * x2**j for i, j in powers], axis=-1)
    border = _border((height, width))
    surfaces = []
    for image in block:
        values, columns = image[border].astype(float), basis[border]
        keep = np.isfinite(values)
        coefficients = np.zeros(len(powers))
        for _ in range(2):
            if keep.sum() < len(powers):
                break
            coefficients = np.linalg.lstsq(columns[keep], values[keep], rcond=None)[0]
            misfit = np.abs(values - columns @ coefficients)
            keep &= misfit <= 3 * np.median(misfit[keep]) + 1e-12
        surfaces.append(basis @ coefficients)
    return np.array(surfaces)
