"""The command `trap-motion simulate`: files, options, exit codes."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import tifffile

from trapcli.cli.main import run
from trapcli.result.motion import Motion

SMALL = ["-n", "6", "--size", "32x24", "--spacing", "0.8"]


@pytest.fixture
def simulate(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        with pytest.raises(SystemExit) as done:
            run(["simulate", *map(str, arguments)])
        captured = capsys.readouterr()
        return done.value.code, captured.out, captured.err

    return call


def test_without_options_the_papers_scene_is_written(simulate):
    code, out, err = simulate()
    assert (code, out, err) == (0, "sim.tif\ntruth.h5\n", "")
    with tifffile.TiffFile("sim.tif") as file:
        frames = file.asarray()
        metadata = file.imagej_metadata
    assert frames.shape == (200, 128, 128)
    assert frames.dtype == np.float32
    assert float(metadata["finterval"]) == 0.0025
    truth = Motion.load("truth.h5")
    assert truth.truth
    assert (truth.time_unit, truth.length_unit) == ("s", "µm")
    np.testing.assert_allclose(truth.phi, np.pi * truth.time + np.pi / 3)
    np.testing.assert_allclose(truth.alpha, 1 + 10 * truth.time**2)
    x = (np.arange(128) - 64) * 0.2
    center = np.einsum("nij,j->n", frames, x) / frames.sum(axis=(1, 2))
    np.testing.assert_allclose(center, truth.center[:, 0], atol=1e-5)
    assert truth.provenance["program"] == "trap-motion"
    assert "frame_interval = 0.0025" in truth.provenance["configuration"]


def test_existing_outputs_stay_unless_told_otherwise(simulate, tmp_path):
    assert simulate(*SMALL)[0] == 0
    for name in ("sim.tif", "truth.h5"):
        other = tmp_path / ("truth.h5" if name == "sim.tif" else "sim.tif")
        other.unlink()
        before = (tmp_path / name).read_bytes()
        code, out, err = simulate(*SMALL, "--seed", 1)
        assert (code, out) == (5, "")
        assert name in err
        assert "--overwrite" in err
        assert (tmp_path / name).read_bytes() == before
        assert not other.exists()
        assert simulate(*SMALL, "--overwrite")[0] == 0


def test_options_beat_the_preset(simulate):
    code, out, _ = simulate(
        "--preset", "tumbling", *SMALL, "-o", "t.tif", "--truth", "t.h5", "--total-angle", 90
    )
    assert (code, out) == (0, "t.tif\nt.h5\n")
    assert tifffile.imread("t.tif").shape == (6, 24, 32)
    configuration = Motion.load("t.h5").provenance["configuration"]
    for line in ('kind = "grain"', 'kind = "tumbling"', "total_angle = 90.0", "noise = 0.01", "width = 32"):
        assert line in configuration


def test_a_truth_file_renders_its_stack_again(simulate):
    simulate(
        *SMALL,
        "--phantom",
        "blobs",
        "--motion",
        "single-axis",
        "--tilt",
        "10",
        "--noise",
        "0.05",
        "--seed",
        5,
    )
    code, _, _ = simulate("--config", "truth.h5", "-o", "again.tif", "--truth", "again.h5")
    assert code == 0
    np.testing.assert_array_equal(tifffile.imread("again.tif"), tifffile.imread("sim.tif"))
    np.testing.assert_array_equal(Motion.load("again.h5").R, Motion.load("truth.h5").R)


def test_camera_with_its_background(simulate):
    code, out, _ = simulate("--preset", "tumbling", *SMALL, "--bits", 8, "--background-out", "empty.tif")
    assert (code, out.split()) == (0, ["sim.tif", "truth.h5", "empty.tif"])
    frames, empty = tifffile.imread("sim.tif"), tifffile.imread("empty.tif")
    assert frames.dtype == np.uint8
    assert (empty.dtype, empty.shape) == (np.float32, (24, 32))
    # the grain absorbs in the middle and nothing in the corners
    assert np.median(frames[:, 10:14, 14:18]) < 0.8 * empty[12, 16]
    np.testing.assert_allclose(frames[:, :3, :3].mean(), empty[:3, :3].mean(), rtol=0.05)


def test_avi_holds_8_bits_raw(simulate):
    cv2 = pytest.importorskip("cv2")
    assert simulate(*SMALL, "--dtype", "uint8", "-o", "sim.avi")[0] == 0
    assert simulate(*SMALL, "--dtype", "uint8", "--overwrite")[0] == 0
    video = cv2.VideoCapture("sim.avi")
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(400)
    for frame in tifffile.imread("sim.tif"):
        np.testing.assert_array_equal(video.read()[1][..., 0], frame)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--phantom", "cat"], "phantom"),
        (["--size", "big"], "256x192"),
        (["--size", "2"], "stack.height"),
        (["-n", "0"], "stack.frames"),
        (["--spacing", "nan"], "pixel_size"),
        (["--noise", "0.1", "--camera"], "full_well"),
        (["--dtype", "uint8", "--camera"], "--bits"),
        (["--tilt", "5"], "single-axis"),
        (["--preset", "camera", "--config", "x.toml"], "exclude"),
        (["--config", "missing.toml"], "missing.toml"),
        (["-o", "sim.png"], ".avi"),
        (["-o", "sim.avi"], "uint8"),
        (["-o", "a.tif", "--truth", "a.tif"], "same name"),
        (["--background-out", "empty.tif"], "camera"),
    ],
)
def test_requests_that_make_no_sense_end_with_2_and_write_nothing(simulate, tmp_path, arguments, message):
    code, out, err = simulate(*arguments)
    assert (code, out) == (2, "")
    assert message in err
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_ends_with_5(simulate):
    code, out, err = simulate(*SMALL, "-o", "nowhere/sim.tif")
    assert (code, out) == (5, "")
    assert "nowhere" in err


def test_help_needs_no_numpy():
    program = (
        "import sys; sys.argv = ['trap-motion', 'simulate', '--help']\n"
        "from trapcli.cli.main import run\n"
        "try: run()\n"
        "finally: assert 'numpy' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    for preset in ("paper", "single-axis", "tumbling", "camera"):
        assert preset in done.stdout


def test_progress_is_drawn_on_a_terminal_only(simulate, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    code, out, err = simulate(*SMALL)
    assert (code, out) == (0, "sim.tif\ntruth.h5\n")
    assert "rendering" in err
    assert simulate(*SMALL, "-q", "--overwrite")[2] == ""
