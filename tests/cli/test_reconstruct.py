"""``trap-motion reconstruct`` and ``align``: files, exit codes, one line on each bad input."""

from __future__ import annotations

import dataclasses
import json
import os

import h5py
import numpy as np
import pytest
import tifffile

from trapcli.cli.main import run
from trapcli.config import EstimateConfig, InputConfig, PreprocessConfig, to_toml
from trapcli.result.motion import Motion


def call(*arguments):
    with pytest.raises(SystemExit) as end:
        run([str(argument) for argument in arguments])
    return end.value.code


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A small stack with its truth, and the same as raw images."""
    folder = tmp_path_factory.mktemp("made")
    options = (
        "--phantom",
        "blobs",
        "--motion",
        "single-axis",
        "--size",
        "32",
        "--spacing",
        "0.8",
        "-n",
        "60",
    )
    assert call("simulate", "-o", folder / "plain.tif", "--truth", folder / "plain-truth.h5", *options) == 0
    raw = ("--camera", "--background-out", folder / "empty.tif")
    assert call("simulate", "-o", folder / "raw.tif", "--truth", folder / "raw-truth.h5", *options, *raw) == 0
    return folder


@pytest.fixture
def folder(made, tmp_path):
    for path in made.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def one_line(capfd) -> str:
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    return err


def test_volume_beside_the_result(folder, capfd):
    assert call("reconstruct", folder / "plain.tif", folder / "plain-truth.h5", "-v") == 0
    out, err = capfd.readouterr()
    assert out == f"{folder / 'plain-truth-volume.tif'}\n"
    assert "% of Fourier space seen" in err
    with tifffile.TiffFile(folder / "plain-truth-volume.tif") as file:
        assert file.is_ome
        assert len(set(file.asarray().shape)) == 1
    with h5py.File(folder / "plain-truth.h5") as file:
        assert np.isfinite(file["motion/reconstruction/residual"]).all()
        assert file["motion/reconstruction"].attrs["volume"].endswith("plain-truth-volume.tif")
    assert call("reconstruct", folder / "plain.tif", folder / "plain-truth.h5") == 5
    assert "--overwrite" in one_line(capfd)


def test_figure_of_the_volume(folder, capfd):
    result, volume = folder / "plain-truth.h5", folder / "plain-truth-volume.tif"
    assert call("plot", result, "--volume", volume) == 3
    assert call("reconstruct", folder / "plain.tif", result) == 0
    capfd.readouterr()
    assert call("plot", result, "--volume", volume) == 0
    assert capfd.readouterr().out == f"{folder / 'plain-truth-volume.png'}\n"
    assert call("plot", result, "--volume", volume, "--time-step", "3", "--overwrite") == 2
    assert "--volume" in one_line(capfd)


@pytest.mark.parametrize("ending", ["mrc", "h5"])
def test_json(folder, capfd, ending):
    output = folder / f"a.{ending}"
    code = call(
        "reconstruct", folder / "plain.tif", folder / "plain-truth.h5", "-o", output, "--json", "--signed"
    )
    assert code == 0
    summary = json.loads(capfd.readouterr().out, parse_constant=pytest.fail)
    assert summary["output"] == str(output)
    assert summary["coverage"] == 1
    assert summary["frames"] == 60
    assert summary["warnings"] == []
    assert summary["resolution_0.143"] <= summary["resolution_0.5"]
    assert summary["median_misfit"] <= summary["median_held_out"]


def raw_result(folder, **changes) -> Motion:
    """A result of the raw images that says how its frames were prepared."""
    truth = Motion.load(folder / "raw-truth.h5")
    config = EstimateConfig(
        input=InputConfig(frames="5:55", roi=(2, 30, 1, 31)),
        preprocess=PreprocessConfig(background=str(folder / "empty.tif")),
    )
    rows = slice(5, 55)
    series = {
        name: getattr(truth, name)[rows]
        for name in (
            "time", "frame", "T", "T_errors", "phi", "phi_errors", "omega_3", "omega_3_errors",
            "alpha", "alpha_errors", "R", "R_errors", "valid", "flags", "residual",
        )
    }  # fmt: skip
    # the middle pixel of the region is that of the frame: 15 + 1 = 14 + 2 = 16
    motion = dataclasses.replace(
        truth, **series, center=truth.center[rows], truth=False, provenance={"configuration": to_toml(config)}
    )
    return dataclasses.replace(motion, **changes)


def test_frames_are_prepared_as_the_estimate_did(folder):
    raw_result(folder).save(folder / "raw.h5")
    assert call("reconstruct", folder / "raw.tif", folder / "raw.h5", "-o", folder / "raw-volume.h5") == 0
    assert call("reconstruct", folder / "plain.tif", folder / "plain-truth.h5", "-o", folder / "v.h5") == 0
    volumes = []
    for name in ("raw-volume.h5", "v.h5"):
        with h5py.File(folder / name) as file:
            values = file["volume/attenuation/values"][()]
            middle = len(values) // 2
            volumes.append(values[(slice(middle - 6, middle + 6),) * 3].ravel())
    assert np.corrcoef(*volumes)[0, 1] > 0.97


def test_another_background_than_stored(folder, capfd):
    raw_result(folder).save(folder / "raw.h5")
    (folder / "empty.tif").unlink()
    assert call("reconstruct", folder / "raw.tif", folder / "raw.h5") == 3
    assert "empty.tif" in one_line(capfd)
    assert call("reconstruct", folder / "raw.tif", folder / "raw.h5", "--background", "border") == 0


def test_motion_without_trust(folder, capfd):
    verdict = "the object is too round"
    raw_result(folder, identifiable=False, verdict=verdict, valid=np.zeros(50, np.uint8)).save(
        folder / "raw.h5"
    )
    for command in ("reconstruct", "align"):
        assert call(command, folder / "raw.tif", folder / "raw.h5", "-o", folder / "a.tif") == 4
        assert verdict in one_line(capfd)
        assert not (folder / "a.tif").exists()
    assert call("reconstruct", folder / "raw.tif", folder / "raw.h5", "--untrusted") == 4
    out, err = capfd.readouterr()
    assert out == f"{folder / 'raw-volume.tif'}\n"
    assert verdict in err


def test_limited_view_is_a_warning(folder, capfd):
    motion = raw_result(folder)
    half = dataclasses.replace(motion, valid=(np.arange(50) < 15).astype(np.uint8))
    half.save(folder / "raw.h5")
    assert call("reconstruct", folder / "raw.tif", folder / "raw.h5") == 0
    assert "warning: " in (err := capfd.readouterr().err)
    assert "limited view" in err


def bad_inputs(folder):
    truth = Motion.load(folder / "plain-truth.h5")
    dataclasses.replace(truth, center=np.full((60, 2), np.nan)).save(folder / "none.h5")
    dataclasses.replace(truth, center=truth.center + 100).save(folder / "far.h5")
    dataclasses.replace(truth, length_unit="nm").save(folder / "nm.h5")
    dataclasses.replace(truth, truth=False, provenance={"configuration": "= ="}).save(folder / "broken.h5")
    raw_result(folder).save(folder / "raw.h5")
    plain = folder / "plain.tif"
    return {
        "no such": (3, plain, folder / "gone.h5"),
        "gone.tif": (3, folder / "gone.tif", folder / "plain-truth.h5"),
        "not a readable HDF5": (3, plain, plain),
        "holds no motion": (3, plain, folder / "none.h5"),
        "lie outside of its frames": (3, plain, folder / "far.h5"),
        "pass --pixel-size": (3, plain, folder / "nm.h5"),
        "can't be read": (2, plain, folder / "broken.h5"),
        "--pixel-size -1": (2, plain, folder / "plain-truth.h5", "--pixel-size", "-1"),
        "has 1 frames": (3, folder / "empty.tif", folder / "plain-truth.h5"),
        "no known kind": (2, plain, folder / "plain-truth.h5", "-o", folder / "a.nii"),
        "is an input": (5, plain, folder / "plain-truth.h5", "-o", plain, "--overwrite"),
        "exists already": (5, plain, folder / "plain-truth.h5", "-o", folder / "raw.tif"),
    }


@pytest.mark.parametrize("command", ["reconstruct", "align"])
def test_bad_inputs(folder, capfd, command):
    for words, (code, *arguments) in bad_inputs(folder).items():
        if "-o" not in arguments:
            arguments += ["-o", folder / "out.tif"]
        assert call(command, *arguments) == code, words
        assert words in one_line(capfd)
    assert not (folder / "out.tif").exists()


def test_voxels_out_of_range(folder, capfd):
    assert call("reconstruct", folder / "plain.tif", folder / "plain-truth.h5", "--voxels", "3") == 2
    assert "--voxels 3" in one_line(capfd)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_result_that_may_not_be_changed(folder, capfd):
    folder.chmod(0o555)
    assert call("reconstruct", folder / "plain.tif", folder / "plain-truth.h5") == 5
    folder.chmod(0o755)


def test_aligned_frames(folder, capfd):
    assert call("align", folder / "plain.tif", folder / "plain-truth.h5") == 0
    assert capfd.readouterr().out == f"{folder / 'plain-truth-aligned.tif'}\n"
    frames = tifffile.imread(folder / "plain-truth-aligned.tif")
    assert frames.shape == (60, 32, 32)
    axis = np.arange(32) - 16
    for x in (axis, axis[:, None]):
        centroid = (frames * x).sum(axis=(1, 2)) / frames.sum(axis=(1, 2))
        assert np.abs(centroid).max() < 0.05
    assert call("info", folder / "plain-truth-aligned.tif", "--json") == 0
    info = json.loads(capfd.readouterr().out)
    assert info["pixel_size"] == pytest.approx(0.8)


def test_box_and_mrcs(folder, capfd):
    output = folder / "a.mrcs"
    assert call("align", folder / "plain.tif", folder / "plain-truth.h5", "-o", output, "--box", "28") == 0
    capfd.readouterr()
    assert call("export", folder / "plain-truth.h5", "--format", "relion", "--aligned", output) == 0
    star = capfd.readouterr().out
    assert "000060@" in star
    assert "28 2 300" in star
    assert call("align", folder / "plain.tif", folder / "plain-truth.h5", "-o", folder / "a.avi") == 2


def test_upright(folder, capfd):
    """The axis runs down: what is at one height stays there."""
    assert call("align", folder / "plain.tif", folder / "plain-truth.h5", "--upright") == 0
    frames = tifffile.imread(folder / "plain-truth-aligned.tif")
    rows = frames.sum(axis=2)
    assert np.abs(rows - rows.mean(axis=0)).max() < 0.05 * rows.max()


def test_upright_of_a_tumbling(folder, capfd):
    motion = Motion.load(folder / "plain-truth.h5")
    from scipy.spatial.transform import Rotation

    t = np.linspace(0, 2, 60)
    turns = Rotation.from_rotvec(np.outer(t, [1, 0, 0])) * Rotation.from_rotvec(np.outer(t, [0, 0, 1]))
    dataclasses.replace(motion, R=turns.as_matrix()).save(folder / "tumbling.h5")
    assert call("align", folder / "plain.tif", folder / "tumbling.h5", "--upright") == 2
    assert "--upright: the motion is not about one axis" in one_line(capfd)
    for kind in ("tigre", "odtbrain"):
        assert call("export", folder / "tumbling.h5", "--format", kind) == 2
        assert f"--format {kind}: the motion is not about one axis" in one_line(capfd)


def test_geometries(folder, capfdbinary):
    result = folder / "plain-truth.h5"
    for kind in ("relion", "astra"):
        output = folder / f"a.{kind}"
        assert call("export", result, "--format", kind, "-o", output) == 2
        assert b"--stack or --aligned" in capfdbinary.readouterr().err
        assert call("export", result, "--format", kind, "--stack", folder / "plain.tif", "-o", output) == 0
        assert capfdbinary.readouterr().out.decode() == f"{output}\n"
    assert np.loadtxt(folder / "a.astra").shape == (60, 13)
    for kind in ("tigre", "odtbrain"):
        assert call("export", result, "--format", kind) == 0
        assert len(np.loadtxt(capfdbinary.readouterr().out.decode().splitlines())) == 60
    assert call("export", result, "--format", "tigre", "--stack", folder / "plain.tif") == 2
    capfdbinary.readouterr()
    assert call("export", result, "--format", "npz", "-o", folder / "a.npz") == 0
    with np.load(folder / "a.npz") as archive:
        assert archive["R"].shape == (60, 3, 3)
    assert call("export", result, "--format", "astra", "--aligned", folder / "empty.tif") == 3
    assert b"don't belong together" in capfdbinary.readouterr().err
