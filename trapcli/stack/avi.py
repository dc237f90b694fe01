"""The AVI container for frames that are each a chunk of bytes (raw pixels or one JPEG)."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from fractions import Fraction
from typing import BinaryIO

from trapcli.errors import OutputError

_LIMIT = (1 << 32) - (1 << 20)
_HAS_INDEX = 0x10
_KEY_FRAME = 0x10


def write_chunks(
    file: BinaryIO,
    chunks: Iterable[bytes],
    *,
    codec: bytes,
    shape: tuple[int, int, int],
    bits: int,
    fps: float,
) -> None:
    """Write one video stream of N chunks, with its index, to an empty seekable file.

    Parameters
    ----------
    codec:
        FourCC, for example ``b"Y800"`` (8-bit grey) or ``b"MJPG"``.
    shape:
        ``(N, H, W)``.
    bits:
        Bits per pixel.

    Raises
    ------
    OutputError
        Where the frames don't fit in the 4 GiB of an AVI.
    """
    file.write(_header(0, 0, codec, shape, bits, fps))
    first = file.tell() - len(b"movi")
    index = bytearray()
    largest = 0
    for chunk in chunks:
        if file.tell() + len(chunk) + len(index) > _LIMIT:
            raise OutputError(f"{shape[0]} frames don't fit in the 4 GiB of an AVI; write a TIFF instead")
        index += struct.pack("<4sIII", b"00dc", _KEY_FRAME, file.tell() - first, len(chunk))
        file.write(struct.pack("<4sI", b"00dc", len(chunk)) + chunk + b"\0" * (len(chunk) % 2))
        largest = max(largest, len(chunk))
    movie = file.tell() - first
    file.write(_chunk(b"idx1", bytes(index)))
    end = file.tell()
    file.seek(0)
    file.write(_header(end - 8, movie, codec, shape, bits, fps, largest))


def set_rate(file: BinaryIO, fps: float) -> None:
    """Set the frame rate of the first stream of a finished AVI."""
    start = file.read(4096)
    scale_at = start.index(b"strh") + 8 + 20
    file.seek(scale_at)
    file.write(struct.pack("<II", *_rate(fps)))
    file.seek(start.index(b"avih") + 8)
    file.write(struct.pack("<I", round(1e6 / fps)))


def _header(
    size: int, movie: int, codec: bytes, shape: tuple[int, int, int], bits: int, fps: float, largest: int = 0
) -> bytes:
    """Everything before the first frame; the same length whatever the sizes are."""
    count, height, width = shape
    main = struct.pack("<10I16x", round(1e6 / fps), 0, 0, _HAS_INDEX, count, 0, 1, largest, width, height)
    stream = struct.pack(
        "<4s4sIHHIIIIIIIIhhhh",
        *(b"vids", codec, 0, 0, 0, 0, *_rate(fps), 0, count, largest, 0xFFFFFFFF, 0),
        *(0, 0, width, height),
    )
    image = width * height * bits // 8
    bitmap = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, bits, codec, image, 0, 0, 0, 0)
    headers = _list(b"strl", _chunk(b"strh", stream) + _chunk(b"strf", bitmap))
    return (
        struct.pack("<4sI4s", b"RIFF", size, b"AVI ")
        + _list(b"hdrl", _chunk(b"avih", main) + headers)
        + struct.pack("<4sI4s", b"LIST", movie, b"movi")
    )


def _rate(fps: float) -> tuple[int, int]:
    """Scale and rate, ``fps = rate / scale``, as integers of 32 bits."""
    large = max(fps, 1 / fps)
    ratio = Fraction(large).limit_denominator(int(min(1e5, 2e9 / large)))
    return (ratio.denominator, ratio.numerator) if fps >= 1 else (ratio.numerator, ratio.denominator)


def _chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack("<4sI", name, len(content)) + content


def _list(name: bytes, content: bytes) -> bytes:
    return _chunk(b"LIST", name + content)
