"""How many threads work, and what they share."""

from __future__ import annotations

import platform
import subprocess
import sys
import threading

import pytest

from trapcli.threads import in_parallel, processors

ARENAS = """
import ctypes, threading
from trapcli.threads import share_memory
{share}
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
libc.fdopen.restype = ctypes.c_void_p
together = threading.Barrier(4)
def allocate():
    together.wait()
    taken = libc.malloc(1000)
    together.wait()
    libc.free(taken)
threads = [threading.Thread(target=allocate) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
out = ctypes.c_void_p(libc.fdopen(1, b"w"))
libc.malloc_info(0, out)
libc.fflush(out)
"""


def test_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert processors() == 3
    monkeypatch.setenv("OMP_NUM_THREADS", "many")
    assert processors() >= 1


@pytest.mark.parametrize("count", [1, 2])
def test_work_is_shared_and_keeps_its_order(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", str(count))
    meeting = threading.Barrier(count)

    def work(a: int, b: int) -> int:
        meeting.wait(timeout=10)
        return a - b

    before = set(threading.enumerate())
    assert in_parallel(work, [5, 7], [1, 2]) == [4, 5]
    assert set(threading.enumerate()) <= before


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps memory for each thread")
def test_threads_share_what_they_free() -> None:
    def arenas(share: str) -> int:
        done = subprocess.run(
            [sys.executable, "-c", ARENAS.format(share=share)], capture_output=True, text=True, check=True
        )
        return done.stdout.count("<heap nr=")

    assert arenas("") > 1
    assert arenas("share_memory()") == 1
