"""How far a run over many inputs has come."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import Any

from trapcli.cli.options import Console


class Overall:
    """One bar for all inputs; nothing without a terminal or when quiet."""

    def __init__(self, total: int, console: Console) -> None:
        self._bar: Any = None
        if total > 1 and console.verbosity >= 0 and sys.stderr is not None and sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=total, desc="stacks", file=sys.stderr, leave=False, dynamic_ncols=True)

    def advance(self) -> None:
        """Count one more input as done."""
        if self._bar is not None:
            self._bar.update()

    def stage(self, name: str, _done: int, _total: int) -> None:
        """Say what is being done at the moment; a progress callback."""
        if self._bar is not None:
            self._bar.set_postfix_str(name)

    @contextlib.contextmanager
    def aside(self) -> Iterator[None]:
        """Take the bar away while lines are printed."""
        if self._bar is None:
            yield
            return
        with self._bar.external_write_mode():
            yield

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.close()
