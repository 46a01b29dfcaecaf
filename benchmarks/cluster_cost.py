"""What a build costs on a Dask cluster beside the same number of processes of joblib's own.

    slatprep make-demo demo --assets 200
    python benchmarks/cluster_cost.py demo/dataset.toml --workers 2

Both run on this machine. CPU seconds are those of all processes, so that other
work on the machine hardly matters; wall clock needs as many free cores as
workers. Each is run once before it is measured, so nothing is compiled or
loaded, and no process is started. Workers get the environment that
docs/cluster.md advises, unless ``--as-installed`` is given.
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
from pathlib import Path

import psutil

from slatprep.config import load_parameters
from slatprep.parameters import BuildParameters
from slatprep.pipeline.dataset import build_store
from slatprep.workers.dask import Cluster
from slatprep.workers.local import Jobs

ADVISED = {
    "MALLOC_TRIM_THRESHOLD_": "67108864",
    "MALLOC_MMAP_THRESHOLD_": "33554432",
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--as-installed", action="store_true", help="with Dask's own settings")
    arguments = parser.parse_args()
    environment = {} if arguments.as_installed else ADVISED
    parameters = load_parameters(arguments.dataset)
    folder = Path(tempfile.mkdtemp(prefix="cluster-cost-"))
    try:
        report = {"processes": measure(parameters, folder, arguments.workers, arguments.repeat)}
        with dask(arguments.workers, folder, environment) as address, Cluster(address) as cluster:
            report["cluster"] = measure(parameters, folder, cluster, arguments.repeat)
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
