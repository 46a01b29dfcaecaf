"""Dask's scheduler and workers as processes of their own, which fail where they are told to."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from distributed import Client, LocalCluster

from support.faults import wait_until

FAULTS = """
import os, signal, time
from pathlib import Path

faults = Path(__file__).parent


def reached(step, name):
    if step == "asset aligned":
        with (faults / "aligned").open("a") as log:
            log.write(f"{name}\\n")
    kill = faults / f"kill at {step}"
    try:
        whom = int(kill.read_text() or os.getpid())
        kill.unlink()
    except FileNotFoundError:
        pass
    else:
        os.kill(whom, signal.SIGKILL)
    if step != "asset begun":
        return
    if (faults / f"deadly-{name}").exists():
        os.kill(os.getpid(), signal.SIGKILL)
    try:
        (faults / f"hold-{name}").unlink()
    except FileNotFoundError:
        return
    (faults / "held.partial").write_text(str(os.getpid()))
    (faults / "held.partial").rename(faults / "held")
    time.sleep(600)  # until it is killed
"""


PRIVATE = """
import os, sys

root, *seen = os.environ["ONLY_SEES"].split(os.pathsep)
paths = {"open": 1, "os.listdir": 1, "os.scandir": 1, "os.mkdir": 1, "os.rename": 2, "os.link": 2}


def refuse(event, arguments):
    for path in arguments[:paths.get(event, 0)]:
        if isinstance(path, (str, bytes, os.PathLike)):
            path = os.path.abspath(os.fsdecode(path))
            if path.startswith(root) and not path.startswith(tuple(seen)):
                raise PermissionError(13, "is the disk of another machine", path)


sys.addaudithook(refuse)
"""
"""Hides a folder from a process, but for parts of it, as if it ran on another machine."""


FORKING = """
import os
from multiprocessing import forkserver, process

process.current_process()._config["tempdir"] = os.environ["SHORT_PATH"]
forkserver.set_forkserver_preload([
    "distributed", "numba", "s3fs", "scipy.ndimage", "scipy.spatial", "slatprep.align.field",
    "slatprep.pipeline.dataset", "slatprep.workers.dask", "zarr",
])
forkserver.ensure_running()
"""
"""Has a nanny fork its workers of a process that has imported all: who is killed is soon back."""


def wait_for_workers(address: str, number: int) -> None:
    """Wait until so many workers are there: one may have been killed just now."""
    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(number, timeout=900)


@contextmanager
def threads_for_workers(workers: int) -> Iterator[LocalCluster]:
    """A cluster within this process, for what does not depend on its being outside."""
    with LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=False,
        protocol="tcp://", dashboard_address=None,
    ) as started:  # fmt: skip
        yield started


class Processes:
    """Dask's own commands, in a folder that tells them how to fail."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "faults.py").write_text(FAULTS)
        (folder / "private.py").write_text(PRIVATE)
        (folder / "forking.py").write_text(FORKING)
        self._started: list[subprocess.Popen[bytes]] = []
        # An address of a socket has at most some hundred characters.
        self._short = TemporaryDirectory(prefix="dask-", dir="/tmp", ignore_cleanup_errors=True)

    def scheduler(self) -> str:
        """Start a scheduler at a free port and return its address."""
        file = self.folder / "scheduler.json"
        self._start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
            "--dashboard-address", "127.0.0.1:0", "--scheduler-file", str(file),
        )  # fmt: skip
        wait_until(lambda: file.exists() and file.read_text().endswith("}"))
        return str(json.loads(file.read_text())["address"])

    def worker(
        self, address: str, *options: str, path: str = "", **variables: str
    ) -> subprocess.Popen[bytes]:
        """Start a worker of one thread, unless options say otherwise."""
        return self._start(
            "worker", address, "--nthreads", "1", "--no-dashboard",
            "--local-directory", str(self.folder), *options, path=path, **variables,
        )  # fmt: skip

    def forked(self, address: str, *options: str, **variables: str) -> subprocess.Popen[bytes]:
        """Start workers that are soon back when they have been killed."""
        return self.worker(
            address, "--preload-nanny", str(self.folder / "forking.py"), *options,
            DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD="forkserver",
            SHORT_PATH=self._short.name, **variables,
        )  # fmt: skip

    def worker_elsewhere(
        self, address: str, root: Path, **variables: str
    ) -> subprocess.Popen[bytes]:
        """Start a worker that sees nothing of `root` but a disk of its own, and how to fail."""
        disk = self.folder.with_name(f"{self.folder.name}-disk-{len(self._started)}")
        disk.mkdir()
        return self.forked(
            address, "--local-directory", str(disk), "--preload", str(self.folder / "private.py"),
            TMPDIR=str(disk), SLATPREP_CACHE=str(disk / "cache"),
            ONLY_SEES=os.pathsep.join(map(str, (root, disk, self.folder))), **variables,
        )  # fmt: skip

    @property
    def pids(self) -> list[int]:
        """Their numbers, in the order in which they were started."""
        return [process.pid for process in self._started]

    def stop(self) -> None:
        """End all of them."""
        for process in self._started:
            end(process)
        self._short.cleanup()

    def _start(self, *arguments: str, path: str = "", **variables: str) -> subprocess.Popen[bytes]:
        paths = path, str(self.folder), os.environ.get("PYTHONPATH", "")
        environment = {
            **os.environ,
            "SLATPREP_FAULTS": "faults:reached",
            "OMP_NUM_THREADS": "1",
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            # Two dead workers are enough to give a task up; by default it takes four.
            "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
            **variables,
        }
        with (self.folder / f"{arguments[0]}-{len(self._started)}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]],
                env=environment, cwd=self.folder, stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        self._started.append(process)
        return process


def end(process: subprocess.Popen[bytes]) -> None:
    """Kill a command and the workers that its nanny started."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        return
    process.wait()
