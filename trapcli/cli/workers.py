"""Work on many inputs at once, in processes of this machine or of a cluster, as one kind of executor.

A pool that shares its processes among inputs would lose all of them to one that crashes a library. Here a
process works on one input at a time, and another takes its place when it dies.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any

from trapcli.cli.options import Console
from trapcli.errors import ConfigError

_ADDRESS = re.compile(r"((tcp|tls|ws|wss)://)?[\w.\-\[\]:%]+:\d+")
_PATIENCE = 10
"""Seconds in which a scheduler must answer."""
_AGAIN = 0.01
"""Seconds after which an interrupt that was ignored comes again."""


class LostWorkerError(Exception):
    """The process that worked on an input died."""


class ProcessExecutor(Executor):
    """Processes of this machine, each working on one item at a time.

    Shutting it down, as Ctrl-C does, ends them; what they work on meets that as a `KeyboardInterrupt`.

    Parameters
    ----------
    count:
        Processes at a time.
    """

    def __init__(self, count: int) -> None:
        if os.name == "posix":
            resource_tracker.ensure_running()  # starting it later would let interrupts through again
        self._processes = _Processes(threads_each=max(1, (os.cpu_count() or 1) // count))
        self._threads = ThreadPoolExecutor(count, initializer=_block_interrupts)

    def submit(self, work: Callable[..., Any], /, *items: Any, **named: Any) -> Future[Any]:
        """Call `work`, a function of a module, which the processes import; it should raise nothing."""
        return self._threads.submit(self._processes.run, work, items, named)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = True) -> None:
        """End the processes, whatever they work on."""
        self._processes.stop()
        self._threads.shutdown(wait=wait, cancel_futures=cancel_futures)


@contextlib.contextmanager
def cluster(address: str, console: Console) -> Iterator[Executor]:
    """Give the workers of a Dask scheduler, which take over what one of them leaves undone.

    Raises
    ------
    ConfigError
        Where Dask isn't installed or no scheduler answers at `address`.
    """
    if not _ADDRESS.fullmatch(address):
        raise ConfigError(f"--scheduler {address}: is no address; give one like tcp://host:8786")
    try:
        import dask

        # what workers do is told by what becomes of the inputs; read when distributed is loaded
        names = ("distributed", "distributed.client", "tornado.application")
        quiet = dict.fromkeys(names, "critical")
        with dask.config.set({"logging": quiet}):
            from distributed import Client
    except ImportError:
        raise ConfigError("--scheduler: needs Dask; pip install 'trapcli[cluster]' brings it") from None
    try:
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise ConfigError(f"--scheduler {address}: no scheduler answers there ({first})") from None
    with client:
        if not client.scheduler_info()["workers"]:
            console.note(f"the scheduler {address} has no workers yet; waiting for them")
        yield client.get_executor(pure=False)


def _block_interrupts() -> None:
    """Keep Ctrl-C from a thread and the processes it starts: the main thread ends them."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


class _Processes:
    """A process for every thread that asks for one."""

    def __init__(self, threads_each: int) -> None:
        self._threads_each = threads_each
        self._running: dict[SpawnProcess, Connection] = {}
        self._stopped = False
        self._lock = threading.Lock()
        self._mine = threading.local()
        # a fork would copy locks that threads of libraries hold
        self._context = multiprocessing.get_context("spawn")

    def run(self, work: Callable[..., Any], items: tuple[Any, ...], named: dict[str, Any]) -> Any:
        process, connection = getattr(self._mine, "process", None) or self._start()
        try:
            connection.send((work, items, named))
            return connection.recv()
        except (EOFError, OSError):
            self._mine.process = None
            with self._lock:
                self._running.pop(process, None)
            process.join()
            connection.close()
            raise LostWorkerError("the process that worked on it died") from None

    def _start(self) -> tuple[SpawnProcess, Connection]:
        with self._lock:
            if self._stopped:
                raise LostWorkerError("the program was stopped")
            here, there = self._context.Pipe()
            process = self._context.Process(target=_serve, args=(there, self._threads_each), daemon=True)
            process.start()
            there.close()
            self._running[process] = here
        self._mine.process = process, here
        return process, here

    def stop(self) -> None:
        with self._lock:
            self._stopped = True
            for process in self._running:
                process.terminate()


def _heed_interrupts() -> None:
    """Make SIGTERM a `KeyboardInterrupt`, also where Python ignores exceptions."""

    def interrupt(_signal: int, _frame: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough
        raise KeyboardInterrupt

    def again(ignored: sys.UnraisableHookArgs) -> None:
        # in a finalizer or the callback of a weak reference the interrupt would be lost
        if ignored.exc_type is KeyboardInterrupt:
            signal.setitimer(signal.ITIMER_REAL, _AGAIN)
        else:
            sys.__unraisablehook__(ignored)

    signal.signal(signal.SIGTERM, interrupt)
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, interrupt)
        sys.unraisablehook = again


def _serve(connection: Connection, threads: int) -> None:
    try:
        _heed_interrupts()
        # read when the numerical libraries are loaded, by `work`
        os.environ.setdefault("OMP_NUM_THREADS", str(threads))
        while True:
            work, items, named = connection.recv()
            connection.send(work(*items, **named))
    except (KeyboardInterrupt, EOFError, BrokenPipeError):
        pass
