"""Measure reading from an object store, in place or from a copy, beside the alternatives.

    python benchmarks/remote.py steps STORE [--latency 0.03] [--assets 50]
    python benchmarks/remote.py ways STORE [--latency 0.02] [--assets 60]

``steps`` uploads a local store to moto's server on loopback, in place of S3. Each request waits as
long as a request to S3, and bandwidth is not limited. It prints seconds and requests to publish, to
open, to read an asset's coords, feats and properties in shuffled order, and to copy.

``ways`` reads from this machine's disk, with warm caches, and from S3: a server on loopback that
answers requests for objects like S3, each after the latency. Every way reads coords, feats and
properties of the same assets in the same shuffled order, from one, two and four processes at a
time, each with its share of them. Only WebDataset, which reads its shards from end to end, takes
the order that it shuffles itself. It prints milliseconds per asset and process, the best of the
repeats, after a first asset that opens everything, and requests per asset.
"""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import io
import json
import multiprocessing
import os
import subprocess
import sys
import tarfile
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import checkout
import fsspec
import numpy as np
import reading as local
from reading import write_forms
from s3fs.core import S3FileSystem
from support import object_store

from slatprep.storage.place import place_of
from slatprep.storage.upload import published_state, upload_store
from slatprep.store import Store, open_store
from slatprep.store.reader import TRAINING_COLUMNS

URL = "s3://bench/demo.zarr"

requests: list[str] = []


@contextmanager
def server(latency: float) -> Iterator[None]:
    with tempfile.TemporaryDirectory() as cache, object_store.running() as address:
        os.environ |= {**object_store.environment(address), "SLATPREP_CACHE": cache}
        fsspec.filesystem("s3").mkdir("bench")
        call = S3FileSystem._call_s3

        async def later(filesystem: Any, method: str, *args: Any, **options: Any) -> Any:
            requests.append(method)
            await asyncio.sleep(latency)
            return await call(filesystem, method, *args, **options)

        S3FileSystem._call_s3 = later
        yield


def report(what: str, step: Callable[[], Any], times: int = 1) -> Any:
    requests.clear()
    begin = time.perf_counter()
    result = step()
    seconds = (time.perf_counter() - begin) / times
    print(f"| {what} | {seconds:.4f} | {len(requests) / times:.1f} |")
    return result


def steps(arguments: argparse.Namespace) -> None:
    local = open_store(arguments.store)
    order = np.random.default_rng(0).permutation(len(local))[: arguments.assets].tolist()
    size = sum(path.stat().st_size for path in arguments.store.rglob("*") if path.is_file())
    print(f"{len(local)} assets, {size / 1e6:.1f} MB; {1e3 * arguments.latency:.0f} ms a request\n")
    print("| step | s | requests |\n| --- | --- | --- |")

    def read(store: Store) -> None:
        for index in order:
            store.read(index)

    def publish() -> None:
        upload_store(arguments.store, published_state(place_of(URL))).publish()  # type: ignore[arg-type]

    with server(arguments.latency):
        report("publish", publish)
        store = report("open", lambda: open_store(URL))
        report("first asset", lambda: store.read(order[0]))
        report("an asset, where it lies", lambda: read(store), len(order))
        copy = report("copy", lambda: open_store(URL, copy=True))
        report("open the copy", lambda: open_store(URL, copy=True))
        report("an asset, from the copy", lambda: read(copy), len(order))
        report("an asset, from the local store", lambda: read(local), len(order))


SERVER = """
import asyncio, pathlib, sys
from aiohttp import web
root, latency, made = pathlib.Path(sys.argv[1]), float(sys.argv[2]), [0]
MISSING = "<Error><Code>NoSuchKey</Code><Message>no such key</Message></Error>"
async def answer(request):
    if request.path == "/requests":
        return web.Response(text=str(made[0]))
    made[0] += 1
    await asyncio.sleep(latency)
    file = root / request.path.removeprefix("/bench/")
    if not file.is_file():
        return web.Response(status=404, text=MISSING, content_type="application/xml")
    return web.FileResponse(file, headers={"ETag": '"x"'})
async def main():
    app = web.Application()
    app.router.add_get("/{name:.*}", answer)
    runner = web.AppRunner(app)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    print(runner.addresses[0][1], flush=True)
    await asyncio.Event().wait()
asyncio.run(main())
"""

Reader = Callable[[int], dict[str, Any]]


def by_slatprep(_: str) -> Reader:
    return open_store("s3://bench/store").read


def by_zarr(_: str) -> Reader:
    import zarr

    group: Any = zarr.open_group("s3://bench/store", mode="r")
    arrays = {name: group[f"voxel/{name}"] for name in TRAINING_COLUMNS}
    offsets = group["asset/offset"][:].tolist()

    def read(row: int) -> dict[str, Any]:
        rows = slice(offsets[row], offsets[row + 1])
        return {name: array[rows] for name, array in arrays.items()}

    return read


def by_tensorstore(address: str) -> Reader:
    import tensorstore

    offsets = open_store("s3://bench/store").offsets.tolist()
    # Without room for it, the index of a shard is asked for again with every asset.
    context = tensorstore.Context({"cache_pool": {"total_bytes_limit": 2**26}})
    arrays = {
        name: tensorstore.open(
            {
                "driver": "zarr3",
                "recheck_cached_data": "open",
                "recheck_cached_metadata": "open",
                "kvstore": {
                    "driver": "s3",
                    "bucket": "bench",
                    "path": f"store/voxel/{name}/",
                    "endpoint": address,
                    "aws_region": "us-east-1",
                },
            },
            context=context,
            read=True,
        ).result()
        for name in TRAINING_COLUMNS
    }

    def read(row: int) -> dict[str, Any]:
        rows = slice(offsets[row], offsets[row + 1])
        pending = {name: array[rows].read() for name, array in arrays.items()}
        return {name: future.result() for name, future in pending.items()}

    return read


def by_npz(_: str) -> Reader:
    import fsspec

    system = fsspec.filesystem("s3")

    def read(row: int) -> dict[str, Any]:
        with np.load(io.BytesIO(system.cat_file(f"bench/npz/{row}.npz"))) as file:
            return {name: file[name] for name in TRAINING_COLUMNS}

    return read


def by_hdf5(_: str) -> Reader:
    import fsspec
    import h5py

    file = h5py.File(fsspec.filesystem("s3").open("bench/all.h5", block_size=2**20), "r")

    def read(row: int) -> dict[str, Any]:
        return {name: file[str(row)][name][()] for name in TRAINING_COLUMNS}

    return read


def by_webdataset(address: str, assets: int) -> Reader:
    """Return what reads the next asset, whichever was asked for."""
    import webdataset
    from webdataset.gopen import gopen_schemes

    gopen_schemes["http"] = lambda url, mode, bufsize: urllib.request.urlopen(url)
    shards = [f"{address}/tars/{number}.tar" for number in range(-(-assets // IN_TAR))]
    stream = iter(
        webdataset.WebDataset(shards, shardshuffle=len(shards), empty_check=False, seed=0)
        .shuffle(2 * IN_TAR)
        .repeat()
    )

    def read(_: int) -> dict[str, Any]:
        with np.load(io.BytesIO(next(stream)["npz"])) as file:
            return {name: file[name] for name in TRAINING_COLUMNS}

    return read


def write_tars(folder: Path, assets: int) -> None:
    (folder / "tars").mkdir()
    for first in range(0, assets, IN_TAR):
        with tarfile.open(folder / "tars" / f"{first // IN_TAR}.tar", "w") as tar:
            for row in range(first, min(first + IN_TAR, assets)):
                tar.add(folder / "npz" / f"{row}.npz", f"{row}.npz")


IN_TAR = 16
WEBDATASET = "WebDataset"
WAYS = {
    "slatprep": by_slatprep,
    "tensorstore": by_tensorstore,
    "zarr-python": by_zarr,
    "npz": by_npz,
    "one HDF5 file": by_hdf5,
}


def opened(way: str, address: str, assets: int) -> Reader:
    """Open what a way reads: below a folder, or at a server."""
    served = address.startswith("http")
    if way == WEBDATASET:
        return by_webdataset(f"{address}/bench" if served else address, assets)
    if served:
        return WAYS[way](address)
    return next(one for one in local.WAYS if one.name == way).open(Path(address))


def ways(arguments: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        assets = min(arguments.assets, len(open_store(arguments.store)))
        write_forms(arguments.store, folder, assets)
        write_tars(folder, assets)
        (folder / "store").symlink_to(arguments.store.resolve())
        for way in (*WAYS, WEBDATASET):
            check(way, name, arguments.store, assets)
            measured = measure(way, name, arguments, assets)
            print(json.dumps({"from": "disk", "way": way, **measured}), flush=True)
        with serving(folder, arguments.latency) as address:
            for way in (*WAYS, WEBDATASET):
                before = asked(address)
                check(way, address, arguments.store, assets)
                number = round((asked(address) - before) / assets, 1)
                measured = measure(way, address, arguments, assets)
                told = {"from": "S3", "way": way, **measured, "requests an asset": number}
                print(json.dumps(told), flush=True)


def check(way: str, address: str, store: Path, assets: int) -> None:
    """Raise unless a way reads each asset once, with the values that the store has."""
    read, expected = opened(way, address, assets), open_store(store)
    every = sorted(digest(read(row)) for row in range(assets))
    if every != sorted(digest(expected.read(row, TRAINING_COLUMNS)) for row in range(assets)):
        raise RuntimeError(f"{way} reads other values")


def digest(arrays: dict[str, Any]) -> str:
    return hashlib.sha256(b"".join(arrays[name].tobytes() for name in TRAINING_COLUMNS)).hexdigest()


def measure(way: str, address: str, arguments: argparse.Namespace, assets: int) -> dict[str, float]:
    order = np.random.default_rng(0).permutation(assets).tolist()
    row = {}
    for processes in arguments.processes:
        times = [at_once(way, address, order, processes) for _ in range(arguments.repeats)]
        row[f"{processes} at a time [ms]"] = round(1e3 * min(times), 2)
    return row


@contextmanager
def serving(folder: Path, latency: float) -> Iterator[str]:
    command = [sys.executable, "-c", SERVER, str(folder), str(latency)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = f"http://127.0.0.1:{process.stdout.readline().strip()}"
        os.environ |= object_store.environment(address)
        try:
            yield address
        finally:
            process.kill()


def asked(address: str) -> int:
    with urllib.request.urlopen(f"{address}/requests") as answer:
        return int(answer.read())


def at_once(way: str, address: str, order: list[int], processes: int) -> float:
    """Return the seconds that a process takes for an asset, where so many read at a time."""
    context = multiprocessing.get_context("spawn")
    start = context.Barrier(processes + 1)
    parts = [order[number::processes] for number in range(processes)]
    workers = [
        context.Process(target=work, args=(way, address, part, len(order), start)) for part in parts
    ]
    for worker in workers:
        worker.start()
    start.wait(120)
    begin = time.perf_counter()
    for worker in workers:
        worker.join()
    seconds = time.perf_counter() - begin
    if any(worker.exitcode for worker in workers):
        raise RuntimeError(f"a process that reads by {way} failed")
    return seconds / (len(order) / processes)


def work(way: str, address: str, order: list[int], assets: int, start: Any) -> None:
    read = opened(way, address, assets)
    read(order[-1])
    start.wait(120)
    for row in order:
        read(row)
    os._exit(0)  # What a way tears down is not reading.


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    questions = parser.add_subparsers(required=True)
    for run, latency, assets in ((steps, 0.03, 50), (ways, 0.02, 60)):
        question = questions.add_parser(run.__name__)
        question.set_defaults(run=run)
        question.add_argument("store", type=Path)
        question.add_argument("--latency", type=float, default=latency)
        question.add_argument("--assets", type=int, default=assets)
    question.add_argument("--repeats", type=int, default=3)
    question.add_argument("--processes", type=int, nargs="+", default=[1, 2, 4])
    arguments = parser.parse_args()
    arguments.run(arguments)


assert checkout.ROOT  # Importing it made the tests' server known.

if __name__ == "__main__":
    main()
