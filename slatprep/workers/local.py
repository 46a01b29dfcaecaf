"""One function over many tasks, on one core or several, or on a cluster, one thread each."""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from slatprep.errors import SlatprepError

if TYPE_CHECKING:
    from slatprep.records import Place

Result = TypeVar("Result")

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)
"""What the numeric libraries read, once, when they are loaded."""

WORKER_DIED = object()
"""Stands in a pair of a task's number and its result for one that cost its workers their lives."""


class Workers(Protocol):
    """Workers other than this process's own, as `slatprep.workers.dask.Cluster` has them."""

    def run_unordered(
        self,
        function: Callable[..., Result],
        tasks: Iterable[tuple[Any, ...]],
        died: Callable[..., Result] | None = None,
    ) -> Iterator[Result]:
        """Do what the function `run_unordered` promises."""
        ...

    def require_shared(self, paths: Iterable[Place]) -> None:
        """Raise `SlatprepError` unless every worker sees these files and folders as we do."""
        ...


Jobs = int | Workers
"""How many processes of this machine compute, or who else does."""


def run_unordered(
    function: Callable[..., Result],
    tasks: Iterable[tuple[Any, ...]],
    jobs: Jobs = 1,
    died: Callable[..., Result] | None = None,
) -> Iterator[Result]:
    """Yield ``function(*task)`` for each task, in the order in which they finish.

    Tasks are taken from the iterable only as workers come free, and each
    worker computes on one thread. When a worker is killed, whatever was under
    way is done again, a task at a time, in a process of its own.

    Parameters
    ----------
    function : callable
        Must be importable by a worker.
    tasks : iterable of tuple
        Positional arguments of each call.
    jobs : int or Workers
        Worker processes, 1 computes in this process; or workers elsewhere.
    died : callable, optional
        ``died(*task)`` stands in for the result of a task that was alone when
        its worker was killed again. Without it that is an error.

    Raises
    ------
    SlatprepError
        If a task kills its worker even alone, and `died` is not given.
    """
    if not isinstance(jobs, int):
        yield from jobs.run_unordered(function, tasks, died)
        return
    if jobs == 1:
        with single_threaded():
            for task in tasks:
                yield function(*task)
        return
    from joblib.externals.loky.process_executor import BrokenProcessPool

    source = Handout(tasks)
    while not source.exhausted:
        try:
            yield from _run_in_pool(function, source, jobs)
        except BrokenProcessPool:
            yield from _run_alone(function, source.unfinished(), died)


def require_shared(jobs: Jobs, paths: Iterable[Place]) -> None:
    """Raise `SlatprepError` unless all workers see these files; those of this machine do."""
    if not isinstance(jobs, int):
        jobs.require_shared(paths)


class Handout:
    """Hands tasks out and remembers which have not come back."""

    def __init__(self, tasks: Iterable[tuple[Any, ...]]) -> None:
        self._tasks = enumerate(tasks)
        self._out: dict[int, tuple[Any, ...]] = {}
        self._lock = threading.Lock()
        self._turn = 0
        self.exhausted = False

    def __iter__(self) -> Iterator[tuple[int, tuple[Any, ...]]]:
        turn = self._turn
        while True:
            with self._lock:  # joblib asks from threads of its own, one of them perhaps too late
                if turn != self._turn:
                    return
                number, task = next(self._tasks, (-1, ()))
                if number < 0:
                    self.exhausted = True
                    return
                self._out[number] = task
            yield number, task

    def back(self, number: int) -> None:
        """Forget a task whose result has come."""
        with self._lock:
            del self._out[number]

    def unfinished(self) -> list[tuple[Any, ...]]:
        """Take the tasks that were under way, in order; who iterates now gets no more."""
        with self._lock:
            self._turn += 1
            tasks = [self._out[number] for number in sorted(self._out)]
            self._out.clear()
        return tasks


def results_of(
    results: Generator[tuple[int, Result], None, None], source: Handout
) -> Iterator[Result]:
    """Yield what joblib yields of numbered tasks; those whose worker died stay unfinished."""
    try:
        for number, result in results:
            if result is not WORKER_DIED:
                source.back(number)
                yield result
    finally:
        with warnings.catch_warnings():
            # Whoever stops early, as a strict build does, means to waste the rest.
            for wasted in (".*but not used", ".*have been cancelled"):
                warnings.filterwarnings("ignore", message=wasted, category=UserWarning)
            results.close()


def _run_in_pool(function: Callable[..., Result], source: Handout, jobs: int) -> Iterator[Result]:
    from joblib import Parallel, delayed, parallel_config

    calls = (delayed(_numbered)(function, number, task) for number, task in source)
    watch = {"initializer": _end_with, "initargs": (os.getpid(),)}
    with parallel_config("loky", n_jobs=jobs, inner_max_num_threads=1, **watch):
        # Our tasks take long enough to travel alone; in batches progress would jump.
        parallel = Parallel(return_as="generator_unordered", batch_size=1)
    yield from results_of(parallel(calls), source)


def _run_alone(
    function: Callable[..., Result],
    tasks: Iterable[tuple[Any, ...]],
    died: Callable[..., Result] | None,
) -> Iterator[Result]:
    """Yield the result of each task, one at a time in a process that does nothing else."""
    from joblib.externals.loky import ProcessPoolExecutor
    from joblib.externals.loky.process_executor import BrokenProcessPool

    environment = dict.fromkeys(THREAD_VARIABLES, "1")
    alone = None
    for task in tasks:
        if alone is None:
            alone = ProcessPoolExecutor(
                1, env=environment, initializer=_end_with, initargs=(os.getpid(),)
            )
        try:
            yield alone.submit(function, *task).result()
        except BrokenProcessPool:
            alone = None
            yield result_of_death(task, died)
    if alone is not None:
        alone.shutdown()


def result_of_death(task: tuple[Any, ...], died: Callable[..., Result] | None) -> Result:
    """Return what stands in for a task that kills its worker even alone."""
    if died is None:
        raise SlatprepError(
            "a worker process was killed twice at the same task, probably because memory "
            "ran out; nothing was replaced. Run again with fewer jobs or more memory"
        )
    return died(*task)


def _numbered(
    function: Callable[..., Result], number: int, task: tuple[Any, ...]
) -> tuple[int, Result]:
    return number, function(*task)


def _end_with(parent: int) -> None:
    """End this worker soon after its parent, however that ends."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def single_threaded() -> Iterator[None]:
    """Hold the numeric libraries to one thread each, loaded already or loaded within."""
    from threadpoolctl import threadpool_limits

    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
