"""Results of work in other threads, in order."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from tapetum.futures import in_order


def test_results_come_in_order_and_so_many_are_under_way():
    asked: list[int] = []
    with ThreadPoolExecutor(3) as pool:

        def submitted():
            for number in range(6):
                asked.append(number)
                yield pool.submit(lambda number=number: number**2)

        found = in_order(submitted(), 3)
        assert asked == []
        assert next(found) == 0
        assert asked == [0, 1, 2]
        assert list(found) == [1, 4, 9, 16, 25]


def test_an_error_comes_at_its_turn_and_cancels_what_waits():
    go, done = threading.Event(), []
    with ThreadPoolExecutor(1) as pool:

        def work(number: int) -> int:
            go.wait(10)
            done.append(number)
            return 1 // (1 - number)

        found = in_order((pool.submit(work, number) for number in range(9)), 4)
        go.set()
        assert next(found) == 1
        with pytest.raises(ZeroDivisionError):
            next(found)
        with pytest.raises(StopIteration):
            next(found)
    assert len(done) < 9
