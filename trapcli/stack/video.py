"""Video files; the only module that knows OpenCV."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

# FFmpeg reads its log level once, when OpenCV opens the first video
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2

from trapcli.atomic import atomic_path
from trapcli.config import InputConfig
from trapcli.errors import ConfigError, InputError, OutputError
from trapcli.stack import avi
from trapcli.stack.container import video_fault
from trapcli.stack.frames import StackInfo, single_frames
from trapcli.stack.source import PARTIAL_HINT, Source, check_frame_bytes, guard

getattr(cv2.utils, "logging", cv2).setLogLevel(0)  # OpenCV 5 has moved it

_GREY = {b"Y800": np.uint8, b"Y1\0\x10": np.uint16}
_COLOUR = (b"BGR\x18", b"RGB\x18", b"BGR\0", b"RGB\0", b"BGRA", b"RGBA", b"G3\0\x08")
_LOSSY_COLOUR_TOLERANCE = 8
_LOSSLESS = (b"\0\0\0\0", b"DIB ", b"Y800", b"GREY", b"Y8  ", b"FFV1", b"HFYU", b"FFVH", b"MPNG", b"PNG1")

Codec = Literal["raw", "ffv1", "mjpeg"]


def write_avi(
    path: Path | str,
    blocks: Iterable[NDArray[Any]],
    *,
    shape: tuple[int, int, int],
    codec: Codec,
    fps: float,
    bits: int = 8,
    quality: int = 95,
    overwrite: bool = False,
) -> None:
    """Write a grey-value stack as AVI.

    Parameters
    ----------
    blocks:
        ``(n, H, W)`` arrays, uint8 for 8 bits and uint16 for 16, N frames in all.
    shape:
        ``(N, H, W)``.
    codec:
        ``ffv1`` keeps 8 or 16 bits as they are, ``raw`` 8 bits; ``mjpeg`` holds 8 bits and changes them.
    fps:
        Frames per second.
    quality:
        JPEG quality, 0 to 100, of ``mjpeg``.

    Raises
    ------
    ConfigError
        Where the codec can't hold frames of this size or depth.
    OutputError
        Where `path` exists (without `overwrite`) or can't be written.
    ValueError
        Where the blocks don't add up to `shape` and `bits`.
    """
    if bits not in (8, 16):
        raise ConfigError(f"AVI holds 8 or 16 bits per pixel, not {bits}; write a TIFF instead")
    if codec != "ffv1" and bits != 8:
        # FFmpeg knows no AVI of raw 16-bit grey values, so that hardly any program could read one
        raise ConfigError(
            f"AVI with the codec {codec} holds 8 bits per pixel only; use ffv1, or write a TIFF"
        )
    if codec == "ffv1" and (shape[1] % 2 or shape[2] % 2):
        raise ConfigError(
            f"FFV1 frames need an even width and height, not {shape[2]} x {shape[1]} (OpenCV crops them); "
            "use the codec raw, or write a TIFF"
        )
    if codec == "ffv1" and Path(path).suffix.lower() != ".avi":
        raise ConfigError(f"{path}: must end in .avi, by which OpenCV chooses the container; or write a TIFF")
    if not 1e-3 <= fps <= 1e6:
        raise ConfigError(f"{fps} frames per second can't be written in an AVI; write a TIFF instead")
    frames = single_frames(blocks, shape, np.dtype(f"u{bits // 8}"))
    with atomic_path(path, overwrite) as temporary:
        if codec == "ffv1":
            _write_ffv1(temporary, frames, shape, bits)
            with temporary.open("r+b") as file:
                avi.set_rate(file, fps)
        elif codec == "mjpeg":
            jpegs = (_jpeg(frame, quality) for frame in frames)
            with temporary.open("wb") as file:
                avi.write_chunks(file, jpegs, codec=b"MJPG", shape=shape, bits=24, fps=fps)
        else:
            raw = (frame.tobytes() for frame in frames)
            with temporary.open("wb") as file:
                avi.write_chunks(file, raw, codec=b"Y800", shape=shape, bits=8, fps=fps)


def _jpeg(frame: NDArray[Any], quality: int) -> bytes:
    _, encoded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return encoded.tobytes()


def _write_ffv1(path: Path, frames: Iterator[NDArray[Any]], shape: tuple[int, int, int], bits: int) -> None:
    depth = cv2.CV_8U if bits == 8 else cv2.CV_16U
    options = [cv2.VIDEOWRITER_PROP_IS_COLOR, 0, cv2.VIDEOWRITER_PROP_DEPTH, depth]
    size = (shape[2], shape[1])
    rate = 25.0  # any: OpenCV would round the true one, which is set afterwards
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"FFV1"), rate, size, options)
    try:
        if not writer.isOpened():
            raise OutputError(f"{path.name}: OpenCV can't write FFV1 here; write a TIFF instead")
        for frame in frames:
            writer.write(frame)
    finally:
        writer.release()


@dataclass(frozen=True)
class _Header:
    """What a video says of itself; its frames are counted where it can't be trusted with that."""

    container: str
    codec: bytes
    stored: bytes
    fps: float
    count: int
    size: tuple[int, int]
    warnings: tuple[str, ...]

    @property
    def lossless(self) -> bool:
        # conversion between brightness with colour differences and RGB rounds
        return self.codec.upper() in _LOSSLESS and (self.stored in _GREY or self.stored in _COLOUR)


def open_video(path: Path, name: str, config: InputConfig) -> Source:
    """Open an AVI, MP4, MOV or MKV video.

    Parameters
    ----------
    name:
        What messages call the input.
    config:
        Its `allow_partial` is used here.

    Raises
    ------
    InputError
        Where the file is truncated, or OpenCV can't read its codec.
    """
    with guard(name):
        header = _read_header(path, name, config.allow_partial)
    grey = header.stored in _GREY
    dtype = np.dtype(_GREY.get(header.stored, np.uint8))
    interval = 1 / header.fps if 0 < header.fps < 1e9 else None

    def read(index: NDArray[np.int64], channel: int | None) -> Iterator[NDArray[Any]]:
        with _capture(path, name) as video:
            position = -1
            for wanted in index:
                while position < wanted:
                    if not video.grab():
                        raise InputError(
                            f"{name}: truncated or damaged: it declares {header.count} frames, "
                            f"and frame {position + 1} can't be read; {PARTIAL_HINT}"
                        )
                    position += 1
                _, frame = video.retrieve()
                if frame is None or frame.shape[:2] != header.size or frame.dtype != dtype:
                    raise InputError(f"{name}: frame {wanted} differs in size or type from the first")
                colours = frame if grey else frame[..., ::-1]
                yield colours if channel is None else colours[..., channel]

    warnings = header.warnings
    if config.frame_interval is None and interval:
        playing = f"its frame interval is that of playing it ({header.fps:g} frames/s)"
        warnings = (*warnings, f"{playing}; pass --frame-interval or --fps where the camera's was another")
    codec = header.codec.decode("ascii", "replace") if header.codec.strip(bytes(1)) else "raw"
    info = StackInfo(
        source=name,
        format=f"{header.container}, {codec}",
        frame_interval=interval,
        bits=8 * dtype.itemsize,
        lossy=not header.lossless,
        warnings=warnings,
    )
    tolerance = 0 if header.lossless else _LOSSY_COLOUR_TOLERANCE
    return Source(name, (header.count, *header.size), dtype, 1 if grey else 3, info, read, tolerance)


def _read_header(path: Path, name: str, allow_partial: bool) -> _Header:
    with path.open("rb") as file:
        fault, container = video_fault(file), _container(file)
    if fault and not allow_partial:
        raise InputError(f"{name}: truncated: {fault}; {PARTIAL_HINT}")
    with _capture(path, name) as video:
        codec, stored = _tag(video, cv2.CAP_PROP_FOURCC), _tag(video, cv2.CAP_PROP_CODEC_PIXEL_FORMAT)
        size = (int(video.get(cv2.CAP_PROP_FRAME_HEIGHT)), int(video.get(cv2.CAP_PROP_FRAME_WIDTH)))
        check_frame_bytes(name, size[0] * size[1] * 3)
        declared = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        about = container == "MKV"  # which declares a duration only
        count = _count(video) if allow_partial or about else declared
        header = _Header(container, codec, stored, video.get(cv2.CAP_PROP_FPS), count, size, ())
    warnings = []
    if fault or count < declared - about:
        if not allow_partial:
            raise InputError(
                f"{name}: damaged: {count} of about {declared} frames can be read; {PARTIAL_HINT}"
            )
        count -= bool(fault)  # the last one may be cut, which FFmpeg conceals
        warnings.append(f"it is truncated or damaged: {count} frames can be read")
    if not header.lossless:
        warnings.append(
            "its codec has changed the pixel values: weak attenuation may be lost; prefer TIFF or FFV1"
        )
    if stored[:2] == b"Y1" and stored not in _GREY:
        warnings.append(f"OpenCV reduces its {stored[3]} bits per pixel to 8; convert it to TIFF")
    return replace(header, count=count, warnings=tuple(warnings))


@contextmanager
def _capture(path: Path, name: str) -> Iterator[cv2.VideoCapture]:
    # the absolute path: a name such as ``a:b`` would be taken for a network protocol
    video = cv2.VideoCapture(os.path.abspath(path), cv2.CAP_FFMPEG)
    try:
        if not video.isOpened():
            raise InputError(
                f"{name}: damaged, or of a codec that OpenCV can't read; save it as TIFF or FFV1 AVI"
            )
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        if _tag(video, cv2.CAP_PROP_CODEC_PIXEL_FORMAT) in _GREY:
            # else 16 bits become 8; but for colours, OpenCV then reads beyond its buffer
            video.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        yield video
    finally:
        video.release()


def _tag(video: cv2.VideoCapture, what: int) -> bytes:
    """Four characters of a property, such as the codec."""
    value = video.get(what)
    return int(value).to_bytes(4, "little") if 0 <= value < 1 << 32 else b"????"


def _count(video: cv2.VideoCapture) -> int:
    count = 0
    while video.grab():
        count += 1
    return count


def _container(file: BinaryIO) -> str:
    file.seek(0)
    start = file.read(8)
    return "AVI" if start.startswith(b"RIFF") else "MKV" if start.startswith(b"\x1a\x45") else "MP4"
