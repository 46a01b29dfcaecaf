"""One function over many tasks, on one core or several, one thread each."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from slatprep.errors import SlatprepError

Result = TypeVar("Result")

_THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)


def run_unordered(
    function: Callable[..., Result], tasks: Iterable[tuple[Any, ...]], jobs: int = 1
) -> Iterator[Result]:
    """Yield ``function(*task)`` for each task, in the order in which they finish.

    Tasks are taken from the iterable only as workers come free, and each
    worker computes on one thread.

    Parameters
    ----------
    function : callable
        Must be importable by a worker.
    tasks : iterable of tuple
        Positional arguments of each call.
    jobs : int
        Worker processes; 1 computes in this process.

    Raises
    ------
    SlatprepError
        If a worker was killed from outside.
    """
    from joblib import Parallel, delayed, parallel_config
    from joblib.externals.loky.process_executor import BrokenProcessPool

    calls = (delayed(function)(*task) for task in tasks)
    if jobs == 1:
        with single_threaded():
            yield from Parallel(n_jobs=1, return_as="generator")(calls)
        return
    with parallel_config("loky", n_jobs=jobs, inner_max_num_threads=1):
        # Our tasks take long enough to travel alone; in batches progress would jump.
        parallel = Parallel(return_as="generator_unordered", batch_size=1)
    results = parallel(calls)
    try:
        for result in results:  # noqa: UP028 - "yield from" would close it before `finally` does
            yield result
    except BrokenProcessPool as error:
        raise SlatprepError(
            "a worker process was killed, probably because memory ran out; nothing was replaced. "
            "Run again with fewer jobs"
        ) from error
    finally:
        with warnings.catch_warnings():
            # Whoever stops early, as a strict build does, means to waste the rest.
            warnings.filterwarnings("ignore", message=".*but not used", category=UserWarning)
            results.close()


@contextmanager
def single_threaded() -> Iterator[None]:
    """Hold the numeric libraries to one thread each, loaded already or loaded within."""
    from threadpoolctl import threadpool_limits

    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
