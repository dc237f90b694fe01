"""What the frames themselves say about background and noise, one number a frame.

A rigid object has the same total attenuation in every frame, and where there is no object there is none: what
departs from that is light that was not accounted for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trapcli.preprocess.surface import border
from trapcli.stack.frames import Frames

Array = NDArray[np.float64]

_STEADY = 0.02  # share by which the total attenuation, or the border, may depart from what is ideal
_BEYOND_NOISE = 3.0  # how many times what the noise alone would give is too much
_LOUD = 0.05  # pixel noise, as a share of the peak, from which results get coarse
_SECOND_DIFFERENCE = np.sqrt(6.0)  # its gain for white noise: 1, −2, 1
_PIXELS = 1 << 16  # of a frame that noise and peak are told from
_GAUSSIAN = 1.4826  # standard deviation by median absolute deviation


@dataclass(frozen=True)
class FrameChecks:
    """Numbers of N attenuation frames; NaN for frames that hold none.

    Attributes
    ----------
    mass:
        ``(N,)`` total attenuation, relative to its median.
    border:
        ``(N,)`` mean attenuation along the border, as a share of the peak.
    noise:
        ``(N,)`` standard deviation of the pixel noise, as a share of the peak.
    mass_noise, border_noise:
        Standard deviations of `mass` and `border` that the pixel noise alone gives.
    images:
        Attenuation ``(H, W)`` of the chosen frames.
    """

    mass: Array
    border: Array
    noise: Array
    mass_noise: float
    border_noise: float
    images: tuple[NDArray[np.floating], ...]


@dataclass(frozen=True)
class Finding:
    """One check in words."""

    name: str
    good: bool
    text: str


def check_frames(
    frames: Frames, chosen: Sequence[int] = (), progress: Callable[[str, int, int], None] | None = None
) -> FrameChecks:
    """Measure total attenuation, border and noise of attenuation frames in one pass.

    Parameters
    ----------
    chosen:
        Positions in `frames` whose images are kept.

    Raises
    ------
    InputError
        Where the frames can't be read.
    """
    edge = border(frames.shape[1:])
    rows: list[tuple[float, ...]] = []
    images: dict[int, NDArray[np.floating]] = {}
    for block in frames.blocks():
        for image in block:
            if len(rows) in chosen:
                images[len(rows)] = np.array(image)
            rows.append(_measure(image, edge))
        if progress:
            progress("checks", len(rows), len(frames))
    total, ring, noise, highest = np.array(rows, dtype=float).T
    peak, mass, sigma = (_median(values) for values in (highest, total, noise))
    scale = 1 / peak if peak > 0 else np.nan
    return FrameChecks(
        mass=total / mass if mass else np.full(len(total), np.nan),
        border=ring * scale,
        noise=noise * scale,
        mass_noise=float(sigma * np.sqrt(edge.size) / abs(mass)) if mass else np.nan,
        border_noise=float(sigma * scale / np.sqrt(edge.sum())),
        images=tuple(images[position] for position in chosen),
    )


def findings(checks: FrameChecks) -> list[Finding]:
    """Say what the checks mean, each with whether it is as it should be."""
    spread, residue, noise = _spread(checks.mass), _median(np.abs(checks.border)), _median(checks.noise)
    if np.isnan(spread + residue + noise):
        return [Finding("Frames", False, "hold too little to be checked")]
    return [
        Finding(
            "Total attenuation",
            bool(spread <= max(_STEADY, _BEYOND_NOISE * checks.mass_noise)),
            f"varies by {spread:.2%} from frame to frame; {checks.mass_noise:.2%} would be due to noise. "
            "A rigid object keeps it constant, unless it leaves the frame or the light changes.",
        ),
        Finding(
            "Background",
            bool(residue <= max(_STEADY, _BEYOND_NOISE * checks.border_noise)),
            f"{residue:.2%} of the peak is left along the border; {checks.border_noise:.2%} would be due to "
            "noise. Where there is no object it should be 0.",
        ),
        Finding(
            "Noise",
            bool(noise <= _LOUD),
            f"{noise:.2%} of the peak in each pixel.",
        ),
    ]


def _measure(image: NDArray[np.floating], edge: NDArray[np.bool_]) -> tuple[float, ...]:
    """Return total, mean of the border, noise and peak of one frame."""
    if not np.isfinite(image).all():
        return (np.nan,) * 4
    some = image[:: -(-image.size // _PIXELS)]
    curved = np.diff(some, 2, axis=1)  # smooth objects leave next to nothing here
    noise = _GAUSSIAN * float(np.median(np.abs(curved))) / _SECOND_DIFFERENCE if curved.size else np.nan
    peak = float(np.quantile(some, 0.999))
    return float(image.sum(dtype=float)), float(image[edge].mean(dtype=float)), noise, peak


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


def _spread(values: Array) -> float:
    return _GAUSSIAN * _median(np.abs(values - _median(values)))
