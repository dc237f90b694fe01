"""``trap-motion plot``: where the figure goes, what it needs, what it refuses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from trapcli.cli.main import run
from trapcli.config import EstimateConfig, InputConfig, to_toml
from trapcli.report import figures
from trapcli.result.motion import Landscape, Motion
from trapcli.stack.tiff import write_tiff


@pytest.fixture
def path(make_motion, tmp_path):
    """A result of rows 4 … 24 and columns 0 … 30 of a stack."""
    configuration = to_toml(EstimateConfig(input=InputConfig(frames="10:", roi=(4, 24, 0, 30))))
    motion = make_motion(20, provenance={"configuration": configuration})
    landscape = Landscape(np.linspace(0, 3, 9), np.array([11]), np.ones((1, 9)))
    motion = dataclasses.replace(motion, frame=motion.frame + 10, landscape=landscape)
    motion.save(tmp_path / "result.h5")
    return tmp_path / "result.h5"


@pytest.fixture
def stack(tmp_path):
    """40 frames of 32 × 32 pixels, each with its number as value."""
    frames = np.broadcast_to(np.arange(40, dtype=np.uint16)[:, None, None], (40, 32, 32))
    write_tiff(
        tmp_path / "a.tif", [frames], shape=frames.shape, dtype=frames.dtype, pixel_size=0.5, pixel_unit="µm"
    )
    return tmp_path / "a.tif"


@pytest.fixture
def drawn(monkeypatch):
    """What was asked to be drawn."""
    calls = []
    draw = figures.draw
    monkeypatch.setattr(
        figures, "draw", lambda *args, **kwargs: calls.append(kwargs) or draw(*args, **kwargs)
    )
    return calls


def call(*arguments):
    with pytest.raises(SystemExit) as end:
        run([str(argument) for argument in arguments])
    return end.value.code


def test_default_name_is_beside_the_result(path, capsys):
    assert call("plot", path) == 0
    out, err = capsys.readouterr()
    assert out == f"{path.with_suffix('.png')}\n"
    assert err == ""
    assert path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_existing_figure_is_kept(path, capsys):
    figure = path.with_suffix(".png")
    figure.write_text("precious")
    assert call("plot", path) == 5
    assert "--overwrite" in capsys.readouterr().err
    assert figure.read_text() == "precious"
    assert call("plot", path, "--overwrite") == 0
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_pdf(path, tmp_path):
    assert call("plot", path, "-o", tmp_path / "a.PDF") == 0
    assert (tmp_path / "a.PDF").read_bytes().startswith(b"%PDF")


def test_truth_and_stack(path, stack, make_motion, tmp_path, drawn):
    make_motion(60, truth=True).save(tmp_path / "truth.h5")
    assert call("plot", path, "--truth", tmp_path / "truth.h5", "--stack", stack) == 0
    assert drawn[0]["truth"].truth
    shown = drawn[0]["projections"]
    assert [projection.frame for projection in shown] == [10, 16, 23, 29]
    for projection in shown:
        assert projection.image.shape == (20, 30)
        assert (projection.image == projection.frame).all()
        assert projection.pixel_size == 0.5


def test_chosen_frames(path, stack, drawn, capsys):
    assert call("plot", path, "--stack", stack, "--time-step", 12, "--time-step", 20) == 0
    assert [projection.frame for projection in drawn[0]["projections"]] == [12, 20]
    assert "Phi is not stored for these frames, but for 11" in capsys.readouterr().err


def test_frame_that_the_stack_lacks(path, stack, capsys, tmp_path):
    assert call("plot", path, "--stack", stack, "--time-step", 99) == 3
    err = capsys.readouterr().err
    assert "frame 99" in err
    assert "a.tif" in err
    assert not (tmp_path / "result.png").exists()


@pytest.mark.parametrize("name", ["a.jpg", "a", "a.h5"])
def test_unknown_kind_of_figure(path, tmp_path, capsys, name):
    assert call("plot", path, "-o", tmp_path / name) == 2
    assert ".png, .pdf, .svg" in capsys.readouterr().err


def test_never_onto_an_input(path, tmp_path):
    renamed = tmp_path / "result.png"
    path.rename(renamed)
    assert call("plot", renamed, "--overwrite") == 5
    assert len(Motion.load(renamed)) == 20


def test_wrong_truth_names_both_files(path, make_motion, tmp_path, capsys):
    make_motion(frame=np.arange(40) + 500).save(tmp_path / "truth.h5")
    assert call("plot", path, "--truth", tmp_path / "truth.h5") == 3
    err = capsys.readouterr().err
    assert "result.h5" in err
    assert "truth.h5" in err
