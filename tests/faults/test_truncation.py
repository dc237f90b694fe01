"""A file cut anywhere is never taken for a shorter one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

from trapcli.config import InputConfig
from trapcli.errors import InputError
from trapcli.stack import open_stack
from trapcli.stack.tiff import write_tiff
from trapcli.stack.video import write_avi

FRAMES = np.random.default_rng(0).integers(0, 60000, (20, 24, 32)).astype(np.uint16)
BYTES = (FRAMES >> 8).astype(np.uint8)
TIME = {"axes": "TYX"}

Write = Callable[[Path], None]


def stored(**storage: object) -> Write:
    return lambda path: tifffile.imwrite(path, FRAMES, photometric="minisblack", **storage)


def ours(frames: np.ndarray) -> Write:
    return lambda path: write_tiff(path, [frames], shape=frames.shape, dtype=frames.dtype, frame_interval=0.1)


def video(frames: np.ndarray, codec: str) -> Write:
    bits = 8 * frames.itemsize
    return lambda path: write_avi(path, [frames], shape=frames.shape, codec=codec, fps=50.0, bits=bits)


def page_by_page(description: str | None) -> Write:
    def write(path: Path) -> None:
        with tifffile.TiffWriter(path) as tiff:
            for frame in FRAMES:
                tiff.write(
                    frame, photometric="minisblack", metadata=None, contiguous=False, description=description
                )

    return write


WRITERS: dict[str, Write] = {
    "plain.tif": stored(metadata=None),
    "page by page.tif": page_by_page(None),
    "imagej page by page.tif": page_by_page("ImageJ=1.54f\nimages=20\nframes=20\n"),
    "shaped.tif": stored(),
    "imagej.tif": stored(imagej=True, metadata=TIME),
    "ome.tif": stored(ome=True, metadata=TIME),
    "big.tif": stored(bigtiff=True, metadata=None),
    "big-endian.tif": stored(byteorder=">", imagej=True, metadata=TIME),
    "lzw.tif": stored(compression="lzw", metadata=None),
    "lzw shaped.tif": stored(compression="lzw"),
    "deflate ome.tif": stored(compression="zlib", ome=True, metadata=TIME),
    "tiles.tif": stored(tile=(16, 16), metadata=None),
    "ours.tif": ours(FRAMES),
    "ours float64.tif": ours(FRAMES.astype(np.float64)),
    "raw.avi": video(BYTES, "raw"),
    "ffv1.avi": video(BYTES, "ffv1"),
    "ffv1 16.avi": video(FRAMES, "ffv1"),
    "mjpeg.avi": video(BYTES, "mjpeg"),
}


def cuts(path: Path) -> list[bytes]:
    whole = path.read_bytes()
    return [whole[: len(whole) * percent // 100] for percent in range(0, 100, 5)]


def test_no_cut_is_a_success(tmp_path: Path) -> None:
    silent = []
    tried = 0
    for name, write in WRITERS.items():
        path = tmp_path / name
        write(path)
        assert open_stack(str(path)).shape == FRAMES.shape
        for percent, content in zip(range(0, 100, 5), cuts(path), strict=True):
            path.write_bytes(content)
            tried += 1
            try:
                read: object = sum(len(block) for block in open_stack(str(path)).blocks())
            except InputError as error:
                if str(path) in str(error):
                    continue
                read = str(error)
            silent.append(f"{name} at {percent} %: {read}")
    assert tried == 20 * len(WRITERS)
    assert len(silent) == 0, silent


@pytest.mark.parametrize("name", WRITERS)
def test_what_is_left_of_a_cut_file(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    WRITERS[name](path)
    whole = open_stack(str(path)).to_array()
    read = []
    for content in cuts(path):
        path.write_bytes(content)
        try:
            stack = open_stack(str(path), InputConfig(allow_partial=True))
        except InputError:
            read.append(0)
            continue
        np.testing.assert_array_equal(stack.to_array(), whole[: len(stack)])
        assert any("truncated" in warning for warning in stack.info.warnings)
        read.append(len(stack))
    assert read == sorted(read)
    assert max(read) <= len(whole)
    if name in ("imagej.tif", "shaped.tif", "lzw.tif", "page by page.tif", "raw.avi"):
        assert read[-1] >= 18
