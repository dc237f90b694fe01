"""``trap-motion report``: where the page goes, what it needs, how it looks in a browser."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile

from trapcli.cli.main import run
from trapcli.config import EstimateConfig, InputConfig, PreprocessConfig, to_toml
from trapcli.result.provenance import checksum_line


def make_stack(folder):
    """Write 40 raw frames of a dark blob of 48 × 48 pixels."""
    x = np.arange(48) - 24
    blob = 0.5 * np.exp(-(x[:, None] ** 2 + x**2) / 50)
    noise = 1 + 0.003 * np.random.default_rng(0).standard_normal((40, 48, 48))
    frames = (30000 * np.exp(-blob) * noise).astype("u2")
    tifffile.imwrite(folder / "a.tif", frames, photometric="minisblack")


def make_result(make_motion, folder):
    """Write a result of every second frame of it."""
    config = EstimateConfig(InputConfig(frames="::2"), PreprocessConfig(background="border"))
    texts = {"configuration": to_toml(config), "inputs": checksum_line(folder / "a.tif")}
    flags = np.zeros(20, np.uint16)
    flags[4:6] = 1
    motion = make_motion(
        20, provenance=texts, length_unit="pixel", frame=np.arange(0, 40, 2), flags=flags, valid=flags == 0,
        phi_errors=np.full(20, 0.1), center=np.zeros((20, 2)),
    )  # fmt: skip
    motion.save(folder / "a.h5")


@pytest.fixture
def result(make_motion, tmp_path, monkeypatch):
    """``a.h5`` of ``a.tif`` in the working folder."""
    monkeypatch.chdir(tmp_path)
    make_stack(tmp_path)
    make_result(make_motion, tmp_path)
    return tmp_path / "a.h5"


def call(*arguments):
    with pytest.raises(SystemExit) as end:
        run(["report", *map(str, arguments)])
    return end.value.code


def test_default_name_is_beside_the_result(result, capsys):
    assert call(result) == 0
    out, err = capsys.readouterr()
    assert (out, err) == (f"{result.with_suffix('.html')}\n", "")
    assert result.with_suffix(".html").read_text().startswith("<!DOCTYPE html>")
    assert call(result) == 5
    assert call(result, "--overwrite") == 0


def test_stack(result, capsys):
    assert call("a.h5", "a.tif", "-o", "b.html") == 0
    assert capsys.readouterr() == ("b.html\n", "")
    text = Path("b.html").read_text()
    assert text.count("as it should be") == 3
    assert "a surface through the border" in text
    assert "give the stack" not in text


def test_another_stack(result, capsys):
    frames = tifffile.imread("a.tif")
    tifffile.imwrite("other.tif", frames[:, ::-1], photometric="minisblack")
    assert call("a.h5", "other.tif") == 0
    assert "is not the file" in capsys.readouterr().err
    assert "is not the file that was estimated" in Path("a.html").read_text()
    tifffile.imwrite("short.tif", frames[:20], photometric="minisblack")
    assert call("a.h5", "short.tif", "--overwrite") == 3
    assert "gives 10 frames" in capsys.readouterr().err


def test_a_background_that_is_elsewhere(make_motion, result, capsys):
    config = EstimateConfig(preprocess=PreprocessConfig(background="empty.tif"))
    make_motion(provenance={"configuration": to_toml(config)}).save("b.h5")
    assert call("b.h5", "a.tif") == 3
    err = capsys.readouterr().err
    assert "empty.tif" in err
    assert "in the folder where" in err
    assert err.count("\n") == 1


def test_what_makes_no_sense(result, capsys):
    for arguments, code in (
        (("a.h5", "-o", "a.pdf"), 2),
        (("missing.h5",), 3),
        (("a.tif",), 3),
        (("a.h5", "missing.tif"), 3),
        (("a.h5", "-o", "nowhere/a.html"), 5),
    ):
        assert call(*arguments) == code
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
    assert not Path("a.html").exists()


# in a browser


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip("playwright.sync_api", reason="playwright isn't installed")
    installed = shutil.which("chromium") or shutil.which("google-chrome")
    with api.sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=installed, args=["--no-sandbox"])
        except api.Error:
            pytest.skip("no Chromium here; `playwright install chromium` or the system's package brings one")
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def address(make_motion, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    make_stack(folder)
    make_result(make_motion, folder)
    assert call(folder / "a.h5", folder / "a.tif") == 0
    return (folder / "a.html").as_uri()


@pytest.fixture
def opened(browser, address):
    """The page as a reader sees it, with what it asked for and complained about."""
    page = browser.new_page(viewport={"width": 1000, "height": 900})
    page.asked, page.complaints = [], []
    page.on("request", lambda request: page.asked.append(request.url))
    page.on("console", lambda message: page.complaints.append(message.text))
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.goto(address)
    yield page
    page.close()


def picture(page):
    return page.evaluate("document.getElementById('sphere').toDataURL()")


def test_it_renders_and_asks_for_nothing(opened):
    assert opened.title() == "a.h5"
    assert opened.inner_text("h1") == "Trustworthy in part: 18 of 20 frames"
    widths = opened.evaluate("[...document.images].map(image => image.naturalWidth)")
    assert len(widths) == 4
    assert min(widths) > 300
    assert opened.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    assert opened.asked == [opened.url]
    assert opened.complaints == []


def test_the_mouse_turns_the_sphere(opened):
    canvas = opened.locator("#sphere")
    canvas.scroll_into_view_if_needed()
    before = picture(opened)
    box = canvas.bounding_box()
    opened.mouse.move(box["x"] + 200, box["y"] + 200)
    assert picture(opened) == before
    opened.mouse.down()
    opened.mouse.move(box["x"] + 260, box["y"] + 170)
    turned = picture(opened)
    assert turned != before
    opened.mouse.up()
    opened.mouse.move(box["x"] + 100, box["y"] + 100)
    assert picture(opened) == turned
    canvas.press("ArrowLeft")
    assert picture(opened) != turned
    assert opened.complaints == []


def test_the_slider_tells_time_and_direction(opened):
    opened.locator("#moment").fill("10")
    told = opened.inner_text("#where")
    assert told.startswith("t = 0.5 s, frame 20: γ = (")
    gamma = [float(x) for x in told.split("(")[1].rstrip(")").split(",")]
    exact = [np.sin(0.35) * np.sin(0.55), -np.cos(0.35) * np.sin(0.55), np.cos(0.55)]
    np.testing.assert_allclose(gamma, exact, atol=0.006)


def test_it_prints(opened):
    assert opened.pdf().startswith(b"%PDF")
    opened.emulate_media(media="print")
    assert not opened.is_visible("#moment")
    assert opened.is_visible("#sphere")
