"""Reading ahead in a thread of its own, while what was read is worked on."""

from __future__ import annotations

import queue
import threading
from collections.abc import Generator, Iterable
from typing import TypeVar

T = TypeVar("T")

_LOOK = 0.1  # time after which a reader that can't get rid of an item looks whether it is still wanted [s]


def read_ahead(items: Iterable[T], count: int = 2) -> Generator[T]:
    """Yield `items`, of which up to `count` are made ahead in another thread.

    Whatever making them raises is raised here. Closing the iterator ends the thread.
    """
    made: queue.Queue[T | _End] = queue.Queue(count)
    wanted = threading.Event()
    wanted.set()

    def put(item: T | _End) -> None:
        while wanted.is_set():
            try:
                return made.put(item, timeout=_LOOK)
            except queue.Full:
                continue

    def make() -> None:
        error = None
        try:
            for item in items:
                put(item)
                if not wanted.is_set():
                    return
        except BaseException as raised:  # handed over, whatever it is
            error = raised
        put(_End(error))

    thread = threading.Thread(target=make, daemon=True)
    thread.start()
    try:
        while not isinstance(item := made.get(), _End):
            yield item
        if item.error is not None:
            raise item.error
    finally:
        wanted.clear()
        thread.join()


class _End:
    def __init__(self, error: BaseException | None) -> None:
        self.error = error
