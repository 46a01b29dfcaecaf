"""Tasks on the user's Dask cluster.

The cluster decides which worker does a task, and repeats tasks of dead workers. This module makes
sure that every worker, also one that joins late, has the code, the libraries and the files of this
process, and computes on one thread. Only then are the bytes the same as on one machine.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import os
import platform
import stat
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

from slatprep.errors import SlatprepError, amount, needing
from slatprep.records import Place
from slatprep.storage.place import place_of, storage_of
from slatprep.workers.local import Pool, run_in_pools, single_threaded

with needing("a cluster needs", "cluster"):
    import distributed

Result = TypeVar("Result")

ANSWER_SECONDS = 15.0
"""Longest time [s] for a scheduler to answer; a third of it is the limit for connecting."""

BATCHES_A_CORE = 3
"""Number of batches per core of a cluster: one runs, the others wait."""

BATCHES_A_SECOND = 200.0
"""Largest number of batches per second; a scheduler could hand out some 500."""

SHORTEST_BATCH_SECONDS = 0.25

_LIBRARIES = (
    "numpy", "scipy", "numba", "open3d", "open3d-cpu", "small_gicp",
    "h5py", "zarr", "numcodecs", "google-crc32c", "joblib", "trimesh",
)  # fmt: skip


class Cluster:
    """The workers of a Dask cluster, in place of a number of jobs.

    `scheduler` is its address, such as ``tcp://host:8786``. `note` gets a line for the user if no
    worker is there yet, and one when the workers are ready. On entry, SlatprepError is raised if no
    scheduler answers or a worker is not fit.

    >>> with Cluster("tcp://host:8786") as cluster:  # doctest: +SKIP
    ...     build_store(parameters, out, jobs=cluster)
    """

    def __init__(self, scheduler: str, note: Callable[[str], object] = lambda line: None) -> None:
        self.scheduler = scheduler
        self._note = note
        self._common = _Common(_software())

    def __enter__(self) -> Cluster:
        # Lost workers and connections are either replaced or raised by us.
        for name in ("distributed.client", "tornado.application"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            with ThreadPoolExecutor(1) as thread:  # A notebook's thread already runs a loop.
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
        self._note(f"{self.scheduler}: {amount(workers, 'worker')}")
        return self

    def __exit__(self, *error: object) -> None:
        self._client.close()

    def run_unordered(
        self,
        function: Callable[..., Result],
        tasks: Iterable[tuple[Any, ...]],
        died: Callable[..., Result] | None = None,
    ) -> Iterator[Result]:
        """Run tasks on the cluster as `slatprep.workers.local.run_unordered` does.

        Dask itself repeats a task whose worker died, and gives up after several.
        """
        with self._connected():
            pool = _Pool(self._client, self._common)
            yield from run_in_pools(pool, pool, function, tasks, died)

    def require_shared(self, paths: Iterable[Place]) -> None:
        """Raise `SlatprepError` unless every worker sees the same files and folders as we do.

        A worker that joins later is checked before its first task. The next call replaces `paths`.
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

    def _check_workers(self) -> int:
        """Wait for a first worker without limit; return their number, or raise if one is unfit."""
        found: dict[str, Exception | None] = {}
        while not found:
            if not self._client.ncores():
                # There is no time limit, because a batch system's queue may take hours.
                self._note(f"{self.scheduler}: has no worker yet; waiting for the first")
                self._client.wait_for_workers(1)
            answers = self._client.run(_check, self._common, on_error="return")
            # Workers that died meanwhile are not counted.
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
        """Explain the loss of the scheduler in an error."""
        try:
            yield
        except (OSError, CancelledError) as error:
            if isinstance(error, OSError) and self._client.status == "running":
                raise  # A task raised it.
            raise SlatprepError(
                f"{self.scheduler}: the connection to the scheduler was lost; what was finished "
                "is kept, so run the same again when it is back"
            ) from error


@dataclass(frozen=True)
class _Common:
    """Software and files that a worker must share with this process.

    `software` has the name and version of each library, `files` each path and its `_look`.
    """

    software: tuple[tuple[str, str], ...]
    files: tuple[tuple[str, str], ...] = ()


async def _reach(scheduler: str) -> None:
    """Connect once and disconnect; a Dask client waits forever if no scheduler answers.

    OSError or ValueError if nothing answers in time, or the address is invalid.
    """
    arguments = distributed.Security().get_connection_args("client")
    try:
        async with asyncio.timeout(ANSWER_SECONDS):
            comm = await distributed.comm.connect(scheduler, ANSWER_SECONDS / 3, **arguments)
    except TimeoutError as error:
        raise OSError(f"what is there did not speak within {ANSWER_SECONDS:.0f} s") from error
    comm.abort()


class _Pool(Pool):
    """The workers that a cluster has now, as a pool."""

    killed = distributed.KilledWorker

    def __init__(self, client: distributed.Client, common: _Common) -> None:
        self._client = client
        self._common = common
        self._executor = client.get_executor(pure=False)
        self._cores = 0
        self._asked = -1.0

    def room(self) -> int:
        """Return several calls per core; a few if there is no worker."""
        return BATCHES_A_CORE * max(self._known_cores(), 1)

    def batch_seconds(self) -> float:
        """Return the time per batch [s] at which the scheduler can keep all workers busy."""
        return max(SHORTEST_BATCH_SECONDS, self._known_cores() / BATCHES_A_SECOND)

    def submit(self, call: Callable[[], Any]) -> Future[Any]:
        """Hand a call to a worker."""
        future: Future[Any] = self._executor.submit(_do, self._common, call)
        return future

    def check(self) -> None:
        """Raise if the scheduler was lost, because pending results will never come."""
        if self._client.status != "running":
            raise ConnectionError("the connection to the scheduler was lost")

    def abandon(self, calls: Iterable[Future[Any]]) -> None:
        """Tell the scheduler to drop calls that no worker has begun."""
        if self._client.status == "running":
            self._executor.shutdown(wait=False)

    def _known_cores(self) -> int:
        """Return the number of the workers' cores, at most a second old."""
        if time.monotonic() - self._asked > 1.0:
            self.check()
            self._cores = sum(self._client.ncores().values())
            self._asked = time.monotonic()
        return self._cores


def _do(common: _Common, call: Callable[[], Result]) -> Result:
    """Make a call on this worker, if the worker is fit."""
    _agree(common, distributed.get_worker())
    with single_threaded():
        return call()


def _check(common: _Common, dask_worker: Any) -> None:
    _agree(common, dask_worker)


@lru_cache(maxsize=8)
def _agree(common: _Common, worker: Any) -> None:
    """Raise unless this worker is fit; the cache keeps success for the process, but no error."""
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
    """Return the versions that decide a store's bytes: Python, slatprep's code, libraries."""
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
    """Describe a file or folder in words that must be equal on all workers."""
    storage = storage_of(place)
    try:
        if storage.local is None or stat.S_ISREG(storage.local.stat().st_mode):
            return f"a file of {storage.size()} bytes"
        writable = os.access(storage.local, os.W_OK)
        return f"a folder that {'may' if writable else 'must not'} be written to"
    except OSError as error:
        return f"nothing it may read ({error.strerror})"
