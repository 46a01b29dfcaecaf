"""Tasks on a Dask cluster that the user has, handed out by joblib's own Dask backend.

The cluster decides which worker does what, and what is done again when one
dies. What it cannot know is made sure here: that every worker, those that join
late as well, has the code, the libraries and the files that this process has,
and computes on one thread. Only then are the bytes the same as on one machine.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import os
import platform
import stat
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

from slatprep.errors import ConfigError, SlatprepError
from slatprep.storage.place import place_of, storage_of
from slatprep.workers.local import (
    WORKER_DIED,
    Handout,
    result_of_death,
    results_of,
    single_threaded,
)

if TYPE_CHECKING:
    from slatprep.records import Place

try:
    import distributed
    from distributed.scheduler import KilledWorker
    from joblib._dask import DaskDistributedBackend
    from tornado.ioloop import PeriodicCallback
except ImportError as error:
    raise ConfigError(
        f"Dask cannot be imported ({error}); install it with `pip install 'slatprep[cluster]'`"
    ) from error

Result = TypeVar("Result")

ANSWER_SECONDS = 15.0
"""How long a scheduler may take to answer, and three times as long as to be found at all."""

IN_FLIGHT = 1000
"""Tasks the cluster has at a time: enough for workers that join midway, and few to remember."""

_LIBRARIES = (
    "numpy", "scipy", "numba", "open3d", "open3d-cpu", "small_gicp",
    "h5py", "zarr", "numcodecs", "google-crc32c", "joblib",
)  # fmt: skip


class Cluster:
    """The workers of a Dask cluster, given wherever a number of jobs is.

    Parameters
    ----------
    scheduler : str
        Address of its scheduler, such as ``tcp://host:8786``.
    note : callable, optional
        Called with a line for people, while a first worker is waited for and
        when there is one.

    Raises
    ------
    SlatprepError
        On entering: if no scheduler answers, or a worker is not fit.

    Examples
    --------
    >>> with Cluster("tcp://host:8786") as cluster:  # doctest: +SKIP
    ...     build_store(parameters, out, jobs=cluster)
    """

    def __init__(self, scheduler: str, note: Callable[[str], object] = lambda line: None) -> None:
        self.scheduler = scheduler
        self._note = note
        self._common = _Common(_software())

    def __enter__(self) -> Cluster:
        # What is logged of lost workers and connections is either mended or raised by us.
        for name in ("distributed.client", "tornado.application"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            with ThreadPoolExecutor(1) as thread:  # in a notebook, this one has a loop already
                thread.submit(asyncio.run, _reach(self.scheduler)).result()
            self._client = distributed.Client(
                self.scheduler, timeout=ANSWER_SECONDS, set_as_default=False
            )
        except (OSError, ValueError) as error:
            raise SlatprepError(
                f"{self.scheduler}: no Dask scheduler answers there ({error}); expected an "
                "address such as tcp://host:8786, as `dask scheduler` prints it when it starts"
            ) from error
        try:
            workers = self._check_workers()
        except BaseException:
            self._client.close()
            raise
        self._note(f"{self.scheduler}: {workers} worker{'s'[: workers != 1]}")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._client.close()

    def run_unordered(
        self,
        function: Callable[..., Result],
        tasks: Iterable[tuple[Any, ...]],
        died: Callable[..., Result] | None = None,
    ) -> Iterator[Result]:
        """Do what `slatprep.workers.local.run_unordered` promises, on the cluster.

        Dask does a task again whose worker died, and gives it up when several
        have. As it blames whatever else waited at those workers too, tasks
        given up are done again at the end, alone on the whole cluster.
        """
        with self._connected():
            source = Handout(tasks)
            yield from self._run(function, source, IN_FLIGHT)
            suspects = Handout(source.unfinished())
            yield from self._run(function, suspects, 1)
            for task in suspects.unfinished():
                yield result_of_death(task, died)

    def require_shared(self, paths: Iterable[Place]) -> None:
        """Raise `SlatprepError` unless every worker sees these files and folders as we do.

        Workers that join later are asked before their first task, until other
        files are asked for.
        """
        files = {}
        for path in paths:
            if path != path.absolute():
                raise SlatprepError(
                    f"{path}: is a relative path, and workers may stand in another folder; "
                    "expected an absolute path"
                )
            files[str(path)] = _look(path)
        self._common = replace(self._common, files=tuple(files.items()))
        with self._connected():
            self._check_workers()

    def _run(
        self, function: Callable[..., Result], source: Handout, in_flight: int
    ) -> Iterator[Result]:
        from joblib import Parallel, delayed

        calls = (delayed(_do)(self._common, number, function, task) for number, task in source)
        parallel = Parallel(
            backend=_Backend(client=self._client),
            return_as="generator_unordered",
            batch_size=1,
            pre_dispatch=in_flight,
        )
        yield from results_of(parallel(calls), source)

    def _check_workers(self) -> int:
        """Wait for a first worker, without limit; raise unless all are fit, or say how many."""
        found: dict[str, Exception | None] = {}
        while not found:
            if not self._client.ncores():
                # A batch system's queue may take hours; how long is too long, people know.
                self._note(f"{self.scheduler}: has no worker yet; waiting for the first")
                self._client.wait_for_workers(1)
            answers = self._client.run(_check, self._common, on_error="return")
            # Those that died while we asked are none of ours.
            found = {w: fault for w, fault in answers.items() if not isinstance(fault, OSError)}
        for worker, fault in sorted(found.items()):
            if isinstance(fault, SlatprepError):
                raise fault
            if fault is not None:
                raise SlatprepError(
                    f"{worker}: cannot run slatprep ({type(fault).__name__}: {fault}); "
                    "expected the same environment on all workers"
                )
        return len(found)

    @contextmanager
    def _connected(self) -> Iterator[None]:
        """Say in words that the scheduler was lost."""
        try:
            yield
        except (OSError, distributed.CancelledError) as error:
            if isinstance(error, OSError) and self._client.status == "running":
                raise  # it is a task's own
            raise SlatprepError(
                f"{self.scheduler}: the connection to the scheduler was lost; what was finished "
                "is kept, so run the same again when it is back"
            ) from error


@dataclass(frozen=True)
class _Common:
    """What a worker must have in common with this process.

    Attributes
    ----------
    software : tuple of (str, str)
        What computes, and its version.
    files : tuple of (str, str)
        Paths of files and folders, and what `_look` says of them.
    """

    software: tuple[tuple[str, str], ...]
    files: tuple[tuple[str, str], ...] = ()


async def _reach(scheduler: str) -> None:
    """Connect once and leave; a Dask client waits for ever where something else answers.

    Raises
    ------
    OSError, ValueError
        If nothing answers in time, or the address is none.
    """
    arguments = distributed.Security().get_connection_args("client")
    try:
        async with asyncio.timeout(ANSWER_SECONDS):
            comm = await distributed.comm.connect(scheduler, ANSWER_SECONDS / 3, **arguments)
    except TimeoutError as error:
        raise OSError(f"what is there did not speak within {ANSWER_SECONDS:.0f} s") from error
    comm.abort()


class _Backend(DaskDistributedBackend):  # type: ignore[misc]
    """Joblib's backend, mended where it would compute in this process, or wait for ever."""

    def start_call(self) -> None:
        """Begin a run, and watch the scheduler in it."""
        self._waiting: set[Future[Any]] = set()
        self._watch = PeriodicCallback(self._give_up_if_lost, 1000)
        self.client.loop.add_callback(self._watch.start)
        super().start_call()

    def stop_call(self) -> None:
        """End a run."""
        self.client.loop.add_callback(self._watch.stop)
        super().stop_call()

    def effective_n_jobs(self, n_jobs: int) -> int:
        """Return the number of workers, two at least.

        With one, joblib would do everything in this process, not on the worker.
        """
        workers: int = sum(self.client.ncores().values())
        return max(2, workers)

    def submit(self, func: Any, callback: Callable[[Any], None]) -> Future[Any]:
        """Submit a batch; call back as well where Dask itself gave up, as joblib's own does not."""

        def done(future: Future[Any]) -> None:
            self._waiting.discard(future)
            error = future.exception()
            if isinstance(error, KilledWorker):
                callback([(number, WORKER_DIED) for _, (_, number, *_), _ in func.items])
            elif error is not None:
                callback(error)

        future: Future[Any] = super().submit(func, callback)
        self._waiting.add(future)
        future.add_done_callback(done)
        return future

    def _give_up_if_lost(self) -> None:
        """End the wait for results that were on their way when the connection broke."""
        if self.client.status != "running":
            for future in list(self._waiting):
                future.set_exception(ConnectionError("the connection to the scheduler was lost"))


def _do(
    common: _Common, number: int, function: Callable[..., Result], task: tuple[Any, ...]
) -> tuple[int, Result]:
    """Do one task, on a worker."""
    _agree(common, distributed.get_worker())
    with single_threaded():
        return number, function(*task)


def _check(common: _Common, dask_worker: Any) -> None:
    _agree(common, dask_worker)


@lru_cache(maxsize=8)
def _agree(common: _Common, worker: Any) -> None:
    """Raise unless this worker is fit; asked once a process, because errors are not cached."""
    name = f"worker {worker.address} on {platform.node()}"
    if worker.state.nthreads != 1:
        raise SlatprepError(
            f"{name}: has {worker.state.nthreads} threads; expected one, so start it with "
            "`dask worker --nthreads 1`, and --nworkers for several on one machine"
        )
    own = dict(_software())
    for what, version in common.software:
        if own.get(what, "") != version:
            raise SlatprepError(
                f"{name}: has {what} {own.get(what) or 'not at all'}, where the build was started "
                f"it is {version or 'absent'}; expected the same environment on all workers"
            )
    for path, look in common.files:
        seen = _look(place_of(path))
        if seen != look:
            raise SlatprepError(
                f"{name}: sees {seen} at {path}, which is {look} where the build was started; "
                "expected a file system that all workers share and may write to"
            )


@lru_cache(maxsize=1)
def _software() -> tuple[tuple[str, str], ...]:
    """Return what makes the bytes of a store: Python, all of slatprep's code, the libraries."""
    package = Path(__file__).parents[1]
    code = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        code.update(f"{path.relative_to(package)}\n".encode() + path.read_bytes())
    versions = {"slatprep's code": code.hexdigest()[:16], "python": platform.python_version()}
    for library in _LIBRARIES:
        try:
            versions[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            versions[library] = ""
    return tuple(versions.items())


def _look(place: Place) -> str:
    """Return what lies at a place, as far as workers must agree on it."""
    storage = storage_of(place)
    try:
        if storage.local is None or stat.S_ISREG(storage.local.stat().st_mode):
            return f"a file of {storage.size()} bytes"
        writable = os.access(storage.local, os.W_OK)
        return f"a folder that {'may' if writable else 'must not'} be written to"
    except OSError as error:
        return f"nothing it may read ({error.strerror})"
