"""Figures: the right curves in the right panels, whatever the result looks like."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.image import AxesImage

from trapcli.report.figures import Projection, draw, save
from trapcli.result.comparison import mirror
from trapcli.result.motion import Landscape

BLUE, RED = "#1f4fa8", "#d1332e"


@pytest.fixture
def truth(make_motion):
    return make_motion(60, truth=True, verdict="")


@pytest.fixture
def result(truth):
    """Known errors, one gap, a Φ with its least value at φ of frame 10."""
    phi = truth.phi + 0.01
    phi[20:23] = np.nan
    valid = truth.valid.copy()
    valid[20:23] = 0
    valid[59] = 0
    angles = np.linspace(0, np.pi, 180, endpoint=False)
    values = np.sin(angles[None, :] - truth.phi[[10, 40], None]) ** 2 + 1e-3
    return dataclasses.replace(
        truth,
        truth=False,
        phi=phi,
        phi_errors=np.full(60, 0.02),
        valid=valid,
        verdict="motion found in 56 of 60 frames",
        landscape=Landscape(angles, np.array([10, 40]), values),
    )


def panels(figure):
    return {axes.get_title(loc="left").split(":")[0]: axes for axes in figure.axes}


def line(axes, color, marker="None"):
    found = [
        candidate
        for candidate in axes.lines
        if to_hex(candidate.get_color()) == color and candidate.get_marker() == marker
    ]
    assert len(found) == 1
    return found[0]


def test_panels_of_a_bare_result(make_motion):
    assert list(panels(draw(make_motion()))) == ["T", "φ", "ω₃", "α"]


def test_crosses_and_exact_curves(result, truth):
    axes = panels(draw(result, truth=truth))
    assert list(axes) == ["T", "Φ", "φ", "ω₃", "α", "absolute errors"]
    for name, values, exact in (
        ("φ", result.phi, truth.phi),
        ("ω₃", result.omega_3, truth.omega_3),
        ("α", result.alpha, truth.alpha),
    ):
        crosses, curve = line(axes[name], BLUE, "x"), line(axes[name], RED)
        np.testing.assert_array_equal(crosses.get_ydata(), values)
        np.testing.assert_array_equal(crosses.get_xdata(), result.time)
        np.testing.assert_array_equal(curve.get_ydata(), exact)
    np.testing.assert_array_equal(line(axes["T"], BLUE, "x").get_ydata(), result.T[:, 0])
    assert axes["φ"].get_ylabel() == "rad"
    assert axes["α"].get_ylabel() == "rad/s"
    assert axes["T"].get_ylabel() == "µm"
    assert axes["T"].get_xlabel() == "t (s)"


def test_truth_is_drawn_as_the_solution_that_was_found(result, truth):
    """The mirror solution, a turn away, with another offset of T: the red curve still fits."""
    shifted = dataclasses.replace(mirror(truth), T=truth.T + 5.0)
    shifted = dataclasses.replace(shifted, phi=shifted.phi - 4 * np.pi)
    axes = panels(draw(result, truth=shifted))
    np.testing.assert_allclose(line(axes["φ"], RED).get_ydata(), truth.phi, atol=1e-12)
    red = [curve for curve in axes["T"].lines if to_hex(curve.get_color()) == RED]
    np.testing.assert_allclose([curve.get_ydata() for curve in red], truth.T.T, atol=1e-12)


def test_errors_have_the_paper_s_marks_on_a_logarithmic_scale(result, truth):
    axes = panels(draw(dataclasses.replace(result, omega_3=truth.omega_3 - 0.1), truth=truth))[
        "absolute errors"
    ]
    assert axes.get_yscale() == "log"
    assert [mark.get_marker() for mark in axes.lines] == ["x", "^", "s"]
    phi, omega_3, alpha = (mark.get_ydata() for mark in axes.lines)
    known = result.valid == 1
    np.testing.assert_allclose(phi[known], 0.01)
    np.testing.assert_allclose(omega_3[known], 0.1)
    assert np.isnan(phi[~known]).all()
    assert np.isnan(alpha).all()  # no error at all has no place on this scale


def test_band_is_one_sigma(result):
    band = next(c for c in panels(draw(result))["φ"].collections if isinstance(c, PolyCollection))
    vertices = band.get_paths()[0].vertices
    heights = vertices[np.isclose(vertices[:, 0], result.time[5]), 1]
    assert np.ptp(heights) == pytest.approx(0.04)


def test_frames_that_are_not_valid_are_shaded(result):
    spans = panels(draw(result))["α"].patches
    assert [(span.get_x(), span.get_width()) for span in spans] == [
        (pytest.approx(result.time[20] - 0.025), pytest.approx(0.15)),
        (pytest.approx(result.time[59] - 0.025), pytest.approx(0.05)),
    ]


def test_landscape_of_the_chosen_frame(result, truth):
    axes = panels(draw(result, truth=truth, steps=[40]))["Φ"]
    curve = axes.lines[0]
    np.testing.assert_array_equal(curve.get_ydata(), result.landscape.values[1])
    assert curve.get_label() == "frame 40"
    least = curve.get_xdata()[np.argmin(curve.get_ydata())]
    marked = {to_hex(mark.get_color()): mark.get_xdata()[0] for mark in axes.lines[1:]}
    assert marked[RED] == pytest.approx(least, abs=np.pi / 180)
    assert marked[BLUE] == pytest.approx(least + 0.01, abs=np.pi / 180)
    middle = result.landscape.frame[len(result.landscape.frame) // 2]
    assert panels(draw(result))["Φ"].lines[0].get_label() == f"frame {middle}"


def test_projections_show_the_centre_in_its_place(result, truth):
    """Pixel (H//2, W//2) is the origin, x₁ to the right, x₂ downwards."""
    image = np.zeros((8, 11))
    figure = draw(result, truth=truth, projections=[Projection(30, image, 0.5)])
    axes = figure.axes[0]
    picture = next(child for child in axes.get_children() if isinstance(child, AxesImage))
    left, right, bottom, top = picture.get_extent()
    assert (left, right) == (-5.5 * 0.5, 5.5 * 0.5)
    assert (top, bottom) == (-4.5 * 0.5, 3.5 * 0.5)
    np.testing.assert_allclose(line(axes, "#3aa0c9", "x").get_xydata()[0], result.center[30])
    np.testing.assert_allclose(line(axes, RED, "o").get_xydata()[0], truth.center[30])
    assert "frame 30" in axes.get_title(loc="left")


def test_no_centre_without_a_pixel_size(result):
    axes = draw(result, projections=[Projection(30, np.zeros((8, 8)), None)]).axes[0]
    assert not axes.lines
    assert axes.get_xlabel() == "x₁ (pixel)"


def test_limits_ignore_wild_frames_that_are_not_valid(result):
    alpha = result.alpha.copy()
    alpha[59] = 1e9
    low, high = panels(draw(dataclasses.replace(result, alpha=alpha)))["α"].get_ylim()
    assert 0 < low < high < 1e9


@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_equal_results_give_equal_files(result, truth, tmp_path, suffix):
    for name in ("a", "b"):
        save(draw(result, truth=truth, title="a $b^{_ ü.h5"), tmp_path / name, suffix)
    first = (tmp_path / "a").read_bytes()
    assert first == (tmp_path / "b").read_bytes()
    assert first.startswith({".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}[suffix])


def test_nothing_is_known(truth, tmp_path):
    unknown = np.full(60, np.nan)
    lost = dataclasses.replace(
        truth,
        truth=False,
        **dict.fromkeys(("phi", "omega_3", "alpha"), unknown),
        T=np.full((60, 2), np.nan),
        R=np.full((60, 3, 3), np.nan),
        valid=np.zeros(60, np.uint8),
        identifiable=False,
        verdict="no object in any frame",
    )
    figure = draw(lost, truth=truth)
    save(figure, tmp_path / "a", ".png")
    assert to_hex(figure.get_suptitle() and figure._suptitle.get_color()) == RED
    assert any(text.get_text() == "not known" for text in panels(draw(lost))["α"].texts)


@pytest.mark.parametrize("n", [1, 2, 3000])
def test_few_and_many_frames(make_motion, tmp_path, n):
    motion = make_motion(n)
    save(draw(motion, truth=motion), tmp_path / "a", ".png")


@pytest.mark.parametrize("value", [np.inf, 1e300, -1e308])
def test_absurd_values_are_left_out(truth, tmp_path, value):
    alpha, T = truth.alpha.copy(), truth.T.copy()
    alpha[3], T[4] = value, value
    absurd = dataclasses.replace(truth, alpha=alpha, T=T, phi_errors=np.full(60, value))
    save(draw(absurd, truth=truth), tmp_path / "a", ".png")
