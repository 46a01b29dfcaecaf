"""Run one function over many tasks, on one core, several cores or a cluster.

Each worker computes on one thread, and gets its tasks in batches. The tasks of a killed worker run
again, one at a time.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from functools import lru_cache, partial
from itertools import islice
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from slatprep.errors import ConfigError, SlatprepError

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

    from slatprep.records import Place

Result = TypeVar("Result")
Task = tuple[Any, ...]
"""Positional arguments of one call."""

THREAD_VARIABLES = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS",
)  # fmt: skip
"""Environment variables for the number of threads, which numeric libraries read when they load."""

LARGEST_BATCH = 1000
"""Largest number of tasks in a batch, however short they are."""

_BATCH_SECONDS = 0.2
"""Time per batch [s]; handing over a call takes 1 ms, 2 % of an asset, and progress is steady."""

_POLL_SECONDS = 1.0

_IDLE_SECONDS = 300
"""Time [s] after which an idle worker process ends, longer than any pause of a build."""


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
"""Number of worker processes of this machine, or other workers."""


def run_unordered(
    function: Callable[..., Result],
    tasks: Iterable[tuple[Any, ...]],
    jobs: Jobs = 1,
    died: Callable[..., Result] | None = None,
) -> Iterator[Result]:
    """Yield ``function(*task)`` for each task, in the order in which they finish.

    Tasks are taken from the iterable only as workers become free; each worker computes on one
    thread. After a worker is killed, the tasks under way run again at the end, one at a time. If a
    task then kills its worker again, ``died(*task)`` gives its result; without `died`, it is a
    SlatprepError. Workers must be able to import `function`; with 1 job it runs in this process.
    ConfigError, before any task begins, if there is no worker.
    """
    require_workers(jobs)
    if not isinstance(jobs, int):
        return jobs.run_unordered(function, tasks, died)
    if jobs == 1:
        return _run_here(function, tasks)
    return run_in_pools(_Processes(jobs), _Processes(1), function, tasks, died)


def _run_here(
    function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]]
) -> Iterator[Result]:
    for task in tasks:
        with single_threaded():
            result = function(*task)
        yield result


def require_workers(jobs: Jobs) -> None:
    """Raise `ConfigError` unless there is a worker."""
    if not hasattr(jobs, "run_unordered") and (not isinstance(jobs, int) or jobs < 1):
        raise ConfigError(f"jobs is {jobs!r}; expected an int from 1, or a cluster")


def start_early(function: Callable[..., Any], jobs: Jobs) -> None:
    """Start the processes that `run_unordered` will use, so that they import `function` early.

    Nothing happens if it will use none.
    """
    if isinstance(jobs, int) and jobs > 1:
        processes = _Processes(jobs)
        for _ in range(jobs):
            processes.submit(partial(_imported, function))


def _imported(function: Callable[..., Any]) -> None:
    """Keep the modules that the function imported out of garbage collection."""
    # Without psutil, loky collects garbage every second, which scans all modules.
    gc.freeze()


def run_in_order(
    function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]], jobs: Jobs = 1
) -> Iterator[Result]:
    """Yield the results of `run_unordered` in the order of the tasks, so that sums are the same."""
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
    require_workers(jobs)
    if not isinstance(jobs, int):
        jobs.require_shared(paths)


def at_most(most: int, jobs: Jobs) -> Jobs:
    """Limit a number of processes to `most`, but to at least one; leave other workers alone."""
    require_workers(jobs)
    return max(1, min(jobs, most)) if isinstance(jobs, int) else jobs


class Pool(ABC):
    """Workers that take calls, as a `concurrent.futures.Executor` does."""

    killed: type[BaseException]
    """Type of the error of a call whose worker was killed."""

    @abstractmethod
    def room(self) -> int:
        """Return how many calls may be under way, including waiting ones."""

    @abstractmethod
    def submit(self, call: Callable[[], Any]) -> Future[Any]:
        """Hand a call to a worker."""

    @abstractmethod
    def abandon(self, calls: Iterable[Future[Any]]) -> None:
        """Drop the given calls, which are all calls under way."""

    def batch_seconds(self) -> float:
        """Return how long a batch should take [s]; 0 means one task per batch."""
        return _BATCH_SECONDS

    def check(self) -> None:  # noqa: B027 -- nothing to ask where lost calls raise by themselves
        """Raise if no answer can come any more; called every second while none comes."""


_QUIETLY = "ignore:resource_tracker:UserWarning"


class _Processes(Pool):
    """Processes of this machine, which stay for the next call."""

    def __init__(self, number: int) -> None:
        from joblib.externals.loky.process_executor import BrokenProcessPool

        self.killed = BrokenProcessPool
        self._number = number

    def room(self) -> int:
        """Return two calls per process: one that runs, and one that waits."""
        return 2 * self._number

    def submit(self, call: Callable[[], Any]) -> Future[Any]:
        """Hand a call to a process; new processes replace killed ones."""
        while True:
            try:
                with _interrupts_held():
                    future: Future[Any] = self._executor().submit(call)
                return future
            except self.killed:
                continue

    def abandon(self, calls: Iterable[Future[Any]]) -> None:
        """End the processes, because they must not write after an early stop."""
        # Loky's thread fails on calls that it has not passed to the processes yet.
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


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold a SIGINT back; processes that start meanwhile never get one, as their parent ends them.

    Otherwise Ctrl-C makes a process that is starting print a traceback.
    """
    if sys.platform == "win32":
        yield
        return
    from multiprocessing import resource_tracker

    # Started with the first process, the tracker would unblock SIGINT. It removes the semaphores of
    # killed processes, and would warn of them.
    sys.warnoptions.append(_QUIETLY)
    resource_tracker.ensure_running()
    sys.warnoptions.remove(_QUIETLY)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with(parent: int) -> None:
    """Make this worker end soon after its parent, however the parent ends."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def run_in_pools(
    pool: Pool,
    alone: Pool,
    function: Callable[..., Result],
    tasks: Iterable[Task],
    died: Callable[..., Result] | None,
) -> Iterator[Result]:
    """Run tasks in `pool` as `run_unordered` does, and tasks of killed workers in `alone`.

    A killed worker makes all calls beside it fail, and any of their tasks may have killed it. All
    these tasks run again at the end, one at a time.
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
            yield from results  # Workers already have their next batches while the caller is busy.
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
        # If nothing is under way, the caller has taken all results, by `next` or in a `zip`.
        if under_way:
            pool.abandon(under_way)
        raise
    except BaseException:
        # This is done even if no call is known. A signal may arrive while a call is handed over,
        # and its worker would go on writing while the caller cleans up.
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
    """Do tasks, at least one, until `seconds` have passed; return results and the time taken [s].

    The other tasks are handed out again, so that no task waits long behind a slow one. A task that
    raises is handed out again too, unless it is the first. Its error then arrives after the results
    of the tasks before it.
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


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit each numeric library to one thread, whether it is loaded already or within."""
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
    """Find the loaded libraries, in 1 to 4 ms; another number of `modules` searches again."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
