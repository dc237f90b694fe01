"""Work on many inputs at once, each in a process of its own.

A pool that shares its processes among inputs would lose all of them to one that crashes a library.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_processes(
    work: Callable[[Item], Result], items: Sequence[Item], count: int
) -> Generator[Result | None]:
    """Yield ``work(item)`` for every item, in order, `count` at a time; None where the process died.

    Closing the iterator, as Ctrl-C does, ends the processes; `work` meets that as a `KeyboardInterrupt`.

    Parameters
    ----------
    work:
        A function of a module, which the processes import; it raises nothing else.
    count:
        Processes at a time.
    """
    if os.name == "posix":
        resource_tracker.ensure_running()  # starting it later would let interrupts through again
    processes = _Processes(threads_each=max(1, (os.cpu_count() or 1) // count))
    with ThreadPoolExecutor(count, initializer=_block_interrupts) as executor:
        try:
            yield from executor.map(processes.run, [work] * len(items), items)
        finally:
            processes.stop()
            executor.shutdown(cancel_futures=True)


def _block_interrupts() -> None:
    """Keep Ctrl-C from a thread and the processes it starts: the main thread ends them."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


class _Processes:
    """The processes that run at the moment."""

    def __init__(self, threads_each: int) -> None:
        self._threads_each = threads_each
        self._running: set[SpawnProcess] = set()
        self._stopped = False
        self._lock = threading.Lock()
        # a fork would copy locks that threads of libraries hold
        self._context = multiprocessing.get_context("spawn")

    def run(self, work: Callable[[Item], Result], item: Item) -> Result | None:
        receiver, sender = self._context.Pipe(duplex=False)
        process = self._context.Process(
            target=_serve, args=(work, item, sender, self._threads_each), daemon=True
        )
        with self._lock:
            if self._stopped:
                return None
            process.start()
            self._running.add(process)
        sender.close()
        result: Result | None = None
        try:
            result = receiver.recv()
        except EOFError:
            pass
        finally:
            process.join()
            receiver.close()
            with self._lock:
                self._running.discard(process)
        return result

    def stop(self) -> None:
        with self._lock:
            self._stopped = True
            for process in self._running:
                process.terminate()


def _serve(work: Callable[[Item], Result], item: Item, sender: Connection, threads: int) -> None:
    def interrupt(_signal: int, _frame: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough
        raise KeyboardInterrupt

    try:
        signal.signal(signal.SIGTERM, interrupt)
        # read when the numerical libraries are loaded, by `work`
        os.environ.setdefault("OMP_NUM_THREADS", str(threads))
        sender.send(work(item))
    except (KeyboardInterrupt, BrokenPipeError):
        pass
