from __future__ import annotations

import os

import pytest
from click.testing import CliRunner

from trapcli.cli.estimate import command


def test_threads_are_set_before_the_libraries_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    CliRunner().invoke(command, ["no-such-file.tif", "--threads", "3"], standalone_mode=False)
    assert os.environ["OMP_NUM_THREADS"] == "3"
    CliRunner().invoke(command, ["no-such-file.tif"], standalone_mode=False)
    assert os.environ["OMP_NUM_THREADS"] == "3"
