"""The frames of a result, prepared as its estimate prepared them."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from trapcli.config import EstimateConfig, PreprocessConfig, from_dict
from trapcli.errors import ConfigError, InputError, UntrustedError
from trapcli.preprocess.attenuation import to_attenuation
from trapcli.result.motion import Motion
from trapcli.stack import Frames, open_stack


@dataclass(frozen=True)
class Prepared:
    """Attenuation projections and the motion that belongs to them.

    Attributes
    ----------
    frames:
        N attenuation projections.
    motion:
        Of these frames.
    pixel_size:
        Edge of a pixel in the motion's unit of length.
    """

    frames: Frames
    motion: Motion
    pixel_size: float


@dataclass(frozen=True)
class Changes:
    """What to do otherwise than the estimate did; None: as it did.

    Attributes
    ----------
    attenuation, background, dark:
        As in `PreprocessConfig`.
    pixel_size:
        Edge of a pixel in the motion's unit of length.
    untrusted:
        Whether a motion is used whose own verdict says that it can't be trusted.
    """

    attenuation: bool | None = None
    background: str | None = None
    dark: str | None = None
    pixel_size: float | None = None
    untrusted: bool = False


def prepare(stack: str, result: Path, changes: Changes | None = None) -> Prepared:
    """Open a stack for the motion that was found in it.

    Parameters
    ----------
    stack:
        As for `trapcli.stack.open_stack`.
    result:
        Result or truth file.

    Raises
    ------
    ConfigError
        Where the result doesn't say how its frames were prepared.
    InputError
        Where a file can't be read, or stack and result don't belong together.
    UntrustedError
        Where the result says that its motion can't be trusted.
    """
    changes = changes or Changes()
    motion = Motion.load(result)
    if not motion.identifiable and not changes.untrusted:
        raise UntrustedError(
            f"{result}: its motion can't be trusted ({motion.verdict}); --untrusted uses it all the same"
        )
    frames, pixel_size = open_frames(stack, result, motion, changes)
    config = _configuration(result, motion)
    given = {name: getattr(changes, name) for name in ("attenuation", "background", "dark")}
    preprocess = replace(config.preprocess, **{k: v for k, v in given.items() if v is not None})
    return Prepared(to_attenuation(frames, preprocess, roi=config.input.roi), motion, pixel_size)


def open_frames(stack: str, result: Path, motion: Motion, changes: Changes) -> tuple[Frames, float]:
    """Open the frames of a motion as its estimate did, not yet prepared.

    Returns
    -------
    frames, pixel_size:
        N frames, and the edge of a pixel in the motion's unit of length.

    Raises
    ------
    ConfigError, InputError
        As `prepare` does.
    """
    if not np.isfinite(motion.center).all(axis=1).any():
        raise InputError(f"{result}: holds no motion; no frame has a known centre")
    frames = open_stack(stack, _configuration(result, motion).input)
    if not np.array_equal(frames.index, motion.frame):
        raise InputError(
            f"{stack}: has {len(frames)} frames{_span(frames.index)} where {result} has {len(motion)}"
            f"{_span(motion.frame)}; they don't belong together"
        )
    pixel_size = _pixel_size(stack, frames, motion, changes.pixel_size)
    _check_inside(stack, frames, motion, pixel_size)
    return frames, pixel_size


def _configuration(result: Path, motion: Motion) -> EstimateConfig:
    """Return the estimate's configuration; a truth file has that of its simulation."""
    try:
        stored = tomllib.loads(motion.provenance.get("configuration", ""))
    except (ValueError, RecursionError):
        raise ConfigError(f"{result}: the configuration stored in it can't be read") from None
    if motion.truth:
        plain = stored.get("camera", {}).get("output") == "attenuation"
        return EstimateConfig(preprocess=PreprocessConfig(attenuation=plain))
    return from_dict(EstimateConfig, stored, f"configuration in {result}")


def _span(index: np.ndarray[tuple[int], np.dtype[np.int64]]) -> str:
    return f" ({index[0]} to {index[-1]})" if len(index) else ""


def _pixel_size(stack: str, frames: Frames, motion: Motion, given: float | None) -> float:
    if given is not None:
        if not 0 < given < float("inf"):
            raise ConfigError(f"--pixel-size {given}: must be a positive number")
        return given
    if motion.length_unit == "pixel":
        return 1.0
    info = frames.info
    if info.pixel_size is None or info.pixel_unit != motion.length_unit:
        raise InputError(
            f"{stack}: does not say how large a pixel is in {motion.length_unit}, the unit of the result; "
            "pass --pixel-size"
        )
    return info.pixel_size


def _check_inside(stack: str, frames: Frames, motion: Motion, pixel_size: float) -> None:
    """Refuse centres outside of the frames: another stack, region or pixel size."""
    reach = np.array([frames.shape[2], frames.shape[1]]) / 2 * pixel_size
    center = motion.center[np.isfinite(motion.center).all(axis=1)]
    if (np.abs(np.median(center, axis=0)) > reach).any():
        raise InputError(
            f"{stack}: the centres in the result lie outside of its frames; they don't belong together, or "
            "--pixel-size is wrong"
        )
