"""Try to harm a build or a reader in ways that need more than a damaged file.

    python benchmarks/doors.py cluster|multipart|slow|swapped
    python benchmarks/doors.py clock --faketime /usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1

cluster: a worker, then the scheduler, of a Dask cluster is killed at each step of a build to S3.
multipart: a store with files of 40 and 112 MiB goes to S3 in parts of 16 MiB; requests fail.
slow: every connection to S3 carries 1,000 bytes per second; stalled: S3 accepts calls but does not
answer.
swapped: S3 answers for one file of a store with the same file of another store of equal shape.
clock: sources change, and the clock is set an hour back or forward between two builds.

Each run must end as without faults, or in an error in words with the old store whole; the same run
without faults must then succeed. Prints the number of each outcome; harm makes the exit code 1.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import checkout
import fsspec
import numpy as np
from support import object_store
from support.dask_processes import Processes, wait_for_workers
from support.faulty_proxy import Faults, faulty
from support.remote import current, put
from support.synthetic import Dataset
from support.trees import tree

from slatprep.errors import SlatprepError
from slatprep.inspect.verify import verify_store
from slatprep.pipeline.dataset import build_store
from slatprep.storage.place import place_of
from slatprep.storage.versions import read_pointer
from slatprep.store import open_store

URL = "s3://bench/stores/s.zarr"
SECONDS_A_COMMAND = 400

IN_WORKERS = ("asset begun", "asset read", "asset aligned", "asset spooled", "shard begun",
              "shard filled", "shard written")  # fmt: skip
STEPS = (*IN_WORKERS, "work folder made", "work folder locked", "asset compared", "store created",
         "records written", "manifests written", "manifests published", "store replaced",
         "pointer replaced")  # fmt: skip


class Told(Counter[str]):
    """How often what came of it, and what was harm."""

    def harm(self, what: str) -> None:
        self["harm"] += 1
        print(what, file=sys.stderr, flush=True)


@contextmanager
def s3_server(folder: Path, faults: Faults) -> Iterator[Any]:
    """Run S3 behind the proxy; yield a file system that goes past the proxy."""
    with object_store.running() as server, faulty(server, faults) as proxy:
        os.environ |= object_store.environment(proxy) | {"SLATPREP_CACHE": str(folder / "cache")}
        direct = fsspec.filesystem("s3", endpoint_url=server, use_listings_cache=False)
        direct.mkdir("bench")
        yield direct


def made(folder: Path, objects: str, seed: int = 0) -> Dataset:
    dataset = Dataset(folder)
    for number, name in enumerate(objects):
        dataset.add(name, number + seed)
    return dataset


def build(dataset: Dataset, out: object) -> None:
    build_store(dataset.parameters("pixie"), out, strict=True)  # type: ignore[arg-type]


def command(config: Path, out: object, *more: str, **variables: str) -> tuple[int, str]:
    """Run a build; return its exit code and what it said. A hang is exit code 124."""
    line = [sys.executable, "-m", "slatprep", "build-store", "--config", str(config)]
    try:
        done = subprocess.run(
            [*line, "--out", str(out), *more], env={**checkout.environment(), **variables},
            capture_output=True, text=True, check=False, timeout=SECONDS_A_COMMAND,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return 124, "hangs"
    return done.returncode, done.stderr


def config_of(dataset: Dataset) -> Path:
    path = dataset.root / "dataset.toml"
    path.write_text(
        '[pixieverse]\nroot = "pixieverse"\n[slat]\nroot = "slat"\n[normalize]\nranges = "pixie"\n'
        "[store]\nvoxel_chunk = 128\nvoxel_chunks_per_shard = 4\ngrid_assets_per_shard = 2\n"
        "compression_level = 1\n"
    )
    return path


def try_cluster(folder: Path, told: Told, whose: tuple[str, ...], only: list[str]) -> None:
    new, old = made(folder / "new", "abc"), made(folder / "old", "ab")
    for dataset in (new, old):
        build(dataset, dataset.root / "s.zarr")
    old_tree, new_tree = tree(old.root / "s.zarr"), tree(new.root / "s.zarr")
    config = config_of(new)
    with s3_server(folder, Faults()) as s3:
        for whom in whose:
            for number, step in enumerate(only or (IN_WORKERS if whom == "worker" else STEPS)):
                with suppress(FileNotFoundError):
                    s3.rm(URL, recursive=True)
                shutil.rmtree(folder / "cache", ignore_errors=True)
                put(old.root / "s.zarr", URL)
                what = f"{whom} killed at {step!r}"
                for attempt in ("killed", "again"):
                    cluster = folder / f"{whom}-{number}-{attempt}"
                    cluster.mkdir()
                    processes = Processes(cluster)
                    try:
                        address = processes.scheduler()
                        for _ in range(2):
                            processes.worker_elsewhere(address, folder / "nowhere")
                        wait_for_workers(address, 2)
                        pid = str(processes.pids[0]) if whom == "scheduler" else ""
                        kill = cluster / f"kill at {step}"
                        if attempt == "killed":
                            kill.write_text(pid)
                        path = f"{os.environ['PYTHONPATH']}{os.pathsep}{cluster}"
                        code, said = command(
                            config, URL, "--scheduler", address, "--strict",
                            SLATPREP_FAULTS="faults:reached", PYTHONPATH=path,
                        )  # fmt: skip
                        struck = not kill.exists()
                    finally:
                        processes.stop()
                    now = current(s3, URL)
                    if code == 124 or "Traceback" in said or "internal error" in said:
                        told.harm(f"{what}, {attempt}: {code} {said[-1500:]}")
                    if now not in (old_tree, new_tree) or (code == 0 and now != new_tree):
                        told.harm(f"{what}, {attempt}: a store that nobody built")
                    if attempt == "again":
                        if code or now != new_tree:
                            told.harm(f"{what}: the next build fails: {said[-1500:]}")
                        pointer = read_pointer(place_of(URL))
                        left = [n for n in s3.find(URL) if pointer.version not in n
                                and pointer.previous not in n]  # type: ignore  # fmt: skip
                        if [n for n in left if not n.endswith("current.json")]:
                            told.harm(f"{what}: left behind: {left[:5]}")
                    else:
                        came = "ended well" if code == 0 else "told so, old store whole"
                        if code and now == new_tree:
                            came = "told so, new store in sight"
                        told[f"{whom}: {came if struck else 'step not reached'}"] += 1
                    print(what, attempt, code, said.strip().splitlines()[-1:], flush=True)


def try_multipart(folder: Path, told: Told) -> None:
    dataset = made(folder / "data", "a")
    store = folder / "s.zarr"
    build(dataset, store)
    for name, size in (("voxel/feats/c/0/0", 112), ("voxel/coords/c/0/0", 40)):
        (store / name).write_bytes(np.random.default_rng(size).bytes(size * 2**20))
    expected, faults = tree(store), Faults(only=r"partNumber|uploadId|uploads")
    with s3_server(folder, faults) as s3:
        for kind in ("", "upload flipped", "500", "503", "reset", "lost", "twice", "403", "kill"):
            for chance in (0.1, 0.4):
                with suppress(FileNotFoundError):
                    s3.rm(URL, recursive=True)
                faults.kinds, faults.seed = (kind,), f"{kind} {chance}"
                faults.chance = chance if kind not in ("", "kill") else 0.0
                if kind == "kill":
                    outcome = killed_upload(store, 1.0 + 8 * chance)
                else:
                    try:
                        put(store, URL)
                        outcome = "as without faults"
                    except SlatprepError as error:
                        outcome = "refused"
                        print(kind, chance, error, flush=True)
                faults.chance = 0.0
                there = s3.exists(f"{URL}/current.json")
                if there != (outcome == "as without faults") and outcome != "killed":
                    told.harm(f"{kind}: {outcome}, but a store is there: {there}")
                if there and current(s3, URL) != expected:
                    told.harm(f"{kind}: {outcome}, and what is there is another")
                told[f"{kind or 'no fault'}: {outcome}"] += 1
                put(store, URL)
                if current(s3, URL) != expected:
                    told.harm(f"{kind}: what is put after it is another")
    told["faults"] = sum(faults.told.values())


def killed_upload(store: Path, seconds: float) -> str:
    """Kill an upload after a time."""
    line = (
        "from pathlib import Path; from support.remote import put; "
        f"put(Path({str(store)!r}), {URL!r})"
    )
    with subprocess.Popen([sys.executable, "-c", line], env=checkout.environment()) as running:
        with suppress(subprocess.TimeoutExpired):
            running.wait(seconds)
        running.kill()
    return "killed" if running.returncode == -signal.SIGKILL else "as without faults"


def try_stalled(folder: Path, told: Told) -> None:
    try_slow(folder, told, rate=-1.0, only=("first build", "read"))


def try_slow(folder: Path, told: Told, rate: float = 1000.0, only: tuple[str, ...] = ()) -> None:
    dataset, faults = made(folder / "data", "a"), Faults()
    local = dataset.root / "s.zarr"
    build(dataset, local)
    expected = tree(local)
    print(f"the store has {sum((local / name).stat().st_size for name in expected):,} bytes")
    os.environ["AWS_MAX_ATTEMPTS"] = "2"
    with s3_server(folder, faults) as s3:
        works: dict[str, Callable[[], object]] = {
            "first build": lambda: build(dataset, URL),
            "nothing changed": lambda: build(dataset, URL),
            "read": lambda: values(URL),
            "verify": lambda: verify_store(URL).findings,
            "copy": lambda: tree(Path(str(open_store(URL, copy=True).path))),
        }
        wanted = {"read": values(local), "verify": (), "copy": expected}
        for name, work in works.items():
            if only and name not in only:
                continue
            # A first build over nothing, and without what another has read before.
            shutil.rmtree(folder / "cache", ignore_errors=True)
            if name == "first build" and s3.exists(URL):
                s3.rm(URL, recursive=True)
            faults.rate, begin = rate, time.monotonic()
            try:
                came = work()
                outcome = "as at full speed"
                if came != wanted.get(name):
                    told.harm(f"{name} at {rate} B/s gives something else")
            except SlatprepError as error:
                outcome = "refused"
                print(error, flush=True)
            took = time.monotonic() - begin
            faults.rate = 0.0
            print(f"{name}, {rate:.0f} B/s: {outcome} after {took:.0f} s", flush=True)
            told[f"{name}, {rate:.0f} B/s: {outcome} after {took:.0f} s"] += 1
            if not s3.exists(f"{URL}/current.json"):
                build(dataset, URL)
            if current(s3, URL) != expected:
                told.harm(f"{name} at {rate} B/s spoils the store")


def values(path: object) -> list[str]:
    store = open_store(path)  # type: ignore[arg-type]
    return [
        hashlib.sha256(array.tobytes()).hexdigest()
        for row in range(len(store.ids))
        for array in store.read(row).values()
    ]


def try_swapped(folder: Path, told: Told) -> None:
    """Two stores whose files have equal names, of assets whose arrays have equal shapes."""
    ours, theirs = made(folder / "ours", "abc"), made(folder / "theirs", "abc", seed=4)
    for dataset in (ours, theirs):
        build(dataset, dataset.root / "s.zarr")
    expected, other = tree(ours.root / "s.zarr"), tree(theirs.root / "s.zarr")
    wanted = values(ours.root / "s.zarr")
    with s3_server(folder, Faults()) as s3:
        for name in sorted(n for n in expected if other.get(n) not in (None, expected[n])):
            # The first shard of each large array, and some columns, stand for the others.
            if not name.endswith(("c/0", "c/0/0", "c/0/0/0/0")) or (
                name.startswith("asset/") and name.split("/")[1] not in ("record", "offset", "id")
            ):
                continue
            for what in ("read", "copy", "verify", "update"):
                shutil.rmtree(folder / "cache", ignore_errors=True)
                with suppress(FileNotFoundError):
                    s3.rm(URL, recursive=True)
                version = put(ours.root / "s.zarr", URL)
                s3.pipe_file(f"{version}/{name}", (theirs.root / "s.zarr" / name).read_bytes())
                try:
                    if what == "read":
                        same = values(URL) == wanted
                    elif what == "copy":
                        same = tree(Path(str(open_store(URL, copy=True).path))) == expected
                    elif what == "verify":
                        same = not verify_store(URL).findings
                    else:
                        if not (ours.root / "pixieverse/d").exists():
                            ours.add("d", 3)
                            build(ours, folder / "more.zarr")
                        build(ours, URL)
                        same = values(URL) == values(folder / "more.zarr")
                    outcome = "as it should be" if same else "another's, unnoticed"
                    if what == "verify":
                        outcome = "unnoticed" if same else "found"
                except SlatprepError:
                    outcome = "refused"
                if "unnoticed" in outcome:
                    print(f"{what} {name}: {outcome}", flush=True)
                    told[f"of these {name}"] += 1
                told[f"{what}: {outcome}"] += 1


def try_clock(folder: Path, told: Told, faketime: str) -> None:
    def shifted(shift: str) -> dict[str, str]:
        fake = {"LD_PRELOAD": faketime, "FAKETIME": shift, "NO_FAKE_STAT": "1"}
        return fake if shift else {}

    for first, second in (("", "-1h"), ("+1h", "")):
        for way in ("rewritten", "with its old time", "renamed over", "new", "gone", "nothing"):
            data = made(folder / f"{first}{second}{way}", "ab")
            config, out = config_of(data), data.root / "s.zarr"
            codes = [command(config, out, **shifted(first))[0]]
            slat = data.root / "slat/b.npz"
            before = slat.stat()
            if way in ("rewritten", "with its old time", "renamed over"):
                feats = data.assets["b"].feats[::-1].copy()
                name = "b.npz" if way != "renamed over" else "other.npz"
                data.write_slat(name, data.assets["b"].coords, feats)
                if way == "renamed over":
                    (data.root / "slat/other.npz").rename(slat)
                if way != "rewritten":
                    os.utime(slat, ns=(before.st_atime_ns, before.st_mtime_ns))
            elif way == "new":
                data.add("c", 2)
            elif way == "gone":
                slat.unlink()
            codes.append(command(config, folder / "fresh.zarr", "--fresh")[0])
            for shift in (second, ""):
                codes.append(command(config, out, "--compact", **shifted(shift))[0])
                if tree(out) != tree(folder / "fresh.zarr"):
                    told.harm(f"clock {first or 'right'}, then {shift or 'right'}, {way}: differs")
                told["builds after a change"] += 1
            if way != "gone" and any(codes):
                told.harm(f"clock {first}, {second}, {way}: exit codes {codes}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ways = {"multipart": try_multipart, "slow": try_slow,
            "stalled": try_stalled, "swapped": try_swapped}  # fmt: skip
    parser.add_argument("door", choices=[*ways, "clock", "cluster"])
    parser.add_argument("--whom", action="append", choices=("worker", "scheduler"))
    parser.add_argument("--step", action="append", choices=STEPS, help="kill at these alone")
    parser.add_argument("--faketime", default="", help="the library of libfaketime, for the clock")
    given = parser.parse_args()
    os.environ |= checkout.environment()
    told, begin = Told(), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="doors-") as folder:
        if given.door == "clock":
            try_clock(Path(folder), told, given.faketime)
        elif given.door == "cluster":
            whose = tuple(given.whom or ("worker", "scheduler"))
            try_cluster(Path(folder), told, whose, given.step or [])
        else:
            ways[given.door](Path(folder), told)
    told["seconds"] = round(time.monotonic() - begin)
    print(json.dumps(dict(sorted(told.items())), indent=2))
    sys.exit(bool(told["harm"]))


if __name__ == "__main__":
    main()
