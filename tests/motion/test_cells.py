"""Averages over cells against their definition and against Gaussians."""

from __future__ import annotations

import numpy as np
import pytest

from trapcli.motion.cells import Cells, cut_square, transfer


@pytest.mark.parametrize("binning", [1, 2, 3, 7])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_cells_are_means(binning: int, dtype: type) -> None:
    image = np.random.default_rng(0).uniform(0, 250, (45, 61)).astype(dtype)
    averaged = Cells(image.shape, binning).average(image)
    height, width = 45 // binning, 61 // binning
    whole = image[: height * binning, : width * binning].astype(float)
    means = whole.reshape(height, binning, width, binning).mean(axis=(1, 3))
    assert averaged == pytest.approx(means, rel=1e-13 if dtype == np.float64 else 1e-6)


@pytest.mark.parametrize("shape", [(120, 160), (125, 163)])
@pytest.mark.parametrize("binning", [1, 2, 5])
def test_places_and_transforms_of_a_gaussian(shape: tuple[int, int], binning: int) -> None:
    x2, x1 = (np.arange(size) - size // 2 for size in shape)
    place = np.array([4.3, -7.8])
    image = np.exp(-((x1 - place[0]) ** 2 + ((x2 - place[1]) ** 2)[:, None]) / (2 * 8.0**2))
    cells = Cells(shape, binning)
    averaged = cells.average(image)
    c2, c1 = (np.arange(size) - size // 2 for size in averaged.shape)
    center = np.array([averaged.sum(axis=0) @ c1, averaged.sum(axis=1) @ c2]) / averaged.sum()
    assert cells.to_pixels(center) == pytest.approx(place, abs=1e-8)
    k = 0.25
    wave = averaged.sum(axis=0) @ np.exp(-1j * k * binning * (c1 - center[0])) * binning**2
    exact = 2 * np.pi * 8.0**2 * np.exp(-((8.0 * k) ** 2) / 2)
    assert wave / transfer(np.array(k), binning, 1.0) == pytest.approx(exact, rel=1e-8)


def test_cells_suit_the_radius() -> None:
    assert Cells.for_radius((128, 128), 60.0).binning == 1
    assert Cells.for_radius((1024, 1024), 330.0).binning == 5
    assert Cells.for_radius((3, 3), 1e4).binning == 3


def test_squares_end_where_the_frame_does() -> None:
    image = np.arange(20.0).reshape(4, 5)
    square = cut_square(image, np.array([2, 1]), 2, level=0.5)
    inside = np.zeros((5, 5))
    inside[:3, :3] = image[1:, 2:] - 0.5
    assert np.array_equal(square, inside)
    assert not cut_square(image, np.array([40, 0]), 2).any()
