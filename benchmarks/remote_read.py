"""Reading a store on S3: piece by piece where it lies, or from a copy made once.

    python benchmarks/remote_read.py STORE [--latency 0.03] [--assets 50]

Uploads a local store to moto's server on loopback, which stands in for S3:
each request is made to wait as long as one to S3 does, and nothing limits the
bandwidth. Prints seconds to publish, to open, to read an asset's coords, feats
and properties in shuffled order, and to copy, and the requests each takes.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import checkout
import fsspec
import numpy as np
from s3fs.core import S3FileSystem
from support import object_store

from slatprep.storage.place import place_of
from slatprep.storage.upload import published_state, upload_store
from slatprep.store import Store, open_store

URL = "s3://bench/demo.zarr"

made: list[str] = []


@contextmanager
def server(latency: float) -> Iterator[None]:
    with tempfile.TemporaryDirectory() as cache, object_store.running() as address:
        os.environ |= {**object_store.environment(address), "SLATPREP_CACHE": cache}
        fsspec.filesystem("s3").mkdir("bench")
        call = S3FileSystem._call_s3

        async def later(filesystem: Any, method: str, *args: Any, **options: Any) -> Any:
            made.append(method)
            await asyncio.sleep(latency)
            return await call(filesystem, method, *args, **options)

        S3FileSystem._call_s3 = later
        yield


def report(what: str, step: Callable[[], Any], times: int = 1) -> Any:
    made.clear()
    begin = time.perf_counter()
    result = step()
    seconds = (time.perf_counter() - begin) / times
    print(f"| {what} | {seconds:.4f} | {len(made) / times:.1f} |")
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store", type=Path)
    parser.add_argument("--latency", type=float, default=0.03)
    parser.add_argument("--assets", type=int, default=50)
    arguments = parser.parse_args()
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


assert checkout.ROOT  # Importing it made the tests' server known.

if __name__ == "__main__":
    main()
