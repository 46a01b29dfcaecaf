"""Measure what a build costs on a Dask cluster, and its traffic through the command's machine.

    slatprep make-demo demo --assets 200
    python benchmarks/cluster.py cost demo/dataset.toml --workers 2
    python benchmarks/cluster.py cost --empty 100000 --workers 2
    python benchmarks/cluster.py traffic demo/dataset.toml --workers 2

``cost`` compares a cluster with the same number of processes, both on this machine. CPU seconds are
summed over all processes, so other work on the machine hardly matters; wall-clock time needs as
many free cores as workers. Each runs once before it is measured, so compiling, loading and starting
processes are not measured. Workers get the environment that docs/cluster.md advises, unless
``--as-installed`` is given. ``--empty N`` instead distributes N tasks that do nothing. This gives
the number per second that one scheduler and one command reach with any number of workers.

``traffic`` builds a store on an object store. Sources and store are on moto's S3, and each worker
has its own folder for temporary files. Separate counters count all bytes between command and
scheduler, command and S3, and workers and S3. Prints bytes per asset of a build, in both directions
together. They include the bytes that a build transfers once, for any number of assets.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import checkout
import fsspec
import psutil
from support import object_store

from slatprep.parameters import BuildParameters
from slatprep.parameters.files import load_parameters
from slatprep.pipeline.dataset import build_store
from slatprep.workers.dask import Cluster
from slatprep.workers.local import Jobs, run_unordered

ADVISED = {
    "MALLOC_TRIM_THRESHOLD_": "67108864",
    "MALLOC_MMAP_THRESHOLD_": "33554432",
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
}


def cost(arguments: argparse.Namespace) -> None:
    if (arguments.dataset is None) == (arguments.empty is None):
        sys.exit("expected either a dataset definition or --empty N")
    environment = {} if arguments.as_installed else ADVISED
    folder = Path(tempfile.mkdtemp(prefix="cluster-cost-"))
    try:
        report = {}
        if arguments.empty is None:
            parameters = load_parameters(arguments.dataset)
            measured = partial(measure, parameters, folder, repeat=arguments.repeat)
            report["processes"] = measured(jobs=arguments.workers)
        else:
            measured = partial(hand_out, arguments.empty, repeat=arguments.repeat)
        with dask(arguments.workers, folder, environment) as address, Cluster(address) as cluster:
            report["cluster"] = measured(jobs=cluster)
    finally:
        shutil.rmtree(folder)
    print(json.dumps(report, indent=2))


def measure(
    parameters: BuildParameters, folder: Path, jobs: Jobs, repeat: int
) -> list[dict[str, float]]:
    """Return what an asset costs [ms], by process, in each of several builds."""
    runs = []
    for number in range(repeat + 1):
        before, begin = cpu(), time.perf_counter()
        summary = build_store(parameters, folder / "s.zarr", jobs=jobs, fresh=True)
        wall = time.perf_counter() - begin
        spent = {name: seconds - before.get(name, 0.0) for name, seconds in cpu().items()}
        assets = sum(summary.statuses.values())
        all_of_it = {"wall": wall, "cpu": sum(spent.values()), **spent}
        if number:
            runs.append({name: round(1e3 * s / assets, 1) for name, s in all_of_it.items()})
    return runs


def hand_out(tasks: int, jobs: Jobs, repeat: int) -> list[dict[str, float]]:
    """Return how many empty tasks are done a second, and their CPU seconds by process."""
    runs = []
    for number in range(repeat + 1):
        before, begin = cpu(), time.perf_counter()
        done = sum(1 for _ in run_unordered(empty, ((n,) for n in range(tasks)), jobs))
        wall = time.perf_counter() - begin
        assert done == tasks
        if number:
            spent = {name: round(s - before.get(name, 0.0), 2) for name, s in cpu().items()}
            runs.append({"tasks_per_second": round(tasks / wall), **spent})
    return runs


def empty(number: int) -> int:
    return number


def cpu() -> dict[str, float]:
    """Return the CPU seconds of this process and all below it, by what they do."""
    spent = {"parent": 0.0, "scheduler": 0.0, "workers": 0.0}
    own = psutil.Process()
    for process in (own, *own.children(recursive=True)):
        times = process.cpu_times()
        scheduler = any("dask_scheduler" in word for word in process.cmdline())
        name = "parent" if process == own else "scheduler" if scheduler else "workers"
        spent[name] += times.user + times.system
    return spent


@contextmanager
def dask(workers: int, folder: Path, environment: dict[str, str]) -> Iterator[str]:
    """Start a cluster on this machine and yield its address."""
    file = folder / "scheduler.json"
    python = [sys.executable, "-m"]
    known = ["--scheduler-file", str(file), "--no-dashboard"]
    scheduler = [*python, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
                 "--dashboard-address", "127.0.0.1:0"]  # fmt: skip
    worker = [*python, "distributed.cli.dask_worker", "--nworkers", str(workers),
              "--nthreads", "1", "--local-directory", str(folder)]  # fmt: skip
    started = [
        subprocess.Popen(
            [*command, *known], stderr=subprocess.DEVNULL, env={**os.environ, **environment}
        )
        for command in (scheduler, worker)
    ]
    try:
        while not (file.exists() and file.read_text().endswith("}")):
            time.sleep(0.1)
        yield json.loads(file.read_text())["address"]
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait()


class Counter:
    """Passes a TCP port on and counts the bytes, both ways."""

    def __init__(self, address: str) -> None:
        url = urlsplit(address)
        self._target = url.hostname, url.port
        self.bytes = 0
        ready = threading.Event()
        threading.Thread(target=lambda: asyncio.run(self._serve(ready)), daemon=True).start()
        ready.wait()
        self.address = f"{url.scheme}://127.0.0.1:{self._port}"

    async def _serve(self, ready: threading.Event) -> None:
        server = await asyncio.start_server(self._connect, "127.0.0.1", 0)
        self._port = server.sockets[0].getsockname()[1]
        ready.set()
        await server.serve_forever()

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        other_reader, other_writer = await asyncio.open_connection(*self._target)
        await asyncio.gather(self._pass(reader, other_writer), self._pass(other_reader, writer))

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(2**18):
                self.bytes += len(data)
                writer.write(data)
                await writer.drain()
        except ConnectionError:
            pass  # One of the two has ended.
        finally:
            writer.close()


def traffic(arguments: argparse.Namespace) -> None:
    started: list[subprocess.Popen[str]] = []
    with tempfile.TemporaryDirectory() as folder, object_store.running() as address:
        try:
            measure_traffic(arguments.dataset, arguments.workers, Path(folder), address, started)
        finally:
            for process in reversed(started):
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)  # a nanny and its worker
                    process.wait()


def measure_traffic(
    dataset: Path, workers: int, folder: Path, s3: str, started: list[subprocess.Popen[str]]
) -> None:
    def start(*command: str, **variables: str) -> subprocess.Popen[str]:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        errors = (folder / "errors").open("a")
        environment = {**os.environ, **variables}
        process = subprocess.Popen(
            [sys.executable, *command], env=environment, stderr=errors, text=True,
            start_new_session=True, **pipes,
        )  # fmt: skip
        started.append(process)
        return process

    os.environ |= object_store.environment(s3)
    of_command, of_workers = Counter(s3), Counter(s3)
    system = fsspec.filesystem("s3", client_kwargs={"endpoint_url": s3})
    system.mkdir("bench")
    definition = put_sources(system, dataset, folder)

    file = folder / "scheduler.json"
    start("-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
          "--no-dashboard", "--dashboard-address", "127.0.0.1:0",
          "--scheduler-file", str(file))  # fmt: skip
    while not (file.exists() and file.read_text().endswith("}")):
        time.sleep(0.1)
    address = str(json.loads(file.read_text())["address"])
    scheduler = Counter(address)
    for number in range(workers):
        disk = folder / f"disk-{number}"
        disk.mkdir()
        start("-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard",
              "--local-directory", str(disk), TMPDIR=str(disk), SLATPREP_CACHE=str(disk),
              AWS_ENDPOINT_URL=of_workers.address)  # fmt: skip

    begin = time.perf_counter()
    build = start(
        "-m", "slatprep", "build-store", "--config", str(definition), "--json",
        "--out", "s3://bench/demo.zarr", "--scheduler", scheduler.address,
        AWS_ENDPOINT_URL=of_command.address, SLATPREP_CACHE=str(folder / "command"),
    )  # fmt: skip
    said, _ = build.communicate()
    if build.returncode:
        sys.exit((folder / "errors").read_text()[-2000:])
    assets = sum(json.loads(said)["statuses"].values())
    sizes = system.find("bench/demo.zarr", detail=True).values()
    report = {
        "assets": assets,
        "workers": workers,
        "wall [s]": round(time.perf_counter() - begin, 1),
        "kB an asset": {
            "command and scheduler": scheduler.bytes,
            "command and object store": of_command.bytes,
            "workers and object store": of_workers.bytes,
            "store with its records": sum(entry["size"] for entry in sizes),
        },
    }
    report["kB an asset"] = {
        name: round(size / 1e3 / assets, 1) for name, size in report["kB an asset"].items()
    }
    print(json.dumps(report, indent=2))


def put_sources(system: fsspec.AbstractFileSystem, dataset: Path, folder: Path) -> Path:
    """Put the two sides of a dataset on S3; return a definition that finds them there."""
    document = tomllib.loads(dataset.read_text())
    lines = []
    for side in ("pixieverse", "slat"):
        system.put(f"{dataset.parent / document[side]['root']}/", f"bench/{side}/", recursive=True)
        lines += [f"[{side}]", f'root = "s3://bench/{side}"']
    definition = folder / "dataset.toml"
    definition.write_text("\n".join(lines) + "\n")
    return definition


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ways = parser.add_subparsers(required=True)
    for run, dataset in ((cost, "?"), (traffic, None)):
        way = ways.add_parser(run.__name__)
        way.set_defaults(run=run)
        way.add_argument("dataset", type=Path, nargs=dataset, help="of `slatprep make-demo`")
        way.add_argument("--workers", type=int, default=2)
        if run is cost:
            way.add_argument("--empty", type=int, metavar="N", help="N empty tasks, not a dataset")
            way.add_argument("--repeat", type=int, default=3)
            way.add_argument("--as-installed", action="store_true", help="Dask's own settings")
    arguments = parser.parse_args()
    arguments.run(arguments)


assert checkout.ROOT  # Importing it made the tests' server known.

if __name__ == "__main__":
    main()
