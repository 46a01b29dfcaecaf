"""Kill many builds, at random times or in a given phase, and check the files that remain.

    python benchmarks/soak_kills.py --kills 200 --assets 12
    python benchmarks/soak_kills.py --phase pack --phase publish --minutes 20 --seed 3
    python benchmarks/soak_kills.py --phase pack --dask --minutes 20

A dataset that keeps changing (an asset appears, changes or goes before each build) is built into
one store, and each build is killed with SIGKILL: the whole process group, the parent alone, or
one worker. The kill comes after a random time or, with --phase, at a random step of the
phase. With --dask two workers of a Dask cluster compute, which outlives the builds.

After every kill, plain zarr opens the store and reads all of it. The store must equal, byte for
byte, the store of an undisturbed build of an earlier or the present state; of the present state, if
the build ended well. The records beside it must be those of the undisturbed build, or `verify` must
find that they belong to another build. At the end a last build runs undisturbed and must equal a
build from nothing. Builds sort rows by id.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from multiprocessing.context import ForkProcess as Running
from pathlib import Path

import aimed_kill
import zarr
from checkout import ROOT, environment
from joblib.externals.loky.backend.context import set_start_method
from support.synthetic import Dataset
from support.trees import records_of, tree

from slatprep.inspect.verify.manifests import manifest_findings
from slatprep.pipeline.dataset import build_store
from slatprep.storage.faults import VARIABLE
from slatprep.store import open_store
from slatprep.store.records import manifests_of
from slatprep.workers.dask import Cluster
from slatprep.workers.local import Jobs

PHASES = {
    "plan": ("asset compared",),
    "finish": ("asset begun", "asset read", "asset aligned", "asset reused", "asset spooled"),
    "pack": ("store created", "shard begun", "shard filled", "shard written", "records written"),
    "publish": (
        "directory flushed", "directory exchanged", "store replaced",
        "manifests written", "manifests published",
    ),
}  # fmt: skip
"""Steps of a build by phase, as `slatprep.storage.faults` names them."""

STATES = 4
SAID = "said"
"""File with what the last build printed as an error."""

ENDED = "ended before its kill, so not counted"
CLUSTER = """
import subprocess, sys, threading
from distributed import LocalCluster
def work(address):
    line = [sys.executable, "-m", "distributed.cli.dask_worker", address]
    while not ending.is_set():
        subprocess.run(
            [*line, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "30"],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
if __name__ == "__main__":
    ending = threading.Event()
    with LocalCluster(
        n_workers=0, protocol="tcp://", dashboard_address=None, silence_logs=50
    ) as started:
        for _ in range(2):
            threading.Thread(target=work, args=[started.scheduler_address], daemon=True).start()
        print(started.scheduler_address, flush=True)
        sys.stdin.read()
        ending.set()
"""
"""A cluster in an interpreter of its own: builds are forked from a process without threads. A Dask
nanny that fails once to start a worker again gives up; these are started again without end."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after these")
    parser.add_argument("--assets", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--phase", action="append", choices=PHASES, help="aim at; may be repeated")
    parser.add_argument("--dask", action="store_true", help="compute on a Dask cluster")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="soak-") as name:
        folder = Path(name)
        (folder / "aims").mkdir()
        os.environ |= environment() | {aimed_kill.FOLDER: str(folder / "aims")}
        os.environ["PYTHONPATH"] += f"{os.pathsep}{ROOT / 'benchmarks'}"
        aimed_kill.aim(folder / "aims", "none", 0, "self")
        with cluster() if given.dask else no_cluster() as scheduler:
            report = soak(folder, given, scheduler)
    print(json.dumps(report, indent=2))


@contextmanager
def cluster() -> Iterator[str]:
    """Run two workers that stand at the seam, and are started again when they are killed."""
    variables = {**os.environ, VARIABLE: "aimed_kill:reached"}
    with subprocess.Popen(
        [sys.executable, "-c", CLUSTER], env=variables, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    ) as started:  # fmt: skip
        assert started.stdin is not None and started.stdout is not None
        yield started.stdout.readline().strip()
        started.stdin.close()


@contextmanager
def no_cluster() -> Iterator[str]:
    yield ""


def soak(folder: Path, given: argparse.Namespace, scheduler: str) -> dict[str, object]:
    """Return what became of the builds; raises AssertionError at the first harm."""
    chance = random.Random(given.seed)
    sources, expected, records, whole = [], [], [], 60.0
    for state in range(STATES):
        dataset = Dataset(folder / f"state-{state}")
        # From 0 to 1 and from 2 to 3 an asset is added alone, of values that there are already: so
        # the ranges stay, and with them all other records.
        gone, more = divmod(state, 2)
        for number in range(gone, gone + given.assets):
            dataset.add(f"asset-{number:03}", seed=number + (gone if number % 5 == 0 else 0))
        if more:
            dataset.add(f"asset-{gone + given.assets:03}", seed=gone + 1)
        sources.append(dataset.root)
        begin = time.perf_counter()
        # In this process: what it has imported and compiled is there in those forked from it.
        build(dataset.root, folder / f"reference-{state}.zarr", jobs=1)
        whole = min(whole, time.perf_counter() - begin)
        expected.append(tree(folder / f"reference-{state}.zarr"))
        records.append(records_beside(folder / f"reference-{state}.zarr"))
    allowed = [fingerprint(hashes) for hashes in expected]

    out, now = folder / "store.zarr", folder / "now"
    shutil.copytree(folder / "reference-0.zarr", out)
    lines = manifests_of(out) / "assets.jsonl"
    told: Counter[str] = Counter()
    begin = time.perf_counter()
    turn = done = 0
    while done < given.kills and time.perf_counter() - begin < 60 * given.minutes:
        # A state is tried three times, so that builds go on from what was finished.
        state = turn // 3 % STATES
        if turn % 6 == 3:
            # Others are added behind the records of a build that read all sources and ended well.
            put(sources[state - 1], now)
            assert ended(begun(now, out, scheduler, fresh=True), 300) == 0, "a build fails"
        put(sources[state], now)
        before, added_to = fingerprint(tree(out)), file_of(lines)
        if given.phase:
            start = partial(begun, now, out, scheduler)
            outcome, code = aimed_build(start, chance, given, folder / "aims")
        else:
            outcome, code = killed_build(begun(now, out, scheduler), chance, whole)
        told_by_it = (out.parent / SAID).read_text()
        assert code == 0 or outcome != ENDED, f"build {turn}, that nobody killed: {told_by_it}"
        after = fingerprint(tree(out))
        wanted = (allowed[state],) if code == 0 else (before, allowed[state])
        assert after in wanted, f"kill {turn} ({outcome}): a store that nobody built"
        read_whole(out)
        found = [str(one) for one in manifest_findings(open_store(out), lines.parent)]
        assert code != 0 or not found, f"build {turn} ended well ({outcome}), but {found}"
        beside = found or records_beside(out)
        assert found or beside == records[allowed.index(after)], f"kill {turn}: other records"
        number, size = file_of(lines)
        if number == added_to[0] and size > added_to[1]:
            told["lines added to the file of records"] += 1
        told["records that verify names" if found else "records as they should be"] += 1
        told[outcome] += 1
        done += outcome != ENDED
        turn += 1
        told["store replaced" if after != before else "store as before"] += 1
        if sys.stderr.isatty():
            print(f"\r{done} of {given.kills}", end="", file=sys.stderr)
    put(sources[-1], now)
    assert ended(begun(now, out, scheduler), 300) == 0, "the last build fails"
    other = sorted({name for name, _ in tree(out).items() ^ expected[-1].items()})
    told_of = {name: record.get("reason") for name, record in records_of(lines).items()}
    assert not other, f"the last build is not what one from nothing is: {other}, {told_of}"
    assert records_beside(out) == records[-1], "the last build's records are other ones"
    left = {path.name for path in folder.iterdir() if "store" in path.name}
    assert left == {"store.zarr", "store.manifests"}, left
    return {
        **dict(sorted(told.items())),
        "kills": done,
        "undisturbed build [s]": round(whole, 1),
        "seconds": round(time.perf_counter() - begin, 1),
        "harm": 0,
    }


def put(sources: Path, now: Path) -> None:
    """Have `now` hold these sources: a dataset stays in one place, or nothing of it is trusted."""
    shutil.rmtree(now, ignore_errors=True)
    shutil.copytree(sources, now)


def aimed_build(
    start: Callable[..., Running], chance: random.Random, given: argparse.Namespace, aims: Path
) -> tuple[str, int]:
    """Run a build that is killed at a step; return what was killed where, and the exit code."""
    phase = chance.choice(given.phase)
    step, whom = chance.choice(PHASES[phase]), chance.choice(("self", "parent", "all"))
    # Two processes share the assets, and what is finished is not done again.
    calls = chance.randrange(given.assets // 2) if step.startswith(("asset", "shard")) else 0
    aimed_kill.aim(aims, step, calls, whom)
    running = start(faults="aimed_kill:reached")
    code = ended(running, 300)
    if code is None and running.pid is not None:
        os.killpg(running.pid, signal.SIGKILL)  # Else it would hold on to the cluster.
    assert code is not None, f"a build hangs after a kill at {step!r}, {whom}"
    # Workers of a cluster outlive it: with an aim that nothing has met they would go for a process
    # that is gone, which is an error in the asset that they do for the next build.
    (aims / "parent").unlink(missing_ok=True)
    return (f"{phase}, {step}: {whom} killed" if aimed_kill.struck(aims) else ENDED), code


def killed_build(build: Running, chance: random.Random, whole: float) -> tuple[str, int]:
    """Kill something of a build at a random time; return what, and the exit code."""
    whom = chance.choice(("all", "parent", "worker"))
    code = ended(build, chance.uniform(0.1, 1.1) * whole)
    if code is not None:
        return ENDED, code
    assert build.pid is not None
    if whom == "worker":
        workers = children(build.pid)
        if workers:
            os.kill(chance.choice(workers), signal.SIGKILL)
            code = ended(build, 120)
            assert code is not None, "a build hangs after its worker was killed"
            return f"a worker killed, and {'ended well' if code == 0 else 'told so'}", code
        whom = "all"
    if whom == "parent":
        build.kill()
    else:
        os.killpg(build.pid, signal.SIGKILL)
    code = ended(build, 120)
    assert code is not None
    return f"{whom} killed", code


def begun(
    sources: Path, out: Path, scheduler: str = "", faults: str = "", fresh: bool = False
) -> Running:
    """Begin a build in a process group of its own.

    It is forked, as its workers are: to start three interpreters and load compiled kernels takes
    longer than such a build.
    """
    running = multiprocessing.get_context("fork").Process(
        target=_build_apart, args=(sources, out, scheduler, faults, fresh)
    )
    running.start()
    assert running.pid is not None
    with suppress(ProcessLookupError, PermissionError):  # Whoever is first, it or we.
        os.setpgid(running.pid, running.pid)
    return running


def _build_apart(sources: Path, out: Path, scheduler: str, faults: str, fresh: bool) -> None:
    os.setpgid(0, 0)
    os.dup2(os.open(out.parent / SAID, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    set_start_method("fork")
    if faults:
        os.environ[VARIABLE] = faults
        aimed_kill.begin()
    code = 1
    try:
        with Cluster(scheduler) if scheduler else nullcontext(2) as jobs:
            build(sources, out, jobs, fresh)
        code = 0
    except Exception:
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)  # Else it would wait for workers that are idle; they see that it is gone.


def build(sources: Path, out: Path, jobs: Jobs, fresh: bool = False) -> None:
    build_store(Dataset(sources).parameters(), out, jobs=jobs, compact=True, fresh=fresh)


def ended(build: Running, seconds: float) -> int | None:
    """Return a build's exit code; None if it takes longer than this."""
    build.join(seconds)
    return build.exitcode


def children(pid: int) -> list[int]:
    """Return the worker processes of a build."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            name = (path / "cmdline").read_bytes()
        except (OSError, ValueError, IndexError):
            continue
        if parent == pid and b"resource_tracker" not in name:
            found.append(int(path.name))
    return found


def read_whole(path: Path) -> None:
    """Read every value of a store with plain zarr."""
    group = zarr.open_group(path, mode="r")
    rows = int(group["asset/offset"][-1])
    for _, part in group.members(max_depth=None):
        if isinstance(part, zarr.Array):
            assert part[...].shape == part.shape
    assert group["voxel/coords"].shape[0] == rows


def records_beside(store: Path) -> dict[str, dict[str, object]]:
    """Return the records beside a store by asset id."""
    return records_of(manifests_of(store) / "assets.jsonl")


def file_of(path: Path) -> tuple[int, int]:
    """Return the inode and size of a file; zeros where there is none."""
    try:
        return path.stat().st_ino, path.stat().st_size
    except FileNotFoundError:
        return 0, 0


def fingerprint(hashes: dict[str, str]) -> str:
    return hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()


if __name__ == "__main__":
    main()
