"""Videos: lossless codecs give back every bit, lossy ones say so, short ones are never taken for whole."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from trapcli.config import InputConfig
from trapcli.errors import ConfigError, InputError, OutputError
from trapcli.stack import open_stack
from trapcli.stack.video import write_avi

Frames = np.ndarray[Any, np.dtype[Any]]


def noise(shape: tuple[int, int, int], bits: int = 8) -> Frames:
    return np.random.default_rng(0).integers(0, 1 << bits, shape).astype(f"uint{bits}")


def smooth(count: int = 12, height: int = 48, width: int = 64) -> Frames:
    t, y, x = np.indices((count, height, width))
    return (128 + 60 * np.sin(x / 9 + t / 3) * np.cos(y / 7)).astype(np.uint8)


def write(path: Path, frames: Frames, codec: Any = "raw", fps: float = 50.0, **options: Any) -> None:
    bits = 8 * frames.itemsize
    write_avi(path, [frames[:1], frames[1:]], shape=frames.shape, codec=codec, fps=fps, bits=bits, **options)


@pytest.mark.parametrize(("codec", "bits"), [("raw", 8), ("ffv1", 8), ("ffv1", 16)])
@pytest.mark.parametrize("shape", [(5, 16, 16), (3, 48, 34), (1, 6, 2)])
def test_lossless_videos_come_back(
    tmp_path: Path, codec: str, bits: int, shape: tuple[int, int, int]
) -> None:
    frames = noise(shape, bits)
    write(tmp_path / "video.avi", frames, codec)
    path = tmp_path / "video %03d.dat"  # neither the ending nor the pattern says anything
    (tmp_path / "video.avi").rename(path)
    stack = open_stack(str(path))
    assert stack.dtype == frames.dtype
    assert not stack.info.lossy
    np.testing.assert_array_equal(stack.to_array(), frames)
    np.testing.assert_array_equal(np.concatenate(list(stack.blocks(2))), frames)


def test_raw_frames_of_odd_size(tmp_path: Path) -> None:
    for shape in ((4, 7, 5), (3, 1, 1), (2, 49, 51)):
        frames = noise(shape)
        write(tmp_path / "odd.avi", frames, overwrite=True)
        np.testing.assert_array_equal(open_stack(str(tmp_path / "odd.avi")).to_array(), frames)


def test_selection(tmp_path: Path) -> None:
    frames = noise((12, 20, 24))
    path = tmp_path / "video.avi"
    write(path, frames)
    stack = open_stack(str(path), InputConfig(frames="-8::3", roi=(2, 9, 4, 20)))
    np.testing.assert_array_equal(stack.to_array(), frames[-8::3, 2:9, 4:20])
    assert stack.index.tolist() == [4, 7, 10]


@pytest.mark.parametrize("fps", [1e-3, 0.01234567, 25.0, 29.97, 1000 / 3, 123456.789, 1e6])
@pytest.mark.parametrize("codec", ["raw", "ffv1", "mjpeg"])
def test_any_frame_rate_survives(tmp_path: Path, fps: float, codec: str) -> None:
    path = tmp_path / "video.avi"
    write(path, noise((3, 8, 8)), codec, fps)
    info = open_stack(str(path)).info
    assert info.frame_interval == pytest.approx(1 / fps, rel=1e-9)
    assert any("frame interval is that of playing it" in warning for warning in info.warnings)
    info = open_stack(str(path), InputConfig(frame_interval=0.5)).info
    assert info.frame_interval == 0.5
    assert not any("playing" in warning for warning in info.warnings)


def test_lossy_videos_say_so(tmp_path: Path) -> None:
    frames = smooth()
    errors = []
    for quality in (30, 95):
        write(tmp_path / "video.avi", frames, "mjpeg", quality=quality, overwrite=True)
        stack = open_stack(str(tmp_path / "video.avi"))
        assert stack.info.lossy
        assert any("changed the pixel values" in warning for warning in stack.info.warnings)
        errors.append(np.abs(stack.to_array().astype(int) - frames).max())
    assert errors[1] <= 3 < errors[0] < 40


def test_what_no_avi_can_hold(tmp_path: Path) -> None:
    path = tmp_path / "video.avi"
    for codec, shape, bits, fps in (
        ("raw", (2, 8, 8), 16, 10.0),
        ("mjpeg", (2, 8, 8), 16, 10.0),
        ("ffv1", (2, 8, 7), 8, 10.0),
        ("raw", (2, 8, 8), 8, 0.0),
        ("raw", (2, 8, 8), 8, 1e7),
    ):
        with pytest.raises(ConfigError, match="TIFF"):
            write(path, noise(shape, bits), codec, fps)
    with pytest.raises(ConfigError, match=r"\.avi"):
        write(tmp_path / "video.dat", noise((2, 8, 8)), "ffv1")
    with pytest.raises(ValueError, match="in a stack of"):
        write_avi(path, [noise((2, 8, 8))], shape=(3, 8, 8), codec="raw", fps=1.0)
    assert list(tmp_path.iterdir()) == []
    path.touch()
    with pytest.raises(OutputError, match="--overwrite"):
        write(path, noise((2, 8, 8)))


def encode(path: Path, frames: Frames, fourcc: str) -> None:
    """Write colour frames, or grey ones as colours, as other programs do."""
    colours = frames if frames.ndim == 4 else np.stack([frames] * 3, axis=-1)
    size = (colours.shape[2], colours.shape[1])
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*fourcc), 20.0, size)
    assert writer.isOpened()
    for frame in colours:
        writer.write(frame)
    writer.release()


@pytest.mark.parametrize(
    ("fourcc", "ending"), [("mp4v", "mp4"), ("mp4v", "mov"), ("MJPG", "avi"), ("FFV1", "mkv")]
)
def test_grey_scenes_in_colour_videos(tmp_path: Path, fourcc: str, ending: str) -> None:
    frames = smooth()
    path = tmp_path / f"video.{ending}"
    encode(path, frames, fourcc)
    stack = open_stack(str(path))
    assert stack.shape == frames.shape
    assert stack.info.frame_interval == pytest.approx(0.05)
    assert stack.info.lossy == (fourcc != "FFV1")
    assert np.abs(stack.to_array().astype(int) - frames).max() <= (12 if stack.info.lossy else 0)


def test_colours_are_red_green_blue(tmp_path: Path) -> None:
    bgr = np.stack([smooth(), smooth() // 2, smooth() // 3], axis=-1)
    path = tmp_path / "video.avi"
    encode(path, bgr, "FFV1")
    with pytest.raises(InputError, match="3 channels differ; choose one with --channel 0 to 2"):
        open_stack(str(path))
    for channel in range(3):
        stack = open_stack(str(path), InputConfig(channel=channel))
        np.testing.assert_array_equal(stack.to_array(), bgr[..., 2 - channel])


@pytest.mark.parametrize(("codec", "bits"), [("raw", 8), ("ffv1", 16), ("mjpeg", 8)])
def test_more_frames_declared_than_delivered(tmp_path: Path, codec: str, bits: int) -> None:
    path = tmp_path / "video.avi"
    frames = noise((12, 16, 16), bits)
    write(path, frames, codec)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, data.index(b"strh") + 8 + 32, 20)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"declares 20 frames.*frame 12 can't be read"):
        open_stack(str(path)).to_array()
    stack = open_stack(str(path), InputConfig(allow_partial=True))
    assert stack.shape == (12, 16, 16)
    assert any("12 frames can be read" in warning for warning in stack.info.warnings)


def test_an_absurd_number_of_frames(tmp_path: Path) -> None:
    path = tmp_path / "video.avi"
    write(path, noise((3, 8, 8)))
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, data.index(b"strh") + 8 + 32, 0xF0000000)
    path.write_bytes(data)
    with pytest.raises(InputError, match="declares"):
        open_stack(str(path))


def test_a_recording_that_was_never_finished(tmp_path: Path) -> None:
    path = tmp_path / "video.avi"
    write(path, noise((5, 8, 8)))
    whole = path.read_bytes()
    for place in (4, whole.index(b"strh") + 8 + 32):
        data = bytearray(whole)
        struct.pack_into("<I", data, place, 0)
        path.write_bytes(data)
        with pytest.raises(InputError, match="never finished"):
            open_stack(str(path))


@pytest.mark.parametrize("ending", ["mp4", "mkv"])
def test_truncated_containers(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"video.{ending}"
    encode(path, smooth(), "mp4v" if ending == "mp4" else "FFV1")
    whole = path.read_bytes()
    for percent in range(0, 100, 5):
        path.write_bytes(whole[: len(whole) * percent // 100])
        with pytest.raises(InputError):
            open_stack(str(path)).to_array()


def test_a_codec_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "video.avi"
    write(path, noise((3, 8, 8)))
    path.write_bytes(path.read_bytes().replace(b"Y800", b"Q9Z7"))
    with pytest.raises(InputError, match="codec"):
        open_stack(str(path))


def test_nothing_is_said_on_stderr(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "video.avi"
    write(path, smooth(), "mjpeg")
    data = bytearray(path.read_bytes())
    data[3000:9000:50] = bytes(len(range(3000, 9000, 50)))
    path.write_bytes(data)
    stack = open_stack(str(path), InputConfig(allow_partial=True))
    assert len(stack.to_array()) <= 12
    assert capfd.readouterr() == ("", "")
