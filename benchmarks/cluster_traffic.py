"""What passes through the machine of the command when a cluster writes a store on an object store.

    slatprep make-demo demo --assets 12
    python benchmarks/cluster_traffic.py demo/dataset.toml --workers 2

Sources and store lie on moto's S3, each worker has a folder of its own for temporary files, and
every byte between the command and the scheduler, between the command and S3, and between the
workers and S3 goes through a counter of its own. Prints bytes an asset, both ways together, of a
build with any number of assets: what a build moves once is in it.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from pathlib import Path
from urllib.parse import urlsplit

import checkout
import fsspec
from support import object_store


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path, help="a definition of `slatprep make-demo`")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    started: list[subprocess.Popen[str]] = []
    with tempfile.TemporaryDirectory() as folder, object_store.running() as address:
        try:
            measure(arguments.dataset, arguments.workers, Path(folder), address, started)
        finally:
            for process in reversed(started):
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)  # a nanny and its worker
                    process.wait()


def measure(
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


assert checkout.ROOT  # Importing it made the tests' server known.

if __name__ == "__main__":
    main()
