"""Volumes as other programs read them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import h5py
import mrcfile
import numpy as np
import pytest
import tifffile

from trapcli.errors import ConfigError, InputError, OutputError
from trapcli.reconstruction.coverage import cover
from trapcli.reconstruction.resolution import resolve
from trapcli.reconstruction.volume import Reconstruction
from trapcli.reconstruction.volume_files import (
    read_volume,
    record,
    stack_shape,
    write_mrc,
    write_mrc_stack,
    write_volume,
)
from trapcli.result.motion import Motion


@pytest.fixture
def volume(make_motion):
    values = np.random.default_rng(0).random((6, 6, 6), np.float32)
    series = np.arange(30.0)
    return Reconstruction(
        values=values,
        voxel_size=0.25,
        length_unit="µm",
        resolution=resolve(values, values, 0.25),
        coverage=cover(make_motion(30).R, directions=500),
        residual=series,
        misfit=2 * series,
        held_out=3 * series,
        warnings=(),
    )


@pytest.mark.parametrize("ending", ["tif", "mrc", "h5"])
def test_written_and_read(volume, tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    write_volume(path, volume)
    values, voxel, unit = read_volume(path)
    np.testing.assert_array_equal(values, volume.values)
    assert (voxel, unit) == (pytest.approx(2500), "Å") if ending == "mrc" else (pytest.approx(0.25), "µm")
    with pytest.raises(OutputError, match="exists already"):
        write_volume(path, volume)
    write_volume(path, volume, overwrite=True)


def test_ome_tiff(volume, tmp_path):
    write_volume(tmp_path / "a.tif", volume)
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.is_ome
        assert file.series[0].axes == "ZYX"
        np.testing.assert_array_equal(file.asarray(), volume.values)
        pixels = ElementTree.fromstring(file.ome_metadata).find(".//{*}Pixels")
    for axis in "XYZ":
        assert float(pixels.get(f"PhysicalSize{axis}")) == 0.25
        assert pixels.get(f"PhysicalSize{axis}Unit") == "µm"


def test_mrc(volume, tmp_path, capsys):
    write_volume(tmp_path / "a.mrc", volume)
    assert mrcfile.validate(tmp_path / "a.mrc")
    with mrcfile.open(tmp_path / "a.mrc") as mrc:
        assert mrc.is_volume()
        # the first voxel lies three voxels before the object's centre
        assert float(mrc.header.origin.x) == pytest.approx(-7500)
        assert "per um" in str(mrc.get_labels())
    write_mrc(tmp_path / "b.mrc", volume.values, 2.0, "pixel")
    with mrcfile.open(tmp_path / "b.mrc") as mrc:
        assert float(mrc.voxel_size.x) == 2
        assert "pixel, not in angstroms" in str(mrc.get_labels())


def test_hdf5(volume, tmp_path):
    write_volume(tmp_path / "a.h5", volume, provenance={"program": "trap-motion"})
    with h5py.File(tmp_path / "a.h5") as file:
        data = file[file.attrs["default"]]
        data = data[data.attrs["default"]]
        assert data.attrs["NX_class"] == "NXdata"
        assert data[data.attrs["signal"]].attrs["units"] == "1/µm"
        assert list(data.attrs["axes"]) == ["x3", "x2", "x1"]
        np.testing.assert_allclose(data["x1"], 0.25 * (np.arange(6) - 3))
        assert file["volume/shell_correlation/resolution_0.5"][()] == volume.resolution.half
        assert file["volume/process/program"].asstr()[()] == "trap-motion"


def test_stack_of_frames(tmp_path):
    frames = np.random.default_rng(0).random((5, 8, 8), np.float32)
    write_mrc_stack(tmp_path / "a.mrcs", [frames[:3], frames[3:]], frames.shape, 0.1, "µm")
    assert mrcfile.validate(tmp_path / "a.mrcs")
    with mrcfile.open(tmp_path / "a.mrcs") as mrc:
        assert mrc.is_image_stack()
        np.testing.assert_array_equal(mrc.data, frames)
    assert stack_shape(tmp_path / "a.mrcs", "µm") == (5, 8, 8, pytest.approx(0.1))
    (tmp_path / "b.mrcs").write_bytes(b"no stack")
    for name in ("b.mrcs", "c.mrcs"):
        with pytest.raises(InputError, match=name):
            stack_shape(tmp_path / name, "µm")


def test_beside_the_motion(volume, make_motion, tmp_path):
    """The result stays what it was, with a group more; a second volume takes the place of the first."""
    motion = make_motion(30)
    path = tmp_path / "result.h5"
    motion.save(path)
    for name in ("first.tif", "second.tif"):
        record(path, volume, tmp_path / name)
    np.testing.assert_array_equal(Motion.load(path).R, motion.R)
    assert Motion.load(path).provenance == motion.provenance
    with h5py.File(path) as file:
        group = file["motion/reconstruction"]
        assert group.attrs["volume"].endswith("second.tif")
        np.testing.assert_array_equal(group["held_out"], volume.held_out)
        np.testing.assert_array_equal(group["time"], motion.time)
        assert group["coverage/share"][()] == volume.coverage.share
    assert [entry.name for entry in tmp_path.iterdir()] == ["result.h5"]


def test_names_and_files_that_are_no_volumes(volume, tmp_path):
    with pytest.raises(ConfigError, match=r"a\.nii: no known kind of volume"):
        write_volume(tmp_path / "a.nii", volume)
    for ending in ("tif", "mrc", "h5"):
        with pytest.raises(InputError, match="no such file"):
            read_volume(tmp_path / f"a.{ending}")
        (tmp_path / f"a.{ending}").write_bytes(b"nothing of the kind" * 100)
        with pytest.raises(InputError, match=rf"a\.{ending}"):
            read_volume(tmp_path / f"a.{ending}")
