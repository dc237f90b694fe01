"""Some frames of a stack without the others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trapcli.config import InputConfig, PreprocessConfig
from trapcli.preprocess.attenuation import to_attenuation
from trapcli.stack import open_stack
from trapcli.stack.frames import Frames
from trapcli.stack.tiff import write_tiff

WANTED = np.array([0, 3, 4, 11])


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return np.random.default_rng(0).integers(29_000, 31_000, (12, 20, 24)).astype(np.uint16)


def picked(frames: Frames) -> np.ndarray:
    return np.array([image.copy() for image in frames.pick(WANTED)])


def test_from_an_array(images: np.ndarray) -> None:
    frames = Frames.from_array(images)
    assert np.array_equal(picked(frames), images[WANTED])
    # of a stack that can only be read in order
    assert np.array_equal(picked(replace(frames, read_some=None)), images[WANTED])


def test_from_a_selection_of_a_file(images: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    twice = np.repeat(images, 2, axis=0)
    write_tiff(path, [twice], shape=twice.shape, dtype=twice.dtype)
    frames = open_stack(str(path), InputConfig(frames="1::2", roi=(2, 18, 5, 20)))
    assert np.array_equal(picked(frames), images[WANTED, 2:18, 5:20])


def test_of_attenuation(images: np.ndarray) -> None:
    frames = to_attenuation(Frames.from_array(images), PreprocessConfig(background="none"))
    assert np.array_equal(picked(frames), frames.to_array()[WANTED])
