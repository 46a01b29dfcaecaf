"""Tasks on processes of this machine and on a cluster, and the batches that a pool is given."""

import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from typing import Any

import pytest
from support.dask_processes import threads_for_workers

from slatprep.errors import ConfigError, SlatprepError
from slatprep.workers.dask import Cluster
from slatprep.workers.local import (
    Jobs,
    Pool,
    at_most,
    require_shared,
    run_in_pools,
    run_unordered,
    single_threaded,
)


@pytest.fixture(scope="module", params=[1, 2, "cluster"])
def jobs(request: pytest.FixtureRequest) -> Iterator[Jobs]:
    """This process, two of this machine, and a cluster."""
    if request.param != "cluster":
        yield request.param
        return
    with threads_for_workers(2) as started, Cluster(started.scheduler_address) as cluster:
        yield cluster


def test_every_task_is_done_once(jobs):
    results = run_unordered(divmod, ((n, 7) for n in range(5000)), jobs)
    assert sorted(results) == sorted(divmod(n, 7) for n in range(5000))


@pytest.mark.parametrize("jobs", [0, -1, 1.5, None])
def test_without_workers_nothing_seems_done(jobs):
    for call in (
        lambda: run_unordered(abs, [(1,)], jobs),
        lambda: at_most(3, jobs),
        lambda: require_shared(jobs, []),
    ):
        with pytest.raises(ConfigError, match=f"jobs is {jobs}; expected an int"):
            call()


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_tasks_are_taken_as_workers_come_free(jobs):
    taken = 0

    def tasks() -> Iterator[tuple[float]]:
        nonlocal taken
        while taken < 100_000:
            taken += 1
            yield (0.5,)  # long enough that a hundred cannot be done before the first is seen

    results = run_unordered(time.sleep, tasks(), jobs)
    next(results)
    assert taken < 100
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        results.close()


def test_an_error_of_a_task_arrives(jobs):
    with pytest.raises(ZeroDivisionError):
        list(run_unordered(divmod, [(1, 1), (1, 0)], jobs))
    with pytest.raises(FileNotFoundError, match="no-such-file"):
        list(run_unordered(os.stat, [("no-such-file",)], jobs))


@pytest.mark.parametrize("jobs", ["cluster"], indirect=True)
def test_workers_compute_and_not_this_thread(jobs):
    assert threading.get_ident() not in run_unordered(threading.get_ident, [()] * 5, jobs)
    variables = [(name,) for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS")]
    assert list(run_unordered(os.getenv, variables, jobs)) == ["1", "1"]


def test_a_process_never_gets_the_interrupt_that_its_parent_handles():
    # A function of this file would have each new worker import all that this file does.
    asked = (signal.SIG_BLOCK, ())
    for blocked in run_unordered(signal.pthread_sigmask, [asked] * 4, 2):
        assert signal.SIGINT in blocked
    assert signal.SIGINT not in signal.pthread_sigmask(*asked)


def test_a_killed_worker_is_an_error_in_words():
    with pytest.raises(SlatprepError, match="memory ran out"):
        list(run_unordered(os._exit, [(9,), (9,)], jobs=2))


@pytest.mark.parametrize("jobs", [1, 2])
def test_whoever_takes_results_keeps_the_own_environment(jobs, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    for seen in run_unordered(os.getenv, [("OMP_NUM_THREADS",)] * 3, jobs):
        assert seen == "1"
        assert os.environ["OMP_NUM_THREADS"] == "2"


def test_single_threaded_holds_and_gives_back(monkeypatch):
    from threadpoolctl import threadpool_info, threadpool_limits

    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info()}

    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    with threadpool_limits(2):  # The tests may run with one, and that would prove nothing.
        assert threads() == {2}
        with single_threaded():
            assert threads() == {1}
            assert os.environ["MKL_NUM_THREADS"] == "1"
        assert threads() == {2}
    assert os.environ["OMP_NUM_THREADS"] == "2" and "MKL_NUM_THREADS" not in os.environ


def test_a_task_that_kills_its_worker_even_alone_is_answered_for():
    tasks = [("__import__('os')._exit(9)" if n == 5 else str(n),) for n in range(20)]
    results = run_unordered(eval, tasks, 2, died=lambda code: code)
    assert sorted(results, key=str) == sorted([tasks[5][0], *range(5), *range(6, 20)], key=str)


def test_workers_stay_if_the_caller_drops_the_iterator_after_the_last_result():
    results = run_unordered(os.getpid, [()] * 4, jobs=2)
    pids = {next(results) for _ in range(4)}
    results.close()
    for pid in pids:
        os.kill(pid, 0)  # raises if there is no such process


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
    assert len(pool.handed_over) == 1 and pool.abandoned == 1


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
