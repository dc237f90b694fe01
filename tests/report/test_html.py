"""The page of a result: it says what the result holds, and loads nothing."""

from __future__ import annotations

import dataclasses
import html.parser
import json
import re

import numpy as np
import pytest
from matplotlib.colors import to_hex

from trapcli.report import turning
from trapcli.report.checks import check_frames
from trapcli.report.figures import Projection, draw_frames, draw_quality
from trapcli.report.html import Seen, Volume, page, path_on_sphere
from trapcli.report.words import facts, flagged, headline
from trapcli.result.motion import Flag
from trapcli.stack.frames import Frames

LOADING = {"src", "href", "srcset", "data", "action", "poster", "background", "xlink:href", "style"}


class Elements(html.parser.HTMLParser):
    """Open elements, attributes and texts of a page."""

    def __init__(self, text):
        super().__init__()
        self.open, self.attributes, self.texts = [], [], {}
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.attributes += [(tag, name, value) for name, value in attributes]
        if tag not in ("meta", "link", "img", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.setdefault(self.open[-1] if self.open else "", []).append(data)


@pytest.fixture
def seen():
    frames = np.random.default_rng(0).random((40, 24, 30))
    shown = tuple(Projection(n, frames[n], 1.0) for n in (0, 20, 39))
    checks = check_frames(Frames.from_array(frames))
    return Seen(shown, shown, checks, True, ("background: made up",), ())


def test_nothing_leaves_the_page(make_motion, seen):
    elements = Elements(page(make_motion(), title="a.h5", seen=seen))
    assert elements.open == []
    loading = [(tag, value) for tag, name, value in elements.attributes if name in LOADING]
    assert {tag for tag, _ in loading} == {"img", "link"}
    assert all(value.startswith("data:") for _, value in loading)
    assert len(loading) == 5
    scripts = "".join(elements.texts["script"] + elements.texts["style"])
    assert not re.search(r"https?:|url\(|import|fetch\(|XMLHttpRequest", scripts)


@pytest.fixture
def volume(make_motion):
    """Random voxels: nothing is harder to pack."""
    values = np.random.default_rng(0).random((80, 80, 80)).astype(np.float32)
    return Volume(values, 0.2, "µm", None, turning.prepare(values, 0.2, "µm", make_motion()))


def test_nothing_leaves_the_page_with_a_volume(make_motion, seen, volume):
    film = np.random.default_rng(0).random((40, 200, 200))
    shown = turning.with_film(volume.turning, Frames.from_array(film), make_motion(), 0.2)
    text = page(make_motion(), title="a.h5", seen=dataclasses.replace(seen, turning=shown), volume=volume)
    elements = Elements(text)
    assert elements.open == []
    loading = [value for tag, name, value in elements.attributes if name in LOADING]
    assert all(value.startswith("data:") for value in loading)
    scripts = "".join(elements.texts["script"] + elements.texts["style"])
    assert not re.search(r"https?:|url\(|import|fetch\(|XMLHttpRequest", scripts)
    assert "Frames 0 to 39." in "".join(elements.texts["p"])
    assert len(text) < 4_000_000


def test_words_come_first(make_motion):
    elements = Elements(page(make_motion(verdict="it fits"), title="a.h5"))
    assert elements.texts["h1"] == ["Trustworthy: all 40 frames"]
    assert "it fits" in elements.texts["p"]
    assert sum("give the stack" in text for text in elements.texts["p"]) == 2


@pytest.mark.parametrize(
    ("valid", "identifiable", "level", "title"),
    [
        (40, True, "good", "Trustworthy: all 40 frames"),
        (39, True, "good", "Trustworthy: 39 of 40 frames"),
        (20, True, "fair", "Trustworthy in part: 20 of 40 frames"),
        (0, True, "bad", "Not trustworthy"),
        (40, False, "bad", "Not trustworthy"),
    ],
)
def test_verdict(make_motion, valid, identifiable, level, title):
    mask = (np.arange(40) < valid).astype(np.uint8)
    found = headline(make_motion(valid=mask, identifiable=identifiable, verdict="not trustworthy: a sphere"))
    assert (found.level, found.title, found.text) == (level, title, "a sphere")


def test_facts(make_motion):
    motion = make_motion(
        201,
        omega_3=np.full(201, 3.0),
        alpha=np.full(201, 4.0),
        phi_errors=np.full(201, np.radians(2)),
    )
    found = dict(facts(motion))
    duration = motion.time[-1]
    assert float(found["Turned by"].split("°")[0]) == pytest.approx(np.degrees(5 * duration), rel=0.002)
    assert found["Rate of rotation"] == "5 rad/s in the median"
    assert found["Rotation axis"].startswith("36.9°")
    assert found["Typical errors (1 σ)"] == "φ 2°"
    motion.alpha[5] = np.nan
    assert dict(facts(motion))["Turned by"].startswith("at least")


def test_flagged_frames_are_listed(make_motion):
    flags = np.zeros(40, np.uint16)
    flags[[3, 4, 5, 9]] = Flag.BLANK
    valid = np.ones(40, np.uint8)
    valid[9] = 0
    motion = make_motion(flags=flags, valid=valid)
    motion = dataclasses.replace(motion, frame=motion.frame + 100)
    assert flagged(motion) == [("blank", 4, "103 to 105, 109"), ("not valid", 1, "109")]
    axes = draw_quality(motion).axes
    assert [label.get_text() for label in axes[1].get_yticklabels()] == ["blank"]
    circles = next(line for line in axes[0].lines if line.get_marker() == "o")
    np.testing.assert_allclose(circles.get_xdata(), motion.time[[3, 4, 5, 9]])


def test_path_is_the_viewing_direction_and_moves_at_alpha(make_motion):
    motion = make_motion()
    path = json.loads(json.dumps(path_on_sphere(motion)))
    at, bt = 0.7 * motion.time, 1.1 * motion.time
    exact = np.stack([np.sin(at) * np.sin(bt), -np.cos(at) * np.sin(bt), np.cos(bt)], axis=1)
    np.testing.assert_allclose(path["points"], exact, atol=1e-4)
    speed = np.linalg.norm(np.gradient(motion.R[:, :, 2], motion.time, axis=0), axis=1)
    np.testing.assert_allclose(speed[1:-1], motion.alpha[1:-1], rtol=3e-3)
    tangent = np.gradient(motion.R[:, :, 2], motion.time, axis=0)
    bend = np.cross(tangent, np.gradient(tangent, motion.time, axis=0))
    curvature = np.sum(motion.R[:, :, 2] * bend, axis=1) / speed**3
    sigma = np.gradient(motion.phi, motion.time)
    exact_curvature = (motion.omega_3 + sigma) / motion.alpha
    np.testing.assert_allclose(curvature[2:-2], exact_curvature[2:-2], atol=0.01)
    motion.R[3] = np.nan
    assert path_on_sphere(motion)["points"][3] is None


def test_axis_is_as_long_as_a_rod_appears(make_motion):
    motion = make_motion(alpha=np.full(40, 3.0), omega_3=np.full(40, 4.0), phi=np.full(40, 0.4))
    figure = draw_frames(motion, [Projection(7, np.zeros((50, 80)), 2.0)])
    (rod,) = (line for line in figure.axes[0].lines if to_hex(line.get_color()) == "#e0831a")
    ends = rod.get_xydata()
    np.testing.assert_allclose(ends.mean(axis=0), motion.center[7])
    # 35 % of 50 pixels of 2, of which 3/5 are in the image plane
    half = 0.35 * 100 * 0.6
    np.testing.assert_allclose((ends[1] - ends[0]) / 2, [half * np.cos(0.4), half * np.sin(0.4)])


def test_odd_texts_and_values_do_no_harm(make_motion):
    bad = "</script><script>alert(1)</script>\udcff"
    nothing = np.full(40, np.nan)
    motion = make_motion(
        verdict=bad,
        length_unit="</script>",
        provenance={"warnings": bad, "configuration": bad, bad: "x"},
        alpha=nothing,
        residual=nothing,
        valid=np.zeros(40, np.uint8),
        R=np.full((40, 3, 3), np.nan),
    )
    text = page(motion, title=bad)
    assert "<script>alert" not in text
    text.encode("utf-8")
    assert Elements(text).open == []


def test_one_frame(make_motion, seen):
    assert Elements(page(make_motion(1), title="a.h5")).open == []


@pytest.mark.parametrize("n", [4000, 20000])
def test_long_results_stay_below_5_mb(make_motion, n):
    errors = np.full(n, 0.1)
    rough = np.random.default_rng(0).random(n)
    motion = make_motion(
        n, phi_errors=errors, alpha_errors=errors, residual=rough, omega_3=rough, alpha=rough, phi=rough
    )
    assert len(page(motion, title="a.h5").encode()) < 4_000_000
