"""Tasks given to a pool of workers in batches; a killed worker's tasks run again, alone."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from functools import partial
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from slatprep.errors import SlatprepError

Result = TypeVar("Result")
Task = tuple[Any, ...]
"""Positional arguments of one call."""

LARGEST_BATCH = 1000
"""Most tasks in a batch, however short they are."""

_BATCH_SECONDS = 0.2
"""Seconds per batch: a call's hand-over takes 1 ms, 2 % of an asset; progress looks steady."""

_POLL_SECONDS = 1.0


class Pool(ABC):
    """Workers that take calls, as a `concurrent.futures.Executor` does."""

    killed: type[BaseException]
    """Errors of a call whose worker was killed."""

    @abstractmethod
    def room(self) -> int:
        """Return how many calls may be under way, including waiting ones."""

    @abstractmethod
    def submit(self, call: Callable[[], Any]) -> Future[Any]:
        """Have a worker make a call."""

    @abstractmethod
    def abandon(self, calls: Iterable[Future[Any]]) -> None:
        """Drop the given calls, which are all that are under way."""

    def batch_seconds(self) -> float:
        """Return how long a batch should take [s]; 0 for one task a batch."""
        return _BATCH_SECONDS

    def check(self) -> None:  # noqa: B027 -- nothing to ask where lost calls raise by themselves
        """Raise if no answer can come any more; asked every second without an answer."""


def run_in_pools(
    pool: Pool,
    alone: Pool,
    function: Callable[..., Result],
    tasks: Iterable[Task],
    died: Callable[..., Result] | None,
) -> Iterator[Result]:
    """Run tasks as `slatprep.workers.local.run_unordered` does, those of killed workers in `alone`.

    A killed worker takes down, or makes suspect, all calls that waited beside it. All of them run
    again at the end, one at a time.
    """
    suspects: list[Task] = []
    yield from _attempt(pool, function, tasks, suspects)
    for suspect in suspects:
        killers: list[Task] = []
        yield from _attempt(alone, function, [suspect], killers)
        for killer in killers:
            if died is None:
                raise SlatprepError(
                    "a worker process was killed twice at the same task, probably because memory "
                    "ran out; nothing was replaced. Run again with fewer jobs or more memory"
                )
            yield died(*killer)


def _attempt(
    pool: Pool, function: Callable[..., Result], tasks: Iterable[Task], suspects: list[Task]
) -> Iterator[Result]:
    """Yield results as they come; add the tasks of a killed worker to `suspects`."""
    source = iter(tasks)
    given_back: deque[Task] = deque()
    under_way: dict[Future[Any], list[Task]] = {}
    finished: SimpleQueue[Future[Any]] = SimpleQueue()
    results: list[Result] = []
    size = 1
    try:
        while True:
            seconds = pool.batch_seconds()
            while len(under_way) < pool.room():
                batch = [given_back.popleft() for _ in range(min(size, len(given_back)))]
                batch.extend(islice(source, size - len(batch)))
                if not batch:
                    break
                future = pool.submit(partial(_do_batch, function, batch, seconds))
                under_way[future] = batch
                future.add_done_callback(finished.put)
            yield from results  # workers have their next batches while the caller is busy
            if not under_way:
                return
            future = _next(finished, pool)
            batch = under_way.pop(future)
            try:
                results, spent = future.result()
            except pool.killed:
                results = []
                suspects.extend(batch)
            else:
                given_back.extend(batch[len(results) :])
                in_time = len(results) * seconds / max(spent, 1e-9)
                size = int(min(max(in_time, 1), LARGEST_BATCH))
    except GeneratorExit:
        # With nothing under way the caller has taken all results, by `next` or in a `zip`.
        if under_way:
            pool.abandon(under_way)
        raise
    except BaseException:
        # Even with no known call under way: a signal may have come while a call was
        # handed over, and its worker would write on beside what the caller cleans up.
        pool.abandon(under_way)
        raise


def _next(finished: SimpleQueue[Future[Any]], pool: Pool) -> Future[Any]:
    while True:
        try:
            return finished.get(timeout=_POLL_SECONDS)
        except Empty:
            pool.check()


def _do_batch(
    function: Callable[..., Result], tasks: list[Task], seconds: float
) -> tuple[list[Result], float]:
    """Return the results of the first task and of those that follow in time, and the time taken.

    The rest is handed out again, so that no task waits long behind a slow one. A task that raises
    is handed out again, too, unless it is the first. Its error then arrives after the results of
    those before it.
    """
    begin = time.perf_counter()
    results: list[Result] = []
    for task in tasks:
        try:
            results.append(function(*task))
        except Exception:
            if not results:
                raise
            break
        if time.perf_counter() - begin >= seconds:
            break
    return results, time.perf_counter() - begin
