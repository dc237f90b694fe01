"""Datasets in HDF5: read where they are whole and in the file itself, refused elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from trapcli.config import InputConfig
from trapcli.errors import InputError
from trapcli.stack import open_stack

FRAMES = np.random.default_rng(0).integers(0, 4096, (12, 20, 24)).astype("uint16")


def write(path: Path, frames: Any = FRAMES, name: str = "entry/data", **storage: Any) -> str:
    with h5py.File(path, "a") as file:
        file.create_dataset(name, data=frames, **storage)
    return str(path)


@pytest.mark.parametrize(
    "storage",
    [
        {},
        {"chunks": (1, 20, 24)},
        {"chunks": (5, 7, 24), "compression": "gzip", "shuffle": True},
        {"chunks": (12, 20, 24), "fletcher32": True},
        {"chunks": (4, 20, 24), "maxshape": (None, 20, 24)},
    ],
)
def test_storage(tmp_path: Path, storage: dict[str, Any]) -> None:
    text = write(tmp_path / "stack.dat", **storage)
    for stack in (open_stack(text), open_stack(f"{text}::/entry/data"), open_stack(f"{text}::entry/data")):
        assert stack.shape == FRAMES.shape
        np.testing.assert_array_equal(stack.to_array(), FRAMES)
        np.testing.assert_array_equal(np.concatenate(list(stack.blocks(5))), FRAMES)
    some = open_stack(text, InputConfig(frames="1::5", roi=(1, 5, 2, 9), dataset="/entry/data"))
    np.testing.assert_array_equal(some.to_array(), FRAMES[1::5, 1:5, 2:9])


@pytest.mark.parametrize("dtype", [">u2", "<f8", "i1", "bool", ">f4"])
def test_types(tmp_path: Path, dtype: str) -> None:
    frames = FRAMES.astype(dtype)
    stack = open_stack(write(tmp_path / "stack.h5", frames))
    assert stack.dtype == np.dtype(dtype).newbyteorder("=")
    assert stack.dtype.isnative
    np.testing.assert_array_equal(stack.to_array(), frames)


def test_shapes(tmp_path: Path) -> None:
    grey = np.stack([FRAMES] * 3, axis=-1)
    for number, (values, expected) in enumerate(
        [(FRAMES[None], FRAMES), (FRAMES[0], FRAMES[:1]), (grey, FRAMES), (grey[:1], FRAMES[:1])]
    ):
        text = write(tmp_path / f"{number}.h5", values)
        np.testing.assert_array_equal(open_stack(f"{text}::entry/data").to_array(), expected)
    colours = grey.copy()
    colours[0, 0, 0, 1] += 1
    text = write(tmp_path / "colours.h5", colours)
    with pytest.raises(InputError, match="--channel"):
        open_stack(text)
    np.testing.assert_array_equal(open_stack(text, InputConfig(channel=1)).to_array(), colours[..., 1])
    for number, values in enumerate((FRAMES[0, 0], np.zeros((2, 3, 4, 5), "u1"), np.zeros((0, 3, 4), "u1"))):
        text = write(tmp_path / f"odd{number}.h5", values)
        with pytest.raises(InputError):
            open_stack(f"{text}::entry/data")


def test_one_of_several_is_named(tmp_path: Path) -> None:
    path = tmp_path / "stack.h5"
    write(path, name="a/frames")
    text = write(path, FRAMES + 1, name="b/frames")
    with pytest.raises(InputError, match=r"/a/frames, /b/frames.*stack\.h5::/PATH"):
        open_stack(text)
    np.testing.assert_array_equal(open_stack(f"{text}::/b/frames").to_array(), FRAMES + 1)
    for place in ("/c", "/a", "/a/frames/x", "/../a"):
        with pytest.raises(InputError, match="dataset"):
            open_stack(f"{text}::{place}")
    with h5py.File(tmp_path / "empty.h5", "w") as file:
        file["text"] = "nothing"
    with pytest.raises(InputError, match="holds no stack"):
        open_stack(str(tmp_path / "empty.h5"))


def test_a_result_is_no_stack(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "result.h5", "w") as file:
        file.attrs["format"] = "trap-motion"
        file["motion/rotation/R"] = np.zeros((5, 3, 3))
    with pytest.raises(InputError, match="is a result of trap-motion"):
        open_stack(str(tmp_path / "result.h5"))


def test_numbers_that_are_none(tmp_path: Path) -> None:
    for number, values in enumerate((FRAMES.astype(complex), np.zeros((2, 3, 4), "S3"))):
        text = write(tmp_path / f"{number}.h5", values)
        with pytest.raises(InputError):
            open_stack(f"{text}::entry/data")


def test_pixels_outside_the_file_are_refused(tmp_path: Path) -> None:
    secret = tmp_path / "secret.bin"
    secret.write_bytes(bytes(FRAMES.nbytes))
    write(tmp_path / "other.h5")
    with h5py.File(tmp_path / "stack.h5", "w") as file:
        file.create_dataset("external", FRAMES.shape, "u2", external=[(str(secret), 0, FRAMES.nbytes)])
        layout = h5py.VirtualLayout(FRAMES.shape, "u2")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "entry/data", FRAMES.shape)
        file.create_virtual_dataset("virtual", layout)
        file["link"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/entry/data")
        file["detour"] = h5py.SoftLink("/link")
        file["here"] = FRAMES
        file["soft"] = h5py.SoftLink("here")
        file["group/up"] = h5py.SoftLink("/soft")
        file["loop"] = h5py.SoftLink("/loop")
    text = str(tmp_path / "stack.h5")
    for place in ("external", "virtual", "link", "detour"):
        with pytest.raises(InputError, match=r"(is|are)n't followed"):
            open_stack(f"{text}::{place}")
    with pytest.raises(InputError, match="don't end"):
        open_stack(f"{text}::loop")
    for place in ("soft", "group/up"):
        np.testing.assert_array_equal(open_stack(f"{text}::{place}").to_array(), FRAMES)


def test_pixels_that_were_never_written(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "stack.h5", "w") as file:
        file.create_dataset("contiguous", FRAMES.shape, "u2")
        part = file.create_dataset("chunked", FRAMES.shape, "u2", chunks=(1, 20, 24))
        part[:7] = FRAMES[:7]
        file.create_dataset("terabytes", (1 << 20, 1 << 10, 1 << 10), "f8")
        file.create_dataset("giant chunk", (1, 30000, 30000), "f4", chunks=(1, 30000, 30000))
    for place in ("contiguous", "chunked", "terabytes", "giant chunk"):
        with pytest.raises(InputError, match="declares"):
            open_stack(f"{tmp_path / 'stack.h5'}::{place}")


def test_truncated_files(tmp_path: Path) -> None:
    for storage in ({}, {"chunks": (2, 20, 24), "compression": "gzip"}):
        path = tmp_path / "whole.h5"
        path.unlink(missing_ok=True)
        whole = Path(write(path, **storage)).read_bytes()
        for percent in range(0, 100, 5):
            (tmp_path / "cut.h5").write_bytes(whole[: len(whole) * percent // 100])
            with pytest.raises(InputError):
                open_stack(str(tmp_path / "cut.h5")).to_array()


def test_zarr_says_what_to_install_or_is_read(tmp_path: Path) -> None:
    store = tmp_path / "stack.zarr"
    store.mkdir()
    (store / ".zarray").write_text("{}")
    try:
        import zarr
    except ImportError:
        with pytest.raises(InputError, match="pip install zarr"):
            open_stack(str(store))
        return
    array = zarr.create_array(store=str(store), data=FRAMES, chunks=(5, 20, 24), overwrite=True)
    assert array.shape == FRAMES.shape
    np.testing.assert_array_equal(open_stack(str(store)).to_array(), FRAMES)
