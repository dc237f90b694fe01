"""Volumes as OME-TIFF, MRC or HDF5, with their voxel size; what a reconstruction tells beside the motion."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import mrcfile
import numpy as np
from numpy.typing import NDArray

from trapcli.atomic import atomic_path
from trapcli.config import InputConfig
from trapcli.errors import ConfigError, InputError, OutputError
from trapcli.reconstruction.units import ANGSTROMS
from trapcli.reconstruction.volume import Reconstruction
from trapcli.report.volume_page import Judgement
from trapcli.result.motion import Motion
from trapcli.stack import open_stack
from trapcli.stack.frames import single_frames
from trapcli.stack.tiff import write_volume_tiff

ENDINGS = (".tif", ".tiff", ".mrc", ".h5")

GROUP = "motion/reconstruction"
_TEXT = h5py.string_dtype()


def check_ending(path: Path) -> None:
    """Refuse names whose ending says no format.

    Raises
    ------
    ConfigError
        For such a name.
    """
    if path.suffix.lower() not in ENDINGS:
        raise ConfigError(f"{path}: no known kind of volume; end the name in {', '.join(ENDINGS)}")


def write_volume(
    path: Path, volume: Reconstruction, *, provenance: dict[str, str] | None = None, overwrite: bool = False
) -> None:
    """Write a volume in the format that the ending of `path` names.

    Parameters
    ----------
    provenance:
        Texts by name, kept in HDF5.

    Raises
    ------
    ConfigError
        For an unknown ending.
    OutputError
        Where `path` exists (without `overwrite`) or can't be written.
    """
    check_ending(path)
    suffix = path.suffix.lower()
    if suffix == ".mrc":
        write_mrc(path, volume.values, volume.voxel_size, volume.length_unit, overwrite=overwrite)
    elif suffix == ".h5":
        image = _hdf5_image(volume, provenance or {})
        with atomic_path(path, overwrite) as temporary:
            temporary.write_bytes(image)
    else:
        write_volume_tiff(
            path, volume.values, voxel_size=volume.voxel_size, unit=volume.length_unit, overwrite=overwrite
        )


def write_mrc(
    path: Path, values: NDArray[np.float32], voxel_size: float, unit: str, *, overwrite: bool = False
) -> None:
    """Write an MRC2014 volume ``[x3, x2, x1]``, whose origin is its middle voxel.

    MRC files measure in Å. Where the unit is not known, a label says so and the size is written as it is.
    """
    edge = voxel_size * ANGSTROMS.get(unit, 1.0)
    with atomic_path(path, overwrite) as temporary, mrcfile.new(temporary, overwrite=True) as mrc:
        mrc.set_data(values)
        mrc.voxel_size = edge
        mrc.header.origin = tuple(-edge * (size // 2) for size in reversed(values.shape))
        mrc.add_label(f"trap-motion: attenuation per {_ascii(unit)}"[:80])
        if unit not in ANGSTROMS:
            mrc.add_label(f"trap-motion: lengths are in {_ascii(unit)}, not in angstroms"[:80])


def write_mrc_stack(
    path: Path,
    blocks: Iterable[NDArray[Any]],
    shape: tuple[int, int, int],
    pixel_size: float,
    unit: str,
    *,
    overwrite: bool = False,
) -> None:
    """Write an MRC image stack of float32 frames block by block."""
    with (
        atomic_path(path, overwrite) as temporary,
        mrcfile.new_mmap(temporary, shape, mrc_mode=2, overwrite=True) as mrc,
    ):
        mrc.set_image_stack()
        for at, frame in enumerate(single_frames(blocks, shape, np.dtype(np.float32))):
            mrc.data[at] = frame
        mrc.voxel_size = pixel_size * ANGSTROMS.get(unit, 1.0)
        mrc.update_header_stats()


def stack_shape(path: Path, unit: str) -> tuple[int, int, int, float]:
    """Return frames, rows, columns and pixel size [unit] of a stack that was written by `align`.

    Raises
    ------
    InputError
        Where it can't be read.
    """
    if path.suffix.lower() != ".mrcs":
        frames = open_stack(str(path))
        return *frames.shape, frames.info.pixel_size or 1.0
    if not path.is_file():
        raise InputError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    try:
        with mrcfile.mmap(path, mode="r") as mrc:
            count, height, width = mrc.data.shape
            return count, height, width, float(mrc.voxel_size.x) / ANGSTROMS.get(unit, 1.0)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable MRC stack ({error})") from None


def _ascii(text: str) -> str:
    return text.replace("µ", "u").encode("ascii", "replace").decode()


def _hdf5_image(volume: Reconstruction, provenance: dict[str, str]) -> bytes:
    unit = volume.length_unit
    with h5py.File("volume", "w", driver="core", backing_store=False, libver=("v108", "v108")) as file:
        file.attrs.update(NX_class="NXroot", default="volume")
        entry = file.create_group("volume")
        entry.attrs.update(NX_class="NXentry", default="attenuation")
        data = entry.create_group("attenuation")
        data.attrs.update(NX_class="NXdata", signal="values", axes=np.array(["x3", "x2", "x1"], dtype=_TEXT))
        values = data.create_dataset("values", data=volume.values)
        values.attrs["units"] = f"1/{unit}"
        values.attrs["voxel_size"] = volume.voxel_size
        n = len(volume.values)
        for name in ("x1", "x2", "x3"):
            axis = data.create_dataset(name, data=(np.arange(n) - n // 2) * volume.voxel_size)
            axis.attrs["units"] = unit
        _put_quality(entry, volume)
        process = entry.create_group("process")
        process.attrs["NX_class"] = "NXprocess"
        for name, text in provenance.items():
            process.create_dataset(name, data=_clean(text), dtype=_TEXT)
        file.flush()
        return bytes(file.id.get_file_image())


def record(result: Path, volume: Reconstruction, path: Path) -> None:
    """Write misfits, resolution and coverage of a volume beside the motion, in the result file itself.

    Parameters
    ----------
    path:
        Of the volume.

    Raises
    ------
    InputError, OutputError
        Where the result can't be read or replaced.
    """
    content = io.BytesIO(result.read_bytes())
    with h5py.File(content, "r+", libver=("v108", "v108")) as file:
        if GROUP in file:
            del file[GROUP]
        group = file.create_group(GROUP)
        group.attrs.update(
            NX_class="NXdata", signal="residual", axes="time", volume=_clean(str(path.resolve()))
        )
        group.attrs["auxiliary_signals"] = np.array(["misfit", "held_out"], dtype=_TEXT)
        group["time"] = file["motion/time"]
        for name in ("residual", "misfit", "held_out"):
            group.create_dataset(name, data=getattr(volume, name)).attrs["units"] = "1"
        _put_quality(group, volume)
    with atomic_path(result, overwrite=True) as temporary:
        temporary.write_bytes(content.getvalue())
        try:
            Motion.load(temporary)
        except InputError as error:
            raise OutputError(
                f"{result}: can't be read back after writing ({error}); it stays as it was"
            ) from None


def _put_quality(parent: h5py.Group, volume: Reconstruction) -> None:
    resolution, coverage, unit = volume.resolution, volume.coverage, volume.length_unit
    shells = parent.create_group("shell_correlation")
    shells.attrs.update(NX_class="NXdata", signal="correlation", axes="frequency")
    shells.create_dataset("correlation", data=resolution.correlation).attrs["units"] = "1"
    shells.create_dataset("frequency", data=resolution.frequency).attrs["units"] = f"1/{unit}"
    for name, value in (("resolution_0.5", resolution.half), ("resolution_0.143", resolution.seventh)):
        shells.create_dataset(name, data=value).attrs["units"] = unit
    sphere = parent.create_group("coverage")
    sphere.attrs["NX_class"] = "NXcollection"
    sphere.create_dataset("direction", data=coverage.direction.astype(np.float32)).attrs["units"] = "1"
    sphere.create_dataset("times_seen", data=coverage.times_seen.astype(np.int32)).attrs["units"] = "1"
    sphere.create_dataset("share", data=coverage.share).attrs["units"] = "1"
    sphere.create_dataset("missing_angle", data=coverage.missing_angle).attrs["units"] = "rad"
    sphere.create_dataset("missing_axis", data=coverage.missing_axis).attrs["units"] = "1"


def _clean(text: str) -> str:
    return text.replace("\0", "\\0").encode("utf-8", "backslashreplace").decode()


def read_judgement(result: Path, volume: Path) -> Judgement | None:
    """Read what `record` wrote beside the motion; None where that is of another volume, or nothing.

    Raises
    ------
    InputError
        Where `result` is no result.
    """
    Motion.load(result)
    with suppress(KeyError, OSError, ValueError, TypeError), h5py.File(result, "r", locking=False) as file:
        if GROUP not in file or file[GROUP].attrs.get("volume") != _clean(str(volume.resolve())):
            return None
        group = file[GROUP]
        shells, sphere = group["shell_correlation"], group["coverage"]
        return Judgement(
            shells["frequency"][()],
            shells["correlation"][()],
            sphere["direction"][()],
            sphere["times_seen"][()],
            float(sphere["share"][()]),
        )
    return None


def read_volume(path: Path) -> tuple[NDArray[Any], float, str]:
    """Read a volume that `write_volume` wrote.

    Returns
    -------
    values, voxel_size, unit:
        ``[x3, x2, x1]``, the edge of a voxel and its unit.

    Raises
    ------
    InputError
        Where the file can't be read or isn't such a volume.
    """
    check_ending(path)
    if not path.is_file():
        raise InputError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    try:
        return _READERS[path.suffix.lower()](path)
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: not a readable volume ({reason})") from None


def _read_hdf5(path: Path) -> tuple[NDArray[Any], float, str]:
    with h5py.File(path, "r", locking=False) as file:
        values = file["volume/attenuation/values"]
        return (
            values[()],
            float(values.attrs["voxel_size"]),
            str(file["volume/attenuation/x1"].attrs["units"]),
        )


def _read_mrc(path: Path) -> tuple[NDArray[Any], float, str]:
    with warnings.catch_warnings(), mrcfile.open(path) as mrc:
        warnings.simplefilter("error")
        return np.array(mrc.data), float(mrc.voxel_size.x), "Å"


def _read_tiff(path: Path) -> tuple[NDArray[Any], float, str]:
    frames = open_stack(str(path), InputConfig(time_axis="Z"))
    info = frames.info
    return frames.to_array(), info.pixel_size or 1.0, info.pixel_unit or "pixel"


_READERS = {".h5": _read_hdf5, ".mrc": _read_mrc, ".tif": _read_tiff, ".tiff": _read_tiff}
