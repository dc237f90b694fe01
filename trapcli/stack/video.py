"""Video files; the only module that knows OpenCV."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

# FFmpeg reads its log level once, when OpenCV opens the first video
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2

from trapcli.atomic import atomic_path
from trapcli.errors import ConfigError, OutputError
from trapcli.stack import avi
from trapcli.stack.frames import single_frames

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

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
