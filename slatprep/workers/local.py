"""One function over many tasks: on one core, several, or a cluster, one thread each."""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from slatprep.workers.pool import Pool, run_in_pools

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

    from slatprep.records import Place

Result = TypeVar("Result")

THREAD_VARIABLES = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS",
)  # fmt: skip
"""Environment variables that the numeric libraries read once, when loaded."""

_IDLE_SECONDS = 300
"""Seconds that a worker process stays without work: longer than any pause of a build."""


class Workers(Protocol):
    """Workers outside this process, such as `slatprep.workers.dask.Cluster`."""

    def run_unordered(
        self,
        function: Callable[..., Result],
        tasks: Iterable[tuple[Any, ...]],
        died: Callable[..., Result] | None = None,
    ) -> Iterator[Result]:
        """Run tasks as the function `run_unordered` does."""

    def require_shared(self, paths: Iterable[Place]) -> None:
        """Raise `SlatprepError` unless every worker sees the same files and folders as we do."""


Jobs = int | Workers
"""A number of worker processes of this machine, or other workers."""


def run_unordered(
    function: Callable[..., Result],
    tasks: Iterable[tuple[Any, ...]],
    jobs: Jobs = 1,
    died: Callable[..., Result] | None = None,
) -> Iterator[Result]:
    """Yield ``function(*task)`` for each task, in the order in which they finish.

    Tasks are taken from the iterable only as workers become free; each worker computes on one
    thread. After a worker is killed, the tasks under way run again at the end, one at a time. If a
    task kills its worker even alone, ``died(*task)`` gives its result, or else SlatprepError.
    Workers must be able to import `function`; with 1 job it runs in this process.
    """
    if not isinstance(jobs, int):
        yield from jobs.run_unordered(function, tasks, died)
    elif jobs == 1:
        for task in tasks:
            with single_threaded():
                result = function(*task)
            yield result
    else:
        yield from run_in_pools(_Processes(jobs), _Processes(1), function, tasks, died)


def start_early(function: Callable[..., Any], jobs: Jobs) -> None:
    """Start the worker processes that `run_unordered` will need, and let them import, meanwhile.

    Nothing happens where it will start no processes.
    """
    if isinstance(jobs, int) and jobs > 1:
        processes = _Processes(jobs)
        for _ in range(jobs):
            processes.submit(partial(_imported, function))


def _imported(function: Callable[..., Any]) -> None:
    """Keep the imports made for the function out of garbage collection."""
    # Without psutil loky collects garbage every second, and looks through all modules for it.
    gc.freeze()


def run_in_order(
    function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]], jobs: Jobs = 1
) -> Iterator[Result]:
    """Yield the results of `run_unordered` in the order of the tasks, which keeps sums the same."""
    numbered = ((number, function, task) for number, task in enumerate(tasks))
    early: dict[int, Result] = {}
    following = 0
    for number, result in run_unordered(_numbered, numbered, jobs):
        early[number] = result
        while following in early:
            yield early.pop(following)
            following += 1


def _numbered(
    number: int, function: Callable[..., Result], task: tuple[Any, ...]
) -> tuple[int, Result]:
    return number, function(*task)


def require_shared(jobs: Jobs, paths: Iterable[Place]) -> None:
    """Raise `SlatprepError` unless all workers see these files; local ones always do."""
    if not isinstance(jobs, int):
        jobs.require_shared(paths)


def at_most(most: int, jobs: Jobs) -> Jobs:
    """Return fewer processes where there is less work, and at least one."""
    return max(1, min(jobs, most)) if isinstance(jobs, int) else jobs


class _Processes(Pool):
    """Processes of this machine, kept for the next call."""

    def __init__(self, number: int) -> None:
        from joblib.externals.loky.process_executor import BrokenProcessPool

        self.killed = BrokenProcessPool
        self._number = number

    def room(self) -> int:
        """Return a call for each process, and one more for each to begin with next."""
        return 2 * self._number

    def submit(self, call: Callable[[], Any]) -> Future[Any]:
        """Have a process make a call; new processes replace killed ones."""
        while True:
            try:
                future: Future[Any] = self._executor().submit(call)
                return future
            except self.killed:
                continue

    def abandon(self, calls: Iterable[Future[Any]]) -> None:
        """End the processes: after an early stop they must not write any more."""
        # Loky's own thread fails on calls that it has not yet passed on to the processes.
        while not all(call.running() or call.done() for call in calls):
            time.sleep(0.001)
        self._executor().shutdown(kill_workers=True)

    def _executor(self) -> Any:
        from joblib.externals.loky import get_reusable_executor

        return get_reusable_executor(
            self._number,
            timeout=_IDLE_SECONDS,
            env=dict.fromkeys(THREAD_VARIABLES, "1"),
            initializer=_end_with,
            initargs=(os.getpid(),),
        )


def _end_with(parent: int) -> None:
    """End this worker soon after its parent, however that ends."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def single_threaded() -> Iterator[None]:
    """Hold the numeric libraries to one thread each, whether loaded before or within."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        with _thread_pools(len(sys.modules)).limit(limits=1):
            yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@lru_cache(maxsize=1)
def _thread_pools(modules: int) -> ThreadpoolController:
    """Find the loaded libraries in 1 to 4 ms; search again after further imports."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
