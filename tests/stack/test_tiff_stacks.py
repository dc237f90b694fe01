"""TIFF: what is written comes back, whoever wrote it, and what is not there is never made up."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from trapcli.config import InputConfig
from trapcli.errors import ConfigError, InputError, OutputError
from trapcli.stack import open_stack
from trapcli.stack.tiff import write_tiff


def noise(shape: tuple[int, ...], dtype: str, seed: int = 0) -> np.ndarray[Any, np.dtype[Any]]:
    values = np.random.default_rng(seed).random(shape)
    kind = np.dtype(dtype)
    if kind.kind == "f":
        return (200 * values - 100).astype(kind)
    if kind.kind == "b":
        return values > 0.5
    limits = np.iinfo(kind)
    return (limits.min + values * (float(limits.max) - limits.min)).astype(kind)


def test_written_stacks_come_back(tmp_path: Path) -> None:
    for dtype in ("float64", "float32", "uint16", "uint8", "int16", "uint32"):
        for unit in ("µm", "um", "wavelength", "pixel size of the sensor", None):
            frames = noise((5, 7, 4), dtype)
            path = tmp_path / "stack.tif"
            write_tiff(
                path,
                [frames[:2], frames[2:]],
                shape=frames.shape,
                dtype=dtype,
                frame_interval=0.0123,
                pixel_size=0.0321,
                pixel_unit=unit,
                overwrite=True,
            )
            stack = open_stack(str(path))
            assert stack.dtype == dtype
            np.testing.assert_array_equal(stack.to_array(), frames)
            assert stack.info.frame_interval == 0.0123
            assert stack.info.pixel_size == pytest.approx(0.0321, rel=1e-8)
            assert stack.info.pixel_unit == unit
            assert stack.info.warnings == ()


@pytest.mark.parametrize("size", [1e-7, 1e-3, 7.0, 1e5])
@pytest.mark.parametrize("dtype", ["uint16", "float64"])
def test_pixel_sizes_of_any_magnitude_survive(tmp_path: Path, size: float, dtype: str) -> None:
    path = tmp_path / "stack.tif"
    write_tiff(
        path, [np.zeros((1, 2, 2), dtype)], shape=(1, 2, 2), dtype=dtype, pixel_size=size, pixel_unit="m"
    )
    info = open_stack(str(path)).info
    assert info.pixel_size == pytest.approx(size, rel=1e-6)
    assert info.pixel_unit == "m"


@pytest.mark.parametrize("dtype", ["uint8", "float64"])
def test_no_calibration_is_invented(tmp_path: Path, dtype: str) -> None:
    path = tmp_path / "stack.tif"
    write_tiff(path, [np.zeros((3, 2, 2), dtype)], shape=(3, 2, 2), dtype=dtype)
    info = open_stack(str(path)).info
    assert (info.frame_interval, info.pixel_size, info.pixel_unit) == (None, None, None)


def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    for dtype in ("uint16", "float64"):
        frames = noise((3, 4, 5), dtype)
        for name in ("a.tif", "b.tif"):
            write_tiff(tmp_path / name, [frames], shape=frames.shape, dtype=dtype, overwrite=True)
        assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()


def test_writing_insists_on_the_declared_frames(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    for blocks in ([], [np.zeros((2, 4, 4), "u1")], [np.zeros((4, 4, 4), "u1")], [np.zeros((3, 4, 4), "u2")]):
        with pytest.raises(ValueError, match="in a stack of"):
            write_tiff(path, blocks, shape=(3, 4, 4), dtype="u1")
    assert list(tmp_path.iterdir()) == []
    path.write_text("precious")
    with pytest.raises(OutputError, match="--overwrite"):
        write_tiff(path, [np.zeros((1, 1, 1), "u1")], shape=(1, 1, 1), dtype="u1")
    assert path.read_text() == "precious"


STORAGE = {
    "plain": {"metadata": None},
    "shaped": {},
    "imagej": {"imagej": True, "metadata": {"axes": "TYX"}},
    "ome": {"ome": True, "metadata": {"axes": "TYX"}},
    "bigtiff": {"bigtiff": True},
    "big-endian": {"byteorder": ">"},
    "big-endian BigTIFF": {"byteorder": ">", "bigtiff": True, "metadata": None},
    "lzw": {"compression": "lzw"},
    "deflate with predictor": {"compression": "zlib", "predictor": True, "metadata": None},
    "zstd": {"compression": "zstd", "ome": True, "metadata": {"axes": "TYX"}},
    "big-endian lzw": {"compression": "lzw", "byteorder": ">", "predictor": True},
    "strips": {"rowsperstrip": 5, "metadata": None},
    "tiles": {"tile": (16, 32), "metadata": None},
    "compressed tiles": {"tile": (16, 16), "compression": "zlib"},
}


@pytest.mark.parametrize("storage", STORAGE)
@pytest.mark.parametrize("dtype", ["uint16", "float32"])
def test_every_storage_is_read(tmp_path: Path, storage: str, dtype: str) -> None:
    frames = noise((9, 37, 41), dtype)
    path = tmp_path / "stack.dat"  # the ending says nothing
    tifffile.imwrite(path, frames, photometric="minisblack", **STORAGE[storage])
    stack = open_stack(str(path))
    assert stack.shape == frames.shape
    assert stack.dtype == frames.dtype
    assert stack.dtype.isnative
    np.testing.assert_array_equal(stack.to_array(), frames)
    np.testing.assert_array_equal(np.concatenate(list(stack.blocks(2))), frames)
    some = open_stack(str(path), InputConfig(frames="1:-1:3", roi=(3, 30, 5, 40)))
    np.testing.assert_array_equal(some.to_array(), frames[1:-1:3, 3:30, 5:40])
    assert some.index.tolist() == [1, 4, 7]


@pytest.mark.parametrize(
    "dtype",
    [
        "bool",
        "uint8",
        "int8",
        "uint16",
        "int16",
        "uint32",
        "int32",
        "uint64",
        "float16",
        "float32",
        "float64",
    ],
)
def test_every_type_of_number_is_read(tmp_path: Path, dtype: str) -> None:
    frames = noise((3, 5, 9), dtype)
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, frames, photometric="minisblack", metadata=None)
    stack = open_stack(str(path))
    assert stack.dtype == dtype
    np.testing.assert_array_equal(stack.to_array(), frames)


def test_not_a_number_and_infinity_pass(tmp_path: Path) -> None:
    frames = np.array([[[np.nan, np.inf], [-np.inf, -0.0]]] * 2, np.float32)
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, frames, photometric="minisblack")
    np.testing.assert_array_equal(open_stack(str(path)).to_array(), frames)


def test_twelve_packed_bits(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 4096, (3, 8, 10)).astype("uint16")
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, frames, photometric="minisblack", bitspersample=12, metadata=None)
    stack = open_stack(str(path))
    np.testing.assert_array_equal(stack.to_array(), frames)
    assert stack.info.bits == 12


def test_complex_numbers_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, np.zeros((2, 4, 4), np.complex64), photometric="minisblack", metadata=None)
    with pytest.raises(InputError, match="complex64"):
        open_stack(str(path))


@pytest.mark.parametrize("shape", [(1, 5, 7), (2, 5, 7), (4, 1, 9)])
@pytest.mark.parametrize("storage", ["plain", "shaped", "imagej", "ome", "lzw"])
def test_small_stacks(tmp_path: Path, shape: tuple[int, int, int], storage: str) -> None:
    frames = noise(shape, "uint16")
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, frames, photometric="minisblack", **STORAGE[storage])
    np.testing.assert_array_equal(open_stack(str(path)).to_array(), frames)


@pytest.mark.parametrize("shape", [(4, 1, 1), (4, 9, 1), (1, 1, 1), (1, 4, 3), (3, 9, 4), (3, 4, 9)])
@pytest.mark.parametrize("dtype", ["uint8", "float64"])
def test_shapes_that_could_be_colours(tmp_path: Path, shape: tuple[int, int, int], dtype: str) -> None:
    frames = noise(shape, dtype)
    path = tmp_path / "stack.tif"
    write_tiff(path, [frames], shape=shape, dtype=dtype)
    np.testing.assert_array_equal(open_stack(str(path)).to_array(), frames)


def test_passes_may_interleave(tmp_path: Path) -> None:
    frames = noise((6, 4, 5), "uint16")
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, frames, photometric="minisblack")
    stack = open_stack(str(path))
    for one, other in zip(stack.blocks(2), stack.blocks(2), strict=True):
        np.testing.assert_array_equal(one, other)
        assert not np.shares_memory(one, other)


# the axes


def write_imagej(path: Path, frames: np.ndarray[Any, Any], axes: str, **metadata: Any) -> None:
    tifffile.imwrite(path, frames, imagej=True, photometric="minisblack", metadata={"axes": axes, **metadata})


def test_slices_are_times_where_there_is_one_time(tmp_path: Path) -> None:
    frames = noise((6, 4, 5), "uint8")
    path = tmp_path / "stack.tif"
    write_imagej(path, frames, "ZYX")
    stack = open_stack(str(path))
    np.testing.assert_array_equal(stack.to_array(), frames)
    assert stack.info.warnings == ("its slices are taken as times",)


@pytest.mark.parametrize("ome", [False, True])
def test_times_and_slices_are_ambiguous(tmp_path: Path, ome: bool) -> None:
    frames = noise((3, 4, 5, 6), "uint8")
    path = tmp_path / "stack.tif"
    kind = {"ome": True} if ome else {"imagej": True}
    tifffile.imwrite(path, frames, photometric="minisblack", metadata={"axes": "TZYX"}, **kind)
    for config in (InputConfig(), InputConfig(time_axis="T"), InputConfig(time_axis="z")):
        with pytest.raises(InputError, match=r"3 times, 4 slices.*--time-axis TZ"):
            open_stack(str(path), config)
    stack = open_stack(str(path), InputConfig(time_axis="TZ"))
    np.testing.assert_array_equal(stack.to_array(), frames.reshape(12, 5, 6))
    with pytest.raises(ConfigError, match="no such axis"):
        open_stack(str(path), InputConfig(time_axis="P"))


@pytest.mark.parametrize("axes", ["TC", "CT"])
def test_channels_are_chosen(tmp_path: Path, axes: str) -> None:
    frames = noise((3, 2, 5, 6), "uint8")
    path = tmp_path / "stack.tif"
    metadata = {"axes": f"{axes}YX"}
    tifffile.imwrite(path, frames, ome=True, photometric="minisblack", metadata=metadata)
    channel_first = np.moveaxis(frames, axes.index("C"), 0)
    with pytest.raises(InputError, match=f"{len(channel_first)} channels differ.*--channel 0 to"):
        open_stack(str(path))
    for channel, expected in enumerate(channel_first):
        stack = open_stack(str(path), InputConfig(channel=channel))
        np.testing.assert_array_equal(stack.to_array(), expected)
    with pytest.raises(InputError, match="no channel 3"):
        open_stack(str(path), InputConfig(channel=3))


def test_channels_alone_could_be_times(tmp_path: Path) -> None:
    frames = noise((4, 5, 6), "uint8")
    path = tmp_path / "stack.tif"
    write_imagej(path, frames, "CYX")
    with pytest.raises(InputError, match=r"--channel.*--time-axis C"):
        open_stack(str(path))
    np.testing.assert_array_equal(open_stack(str(path), InputConfig(time_axis="C")).to_array(), frames)
    np.testing.assert_array_equal(open_stack(str(path), InputConfig(channel=2)).to_array(), frames[2:3])


def test_axes_without_names_are_ambiguous(tmp_path: Path) -> None:
    frames = noise((2, 3, 5, 6), "uint8")
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, frames, photometric="minisblack")
    with pytest.raises(InputError, match=r"2 pages, 3 pages.*--time-axis QQ"):
        open_stack(str(path))
    stack = open_stack(str(path), InputConfig(time_axis="QQ"))
    np.testing.assert_array_equal(stack.to_array(), frames.reshape(6, 5, 6))


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("samples", [3, 4])
def test_colours(tmp_path: Path, planar: str, samples: int) -> None:
    grey = noise((3, 20, 24), "uint8")
    colours = np.stack([grey] * 3 + [255 - grey] * (samples - 3), axis=-1)
    path = tmp_path / "stack.tif"

    def write(values: np.ndarray[Any, Any]) -> None:
        stored = values if planar == "contig" else np.moveaxis(values, -1, 1)
        extra = {"extrasamples": ["unassalpha"]} if samples == 4 else {}
        tifffile.imwrite(path, stored, photometric="rgb", planarconfig=planar, metadata=None, **extra)

    write(colours)
    np.testing.assert_array_equal(open_stack(str(path)).to_array(), grey)
    colours[1, 2, 3, 2] ^= 1
    write(colours)
    stack = open_stack(str(path))  # the first frame is grey still
    with pytest.raises(InputError, match="3 channels differ; choose one with --channel 0 to 2"):
        stack.to_array()
    for channel in range(3):
        stack = open_stack(str(path), InputConfig(channel=channel))
        np.testing.assert_array_equal(stack.to_array(), colours[..., channel])


# the calibration


def test_imagej_calibration(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(
        path,
        np.zeros((3, 4, 5), "uint8"),
        imagej=True,
        resolution=(5.0, 5.0),
        metadata={"axes": "TYX", "finterval": 20.0, "tunit": "ms", "unit": "micron"},
    )
    info = open_stack(str(path)).info
    assert info.frame_interval == pytest.approx(0.020)
    assert (info.pixel_size, info.pixel_unit) == (pytest.approx(0.2), "µm")
    own = InputConfig(frame_interval=0.5, pixel_size=3.0, pixel_unit="nm")
    info = open_stack(str(path), own).info
    assert (info.frame_interval, info.pixel_size, info.pixel_unit) == (0.5, 3.0, "nm")


@pytest.mark.parametrize(
    "metadata", [{}, {"unit": "pixel"}, {"unit": "inch"}, {"finterval": 0.0}, {"finterval": "nan"}]
)
def test_resolution_for_printing_is_no_calibration(tmp_path: Path, metadata: dict[str, Any]) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(
        path,
        np.zeros((3, 4, 5), "uint8"),
        imagej=True,
        resolution=(72.0, 72.0),
        resolutionunit="inch",
        metadata={"axes": "TYX", **metadata},
    )
    info = open_stack(str(path)).info
    assert (info.frame_interval, info.pixel_size, info.pixel_unit) == (None, None, None)


def test_oblong_pixels_and_unknown_time_units_are_not_used(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(
        path,
        np.zeros((3, 4, 5), "uint8"),
        imagej=True,
        resolution=(5.0, 4.0),
        metadata={"axes": "TYX", "unit": "um", "finterval": 2.0, "tunit": "fortnight"},
    )
    info = open_stack(str(path)).info
    assert (info.frame_interval, info.pixel_size, info.pixel_unit) == (None, None, None)
    assert any("fortnight" in warning for warning in info.warnings)
    assert any("aren't square" in warning for warning in info.warnings)


def test_ome_calibration(tmp_path: Path) -> None:
    path = tmp_path / "stack.ome.tif"
    metadata: dict[str, Any] = {
        "axes": "TYX",
        "TimeIncrement": 4.0,
        "TimeIncrementUnit": "ms",
        "PhysicalSizeX": 65.0,
        "PhysicalSizeXUnit": "nm",
        "PhysicalSizeY": 65.0,
        "PhysicalSizeYUnit": "nm",
        "SignificantBits": 12,
    }
    tifffile.imwrite(path, np.zeros((3, 4, 5), "uint16"), ome=True, metadata=metadata)
    info = open_stack(str(path)).info
    assert (info.frame_interval, info.pixel_size, info.pixel_unit, info.bits) == (0.004, 65.0, "nm", 12)
    del metadata["TimeIncrement"], metadata["PhysicalSizeXUnit"]
    metadata["Plane"] = {"DeltaT": [0.0, 0.25, 0.75], "DeltaTUnit": ["s"] * 3}
    tifffile.imwrite(path, np.zeros((3, 4, 5), "uint16"), ome=True, metadata=metadata)
    info = open_stack(str(path)).info
    assert info.frame_interval == pytest.approx(0.375)
    assert info.pixel_unit == "µm"  # the default of the OME schema
    assert any("uneven" in warning for warning in info.warnings)


# the selection


def test_frames_are_python_slices(tmp_path: Path) -> None:
    frames = noise((10, 3, 4), "uint8")
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, frames, photometric="minisblack")
    for text in ("0:10", ":", "::", "3:", ":-3", "-4:-1", "::4", "2:100", "-100:2", " 1 : 9 : 2 "):
        parts = [int(part) if part.strip() else None for part in text.split(":")]
        stack = open_stack(str(path), InputConfig(frames=text))
        assert stack.index.tolist() == list(range(10))[slice(*parts)]
        np.testing.assert_array_equal(stack.to_array(), frames[stack.index])
    for text in ("5", "a:b", "1:2:3:4", "1.0:2", "::0", "::-1", "9" * 5000 + ":", "٣:٥", "--1:"):
        with pytest.raises(ConfigError, match="--frames"):
            open_stack(str(path), InputConfig(frames=text))
    for text in ("5:5", "8:2", "10:", "100:200"):
        with pytest.raises(InputError, match="selects none of its 10 frames"):
            open_stack(str(path), InputConfig(frames=text))


@pytest.mark.parametrize("roi", [(0, 4, 0), (2, 2, 0, 4), (0, 3, 4, 1), (-1, 2, 0, 4), (1, 2, 3, 4, 5)])
def test_regions_that_make_no_sense(tmp_path: Path, roi: tuple[int, ...]) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, np.zeros((2, 3, 4), "uint8"), photometric="minisblack")
    with pytest.raises(ConfigError, match="--roi"):
        open_stack(str(path), InputConfig(roi=roi))


def test_a_region_must_lie_in_the_frame(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, np.zeros((2, 3, 4), "uint8"), photometric="minisblack")
    with pytest.raises(InputError, match="3 rows and 4 columns"):
        open_stack(str(path), InputConfig(roi=(0, 4, 0, 4)))


@pytest.mark.parametrize("option", ["frame_interval", "pixel_size"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_calibration_must_be_positive(tmp_path: Path, option: str, value: float) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, np.zeros((2, 3, 4), "uint8"), photometric="minisblack")
    with pytest.raises(ConfigError, match="positive"):
        open_stack(str(path), InputConfig(**{option: value}))


# files that lie


def pages(path: Path, *frames: np.ndarray[Any, Any], **storage: Any) -> None:
    with tifffile.TiffWriter(path) as writer:
        for frame in frames:
            writer.write(frame, photometric="minisblack", metadata=None, contiguous=False, **storage)


@pytest.mark.parametrize(
    "odd", [np.zeros((5, 8), "u1"), np.zeros((6, 9), "u1"), np.zeros((6, 8), "u2"), np.zeros((6, 8), "i1")]
)
@pytest.mark.parametrize("place", [1, 4, 7])
def test_pages_that_change(tmp_path: Path, odd: np.ndarray[Any, Any], place: int) -> None:
    path = tmp_path / "stack.tif"
    frames: list[np.ndarray[Any, Any]] = [np.zeros((6, 8), "u1")] * 8
    frames[place] = odd
    pages(path, *frames)
    with pytest.raises(InputError, match="size"):
        open_stack(str(path))


def test_a_description_that_declares_too_much(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    for compression in (None, "lzw"):
        write_imagej(path, np.ones((5, 8, 9), "u1"), "TYX")
        if compression:
            frames = np.ones((5, 8, 9), "u1")
            tifffile.imwrite(
                path, frames, photometric="minisblack", compression="lzw", metadata=None,
                description="ImageJ=1.54f\nimages=5\nframes=5\n",
            )  # fmt: skip
        data = path.read_bytes()
        assert data.count(b"=5\n") == 2
        path.write_bytes(data.replace(b"=5\n", b"=9\n"))
        with pytest.raises(InputError, match=r"truncated|damaged"):
            open_stack(str(path))
        stack = open_stack(str(path), InputConfig(allow_partial=True))
        assert stack.shape == (5, 8, 9)
        assert any("5 of 9 frames" in warning for warning in stack.info.warnings)


def test_an_ome_description_that_declares_too_much(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, np.ones((5, 8, 9), "u1"), ome=True, metadata={"axes": "TYX"})
    data = path.read_bytes()
    data = data.replace(b'SizeT="5"', b'SizeT="9"').replace(b'PlaneCount="5"', b'PlaneCount="9"')
    path.write_bytes(data)
    with pytest.raises(InputError, match="declares 9 frames and has 5"):
        open_stack(str(path))


def test_a_looped_directory(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    pages(path, *[np.zeros((6, 8), "u1")] * 50)
    with tifffile.TiffFile(path) as tiff:
        offsets = [page.offset for page in tiff.pages]
        tags = len(tiff.pages[9].tags)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, offsets[9] + 2 + 12 * tags, offsets[4])
    path.write_bytes(data)
    with pytest.raises(InputError, match="loops"):
        open_stack(str(path))
    stack = open_stack(str(path), InputConfig(allow_partial=True))
    assert len(stack) == 10


def test_a_small_file_that_declares_terabytes(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    for storage in ({"rowsperstrip": 32}, {"tile": (32, 32)}, {"tile": (32, 32), "compression": "zlib"}):
        pages(path, np.zeros((32, 32), "u1"), **storage)
        with tifffile.TiffFile(path) as tiff:
            tags = [tag for tag in tiff.pages.first.tags if tag.code in (256, 257, 278, 322, 323)]
        data = bytearray(path.read_bytes())
        for tag in tags:
            struct.pack_into("<HI", data, tag.offset + 2, 4, 1)
            struct.pack_into("<I", data, tag.offset + 8, 2_000_000)
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"declares frames of 3.73e\+03 GiB"):
            open_stack(str(path))


def test_a_header_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    for header in (b"II*\0\0\0\0\0", b"II+\0\x08\0\0\0" + bytes(8), b"MM\0*\0\0\0\0"):
        path.write_bytes(header)
        with pytest.raises(InputError, match="no image"):
            open_stack(str(path))


def test_pages_without_pixels(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    pages(path, *[np.zeros((6, 8), "u1")] * 3, compression="lzw")
    with tifffile.TiffFile(path) as tiff:
        where = tiff.pages[1].tags[279].valueoffset
    data = bytearray(path.read_bytes())
    data[where : where + 2] = b"\0\0"
    path.write_bytes(data)
    with pytest.raises(InputError, match="page 1 has no pixels"):
        open_stack(str(path))


def test_surplus_pages_are_named(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    write_imagej(path, np.ones((5, 8, 9), "u1"), "TYX")
    path.write_bytes(path.read_bytes().replace(b"=5\n", b"=4\n"))
    stack = open_stack(str(path))
    assert len(stack) == 4
    assert any("1 pages more" in warning for warning in stack.info.warnings)


def test_lossy_compression_is_named(tmp_path: Path) -> None:
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, noise((2, 32, 32), "uint8"), photometric="minisblack", compression="jpeg")
    info = open_stack(str(path)).info
    assert info.lossy
    assert info.warnings == ("its compression has changed the pixel values",)


@pytest.mark.slow
def test_an_imagej_stack_beyond_four_gigabytes_in_bounded_memory(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    path = tmp_path / "stack.tif"
    shape = (2100, 1024, 1024)
    with tifffile.TiffWriter(path, imagej=True) as writer:
        # one directory for all frames, as ImageJ writes them; the zeros take no space on disk
        writer.write(
            None,
            shape=shape,
            dtype="uint16",
            truncate=True,
            photometric="minisblack",
            metadata={"axes": "TYX"},
        )
        start = writer.filehandle.tell()
    with tifffile.TiffFile(path) as tiff:
        assert len(tiff.pages) == 1
        start = tiff.pages.first.dataoffsets[0]
    with path.open("r+b") as file:
        file.truncate(start + 2 * shape[0] * shape[1] * shape[2])
        for frame in range(shape[0]):
            file.seek(start + 2 * frame * shape[1] * shape[2])
            file.write(struct.pack("<H", frame))
    assert path.stat().st_size > 1 << 32
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    stack = open_stack(str(path))
    assert stack.shape == shape
    seen = np.concatenate([block[:, 0, 0].copy() for block in stack.blocks()])
    np.testing.assert_array_equal(seen, np.arange(shape[0]))
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert grown < 200, f"{grown} MiB"


@pytest.mark.slow
def test_forty_gigabytes_in_bounded_memory(tmp_path: Path) -> None:
    """An ImageJ stack, sparse on disk, read as a whole by a process of its own."""
    if not Path("/proc/self/status").exists():
        pytest.skip("peak memory is read from /proc")
    path = tmp_path / "stack.tif"
    count, side = 20_000, 1024
    with tifffile.TiffWriter(path, imagej=True) as writer:
        writer.write(
            None, shape=(count, side, side), dtype="uint16", truncate=True, photometric="minisblack",
            metadata={"axes": "TYX"},
        )  # fmt: skip
    with tifffile.TiffFile(path) as tiff:
        start = tiff.pages.first.dataoffsets[0]
    with path.open("r+b") as file:
        file.truncate(start + 2 * count * side**2)
        file.seek(-2, os.SEEK_END)
        file.write(struct.pack("<H", 7))
    assert path.stat().st_size > 40e9
    program = (
        "import sys\n"
        "from trapcli.stack import open_stack\n"
        "stack = open_stack(sys.argv[1])\n"
        "count = 0\n"
        "for block in stack.blocks():\n"
        "    count += len(block)\n"
        "print(stack.shape[0], count, block[-1, -1, -1])\n"
        # not ru_maxrss, in which a process inherits the peak of the one that started it
        "print(next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')))\n"
    )
    done = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True, check=True)
    counts, memory = done.stdout.splitlines()
    assert counts == f"{count} {count} 7"
    assert int(memory) / 1024 < 600


@pytest.mark.slow
def test_writing_a_bigtiff(tmp_path: Path) -> None:
    block = np.zeros((50, 1024, 1024), np.float32)
    path = tmp_path / "stack.tif"
    write_tiff(
        path, (block for _ in range(20)), shape=(1000, 1024, 1024), dtype="f4", frame_interval=0.1,
        pixel_size=2.0, pixel_unit="nm",
    )  # fmt: skip
    stack = open_stack(str(path))
    assert stack.shape == (1000, 1024, 1024)
    assert "BigTIFF" in stack.info.format
    assert (stack.info.frame_interval, stack.info.pixel_size, stack.info.pixel_unit) == (0.1, 2.0, "nm")
