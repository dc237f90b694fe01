"""Configuration: frozen dataclasses, filled from TOML and options, validated once.

An option beats the file, the file beats the default. The resolved configuration can be written back as TOML
(`to_toml`) and read again.
"""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import tomli_w

from trapcli.errors import ConfigError

MAX_TOML_BYTES = 64 << 10

GUESSED_BACKGROUNDS = ("auto", "median", "surface", "border", "none")
"""Backgrounds that the frames themselves are to tell; any other is a file."""

C = TypeVar("C")


@dataclass(frozen=True)
class InputConfig:
    """Which frames of the input, and what a frame interval and a pixel are."""

    frames: str = ""
    """START:STOP[:STEP], as a Python slice; empty for all."""
    roi: tuple[int, ...] = ()
    """Rows and columns to keep: (top, bottom, left, right); empty for all."""
    channel: int | None = None
    """Channel of a colour or multi-channel input, counted from 0."""
    time_axis: str = ""
    """Axis that is time where a file has several, such as T or Z; TZ for all frames of both, as stored."""
    dataset: str = ""
    """Path of the dataset inside an HDF5 or Zarr input."""
    frame_interval: float | None = None
    """Seconds between frames; overrides the file."""
    pixel_size: float | None = None
    """Edge of a pixel in `pixel_unit`; overrides the file."""
    pixel_unit: str | None = None
    """Unit of `pixel_size`."""
    allow_partial: bool = False
    """Use the readable frames of a truncated file."""


@dataclass(frozen=True)
class PreprocessConfig:
    """From raw counts to attenuation."""

    attenuation: bool = False
    """The frames already are attenuation or phase projections: no background, no logarithm."""
    background: str = "auto"
    """``auto``, ``median``, ``surface``, ``border``, ``none``, or the path of a background file (one frame or
    a stack)."""
    dark: str = ""
    """Pixel value without light, or the path of a file of dark frames; empty: 0."""

    @property
    def dark_level(self) -> float | None:
        """`dark` as a pixel value; None where it is a path."""
        try:
            return float(self.dark or 0)
        except ValueError:
            return None


@dataclass(frozen=True)
class MotionConfig:
    """From attenuation to motion."""

    method: str = "auto"
    """``auto``: joint objective; ``paper``: infinitesimal common lines."""
    window: int = 0
    """Frames in the local-polynomial time windows of ``paper``; 0: chosen from the data."""
    band: float = 0.0
    """Highest spatial frequency used [rad / length]; 0: chosen from the data."""
    knots: int = 0
    """Spline intervals of ω(t) in ``auto``; 0: chosen from the data."""


@dataclass(frozen=True)
class EstimateConfig:
    """All of ``trap-motion estimate``."""

    input: InputConfig = field(default_factory=InputConfig)
    preprocess: PreprocessConfig = field(default_factory=PreprocessConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)


def load_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file of at most 64 KiB.

    Raises
    ------
    ConfigError
        Where the file is missing, too large or not TOML.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_TOML_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: can't be read ({error.strerror or error})") from None
    if len(raw) > MAX_TOML_BYTES:
        raise ConfigError(f"{path}: larger than {MAX_TOML_BYTES >> 10} KiB; no configuration of ours is")
    try:
        # dotted keys and brackets are costly to nest in the standard parser, and none of ours needs many
        text = raw.decode()
        if max((line.count(".") + line.count("[") for line in text.splitlines()), default=0) > 200:
            raise ConfigError(f"{path}: nested too deeply for a configuration")
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"{path}: not valid TOML ({first})") from None


def from_dict(cls: type[C], table: dict[str, Any], where: str) -> C:
    """Fill the dataclass `cls` from a (nested) table.

    Parameters
    ----------
    where:
        Name of the file or option for messages.

    Raises
    ------
    ConfigError
        For an unknown key (naming the nearest known one) or a value of the wrong type.
    """
    hints = typing.get_type_hints(cls)
    known = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
            raise ConfigError(f"{where}: unknown key '{key}'; did you mean '{near[0]}'?")
        values[key] = _convert(hints[key], value, f"{where}: {key}")
    return cls(**values)


def _convert(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise ConfigError(f"{where}: must be a table")
        return from_dict(typing.cast(type[Any], hint), value, where)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        hint = next(a for a in arguments if a is not type(None))
        return _convert(hint, value, where)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"{where}: must be a list")
        return tuple(_convert(arguments[0], v, where) for v in value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, hint) or (hint is int and isinstance(value, bool)):
        raise ConfigError(f"{where}: must be of type {hint.__name__}, not {value!r}")
    return value


def merge(*tables: dict[str, Any]) -> dict[str, Any]:
    """Merge nested tables; later ones win."""
    merged: dict[str, Any] = {}
    for table in tables:
        for key, value in table.items():
            old = merged.get(key)
            merged[key] = merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def to_toml(config: Any) -> str:
    """Write a configuration dataclass as TOML text; None is left out (it is the default)."""

    def table(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: table(v) for k, v in value.items() if v is not None}
        return [table(v) for v in value] if isinstance(value, (list, tuple)) else value

    return tomli_w.dumps(table(dataclasses.asdict(config)))
