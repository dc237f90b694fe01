"""Whether a video file is whole: FFmpeg plays a truncated one as far as it goes and says nothing."""

from __future__ import annotations

import os
import struct
from typing import BinaryIO


def video_fault(file: BinaryIO) -> str:
    """Return what is missing of an AVI, MP4 or Matroska file, or an empty text.

    Raises
    ------
    OSError
        Where reading fails.
    """
    size = os.fstat(file.fileno()).st_size
    file.seek(0)
    start = file.read(4)
    try:
        if start == b"RIFF":
            end = _riff_end(file, size)
        elif start == b"\x1a\x45\xdf\xa3":
            end = _matroska_end(file)
        else:
            end = _mp4_end(file, size)
    except (struct.error, IndexError):
        return "its header is incomplete"
    if end == 0:
        return "its recording was never finished"
    return f"it should have {end} bytes and has {size}" if end > size else ""


def _riff_end(file: BinaryIO, size: int) -> int:
    """End of the last RIFF chunk; 0 where the recorder never filled in its length or the number of frames."""
    file.seek(0)
    head = file.read(4096)
    stream = head.find(b"strh")
    (length,) = struct.unpack_from("<I", head, stream + 8 + 32) if stream > 0 else (1,)
    end = 0
    while end + 12 <= size:
        file.seek(end)
        name, content = struct.unpack("<4sI", file.read(8))
        if name != b"RIFF":
            break
        if content == 0 or length == 0:
            return 0
        end += 8 + content + content % 2
    return end - end % 2 if end == size + 1 else end


def _mp4_end(file: BinaryIO, size: int) -> int:
    """End of the last box; 0 where there is no table of frames."""
    end = 0
    tables = 0
    while end + 8 <= size:
        file.seek(end)
        length, name = struct.unpack(">I4s", file.read(8))
        if length == 1:
            (length,) = struct.unpack(">Q", file.read(8))
        elif length == 0:  # to the end of the file
            length = size - end
        if length < 8:
            break
        tables += name == b"moov"
        end += length
    return end if tables or end > size else 0


def _matroska_end(file: BinaryIO) -> int:
    """End of the segment; 1 where it declares none."""
    position = 4
    for _ in range(2):
        file.seek(position)
        field = file.read(8)
        width = 9 - field[0].bit_length()
        length = int.from_bytes(field[:width], "big") & ((1 << 7 * width) - 1)
        if length == (1 << 7 * width) - 1:
            return 1
        position += width + length + 4  # the next element's name has 4 bytes
    return position - 4
