"""From frames to motion: the paper's workflow (``fig:workflow``) as one function.

::

    frames ──▶ attenuation ──▶ centres ──▶ reduced map ──▶ v, ω₃ ──▶ α ──▶ R ──▶ Motion
               to_attenuation  └───────── estimate_paper or find_motion ────────┘
                     ▲                                                   │
                     └──────────── dust: find_standing_pattern ◀─────────┘

Elbau, Ritsch-Marte, Scherzer and Schmutz, "Inverse problems of trapped objects", Inverse Problems 36 (2020).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from trapcli.config import GUESSED_BACKGROUNDS, EstimateConfig, MotionConfig, to_toml
from trapcli.errors import ConfigError, InputError
from trapcli.preprocess.attenuation import Projections, to_attenuation
from trapcli.result import provenance
from trapcli.result.motion import Flag, Motion
from trapcli.stack.frames import Frames
from trapcli.stack.source import calibrated

if TYPE_CHECKING:  # each method is imported only when it is used
    from trapcli.motion.joint import Found
    from trapcli.preprocess.standing import StandingPattern

Progress = Callable[[str, int, int], None]

_CLIPPED = 0.1  # share of the frames that may cut off a part of a particle whose motion dust may hide


def estimate(
    frames: Frames | NDArray[Any],
    *,
    frame_interval: float | None = None,
    pixel_size: float | None = None,
    pixel_unit: str | None = None,
    attenuation: bool | None = None,
    background: str | None = None,
    method: str | None = None,
    config: EstimateConfig | None = None,
    progress: Progress | None = None,
) -> Motion:
    """Recover the rigid motion of the particle that the frames show.

    Parameters
    ----------
    frames:
        ``(N, H, W)`` raw intensities or attenuation projections, evenly spaced in time; an array, or the
        `Frames` of `trapcli.stack.open_stack`.
    frame_interval:
        Seconds between frames; without it times are in frames.
    pixel_size, pixel_unit:
        Edge of a pixel and its unit; without them lengths are in pixels.
    attenuation:
        Whether the frames are attenuation or phase projections already, rather than raw intensities.
    background:
        Where the empty field comes from: ``auto``, ``median``, ``border``, ``none`` or the path of a file.
    method:
        ``auto`` or ``paper``.
    config:
        All other settings; each argument above that is given beats it. Its frames, region and channel are
        for `open_stack` and don't select from `frames`.
    progress:
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    Motion
        In the geometry, gauge and units of the result file, with the resolved configuration and what the
        frames themselves give reason to doubt (``warnings``, one a line) among its provenance;
        `Motion.identifiable` and `Motion.valid` say what can be trusted.

    Raises
    ------
    ConfigError
        For a setting that makes no sense.
    InputError
        Where the frames can't be read or show too little to estimate a motion from.
    """
    config = config or EstimateConfig()
    config = replace(
        config,
        input=_given(
            config.input, frame_interval=frame_interval, pixel_size=pixel_size, pixel_unit=pixel_unit
        ),
        preprocess=_given(config.preprocess, attenuation=attenuation, background=background),
        motion=_given(config.motion, method=method),
    )
    recover = _method(config.motion.method)
    if not isinstance(frames, Frames):
        frames = _from_array(frames)
    frames = replace(frames, info=calibrated(frames.info, config.input))
    step, time_unit, pixel, length_unit = _units(frames)
    # the matrices are small and many: threads that share one spend most of their time waiting for each other
    with threadpool_limits(1, user_api="blas"):
        projections = to_attenuation(frames, config.preprocess, roi=config.input.roi)
        guessed = not config.preprocess.attenuation and config.preprocess.background in GUESSED_BACKGROUNDS
        about = {"time": frames.index * step, "pixel_size": pixel, "progress": progress}
        projections, motion = recover(projections, config.motion, guessed, **about)
        if isinstance(projections, Projections):
            left_out = projections.left_out
            flags = np.where(left_out > 0, motion.flags & ~np.uint16(Flag.BLANK) | left_out, motion.flags)
            motion = replace(motion, flags=flags)
    origin = provenance.collect(configuration=to_toml(config))
    if warnings := _warnings(projections, config):
        origin["warnings"] = "\n".join(warnings)
    return replace(
        motion, time_unit=time_unit, length_unit=length_unit, provenance=motion.provenance | origin
    )


def _given(table: Any, **values: Any) -> Any:
    return replace(table, **{name: value for name, value in values.items() if value is not None})


def _method(name: str) -> Callable[..., tuple[Frames, Motion]]:
    """Return what recovers the motion from projections, and returns them as it took them."""
    if name == "paper":
        return _paper
    if name == "auto":
        return _joint
    raise ConfigError(f"--method {name}: must be auto or paper")


def _paper(projections: Frames, config: MotionConfig, guessed: bool, **about: Any) -> tuple[Frames, Motion]:
    from trapcli.motion.paper import estimate_paper

    return projections, estimate_paper(projections, config, **about)


def _joint(projections: Frames, config: MotionConfig, guessed: bool, **about: Any) -> tuple[Frames, Motion]:
    from trapcli.motion.joint import find_motion

    def find(projections: Frames) -> Found:
        return find_motion(projections, config, **about)

    found = find(projections)
    if guessed:
        pixel_size, progress = about["pixel_size"], about["progress"]
        projections, found = _without_dust(projections, found, find, pixel_size, progress)
    return projections, found.refined().motion()


def _without_dust(
    projections: Frames,
    found: Found,
    find: Callable[[Frames], Found],
    pixel_size: float,
    progress: Progress | None = None,
) -> tuple[Frames, Found]:
    """Take off what stays in place under the particle, if that explains the images better."""
    from trapcli.preprocess.standing import find_standing_pattern, most_likely, without

    if found.best is None:
        return projections, found
    motion, (fit, _), stack = found.so_far, found.best, found.stack
    center, best, cleared = stack.centers.center, (projections, found), projections

    def less(pattern: StandingPattern) -> Frames:
        return without(projections, pattern.image(projections.shape[1:], pixel_size))

    pattern = find_standing_pattern(found.about(motion.center), motion.center, motion.R, fit.model)
    if pattern is not None:
        cleared = less(pattern)
        best = _better(best, (cleared, found.without(pattern.modes(center))))
    # a pattern could make up for what is cut off of a particle that is larger than the field, with any motion
    if best[1].explains or stack.centers.clipped[stack.used].mean() > _CLIPPED:
        return best
    # so much may stay in place that it hides the motion
    low, centers = stack.low.select(stack.used), center[stack.used]
    path = most_likely(low, centers, found.despite_standing(progress), progress)
    hidden = find_standing_pattern(low, centers, path.R)
    if hidden is not None:
        best = _better(best, (less(hidden), found.without(hidden.modes(center), path)))
    if pattern is not None and not best[1].explains:
        best = _better(best, (cleared, find(cleared)))
    return best


def _better(best: tuple[Frames, Found], other: tuple[Frames, Found]) -> tuple[Frames, Found]:
    """Return the other one if it explains the images better and can be trusted as well."""
    motion, again = (one[1].so_far for one in (best, other))
    both = np.isfinite(motion.residual) & np.isfinite(again.residual)
    better = np.mean(again.residual[both] ** 2) < np.mean(motion.residual[both] ** 2) if both.any() else False
    return other if better and again.identifiable >= motion.identifiable else best


def _from_array(frames: Any) -> Frames:
    array = np.asarray(frames)
    if array.ndim != 3 or 0 in array.shape or array.dtype.kind not in "biuf":
        raise InputError(
            f"array of {array.dtype} and shape {array.shape}: real frames x rows x columns are needed"
        )
    return Frames.from_array(array)


def _units(frames: Frames) -> tuple[float, str, float, str]:
    """Return step and unit of time, pixel size and unit of length; frames and pixels where not known."""
    info = frames.info
    step, time_unit = (info.frame_interval, info.time_unit) if info.frame_interval else (1.0, "frame")
    if info.pixel_size and info.pixel_unit:
        return step, time_unit, info.pixel_size, info.pixel_unit
    return step, time_unit, 1.0, "pixel"


def _warnings(frames: Frames, config: EstimateConfig) -> list[str]:
    """Say what to know before trusting these frames, one sentence each."""
    info = frames.info
    warnings = list(info.warnings)
    if info.lossy and not config.preprocess.attenuation:
        warnings.append("its lossy codec has changed the pixel values, of which a logarithm is taken")
    if info.pixel_size and not info.pixel_unit:
        warnings.append("the unit of its pixel size is not known, so lengths are in pixels")
    return [" ".join(warning.split()) for warning in warnings]
