"""Frames as planes through the object's Fourier space: squares about the centres, transformed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from trapcli.errors import InputError
from trapcli.motion.centers import object_radius, pixel_noise, sample_frames
from trapcli.motion.fourier_slices import conjugate_share
from trapcli.result.motion import Flag, Motion
from trapcli.stack.frames import Frames
from trapcli.threads import processors

Array = NDArray[np.float64]
Complex = NDArray[np.complex64]

MARGIN = 1.3
"""Half the edge of the square, and of the volume, in radii of the object."""

_LEAST_NOISE = 1e-3  # noise, as a share of the peak, below which errors of the model dominate
_LEAST_VISIBLE = 5e-3  # share of the peak at which the object ends
_OUTSIDE = 1.2  # radii of the object beyond which the field is empty
_FEWEST_OUTSIDE = 0.05  # share of the frame that must lie there to tell the empty field's level
_ENOUGH = 256  # pixels across that tell noise and level
_NOISIER = 1.5  # noise of a frame, in units of what is typical, from which it counts less
_POINTS = 1 << 20  # modes in a block
_FEWEST = 3  # frames


@dataclass(frozen=True)
class Survey:
    """What is known of a stack and its motion before the volume is computed.

    Attributes
    ----------
    use:
        ``(N,)`` frames whose motion can be trusted and whose object lies inside the field of view.
    center:
        ``(N, 2)`` centres [pixels from pixel (H // 2, W // 2)].
    R:
        ``(N, 3, 3)`` rotations, lab to object.
    noise:
        Standard deviation of the noise of a pixel [attenuation].
    radius:
        Radius of the object [pixels].
    edge:
        Edge of the square that is cut from each frame [pixels]; even.
    clipped:
        Number of frames that are used although the field of view clips their object.
    """

    use: NDArray[np.bool_]
    center: Array
    R: Array
    noise: float
    radius: float
    edge: int
    clipped: int


def survey(frames: Frames, motion: Motion, pixel_size: float) -> Survey:
    """Look at some frames for noise and radius, and decide which frames are used.

    Parameters
    ----------
    frames:
        N attenuation projections, those of `motion`.
    pixel_size:
        Edge of a pixel in the motion's unit of length.

    Raises
    ------
    InputError
        Where fewer than 3 frames have a known motion.
    """
    known = np.isfinite(motion.R).all(axis=(1, 2)) & np.isfinite(motion.center).all(axis=1)
    known &= motion.valid > 0 if motion.identifiable else True
    clipped = motion.flags & np.uint16(Flag.CLIPPED) > 0
    whole = known & ~clipped
    use = np.asarray(whole if whole.sum() > known.sum() / 2 else known)
    if use.sum() < _FEWEST:
        raise InputError(
            f"{frames.info.source}: {use.sum()} frames have a known motion; at least {_FEWEST} are needed"
        )
    images = sample_frames(frames)
    if not len(images):
        raise InputError(f"{frames.info.source}: shows no object; no frame sampled has finite values")
    peak = float(np.quantile(np.abs(images - np.median(images)), 0.9999))
    noise = pixel_noise(images)
    radius = min(object_radius(images, max(noise, _LEAST_VISIBLE * peak)), max(frames.shape[1:]) / 2)
    return Survey(
        use=use,
        center=motion.center / pixel_size,
        R=motion.R,
        noise=max(noise, _LEAST_NOISE * peak, 1e-30),
        radius=radius,
        edge=2 * int(scipy.fft.next_fast_len(int(np.ceil(MARGIN * radius)), real=True)),
        clipped=int((use & clipped).sum()),
    )


@dataclass(frozen=True)
class Slices:
    """Some frames as whitened modes.

    Attributes
    ----------
    frame:
        ``(G,)`` positions in the stack.
    R:
        ``(G, 3, 3)``.
    modes:
        ``(G, K)`` in units of their noise, so that E|noise|² = 1.
    weight:
        ``(G,)`` weight of each frame: 1 for typical noise, less for more.
    """

    frame: NDArray[np.intp]
    R: Array
    modes: Complex
    weight: Array


class SliceReader:
    """Reads the used frames, block by block, as often as wanted.

    Parameters
    ----------
    frames:
        Attenuation projections.
    survey:
        Of these frames.
    voxels:
        Edge of the volume in voxels; modes that its voxels can't hold are left out.

    Attributes
    ----------
    k:
        ``(K, 2)`` modes [rad / voxel], half of the plane.
    share:
        ``(K,)`` 1 for k = 0, 2 for all others, which stand for their conjugates too.
    scale:
        A whitened mode is `scale` times the sum ``Σ_b lattice[b] exp(−i⟨R k, b⟩)`` of an object whose values
        are attenuation per pixel edge, times voxels per pixel to the power of −3.
    """

    def __init__(self, frames: Frames, survey: Survey, voxels: int) -> None:
        self.frames, self.survey, self.voxels = frames, survey, voxels
        edge = survey.edge
        reach = (min(voxels, edge) - 1) // 2
        m = np.arange(-reach, reach + 1)
        m1, m2 = np.meshgrid(m, m)
        kept = (np.hypot(m1, m2) <= reach) & ((m2 > 0) | ((m2 == 0) & (m1 >= 0)))
        self._rows, self._columns = m2[kept] % edge, m1[kept] % edge
        self.k = 2 * np.pi / voxels * np.stack([m1[kept], m2[kept]], axis=1)
        self.share = conjugate_share(self.k)
        self.scale = 1 / (edge * survey.noise)
        self._noise = np.full(len(frames), np.nan)

    @property
    def count(self) -> int:
        """Number of frames used."""
        return int(self.survey.use.sum())

    def blocks(self) -> Iterator[Slices]:
        """Yield the used frames in order."""
        size = max(1, _POINTS // len(self.k))
        taken: list[tuple[int, Complex]] = []
        done = 0
        for block in self.frames.blocks():
            for image in block:
                if self.survey.use[done] and np.isfinite(image).all():
                    if np.isnan(self._noise[done]):
                        self._noise[done] = pixel_noise(_middle(image)[None])
                    taken.append((done, self._modes(image, self.survey.center[done])))
                    if len(taken) == size:
                        yield self._slices(taken)
                        taken = []
                done += 1
        if taken:
            yield self._slices(taken)

    def _slices(self, taken: list[tuple[int, Complex]]) -> Slices:
        frame = np.array([at for at, _ in taken])
        excess = self._noise[frame] / self.survey.noise
        weight = np.where(excess > _NOISIER, np.maximum(excess, 1.0) ** -2, 1.0)
        return Slices(frame, self.survey.R[frame], np.array([modes for _, modes in taken]), weight)

    def _modes(self, image: NDArray[Any], center: Array) -> Complex:
        """Return the whitened modes of one frame about its centre."""
        edge = self.survey.edge
        whole = np.round(center).astype(int)
        square = cut(image, whole, edge, empty_level(image, center, self.survey.radius))
        spectrum = scipy.fft.fft2(scipy.fft.ifftshift(square), workers=processors())[
            self._rows, self._columns
        ]
        pixel_k = self.k * (self.voxels / edge)
        modes = self.scale * spectrum * np.exp(1j * pixel_k @ (center - whole))
        return np.asarray(modes, np.complex64)


def cut(image: NDArray[Any], middle: NDArray[np.int_], edge: int, level: float) -> Array:
    """Return the square of `edge` pixels whose pixel ``edge // 2`` is `middle`, less the empty field's level.

    Parameters
    ----------
    middle:
        ``(2,)`` x1, x2 from pixel ``(H // 2, W // 2)``. What lies outside of the frame is 0.
    """
    height, width = image.shape
    top, left = middle[1] + height // 2 - edge // 2, middle[0] + width // 2 - edge // 2
    square = np.zeros((edge, edge))
    rows, columns = slice(max(top, 0), min(top + edge, height)), slice(max(left, 0), min(left + edge, width))
    if rows.start < rows.stop and columns.start < columns.stop:
        inside = image[rows, columns] - level
        square[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = inside
    return square


def _middle(image: NDArray[Any]) -> NDArray[Any]:
    """Return at most `_ENOUGH` rows and columns about the middle, which tell the noise."""
    top, left = (max(0, (size - _ENOUGH) // 2) for size in image.shape)
    return image[top : top + _ENOUGH, left : left + _ENOUGH]


def empty_level(image: NDArray[Any], center: Array, radius: float) -> float:
    """Return the median of the empty field around the object; 0 where the object fills the frame."""
    height, width = image.shape
    step = max(1, min(image.shape) // _ENOUGH)
    x2 = np.arange(0, height, step)[:, None] - height // 2 - center[1]
    x1 = np.arange(0, width, step) - width // 2 - center[0]
    outside = x1**2 + x2**2 > (_OUTSIDE * radius) ** 2
    return float(np.median(image[::step, ::step][outside])) if outside.mean() > _FEWEST_OUTSIDE else 0.0
