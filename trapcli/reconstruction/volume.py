"""From frames and their motion to the object: `reconstruct`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.errors import ConfigError, InputError
from trapcli.motion.fourier_slices import project, slice_points
from trapcli.reconstruction.coverage import Coverage, cover
from trapcli.reconstruction.resolution import Resolution, resolve
from trapcli.reconstruction.slices import SliceReader, Survey, survey
from trapcli.reconstruction.solver import Lattice, Solver, accumulate, ball
from trapcli.result.motion import Motion
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

MOST_VOXELS = 160
"""Most voxels along an edge where the user does not choose: they need 1 GB of memory."""

_VOXELS = (8, 512)
_SUPPORT = 1.25  # radius of the ball that the object lies in, in radii of the object: faint tails need room
_UNEXPLAINED = 1.5  # misfit, in units of the noise, that the motion should not leave


@dataclass(frozen=True)
class Reconstruction:
    """An object and how far to trust it.

    Attributes
    ----------
    values:
        ``(n, n, n)`` attenuation per unit length, ``[x3, x2, x1]``, in the object's orientation at the first
        frame; the object's centre is voxel ``n // 2`` of each axis.
    voxel_size, length_unit:
        Edge of a voxel.
    resolution:
        Fourier shell correlation of the volumes of even and odd frames.
    coverage:
        What the motion shows of Fourier space.
    residual:
        ``(N,)`` misfit of the volume's projection to each frame, relative to the frame; NaN where not used.
    misfit, held_out:
        ``(N,)`` the same in units of the noise, of the volume and of the one of the other half-set's frames.
    warnings:
        What to know before trusting the volume, one sentence each.
    """

    values: NDArray[np.float32]
    voxel_size: float
    length_unit: str
    resolution: Resolution
    coverage: Coverage
    residual: Array
    misfit: Array
    held_out: Array
    warnings: tuple[str, ...]


def reconstruct(
    frames: Frames | NDArray[Any],
    motion: Motion,
    *,
    pixel_size: float = 1.0,
    voxels: int = 0,
    positive: bool = True,
    edges: bool = False,
    progress: Progress | None = None,
) -> Reconstruction:
    """Compute the object that frames of known motion show.

    Parameters
    ----------
    frames:
        ``(N, H, W)`` attenuation projections; an array, or `Frames` that are read as often as needed.
    motion:
        Of these frames.
    pixel_size:
        Edge of a pixel in the motion's unit of length.
    voxels:
        Along an edge of the volume, which is somewhat wider than the object; 0: as fine as the pixels, but at
        most 160.
    positive:
        Whether attenuation below 0 is impossible.
    edges:
        Expect sharp edges between even parts (total variation).
    progress:
        Called as ``progress(stage, done, total)``.

    Raises
    ------
    ConfigError
        For a number of voxels that makes no sense.
    InputError
        Where frames and motion don't belong together, or too few frames have a known motion.
    """
    if voxels and not _VOXELS[0] <= voxels <= _VOXELS[1]:
        raise ConfigError(f"--voxels {voxels}: must lie between {_VOXELS[0]} and {_VOXELS[1]}")
    if not isinstance(frames, Frames):
        frames = Frames.from_array(frames)
    if len(frames) != len(motion):
        raise InputError(
            f"{frames.info.source}: has {len(frames)} frames where the motion has {len(motion)}; "
            "they don't belong together"
        )
    found = survey(frames, motion, pixel_size)
    n = voxels or min(found.edge, MOST_VOXELS)
    reader = SliceReader(frames, found, n)
    support = ball(n, min(_SUPPORT * found.radius * n / found.edge, n / 2 - 1))
    data = float(reader.share.sum() * reader.count)
    even, odd, power = accumulate(reader, progress)
    halves = [
        Solver(half, power, reader.scale, support, data).solve(progress=progress) for half in (even, odd)
    ]
    solver = Solver(even + odd, power, reader.scale, support, data)
    volume = solver.solve(np.float32(0.5) * (halves[0] + halves[1]), progress=progress)
    if positive or edges:
        volume = solver.solve_constrained(volume, positive=positive, edges=edges, progress=progress)
    residual, misfit, held_out = _misfits(reader, volume, halves, progress)
    voxel = found.edge / n * pixel_size
    coverage = cover(motion.R[found.use])
    return Reconstruction(
        values=np.ascontiguousarray(volume.T * np.float32((n / found.edge) ** 3 / pixel_size)),
        voxel_size=voxel,
        length_unit=motion.length_unit,
        resolution=resolve(halves[0], halves[1], voxel),
        coverage=coverage,
        residual=residual,
        misfit=misfit,
        held_out=held_out,
        warnings=_warnings(motion, found, coverage, held_out),
    )


def _misfits(
    reader: SliceReader, volume: Lattice, halves: list[Lattice], progress: Progress | None
) -> tuple[Array, Array, Array]:
    """Project the volumes onto all frames: relative misfit, misfit and held-out misfit in units of noise."""
    residual, misfit, held_out = np.full((3, len(reader.frames)), np.nan)
    share = reader.share / reader.share.sum()
    done = 0
    for block in reader.blocks():
        half = (np.arange(len(block.frame)) + done) % 2
        points = slice_points(block.R, reader.k)
        noise = np.sqrt(block.weight)
        model = reader.scale * project(points, volume).reshape(block.modes.shape)
        left = np.abs(block.modes - model) ** 2 @ share
        residual[block.frame] = np.sqrt(left / (np.abs(block.modes) ** 2 @ share))
        misfit[block.frame] = np.sqrt(left) * noise
        for other in range(2):
            chosen = half != other
            if chosen.any():
                points = slice_points(block.R[chosen], reader.k)
                model = reader.scale * project(points, halves[other]).reshape(chosen.sum(), -1)
                left = np.abs(block.modes[chosen] - model) ** 2 @ share
                held_out[block.frame[chosen]] = np.sqrt(left) * noise[chosen]
        done += len(block.frame)
        if progress is not None:
            progress("comparing", done, reader.count)
    return residual, misfit, held_out


def _warnings(motion: Motion, found: Survey, coverage: Coverage, held_out: Array) -> tuple[str, ...]:
    warnings = [coverage.warning] if coverage.limited else []
    if found.clipped:
        warnings.append(f"the field of view clips the object in {found.clipped} of the frames used")
    if not motion.identifiable:
        warnings.append(f"the motion can't be trusted ({motion.verdict}), and so can't the volume")
    typical = float(np.nanmedian(held_out))
    if typical > _UNEXPLAINED:
        warnings.append(
            f"volume and motion together leave {typical:.1f} times the noise in frames that were held out; "
            "the resolution is that of the noise alone"
        )
    return tuple(warnings)
