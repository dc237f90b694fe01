"""The figure of a volume shows the right planes the right way round."""

from __future__ import annotations

import numpy as np
import pytest

from trapcli.report.figures import save
from trapcli.report.volume_page import Judgement, draw_volume


@pytest.fixture
def volume():
    """A bright voxel at x1 = 1, x2 = −2, x3 = 3 and a brighter one in the middle plane x3 = 0."""
    values = np.zeros((12, 10, 8), np.float32)
    values[6 + 3, 5 - 2, 4 + 1] = 5
    values[6, 5, 4 - 3] = 7
    return values


def panels(figure):
    return {axes.get_title(loc="left"): axes for axes in figure.axes}


def at(axes):
    """Coordinates across and down of the brightest pixel."""
    (image,) = axes.images
    values = image.get_array()
    row, column = np.unravel_index(np.argmax(values), values.shape)
    left, right, bottom, top = image.get_extent()
    rows, columns = values.shape
    across = left + (column + 0.5) * (right - left) / columns
    return across, top + (row + 0.5) * (bottom - top) / rows


def test_planes(volume):
    shown = panels(draw_volume(volume, 0.5, "µm"))
    assert len(shown) >= 6
    assert at(shown["slice x₃ = 0"]) == pytest.approx((-1.5, 0))
    assert shown["slice x₂ = 0"].images[0].get_array().shape == (12, 8)
    assert at(shown["maximum along x₁"]) == pytest.approx((0, 0))
    volume[6, 5, 1] = 0
    shown = panels(draw_volume(volume, 0.5, "µm"))
    assert at(shown["maximum along x₃"]) == pytest.approx((0.5, -1))
    assert at(shown["maximum along x₂"]) == pytest.approx((0.5, 1.5))
    assert at(shown["maximum along x₁"]) == pytest.approx((-1, 1.5))
    assert shown["maximum along x₁"].get_xlabel() == "x₂ (µm)"
    assert shown["maximum along x₁"].get_ylabel() == "x₃ (µm)"


def test_judgement_and_file(volume, tmp_path):
    direction = np.array([[0, 0, 1.0], [0.6, 0, 0.8], [0, 1, 0]])
    judgement = Judgement(np.arange(4.0), np.array([1, 0.9, 0.4, 0.1]), direction, np.array([0, 1, 7]), 2 / 3)
    figure = draw_volume(volume, 0.5, "µm", judgement=judgement, title="a $volume$")
    shown = panels(figure)
    assert "seen: 67 %, red: not seen" in shown
    np.testing.assert_array_equal(shown["half-sets: Fourier shell correlation"].lines[0].get_ydata()[2], 0.4)
    save(figure, tmp_path / "a.png", ".png")
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_nothing_in_it():
    draw_volume(np.zeros((4, 4, 4), np.float32), 1.0, "pixel")
