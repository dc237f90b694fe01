"""How many threads work, and the same work in several of them."""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")

_ARENA_MAX = -8  # parameter of glibc's mallopt

_mine = threading.local()


def processors() -> int:
    """Return how many threads to use: ``OMP_NUM_THREADS``, or what this process may, shared by threads."""
    if share := getattr(_mine, "share", 0):
        return int(share)
    try:
        return max(1, int(os.environ["OMP_NUM_THREADS"]))
    except (KeyError, ValueError):
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_parallel(function: Callable[..., T], *arguments: Iterable[Any]) -> list[T]:
    """Return what ``map`` does, from as many threads as may be used; for work that frees the interpreter."""
    items, threads = list(zip(*arguments, strict=False)), processors()
    if threads == 1:
        return [function(*item) for item in items]
    share = max(1, threads // max(1, len(items)))

    def work(item: tuple[Any, ...]) -> T:
        _mine.share = share
        return function(*item)

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))


def share_memory() -> None:
    """Let the threads of this process share what they have freed.

    By default glibc keeps it for each of them, which adds up to hundreds of megabytes.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # other libraries have none, and no need of it
        if mallopt is not None:
            mallopt(_ARENA_MAX, 1)
