"""Kill builds at random times, many of them, and look at what is left after each.

    python benchmarks/soak_kills.py --kills 200 --assets 12

A dataset that keeps changing (an asset appears, changes or goes before each
build) is built into one store, and each build is killed with SIGKILL after a
random time: the whole process group, the parent alone, or one worker. After
every kill the store is opened with plain zarr and read whole, and must be, byte for byte,
one of the stores that an undisturbed build wrote of an earlier or the present state. At
the end a last build runs undisturbed and must equal one from nothing.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import zarr
from checkout import environment
from support.synthetic import Dataset
from support.trees import tree

STATES = 4
ENDED = "ended before its kill, so not counted"
BUILD = """
import sys
from pathlib import Path
from support.synthetic import Dataset
from slatprep import build_store
build_store(Dataset(Path(sys.argv[1])).parameters(), Path(sys.argv[2]), jobs=2)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--assets", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        report = soak(Path(folder), arguments.kills, arguments.assets, arguments.seed)
    print(json.dumps(report, indent=2))


def soak(folder: Path, kills: int, assets: int, seed: int) -> dict[str, object]:
    """Return what became of the builds; raises AssertionError at the first harm."""
    chance = random.Random(seed)
    sources, expected, whole = [], [], 60.0
    for state in range(STATES):
        dataset = Dataset(folder / f"state-{state}")
        for number in range(state, state + assets):
            dataset.add(f"asset-{number:03}", seed=number + (state if number % 5 == 0 else 0))
        sources.append(dataset.root)
        command = build_command(dataset.root, folder / f"reference-{state}.zarr")
        begin = time.perf_counter()
        subprocess.run(command, env=environment(), check=True)
        whole = min(whole, time.perf_counter() - begin)
        expected.append(tree(folder / f"reference-{state}.zarr"))
    allowed = [fingerprint(hashes) for hashes in expected]

    out = folder / "store.zarr"
    shutil.copytree(folder / "reference-0.zarr", out)
    told: Counter[str] = Counter()
    begin = time.perf_counter()
    turn = done = 0
    while done < kills:
        # A state is tried three times, so that builds go on from what was finished.
        state = turn // 3 % STATES
        before = fingerprint(tree(out))
        outcome = killed_build(build_command(sources[state], out), chance, whole)
        after = fingerprint(tree(out))
        assert after in (before, allowed[state]), f"kill {turn}: a store that nobody built"
        read_whole(out)
        told[outcome] += 1
        done += outcome != ENDED
        turn += 1
        told["store replaced" if after != before else "store as before"] += 1
        if sys.stderr.isatty():
            print(f"\r{done} of {kills}", end="", file=sys.stderr)
    subprocess.run(build_command(sources[-1], out), env=environment(), check=True)
    assert tree(out) == expected[-1], "the last build is not what one from nothing is"
    left = {path.name for path in folder.iterdir() if "store" in path.name}
    assert left == {"store.zarr", "store.manifests"}, left
    told["kills"] = done
    return {
        **told,
        "undisturbed build [s]": round(whole, 1),
        "seconds": round(time.perf_counter() - begin, 1),
        "harm": 0,
    }


def killed_build(command: list[str], chance: random.Random, whole: float) -> str:
    """Start a build and kill something of it at a random time; return what."""
    build = subprocess.Popen(
        command, env=environment(), start_new_session=True, stderr=subprocess.DEVNULL
    )
    whom = chance.choice(("all", "parent", "worker"))
    try:
        build.wait(timeout=chance.uniform(0.1, 1.1) * whole)
        return ENDED
    except subprocess.TimeoutExpired:
        pass
    if whom == "worker":
        workers = children(build.pid)
        if workers:
            os.kill(chance.choice(workers), signal.SIGKILL)
            try:
                build.wait(timeout=120)
                return (
                    "a worker killed, and ended well"
                    if build.returncode == 0
                    else "a worker killed, and told so"
                )
            except subprocess.TimeoutExpired as error:
                raise AssertionError("a build hangs after its worker was killed") from error
        whom = "all"
    if whom == "parent":
        build.kill()
    else:
        os.killpg(build.pid, signal.SIGKILL)
    build.wait()
    return f"{whom} killed"


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


def build_command(sources: Path, out: Path) -> list[str]:
    return [sys.executable, "-c", BUILD, str(sources), str(out)]


def fingerprint(hashes: dict[str, str]) -> str:
    return hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()


if __name__ == "__main__":
    main()
