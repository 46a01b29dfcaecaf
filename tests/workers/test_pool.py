"""The bookkeeping of batches, on a pool whose workers do as a test asks."""

from collections.abc import Callable, Iterable
from concurrent.futures import Future
from typing import Any

import pytest

from slatprep.workers.pool import Pool, run_in_pools


class StoppedPool(Pool):
    """A pool whose user presses Ctrl-C while a call is handed over: the worker has it already."""

    killed = OSError

    def __init__(self) -> None:
        self.handed_over: list[Callable[[], Any]] = []
        self.abandoned = 0

    def room(self) -> int:
        return 2

    def submit(self, call: Callable[[], Any]) -> Future[Any]:
        self.handed_over.append(call)
        raise KeyboardInterrupt

    def abandon(self, calls: Iterable[Future[Any]]) -> None:
        assert not list(calls)
        self.abandoned += 1


def test_stopped_while_a_call_is_handed_over():
    """Its future was never returned, so the pool is abandoned although nothing is known of."""
    pool = StoppedPool()
    with pytest.raises(KeyboardInterrupt):
        list(run_in_pools(pool, pool, abs, [(-1,)], None))
    assert len(pool.handed_over) == 1
    assert pool.abandoned == 1


class QuickPool(StoppedPool):
    """A pool that has done a call by the time it is handed over."""

    def submit(self, call: Callable[[], Any]) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(call())
        return done


def test_pool_that_ends_is_not_abandoned():
    """Its workers stay for whoever comes next."""
    pool = QuickPool()
    assert list(run_in_pools(pool, pool, abs, [(-1,), (2,)], None)) == [1, 2]
    assert pool.abandoned == 0
