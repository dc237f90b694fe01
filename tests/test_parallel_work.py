"""How many threads work."""

from __future__ import annotations

import threading

import pytest

from trapcli.threads import in_parallel, processors


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

    assert in_parallel(work, [5, 7], [1, 2]) == [4, 5]
    assert threading.active_count() <= 2
