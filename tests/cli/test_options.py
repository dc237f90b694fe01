"""Shared options: which value wins, what is refused, what the terminal sees."""

from __future__ import annotations

import io
import json
import subprocess
import sys

import pytest

from trapcli.cli.options import Console, print_json, print_text, refuse_input, resolve_config
from trapcli.config import EstimateConfig, to_toml
from trapcli.errors import ConfigError, OutputError


def test_option_beats_file_beats_default(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text('[motion]\nmethod = "paper"\nwindow = 9\n')
    config = resolve_config(EstimateConfig, file, {"motion": {"window": 11, "method": None}})
    assert (config.motion.method, config.motion.window, config.motion.knots) == ("paper", 11, 0)


def test_configuration_of_a_result_is_used_again(make_motion, tmp_path):
    config = resolve_config(EstimateConfig, None, {"motion": {"window": 7}, "input": {"frames": "3:"}})
    make_motion(provenance={"configuration": to_toml(config)}).save(tmp_path / "a.h5")
    assert resolve_config(EstimateConfig, tmp_path / "a.h5", {}) == config


def test_error_names_the_file(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text("[motion]\nwidnow = 9\n")
    with pytest.raises(ConfigError, match=r"a\.toml.*widnow.*window"):
        resolve_config(EstimateConfig, file, {})


def test_error_names_the_option():
    with pytest.raises(ConfigError, match=r"options.*window"):
        resolve_config(EstimateConfig, None, {"motion": {"window": "nine"}})


def test_quiet_and_verbose(capsys):
    for verbosity in (-1, 0, 1):
        console = Console(verbosity)
        console.warn("two\nlines")
        console.detail("more")
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == ["trap-motion: warning: two lines"] * 2 + ["trap-motion: more"]


def test_no_progress_bar_without_a_terminal():
    with Console().progress() as progress:
        assert progress is None


def test_json_is_strict(capsys):
    print_json({"a": float("nan"), "b": [1.5, float("inf")], "name": "\udcff"})
    out = capsys.readouterr().out
    assert out.isascii()
    assert json.loads(out, parse_constant=pytest.fail) == {"a": None, "b": [1.5, None], "name": "\udcff"}


def test_text_that_stdout_cannot_show(monkeypatch, capsys):
    stdout = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stdout)
    print_text("12 µm")
    stdout.flush()
    assert stdout.buffer.getvalue() == b"12 ?m\n"


def test_output_that_is_an_input(tmp_path):
    path = tmp_path / "a"
    path.touch()
    (tmp_path / "link").symlink_to(path)
    refuse_input(tmp_path / "new", path)
    with pytest.raises(OutputError, match="link: is an input"):
        refuse_input(tmp_path / "link", path)


def test_commands_load_without_numpy():
    """``--help`` must answer at once."""
    names = ("compare", "export", "plot", "reconstruct", "align", "options")
    imports = "; ".join(f"import trapcli.cli.{name}" for name in names)
    subprocess.run(
        [sys.executable, "-c", f"{imports}; import sys; assert 'numpy' not in sys.modules"], check=True
    )
