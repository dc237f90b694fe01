"""The object turning beside the video: a volume and some frames, small enough for a page."""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from trapcli.errors import InputError
from trapcli.reconstruction.slices import MARGIN, empty_level
from trapcli.reconstruction.units import ANGSTROMS
from trapcli.result.motion import Motion
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

MOST_FRAMES = 72
"""Frames that are shown."""

_MOST_SAMPLES = 64  # along an edge of the volume
_MOST_PIXELS = 96  # along an edge of a frame
_SMOOTH = np.deg2rad(10.0)  # rotation from one shown frame to the next that still looks continuous
_RANGE = (0.001, 0.9995)  # quantiles of the frames that their grey scale spans


@dataclass(frozen=True)
class Turning:
    """What the page needs to turn a volume by a motion.

    Attributes
    ----------
    values:
        ``(m, m, m)`` volume ``[x3, x2, x1]``, 0 … 255 for `low` … `high`; the centre is sample ``m // 2``.
    low, high:
        Attenuation per unit length.
    step:
        Edge of a sample in the motion's unit of length.
    unit:
        That unit.
    positions:
        ``(F,)`` frames of the motion that are shown.
    film:
        ``(F, s, s)`` these frames about the object's centre, as large as the volume; None without a stack.
    film_low, film_high:
        Attenuation that 0 … 255 stand for in them, and in projections of the volume.
    """

    values: Bytes
    low: float
    high: float
    step: float
    unit: str
    positions: NDArray[np.intp]
    film: Bytes | None
    film_low: float
    film_high: float


def prepare(values: NDArray[Any], voxel_size: float, unit: str, motion: Motion) -> Turning:
    """Bring a volume to the size of a page, and choose the frames to show.

    Parameters
    ----------
    values:
        ``(n, n, n)`` volume ``[x3, x2, x1]`` in the orientation of the motion's first frame, its centre in
        voxel ``n // 2`` of each axis.
    voxel_size, unit:
        Edge of a voxel.

    Raises
    ------
    InputError
        Where the volume is no cube of finite numbers, its unit can't be brought to that of the motion, or the
        motion holds no rotation.
    """
    if values.ndim != 3 or len(set(values.shape)) != 1 or not np.isfinite(values).all():
        raise InputError(
            f"a volume of shape {values.shape} is no cube of finite voxels as reconstruct writes"
        )
    n = len(values)
    m = min(n, _MOST_SAMPLES)
    ratio = n / m
    small = values.astype(np.float32)
    if ratio > 1:
        small = ndimage.gaussian_filter(small, 0.5 * ratio)
        small = ndimage.affine_transform(small, (ratio,) * 3, n // 2 - ratio * (m // 2), (m,) * 3, order=1)
    scale = _scale(unit, motion.length_unit)
    low, high = min(0.0, float(small.min())) / scale, float(small.max()) / scale
    step = ratio * voxel_size * scale
    highest = max(float(small.sum(axis=axis).max()) for axis in range(3)) * step / scale
    return Turning(
        values=_bytes(small / scale, low, high),
        low=low,
        high=high,
        step=step,
        unit=motion.length_unit,
        positions=_positions(motion),
        film=None,
        film_low=0.0,
        film_high=highest,
    )


def with_film(turning: Turning, attenuation: Frames, motion: Motion, pixel_size: float) -> Turning:
    """Add the frames themselves, about the object's centre and as large as the volume.

    Parameters
    ----------
    attenuation:
        All N frames of the motion.
    pixel_size:
        Edge of a pixel in the motion's unit of length.
    """
    edge = len(turning.values) * turning.step / pixel_size
    side = int(min(np.ceil(edge), _MOST_PIXELS))
    images = [
        _about(np.asarray(image, float), center, edge, side)
        for image, center in zip(
            attenuation.pick(turning.positions), motion.center[turning.positions] / pixel_size, strict=True
        )
    ]
    low, high = (float(value) for value in np.quantile(images, _RANGE))
    low = min(low, 0.0)
    return replace(turning, film=_bytes(np.array(images), low, high), film_low=low, film_high=high)


def to_json(turning: Turning, motion: Motion) -> dict[str, Any]:
    """Return all but the samples, for the script of the page."""
    at = turning.positions
    omega = np.stack([motion.omega_1, motion.omega_2, motion.omega_3], axis=1)[at]
    return {
        "samples": len(turning.values),
        "low": turning.low,
        "high": turning.high,
        "step": turning.step,
        "unit": turning.unit,
        "side": 0 if turning.film is None else turning.film.shape[1],
        "filmLow": turning.film_low,
        "filmHigh": turning.film_high,
        "frame": motion.frame[at].tolist(),
        "time": [float(f"{time:.6g}") for time in motion.time[at]],
        "timeUnit": motion.time_unit,
        "R": motion.R[at].round(5).reshape(-1, 9).tolist(),
        "omega": [w.round(9).tolist() if np.isfinite(w).all() else None for w in omega],
    }


def packed(turning: Turning) -> str:
    """Return the samples of volume and frames, one after the other, deflated, as base64."""
    samples = turning.values.tobytes() + (b"" if turning.film is None else turning.film.tobytes())
    return base64.b64encode(zlib.compress(samples, 9)).decode()


def _scale(unit: str, wanted: str) -> float:
    if unit == wanted:
        return 1.0
    if unit in ANGSTROMS and wanted in ANGSTROMS:
        return ANGSTROMS[unit] / ANGSTROMS[wanted]
    raise InputError(f"a volume in {unit} does not fit a result in {wanted}")


def _positions(motion: Motion) -> NDArray[np.intp]:
    """Return the frames to show: from the first one on, so close that the object is seen to turn."""
    known = np.isfinite(motion.R).all(axis=(1, 2)) & np.isfinite(motion.center).all(axis=1)
    if (known & (motion.valid > 0)).any():
        known &= motion.valid > 0
    usable = np.flatnonzero(known)
    if not len(usable):
        raise InputError("the result holds no rotation by which a volume could turn")
    R = motion.R[usable]
    turn = Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).magnitude() if len(R) > 1 else np.zeros(1)
    smooth = int(_SMOOTH / max(float(np.median(turn)), 1e-9))
    stride = max(1, min(-(-len(usable) // MOST_FRAMES), smooth))
    return np.asarray(usable[::stride][:MOST_FRAMES])


def _about(image: Array, center: Array, edge: float, side: int) -> Array:
    """Return `side` samples along each edge of a square of `edge` pixels about `center`, the field at 0."""
    height, width = image.shape
    image = image - empty_level(image, center, edge / 2 / MARGIN)
    step = edge / side
    image = np.nan_to_num(image)
    if step > 1:
        image = ndimage.gaussian_filter(image, 0.5 * step)
    first = np.array([height // 2 + center[1], width // 2 + center[0]]) - step * (side // 2)
    return np.asarray(ndimage.affine_transform(image, (step, step), first, (side, side), order=1))


def _bytes(values: NDArray[Any], low: float, high: float) -> Bytes:
    spread = (high - low) or 1.0
    return np.clip(np.rint(255 * (values - low) / spread), 0, 255).astype(np.uint8)
