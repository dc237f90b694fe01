"""Stacks that are written while processes are killed, disks fill up and others want the same name."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from trapcli.stack import open_stack

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals and limits of POSIX")

PREPARE = """
import os, random, resource, signal, sys, time
import numpy as np
from trapcli.errors import TrapError
from trapcli.stack import open_stack
from trapcli.stack.tiff import write_tiff
from trapcli.stack.video import write_avi

path, codec = sys.argv[1], sys.argv[2]
frames = np.random.default_rng(0).integers(0, 255, (30, 64, 64)).astype(np.uint8)

def write(overwrite=True):
    if codec == "tiff":
        write_tiff(path, [frames], shape=frames.shape, dtype=frames.dtype, overwrite=overwrite)
    else:
        write_avi(path, [frames], shape=frames.shape, codec=codec, fps=50.0, overwrite=overwrite)
"""
KINDS = {"tiff": "a.tif", "raw": "a.avi", "mjpeg": "a.avi"}


def run(script: str, path: Path, kind: str, *, check: bool = True) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", PREPARE + script, str(path), kind]
    return subprocess.run(command, capture_output=True, text=True, check=check)


@pytest.mark.parametrize("kills", [10, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
def test_a_kill_leaves_the_old_stack_or_the_new_one(tmp_path: Path, kind: str, kills: int) -> None:
    path = tmp_path / KINDS[kind]
    script = f"""
write()
for kill in range({kills}):
    child = os.fork()
    if child == 0:
        while True:
            write()
    time.sleep(random.uniform(0, 0.02))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    assert open_stack(path).to_array().shape == frames.shape
write()
"""
    run(script, path, kind)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("limit", [0, 3000, 100_000])
@pytest.mark.parametrize("kind", KINDS)
def test_a_full_disk_leaves_the_old_file(tmp_path: Path, kind: str, limit: int) -> None:
    path = tmp_path / KINDS[kind]
    path.write_text("precious")
    script = f"""
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
try:
    write()
except TrapError as error:
    sys.stderr.write(str(error))
    sys.exit(error.exit_code)
"""
    done = run(script, path, kind, check=False)
    assert done.returncode == 5, done.stderr
    assert done.stderr.startswith(f"{path}: can't be written")
    assert "\n" not in done.stderr
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("kind", ["tiff", "raw"])
def test_of_two_processes_with_one_output_one_wins(tmp_path: Path, kind: str) -> None:
    path = tmp_path / KINDS[kind]
    script = """
children = []
for _ in range(4):
    child = os.fork()
    if child == 0:
        try:
            write(overwrite=False)
        except TrapError as error:
            os._exit(error.exit_code)
        os._exit(0)
    children.append(child)
codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
assert sorted(codes) == [0, 5, 5, 5], codes
"""
    run(script, path, kind)
    assert list(tmp_path.iterdir()) == [path]
    assert open_stack(str(path)).shape == (30, 64, 64)
