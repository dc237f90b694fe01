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
from trapcli.stack.tiff import write_volume_tiff


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


def make_volume(folder):
    """Write a volume with a bright spot at x = (4, −3, 6) voxels from its middle, in pixels of the stack."""
    x = np.arange(48) - 24
    square = (x - 4) ** 2 + (x[:, None] + 3) ** 2 + (x[:, None, None] - 6) ** 2
    values = np.exp(-square / 18).astype(np.float32)
    write_volume_tiff(folder / "v.tif", values, voxel_size=1.0, unit="pixel")


def test_volume(result, capsys):
    make_volume(Path())
    assert call("a.h5", "a.tif", "--volume", "v.tif") == 0
    assert "does not say that this is the volume" in capsys.readouterr().err
    assert Path("a.html").read_text().count("<canvas") == 4
    assert call("a.h5", "--volume", "v.tif", "--overwrite") == 0
    assert Path("a.html").read_text().count("<canvas") == 3


def test_volumes_that_do_not_fit(make_motion, result, capsys):
    make_volume(Path())
    make_motion().save("um.h5")
    write_volume_tiff(Path("flat.tif"), np.ones((3, 9, 9), np.float32), voxel_size=1.0, unit="pixel")
    for arguments, code, words in (
        (("um.h5", "--volume", "v.tif"), 3, "v.tif: a volume in pixel does not fit a result in µm"),
        (("a.h5", "--volume", "flat.tif"), 3, "flat.tif: a volume of shape"),
        (("a.h5", "--volume", "missing.mrc"), 3, "no such file"),
        (("a.h5", "--volume", "v.nii"), 2, "no known kind of volume"),
        (("a.h5", "--volume", "v.tif", "-o", "v.html"), 0, "v.html"),
    ):
        assert call(*arguments) == code
        out, err = capsys.readouterr()
        assert words in out + err
        assert (out + err).count("\n") == 1 + (code == 0)


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


def open_page(browser, address):
    """Open a page as a reader sees it, noting what it asks for and complains about."""
    page = browser.new_page(viewport={"width": 1000, "height": 900})
    page.asked, page.complaints = [], []
    page.on("request", lambda request: page.asked.append(request.url))
    page.on("console", lambda message: page.complaints.append(message.text))
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.goto(address)
    return page


@pytest.fixture
def opened(browser, address):
    page = open_page(browser, address)
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


@pytest.fixture(scope="module")
def turning_address(make_motion, tmp_path_factory):
    folder = tmp_path_factory.mktemp("turning")
    make_stack(folder)
    make_result(make_motion, folder)
    make_volume(folder)
    assert call(folder / "a.h5", folder / "a.tif", "--volume", folder / "v.tif") == 0
    return (folder / "a.html").as_uri()


@pytest.fixture
def turning(browser, turning_address):
    """The page of a volume, its canvases painted."""
    page = open_page(browser, turning_address)
    page.wait_for_selector("#turning[data-ready]")
    yield page
    assert page.asked == [page.url]
    # it is the tests that read pixels back
    assert [words for words in page.complaints if "getImageData" not in words] == []
    page.close()


def spot(page, name):
    """Middle of what is bright, or on the surface blue, in voxels from the middle of the canvas."""
    middle = page.evaluate(
        """name => {
        const canvas = document.getElementById(name), width = canvas.width;
        const pixels = canvas.getContext("2d").getImageData(0, 0, width, width).data;
        let most = 0, count = 0, x = 0, y = 0;
        for (let i = 2; i < pixels.length; i += 4) most = Math.max(most, pixels[i]);
        for (let i = 0; i < width * width; i += 1) {
          const blue = pixels[4 * i + 2], least = name === "shape" ? pixels[4 * i] : most / 2;
          if (blue > least) { count += 1; x += i % width; y += Math.floor(i / width); }
        }
        return [x / count / width, y / count / width]; }""",
        name,
    )
    return 48 * (np.array(middle) - 0.5)


def test_the_object_turns_by_the_motion(turning, make_motion):
    """A point b of the object lies at Rᵀ b, in the projection as on the surface."""
    motion = make_motion(20)
    kept = [n for n in range(20) if n not in (4, 5)]
    for pose in (0, 6, 17):
        turning.locator("#pose").fill(str(pose))
        exact = motion.R[kept[pose]].T @ [4, -3, 6]
        np.testing.assert_allclose(spot(turning, "projection"), exact[:2], atol=0.3)
        np.testing.assert_allclose(spot(turning, "shape"), exact[:2], atol=0.3)
        np.testing.assert_allclose(spot(turning, "film"), 0, atol=0.6)
        assert turning.inner_text("#pose-at") == f"t = {motion.time[kept[pose]]:g} s, frame {2 * kept[pose]}"


def test_the_mouse_turns_the_surface(turning):
    """By a quarter turn to the right what lay in front comes to the right; the projection stays."""
    before = spot(turning, "projection")
    turning.locator("#shape").scroll_into_view_if_needed()
    box = turning.locator("#shape").bounding_box()
    turning.mouse.move(box["x"] + 40, box["y"] + 100)
    turning.mouse.down()
    turning.mouse.move(box["x"] + 40 + 0.4 * np.pi / 2 * box["width"], box["y"] + 100, steps=5)
    turning.mouse.up()
    np.testing.assert_allclose(spot(turning, "shape"), [-6, -3], atol=0.4)
    np.testing.assert_array_equal(spot(turning, "projection"), before)
    turning.locator("#shape").dblclick()
    np.testing.assert_allclose(spot(turning, "shape"), [4, -3], atol=0.4)


def test_level_and_play(turning):
    shown = "document.getElementById('shape').toDataURL()"
    before = turning.evaluate(shown)
    turning.locator("#level").fill("80")
    assert turning.inner_text("#level-at") == "80 %"
    assert turning.evaluate(shown) != before
    turning.locator("#play").click()
    assert turning.inner_text("#play") == "Pause"
    while turning.input_value("#pose") in "01":
        turning.wait_for_timeout(50)
    turning.locator("#play").click()
    assert turning.inner_text("#play") == "Play"


def test_it_prints(opened):
    assert opened.pdf().startswith(b"%PDF")
    opened.emulate_media(media="print")
    assert not opened.is_visible("#moment")
    assert opened.is_visible("#sphere")
