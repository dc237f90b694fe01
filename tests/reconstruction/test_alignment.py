"""Aligned frames against the same object rendered in the middle."""

from __future__ import annotations

import numpy as np
import pytest

from trapcli.reconstruction.alignment import align
from trapcli.stack.frames import Frames


def centred(case, edge, turn=0.0):
    """The projections about the object's centre, in axes turned by `turn`, in closed form."""
    offset = (np.arange(edge) - edge // 2) * case.pixel_size
    phantom, center = case.scene.phantom, case.scene.phantom.center
    T = np.array([*center[:2], 0.0])
    c, s = np.cos(turn), np.sin(turn)
    back = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    # rotations act about the centre: turning the lab's axes turns what R takes to the object
    return np.array(
        [phantom.project(R @ back, T, offset, offset) for R in case.scene.motion.rotations(case.scene.time)]
    )


@pytest.mark.parametrize("edge", [64, 50, 33])
def test_object_in_the_middle(example, edge):
    case = example(size=64, frames=12, drift=0.3)
    found = align(case.frames, case.motion.center / case.pixel_size, edge=edge)
    assert found.shape == (12, edge, edge)
    exact = centred(case, edge)
    np.testing.assert_allclose(found.to_array(), exact, atol=0.01 * exact.max())


def test_turned_frames(example):
    case = example(size=64, frames=12, drift=0.3)
    found = align(case.frames, case.motion.center / case.pixel_size, turn=0.7)
    exact = centred(case, 64, 0.7)
    np.testing.assert_allclose(found.to_array(), exact, atol=0.01 * exact.max())


def test_level_of_the_field_is_taken_off(example):
    case = example(size=64, frames=12, drift=0.3)
    lifted = Frames.from_array(case.frames.to_array() + 3)
    center = case.motion.center / case.pixel_size
    expected = align(case.frames, center).to_array()
    np.testing.assert_allclose(align(lifted, center).to_array(), expected, atol=0.01 * expected.max())


def test_frames_that_are_not_known(example):
    case = example(size=64, frames=12)
    center = case.motion.center / case.pixel_size
    center[4] = np.nan
    images = case.frames.to_array().copy()
    images[7] = np.nan
    aligned = align(Frames.from_array(images), center).to_array()
    assert np.flatnonzero(np.isnan(aligned).all(axis=(1, 2))).tolist() == [4, 7]
    assert np.isfinite(np.delete(aligned, [4, 7], axis=0)).all()


def test_blocks_of_any_size(example):
    case = example(size=64, frames=12)
    found = align(case.frames, case.motion.center / case.pixel_size)
    np.testing.assert_array_equal(np.concatenate(list(found.read_blocks(5))), found.to_array())
