"""What a build costs on a Dask cluster beside the same number of processes of this machine.

    slatprep make-demo demo --assets 200
    python benchmarks/cluster_cost.py demo/dataset.toml --workers 2
    python benchmarks/cluster_cost.py --empty 100000 --workers 2

Both run on this machine. CPU seconds are those of all processes, so that other
work on the machine hardly matters; wall clock needs as many free cores as
workers. Each is run once before it is measured, so nothing is compiled or
loaded, and no process is started. Workers get the environment that
docs/cluster.md advises, unless ``--as-installed`` is given.

``--empty N`` hands out N tasks that do nothing instead, to find the number a
second that one scheduler and one command reach, however many workers there are.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import psutil

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path, nargs="?")
    parser.add_argument("--empty", type=int, metavar="N", help="N empty tasks, not a dataset")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--as-installed", action="store_true", help="with Dask's own settings")
    arguments = parser.parse_args()
    if (arguments.dataset is None) == (arguments.empty is None):
        parser.error("expected either a dataset definition or --empty N")
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


if __name__ == "__main__":
    main()
