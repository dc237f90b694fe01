"""Stacks in several files: in the order of their numbers, all alike, with no hole unsaid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from trapcli.config import InputConfig
from trapcli.errors import InputError
from trapcli.stack import open_stack

FRAMES = np.random.default_rng(0).integers(0, 255, (12, 6, 8)).astype("uint8")


def write(folder: Path, numbers: Any, pattern: str = "img_{}.tif") -> None:
    for frame, number in zip(FRAMES, numbers, strict=False):
        tifffile.imwrite(folder / pattern.format(number), frame, photometric="minisblack", metadata=None)


def test_natural_order(tmp_path: Path) -> None:
    write(tmp_path, range(1, 13))  # img_1 … img_12, which the alphabet puts in another order
    (tmp_path / "._img_1.tif").write_text("what some systems leave behind")
    (tmp_path / "notes.txt").write_text("not a frame")
    for text in (str(tmp_path), str(tmp_path / "img_*.tif"), str(tmp_path / "img_[0-9]*.ti?")):
        stack = open_stack(text)
        assert stack.shape == FRAMES.shape
        np.testing.assert_array_equal(stack.to_array(), FRAMES)
        np.testing.assert_array_equal(np.concatenate(list(stack.blocks(5))), FRAMES)
        assert "12 files" in stack.info.source
        assert stack.info.warnings == ()
    some = open_stack(str(tmp_path), InputConfig(frames="2:-1:3", roi=(1, 4, 2, 8)))
    np.testing.assert_array_equal(some.to_array(), FRAMES[2:-1:3, 1:4, 2:8])


def test_files_of_several_frames_follow_each_other(tmp_path: Path) -> None:
    for number, frames in enumerate(np.split(FRAMES, [5, 6])):
        tifffile.imwrite(tmp_path / f"part{number}.TIFF", frames, photometric="minisblack")
    stack = open_stack(str(tmp_path))
    np.testing.assert_array_equal(stack.to_array(), FRAMES)
    some = open_stack(str(tmp_path), InputConfig(frames="4:7"))
    np.testing.assert_array_equal(some.to_array(), FRAMES[4:7])


def test_missing_numbers_are_named(tmp_path: Path) -> None:
    write(tmp_path, [1, 2, 3, 5, 6])
    warnings = open_stack(str(tmp_path)).info.warnings
    assert warnings == ("its numbers jump from 3 to 5: frames are missing there",)


def test_files_must_be_alike(tmp_path: Path) -> None:
    write(tmp_path, range(3))
    for odd in (FRAMES[0, :5], FRAMES[0].astype("uint16"), np.stack([FRAMES[0]] * 3, axis=-1)):
        kind = "rgb" if odd.ndim == 3 else "minisblack"
        tifffile.imwrite(tmp_path / "img_9.tif", odd, photometric=kind, metadata=None)
        with pytest.raises(InputError, match=r"img_9\.tif: has .* where .*img_0\.tif has 6 x 8 uint8"):
            open_stack(str(tmp_path))


def test_a_bad_file_is_named(tmp_path: Path) -> None:
    write(tmp_path, range(5))
    (tmp_path / "img_3.tif").write_bytes((tmp_path / "img_3.tif").read_bytes()[:-10])
    for config in (InputConfig(), InputConfig(allow_partial=True)):
        with pytest.raises(InputError, match=r"img_3\.tif: truncated"):
            open_stack(str(tmp_path), config)


def test_nothing_there(tmp_path: Path) -> None:
    for text in (str(tmp_path), str(tmp_path / "*.tif")):
        with pytest.raises(InputError, match="no TIFF files"):
            open_stack(text)
    (tmp_path / "folder.tif").mkdir()
    with pytest.raises(InputError, match="no regular file"):
        open_stack(str(tmp_path / "*.tif"))


def test_a_name_with_signs_of_a_pattern(tmp_path: Path) -> None:
    path = tmp_path / "run [1] *.tif"
    tifffile.imwrite(path, FRAMES, photometric="minisblack")
    np.testing.assert_array_equal(open_stack(str(path)).to_array(), FRAMES)
