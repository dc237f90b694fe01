"""A `Scene`: an object, its motion and a sensor, rendered frame by frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trapcli.config import from_dict, merge, to_toml
from trapcli.errors import ConfigError
from trapcli.result.motion import Motion
from trapcli.simulation.camera import Attenuation, Camera, Image, Sensor
from trapcli.simulation.config import MotionConfig, PhantomConfig, SimulateConfig
from trapcli.simulation.motions import (
    DegenerateThird,
    Drift,
    PaperMotion,
    PaperSpecial,
    RigidMotion,
    SingleAxis,
    Still,
    Thermal,
    Tumbling,
    true_motion,
)
from trapcli.simulation.phantoms import Blobs, Grain, PaperPhantom, Phantom
from trapcli.stack.frames import Frames, StackInfo

Array = NDArray[np.float64]

BACKGROUND_FRAMES = 64
"""Empty frames averaged into the background."""
PEAK_FRAMES = 64
"""Frames that tell the peak of the attenuation."""

# one stream of random numbers for each part, so that a change of one leaves the others as they are
_PHANTOM, _MOTION, _DRIFT, _SPECKS, _FRAME, _EMPTY_FRAME, _THERMAL = range(7)


@dataclass(frozen=True, eq=False)
class Scene:
    """An object in motion before a camera.

    Attributes
    ----------
    config:
        Size, sampling, sensor and seed.
    phantom, motion:
        The object and its motion; `from_config` makes them from the configuration.
    """

    config: SimulateConfig
    phantom: Phantom
    motion: RigidMotion

    @classmethod
    def from_config(cls, config: SimulateConfig) -> Scene:
        """Build the object and the motion that the configuration names."""
        stack = config.stack
        field = 0.5 * min(stack.height, stack.width) * stack.pixel_size
        phantom = _phantom(config.phantom, field, _generator(config.seed, _PHANTOM))
        duration = max(1, stack.frames - 1) * stack.frame_interval
        drift = Drift.random(
            _generator(config.seed, _DRIFT),
            amplitude=config.motion.drift * phantom.radius,
            duration=duration,
        )
        motion = _motion(config.motion, duration, drift, _generator(config.seed, _MOTION))
        scene = cls(config, phantom, motion)
        diffusion, shaking = np.deg2rad(config.motion.diffusion), config.motion.shaking * phantom.radius
        if not (diffusion or shaking):
            return scene
        rng = _generator(config.seed, _THERMAL)
        thermal = Thermal.random(rng, motion, scene.time, diffusion=diffusion, shaking=shaking)
        return replace(scene, motion=thermal)

    @property
    def time(self) -> Array:
        """``(N,)`` time of each frame [s]."""
        time: Array = np.arange(self.config.stack.frames, dtype=np.float64) * self.config.stack.frame_interval
        return time

    @property
    def x1(self) -> Array:
        """``(W,)`` coordinates of the columns [pixel_unit]."""
        return _coordinates(self.config.stack.width, self.config.stack.pixel_size)

    @property
    def x2(self) -> Array:
        """``(H,)`` coordinates of the rows [pixel_unit]."""
        return _coordinates(self.config.stack.height, self.config.stack.pixel_size)

    @cached_property
    def peak(self) -> float:
        """Highest attenuation in the stack, judged by at most `PEAK_FRAMES` of its frames."""
        n = self.config.stack.frames
        chosen = np.unique(np.linspace(0, n - 1, min(n, PEAK_FRAMES)).astype(int))
        return max(float(self.attenuation(int(i)).max()) for i in chosen)

    @cached_property
    def sensor(self) -> Sensor:
        """What turns attenuation into pixel values."""
        config, stack = self.config.camera, self.config.stack
        if config.output == "attenuation":
            return Attenuation(config, self.peak)
        specks = np.random.SeedSequence(self.config.seed, spawn_key=(_SPECKS,))
        return Camera(config, self.peak, (stack.height, stack.width), specks)

    @cached_property
    def _truth(self) -> Motion:
        motion = true_motion(
            self.motion, self.phantom.center, self.time, length_unit=self.config.stack.pixel_unit
        )
        provenance = {"configuration": to_toml(self.config)}
        if isinstance(self.sensor, Attenuation):
            provenance["pixel_values"] = f"{self.sensor.scale!r} * J + {self.sensor.pedestal!r}"
        return replace(motion, provenance=provenance)

    def truth(self) -> Motion:
        """Return the true motion in the gauge of the result file, with the configuration as provenance."""
        return self._truth

    @cached_property
    def _trajectory(self) -> tuple[Array, Array]:
        return self.motion.rotations(self.time), self.motion.T(self.time)

    def attenuation(self, n: int) -> Array:
        """Return the ``(H, W)`` attenuation J (``eq:J``) of frame `n` in double precision, without noise."""
        R, T = self._trajectory
        return self.phantom.project(R[n], T[n], self.x1, self.x2)

    def frame(self, n: int) -> Image:
        """Return frame `n`, ``(H, W)``, as the file holds it; the same however the frames are grouped."""
        return self.sensor.record(self.attenuation(n), _generator(self.config.seed, _FRAME, n))

    def frames(self) -> Frames:
        """Return the stack; frames are rendered when they are read."""
        stack = self.config.stack
        shape = (stack.frames, stack.height, stack.width)

        def read_blocks(size: int) -> Iterator[Image]:
            for start in range(0, stack.frames, size):
                stop = min(start + size, stack.frames)
                block = np.empty((stop - start, *shape[1:]), self.sensor.dtype)
                for n in range(start, stop):
                    block[n - start] = self.frame(n)
                yield block

        info = StackInfo(
            source="simulation",
            format="simulation",
            frame_interval=stack.frame_interval,
            pixel_size=stack.pixel_size,
            pixel_unit=stack.pixel_unit,
            bits=self.sensor.bits,
        )
        return Frames(shape, self.sensor.dtype, np.arange(stack.frames), info, read_blocks)

    def background(self) -> NDArray[np.float32]:
        """Return the ``(H, W)`` mean of some frames of the camera without an object.

        Raises
        ------
        ConfigError
            For plain attenuation, which has no background.
        """
        if not isinstance(self.sensor, Camera):
            raise ConfigError("a background needs output = 'camera'; plain attenuation has none")
        empty = np.zeros(self.sensor.shape)
        total = np.zeros(self.sensor.shape)
        for n in range(BACKGROUND_FRAMES):
            total += self.sensor.record(empty, _generator(self.config.seed, _EMPTY_FRAME, n))
        return (total / BACKGROUND_FRAMES).astype(np.float32)


def simulate(config: SimulateConfig | None = None, **overrides: Any) -> tuple[Image, Motion]:
    """Render a stack and its true motion.

    Parameters
    ----------
    config:
        What to render; by default the paper's phantom and motion, 200 frames of 128 × 128.
    **overrides:
        Fields of `SimulateConfig` that differ from it; tables as dictionaries, for example
        ``simulate(seed=3, stack={"frames": 50}, phantom={"kind": "grain"})``.

    Returns
    -------
    frames:
        ``(N, H, W)`` array; for stacks that don't fit into memory use ``Scene.from_config(config).frames()``.
    motion:
        The truth in the gauge of the result file; times in s, lengths in the configuration's `pixel_unit`.

    Raises
    ------
    ConfigError
        For an unknown field or a value that makes no sense.
    """
    table = asdict(config or SimulateConfig())
    scene = Scene.from_config(from_dict(SimulateConfig, merge(table, overrides), "simulate"))
    return scene.frames().to_array(), scene.truth()


def _coordinates(count: int, spacing: float) -> Array:
    x: Array = (np.arange(count, dtype=np.float64) - count // 2) * spacing
    return x


def _generator(seed: int, *key: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def _phantom(config: PhantomConfig, field: float, rng: np.random.Generator) -> Phantom:
    radius = config.radius or 0.7 * field
    match config.kind:
        case "blobs":
            return Blobs.random(rng, count=config.count or 12, radius=radius)
        case "revolution":
            return Blobs.coaxial(rng, count=config.count or 6, radius=radius, axis=(1.0, 0.0, 0.0))
        case "grain":
            return Grain.random(rng, count=config.count, radius=radius, oversampling=config.oversampling)
        case "sphere":
            return Grain.sphere(radius, oversampling=config.oversampling)
        case _:
            return PaperPhantom()


def _motion(config: MotionConfig, duration: float, drift: Drift, rng: np.random.Generator) -> RigidMotion:
    def single_axis(tilt: float, drift: Drift) -> SingleAxis:
        return SingleAxis.from_turns(
            turns=config.turns,
            duration=duration,
            azimuth=config.azimuth,
            tilt=tilt,
            unevenness=config.unevenness,
            drift=drift,
        )

    match config.kind:
        case "tumbling":
            return Tumbling.random(rng, total_angle=config.total_angle, duration=duration, drift=drift)
        case "single-axis":
            return single_axis(config.tilt, drift)
        case "paper-special":
            alpha = np.deg2rad(config.total_angle) / duration
            return PaperSpecial(alpha=alpha, omega_3=0.5 * alpha, drift=drift)
        case "degenerate-third":
            general = Tumbling.random(rng, total_angle=config.total_angle, duration=duration)
            single = single_axis(0.0, Drift())
            return DegenerateThird(general=general, single=single, duration=duration, drift=drift)
        case "still":
            return Still(drift=drift)
        case _:
            return PaperMotion()
