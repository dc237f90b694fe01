"""Damaged bytes anywhere: our own errors or frames, soon, and nothing else."""

from __future__ import annotations

import os
import random
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from trapcli.config import InputConfig
from trapcli.errors import TrapError
from trapcli.stack import open_stack
from trapcli.stack.video import write_avi

FRAMES = np.random.default_rng(0).integers(0, 60000, (12, 20, 24)).astype(np.uint16)
TIFFS = {
    "plain": {"metadata": None},
    "imagej": {"imagej": True, "metadata": {"axes": "TYX"}},
    "ome": {"ome": True, "metadata": {"axes": "TYX"}},
    "big": {"bigtiff": True},
    "lzw": {"compression": "lzw", "metadata": None},
    "tiles": {"tile": (16, 16), "compression": "zstd", "predictor": True},
}
VARIANTS = int(os.environ.get("FUZZ_VARIANTS", "40"))
SEED = os.environ.get("FUZZ_SEED", "")
MOST_MEMORY = 600 << 10  # KiB by which no file of kilobytes may make us grow


def write(path: Path, kind: str) -> None:
    if kind in TIFFS:
        tifffile.imwrite(path, FRAMES, photometric="minisblack", **TIFFS[kind])
    elif kind == "hdf5":
        with h5py.File(path, "w") as file:
            file.create_dataset("data", data=FRAMES, chunks=(4, 20, 24), compression="gzip")
    else:
        bits = 16 if kind == "ffv1" else 8
        frames = FRAMES if bits == 16 else (FRAMES >> 8).astype(np.uint8)
        write_avi(path, [frames], shape=frames.shape, codec=kind, fps=50.0, bits=bits)


def memory() -> int:
    """Return the most memory used so far [KiB]."""
    resource = pytest.importorskip("resource")
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


@pytest.mark.parametrize("kind", [*TIFFS, "hdf5", "raw", "ffv1", "mjpeg"])
def test_only_our_own_errors_escape(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "stack.avi"
    write(path, kind)
    whole = path.read_bytes()
    chance = random.Random(kind + SEED)
    before = memory()
    for variant in range(VARIANTS):
        data = bytearray(whole)
        near = chance.choice((len(data), 1200))  # half of the time among the first directories
        for _ in range(chance.choice((1, 1, 3, 20, 100))):
            data[chance.randrange(min(near, len(data)))] = chance.choice((0, 1, 255, chance.randrange(256)))
        path.write_bytes(data)
        started = time.perf_counter()
        try:
            stack = open_stack(str(path), InputConfig(allow_partial=bool(variant % 2)))
            delivered = sum(len(block) for block in stack.blocks())
            expected = len(stack)
        except TrapError as error:
            delivered, expected = str(path) in str(error), True
        assert delivered == expected
        assert time.perf_counter() - started < 5
    assert memory() - before < MOST_MEMORY
