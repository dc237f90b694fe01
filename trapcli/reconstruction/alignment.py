"""Frames with the object in the middle: the translation taken out, exactly for band-limited frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import finufft
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from trapcli.motion.centers import object_radius, pixel_noise, sample_frames
from trapcli.reconstruction.slices import cut, empty_level
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]

_PRECISION = 1e-6
_WIDER = 1.5  # square that is read for a turned one: its diagonal, and room for the ringing of edges


def align(frames: Frames, center: Array, *, edge: int = 0, turn: float = 0.0) -> Frames:
    """Return frames with the object's centre in pixel ``(edge // 2, edge // 2)``, computed as they are read.

    Parameters
    ----------
    frames:
        N attenuation projections.
    center:
        ``(N, 2)`` centres [pixels from pixel (H // 2, W // 2)]; frames whose centre is NaN become NaN.
    edge:
        Edge of the square frames [pixels]; 0: the shorter edge of the frames.
    turn:
        Angle by which the frames are turned about the centre, from x1 towards x2 [rad].

    Returns
    -------
    Frames
        float32, the empty field at 0; what lay outside of the frames is 0.
    """
    edge = edge or min(frames.shape[1:])
    images = sample_frames(frames)
    radius = object_radius(images, pixel_noise(images)) if len(images) else float(min(frames.shape[1:])) / 2

    def read_blocks(size: int) -> Iterator[NDArray[Any]]:
        done = 0
        for block in frames.blocks(size):
            aligned = np.full((len(block), edge, edge), np.nan, np.float32)
            for at, image in enumerate(block):
                middle = center[done + at]
                if np.isfinite(middle).all() and np.isfinite(image).all():
                    level = empty_level(image, middle, radius)
                    aligned[at] = (
                        _turned(image, middle, level, edge, turn)
                        if turn
                        else _moved(image, middle, level, edge)
                    )
            yield aligned
            done += len(block)

    shape = (len(frames), edge, edge)
    info = replace(frames.info, notes=(*frames.info.notes, "aligned: the object's centre is in the middle"))
    return replace(frames, shape=shape, dtype=np.dtype(np.float32), read_blocks=read_blocks, info=info)


def _moved(image: NDArray[Any], center: Array, level: float, edge: int) -> Array:
    """Cut at whole pixels and move by the rest, a phase in Fourier space."""
    whole = np.round(center).astype(int)
    square = cut(image, whole, edge, level)
    rest = center - whole
    k2, k1 = 2 * np.pi * scipy.fft.fftfreq(edge)[:, None], 2 * np.pi * scipy.fft.rfftfreq(edge)
    spectrum = scipy.fft.rfft2(square) * np.exp(1j * (k1 * rest[0] + k2 * rest[1]))
    return np.asarray(scipy.fft.irfft2(spectrum, square.shape))


def _turned(image: NDArray[Any], center: Array, level: float, edge: int, turn: float) -> Array:
    """Evaluate the image's Fourier series at the pixels of a turned square."""
    wide = 2 * (int(_WIDER * edge) // 2 + 1)
    whole = np.round(center).astype(int)
    square = cut(image, whole, wide, level)
    spectrum = scipy.fft.fftshift(scipy.fft.fft2(scipy.fft.ifftshift(square))) / wide**2
    # the highest frequency has no partner, and none of the object
    spectrum[0], spectrum[:, 0] = 0, 0
    x2, x1 = np.meshgrid(*(np.arange(edge) - edge // 2,) * 2, indexing="ij")
    c, s = np.cos(turn), np.sin(turn)
    rest = center - whole
    at1, at2 = (c * x1 + s * x2 + rest[0]).ravel(), (-s * x1 + c * x2 + rest[1]).ravel()
    unit = 2 * np.pi / wide
    values = finufft.nufft2d2(unit * at2, unit * at1, spectrum, isign=1, eps=_PRECISION, nthreads=1)
    return np.asarray(values.real.reshape(edge, edge))
