"""Build on disks that become full: the old or the new store must exist, and one line must say why.

    python benchmarks/full_disk.py --minutes 5 --seed 1

Each try mounts a tmpfs with too few bytes, or too few inodes, and builds, updates,
exports or reports on it. Mounting needs root; without it the script says so and ends.
Afterwards the disk is enlarged, and the same command must give the same result as on any
other disk. Every harm is printed, and makes the exit code 1.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import checkout
from support.synthetic import Dataset
from support.trees import tree

COMMANDS = {
    "build-store": ("--out", "{disk}/s.zarr"),
    "export": ("--format", "npz", "--out", "{disk}/npz"),
    "report": ("--out", "{disk}/r.html"),
    "publish": ("--out", "{disk}/hub", "--pictures", "1"),
}


def run(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "slatprep", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


def mount(disk: Path, options: str) -> bool:
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(disk)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def one_try(disk: Path, sources: list[str], sound: Path, chance: random.Random) -> tuple[str, str]:
    """Run a command on a small disk; return what came of it, and the harm, if any."""
    name = chance.choice(list(COMMANDS))
    small = chance.choice((f"size={chance.randrange(16, 4000)}k,nr_inodes=9999",
                           f"size=64m,nr_inodes={chance.randrange(3, 300)}"))  # fmt: skip
    if not mount(disk, small):
        return "not mounted", ""
    try:
        older = None
        if name == "build-store" and chance.random() < 0.5:
            subprocess.run(
                ["mount", "-o", "remount,size=64m,nr_inodes=9999", str(disk)], check=True
            )
            run("build-store", *sources, "--out", disk / "s.zarr", "-q")
            older = tree(disk / "s.zarr")
            subprocess.run(["mount", "-o", f"remount,{small}", str(disk)], check=False)
        given = sources if name == "build-store" else [str(sound)]
        options = [word.format(disk=disk) for word in COMMANDS[name]]
        fresh = ["--fresh"] if older else []
        done = run(name, *given, *options, *fresh)
        what = f"{name} on {small}: exit code {done.returncode}"
        if "Traceback" in done.stderr or done.returncode not in (0, 1):
            return what, f"{what}\n{done.stderr[-2000:]}"
        there = disk / "s.zarr"
        if older and (not there.exists() or tree(there) not in (older, tree(sound))):
            return what, f"{what}: neither the old store nor the new one"
        subprocess.run(["mount", "-o", "remount,size=64m,nr_inodes=9999", str(disk)], check=True)
        again = run(name, *given, *options)
        if again.returncode:
            return what, f"{what}, and then with room: {again.stderr[-500:]}"
        if name == "build-store" and tree(there) != tree(sound):
            return what, f"{what}: with room, another store than anywhere else"
        return f"{name}: exit code {done.returncode}", ""
    finally:
        subprocess.run(["umount", str(disk)], check=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    chance, told, harm = random.Random(given.seed), Counter[str](), []
    folder = Path(tempfile.mkdtemp(prefix="full-disk-"))
    try:
        disk = folder / "disk"
        disk.mkdir()
        if not mount(disk, "size=16k"):
            print("no disk can be mounted here (that needs root): nothing was tried")
            return
        subprocess.run(["umount", str(disk)], check=True)
        dataset = Dataset(folder / "sources").having(*"abc")
        root = dataset.root
        sources = ["--pixieverse", str(root / "pixieverse"), "--slat", str(root / "slat")]
        run("build-store", *sources, "--out", folder / "sound.zarr", "-q")
        until = time.monotonic() + 60 * given.minutes
        while time.monotonic() < until:
            what, fault = one_try(disk, sources, folder / "sound.zarr", chance)
            told[what] += 1
            harm += [fault] if fault else []
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print(*harm, sep="\n", file=sys.stderr)
    print(json.dumps({"tries": sum(told.values()), "harm": len(harm), **told}, indent=2))
    sys.exit(bool(harm))


assert checkout.ROOT  # Importing it made the tests' data known.

if __name__ == "__main__":
    main()
