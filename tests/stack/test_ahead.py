from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing

import pytest

from trapcli.stack.ahead import read_ahead


def test_all_items_come_in_order() -> None:
    assert list(read_ahead(range(50), 3)) == list(range(50))
    assert list(read_ahead([])) == []


def test_items_are_made_in_another_thread() -> None:
    makers = list(read_ahead(threading.current_thread() for _ in range(3)))
    assert threading.current_thread() not in makers


def test_what_goes_wrong_is_raised_where_the_items_are_used() -> None:
    def faulty() -> Iterator[int]:
        yield 1
        raise OSError("gone")

    items = read_ahead(faulty())
    assert next(items) == 1
    with pytest.raises(OSError, match="gone"):
        next(items)


def test_closing_ends_the_thread() -> None:
    before = threading.active_count()
    with closing(read_ahead(iter(int, 1))) as endless:
        assert next(endless) == 0
        assert threading.active_count() == before + 1
    assert threading.active_count() == before
