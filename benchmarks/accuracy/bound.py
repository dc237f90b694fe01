"""The Cramér–Rao bound of the rotation: object and every frame's shift unknown, white noise.

Nothing of the estimators is used. Slopes by rotation come from exact projections of the true object; all that
the object could be besides, blobs on a lattice that fills its ball, is eliminated, and so are two shifts a
frame. What is left is the Fisher information of the rotations, and with it that of any spline ω(t).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from trapcli.motion.path import Path, Spline, align
from trapcli.simulation.render import Scene

Array = NDArray[np.float64]

BAND = 22.0
"""Highest spatial frequency times the object's radius."""
VISIBLE = 5e-3
"""Share of the peak attenuation at which the object ends."""
SPREAD = 1.0
"""How strong the object's unseen part may be: its power over that of the strongest mode that is seen."""

_TURN = np.deg2rad(3.0)  # between the frames whose information is gathered
_GATHERED = 40, 400  # fewest and most of them
_TAIL = 4.0  # of a blob that the square to be transformed holds, in standard deviations
_SPACING = 0.7  # of the lattice, in units of π / band
_MARGIN = 0.3  # lattice beyond the ball, in spacings
_WIDTH = 0.4  # standard deviation of a blob, in spacings
_STEP = np.deg2rad(0.2)  # of the differences by rotation
_NEGLECTED = 0.1  # share of the bound by which a spline may miss the true motion
_DRAWS = 200


@dataclass(frozen=True)
class Information:
    """What the frames of a scene tell of their rotations.

    Attributes
    ----------
    frame:
        ``(G,)`` frames, each for those around it.
    fisher:
        ``(3G, 3G)`` Fisher information of rotation vectors [1 / rad²], R → R exp([δ]×).
    unknowns:
        Amplitudes of the object.
    """

    frame: NDArray[np.intp]
    fisher: Array
    unknowns: int


@dataclass(frozen=True)
class Bound:
    """Expected errors, and for which spline.

    Attributes
    ----------
    mean, worst:
        Mean and largest error over the frames [degrees].
    intervals:
        Intervals of the cubic spline that ω(t) is.
    """

    mean: float
    worst: float
    intervals: int


def bound(scene: Scene, information: Information) -> Bound:
    """Return the bound for the coarsest spline that holds the true motion to a tenth of it."""
    intervals = 1
    while True:
        best = bound_of_spline(scene, information, intervals)
        if _missed(scene, intervals) < _NEGLECTED * best.mean or intervals >= len(information.frame) // 3:
            return best
        intervals += 1


def bound_of_spline(scene: Scene, information: Information, intervals: int) -> Bound:
    """Return the bound where ω(t) is a spline of `intervals`, as averages of draws."""
    design = _design(scene, intervals)
    seen = design[information.frame].reshape(-1, design.shape[2])
    root = np.linalg.inv(np.linalg.cholesky(seen.T @ information.fisher @ seen))
    # to first order the best constant rotation of the object, R → exp([c]×) R, adds Rᵀc to every frame
    R = scene.motion.rotations(scene.time)
    aligned = design - np.swapaxes(R, 1, 2) @ np.mean(R @ design, axis=0)
    draws = np.random.default_rng(0).standard_normal((_DRAWS, len(root))) @ root
    angles = np.array([np.linalg.norm(aligned @ draw, axis=1) for draw in draws])
    mean, worst = np.rad2deg([angles.mean(), angles.max(axis=1).mean()])
    return Bound(float(mean), float(worst), intervals)


def _design(scene: Scene, intervals: int) -> Array:
    """Return ``(N, 3, P)`` changes of R, as R exp([δ]×), by the P coefficients of ω."""
    R, time = scene.motion.rotations(scene.time), scene.time
    values = Spline(time[0], time[-1], intervals).values(time)
    change = np.einsum("nij,nb->nibj", R, values).reshape(len(time), 3, -1)
    steps = 0.5 * np.diff(time)[:, None, None] * (change[1:] + change[:-1])
    summed = np.concatenate([np.zeros((1, *change.shape[1:])), np.cumsum(steps, axis=0)])
    return np.asarray(np.swapaxes(R, 1, 2) @ summed)


def information(scene: Scene, noises: Sequence[float], band: float = BAND) -> list[Information]:
    """Gather the information of a scene in the modes up to `band` over its radius.

    Parameters
    ----------
    noises:
        Standard deviations of the noise of one pixel, in peaks.
    """
    frames, pixel = len(scene.time), scene.config.stack.pixel_size
    parts = np.array_split(
        np.arange(frames), min(frames, np.clip(turn(scene) / _TURN, *_GATHERED).astype(int))
    )
    frame = np.array([part[len(part) // 2] for part in parts])
    R = scene.motion.rotations(scene.time)[frame]
    radius = visible_radius(scene)
    lattice, width = _lattice(radius, band / radius)
    half = int(np.ceil((np.abs(lattice).max() + _TAIL * width) / pixel))
    k, kept, share = _modes(half, pixel, band / radius)
    blob = np.exp(-0.5 * (width * np.hypot(*k.T)) ** 2)
    root = np.sqrt(share)

    # a mode's real part sees the object's even part, its imaginary part the odd one
    even = (len(lattice) + 1) // 2
    n, groups = len(lattice), len(parts)
    nuisance = np.zeros((n + 2 * groups, n + 2 * groups))
    coupling = np.zeros((n + 2 * groups, 3 * groups))
    own = np.zeros((3 * groups, 3 * groups))
    power = np.zeros(len(k))
    for g, part in enumerate(parts):
        model, turned = _slopes(scene, R[g], half)
        model, turned = model[kept], turned[:, kept]
        power += np.abs(model) ** 2 / groups
        weight = np.sqrt(len(part)) / scene.peak * root
        slopes = (weight * np.stack([*turned, *(-1j * k.T * model)])).T
        phase = lattice[:even] @ (R[g, :, :2] @ k.T)
        cosine, sine = weight * blob * np.cos(phase), -weight * blob * np.sin(phase[: n - even])
        nuisance[:even, :even] += cosine @ cosine.T
        nuisance[even:n, even:n] += sine @ sine.T
        shift, rotation = slice(n + 2 * g, n + 2 * g + 2), slice(3 * g, 3 * g + 3)
        product = np.concatenate([cosine @ slopes.real, sine @ slopes.imag])
        inner = (slopes.conj().T @ slopes).real
        coupling[:n, rotation], nuisance[shift, :n] = product[:, :3], product[:, 3:].T
        nuisance[shift, shift], coupling[shift, rotation] = inner[3:, 3:], inner[3:, :3]
        own[rotation, rotation] = inner[:3, :3]
    # of sums and differences of two amplitudes
    variance = 2 * SPREAD * float(np.max(power / blob**2)) / n
    found = []
    for noise in noises:
        known = nuisance.copy()
        known[np.diag_indices(n)] += noise**2 / variance
        factor = scipy.linalg.cholesky(known, lower=True, overwrite_a=True, check_finite=False)
        lost = scipy.linalg.solve_triangular(factor, coupling, lower=True, check_finite=False)
        found.append(Information(frame, (own - lost.T @ lost) / noise**2, n))
    return found


def turn(scene: Scene) -> float:
    """Return the angle turned in all [rad]."""
    speed = np.linalg.norm(scene.motion.omega(scene.time), axis=1)
    return float(np.trapezoid(speed, scene.time))


def visible_radius(scene: Scene) -> float:
    """Return the distance from its centre at which the object ends, in some frames [length]."""
    farthest = 0.0
    R = scene.motion.rotations(scene.time)
    for n in np.unique(np.linspace(0, len(R) - 1, 16).astype(int)):
        image = scene.phantom.project(R[n], scene.phantom.center, scene.x1, scene.x2)
        rows, columns = np.nonzero(image > VISIBLE * scene.peak)
        farthest = max(farthest, float(np.hypot(scene.x1[columns], scene.x2[rows]).max()))
    return farthest


def _modes(half: int, pixel: float, highest: float) -> tuple[Array, NDArray[np.intp], Array]:
    """Return k of half of the modes of a square, their places, and how many modes each stands for."""
    frequency = 2 * np.pi * np.fft.fftfreq(2 * half, pixel)
    k1, k2 = (k.ravel() for k in np.meshgrid(frequency, frequency))
    kept = np.flatnonzero((np.hypot(k1, k2) <= highest) & ((k2 > 0) | ((k2 == 0) & (k1 >= 0))))
    k = np.stack([k1[kept], k2[kept]], axis=1)
    return k, kept, np.where((k == 0).all(axis=1), 1.0, 2.0)


def _lattice(radius: float, highest: float) -> tuple[Array, float]:
    """Return ``(n, 3)`` points that fill the ball, and the width of their blobs."""
    spacing = _SPACING * np.pi / highest
    reach = radius + _MARGIN * spacing
    axis = spacing * np.arange(-int(reach / spacing), int(reach / spacing) + 1)
    cube = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return cube[np.linalg.norm(cube, axis=1) <= reach], _WIDTH * spacing


def _slopes(scene: Scene, R: Array, half: int) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return all modes of the centred projection, and their ``(3, …)`` slopes by rotation; white noise."""
    x = np.arange(-half, half) * scene.config.stack.pixel_size

    def modes(R: Array) -> NDArray[np.complex128]:
        image = scene.phantom.project(R, scene.phantom.center, x, x)
        return np.asarray(np.fft.fft2(np.fft.ifftshift(image), norm="ortho")).ravel()

    turns = Rotation.from_rotvec(_STEP * np.eye(3)).as_matrix()
    slopes = [(modes(R @ turn) - modes(R @ turn.T)) / (2 * _STEP) for turn in turns]
    return modes(R), np.array(slopes)


def _missed(scene: Scene, intervals: int) -> float:
    """Return by how much a spline of ω misses the true motion, mean over the frames [degrees]."""
    spline = Spline(scene.time[0], scene.time[-1], intervals)
    coefficients = spline.fit(scene.time, scene.motion.omega(scene.time))
    path = Path.smooth(spline, coefficients, scene.time)
    return float(np.rad2deg(align(path.R, scene.motion.rotations(scene.time))[0].mean()))
