from __future__ import annotations

import threading

import pytest

from trapcli.threads import in_parallel, processors


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_work_in_parallel_keeps_its_order(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", str(threads))
    assert processors() == threads
    assert in_parallel(pow, iter([2, 3, 4]), [5, 6, 7]) == [32, 729, 16384]
    assert in_parallel(str, []) == []
    assert processors() == threads


def test_threads_share_the_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    both = threading.Barrier(2, timeout=60)

    def work(inner: int) -> list[int]:
        both.wait()  # at the same time
        return [processors(), *in_parallel(lambda _: processors(), range(inner))]

    assert in_parallel(work, [1, 2]) == [[2, 2], [2, 1, 1]]
    assert processors() == 5
