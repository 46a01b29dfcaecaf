"""Measure cost, memory and files of builds and updates by number of assets.

    python benchmarks/scale.py 100 1000 10000
    slatprep make-demo demo --assets 24 && python benchmarks/scale.py 10000 --like demo

Sources are small synthetic assets, or those of a demo (``--like``), which are as large as
PixieVerse's; their files are linked, so that any number fits on a disk. Time is CPU time of the
build and its workers. The second build finds no changes, the third gets new assets (``--new``),
the fourth loses an asset.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from checkout import environment
from support.synthetic import Dataset, make_asset

VARIANTS = 8
BUILD = """
import json, resource, sys, time
from pathlib import Path
from dataclasses import replace
from support.synthetic import Dataset
from slatprep.parameters import StoreParameters
from slatprep.pipeline.dataset import build_store

started = time.process_time()
parameters = replace(Dataset(Path(sys.argv[1])).parameters(), store=StoreParameters())
summary = build_store(parameters, Path(sys.argv[2]), jobs=2, assets_per_job=32)
if "joblib" in sys.modules:  # So that its workers end, and their time is counted.
    from joblib.externals.loky import get_reusable_executor
    get_reusable_executor().shutdown()
peak = lambda who: resource.getrusage(who).ru_maxrss / 1024
print(json.dumps({
    "parent [MB]": round(peak(resource.RUSAGE_SELF)),
    "worker [MB]": round(peak(resource.RUSAGE_CHILDREN)),
    "start [s]": round(started, 1),
    "assets": summary.statuses["ok"],
}))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("assets", type=int, nargs="+")
    parser.add_argument("--new", type=int, default=50, help="assets that the update adds")
    parser.add_argument("--folder", type=Path, help="where to work")
    parser.add_argument("--like", type=Path, help="a demo whose assets are taken")
    arguments = parser.parse_args()
    rows = []
    for count in arguments.assets:
        with tempfile.TemporaryDirectory(prefix="scale-", dir=arguments.folder) as folder:
            rows.append(measure(Path(folder), count, arguments.new, arguments.like))
            print(json.dumps(rows[-1]), flush=True)
    if len(rows) < 2:
        return
    counts = np.array([row["assets"] for row in rows], dtype=float)
    for name in ("CPU [s]", "CPU, nothing changed [s]", "parent [MB]", "store [MB]"):
        values = np.array([row[name] for row in rows])
        slope, start = np.polyfit(counts, values, 1)
        worst = np.abs(values - start - slope * counts).max() / values.max()
        print(f"{name}: {start:.2f} + {slope:.5f} an asset, off by at most {worst:.1%}")


def measure(folder: Path, count: int, new: int, like: Path | None) -> dict[str, float]:
    dataset = Dataset(folder / "sources")
    shapes = sorted(path.stem for path in like.glob("slat/*.npz")) if like else []
    gone = f"m{count // 2:06}"
    for number in range(count):
        add(dataset, number, "m", like, shapes)
    # It goes later, and to take a link away would change the state of the files that share it.
    for path in files_of(dataset.root, gone):
        content = path.read_bytes()
        path.unlink()
        path.write_bytes(content)
    out = folder / "s.zarr"
    spent, first = build(dataset.root, out)
    files = [path.stat().st_size for path in out.rglob("*") if path.is_file()]
    begin = time.perf_counter()
    code = f"from slatprep.store import open_store; len(open_store({str(out)!r}))"
    subprocess.run([sys.executable, "-c", code], check=True, env=environment())
    row = {
        "assets": count,
        "CPU [s]": spent,
        "parent [MB]": first["parent [MB]"],
        "worker [MB]": first["worker [MB]"],
        "start of a process, CPU [s]": first["start [s]"],
        "written [MB]": first["written [MB]"],
        "files": len(files),
        "store [MB]": round(sum(files) / 1e6, 2),
        "records [MB]": round(
            sum(f.stat().st_size for f in (folder / "s.manifests").glob("*.jsonl")) / 1e6, 2
        ),
        "open, with start of Python [s]": round(time.perf_counter() - begin, 2),
    }
    row["CPU, nothing changed [s]"], again = build(dataset.root, out)
    row["parent, nothing changed [MB]"] = again["parent [MB]"]
    row["written, nothing changed [MB]"] = again["written [MB]"]
    # Ids in between the others, in files of their own: a new link to a file changes its state.
    for number in range(new):
        add(dataset, number, "mm", like, shapes)
    row[f"CPU, {new} new [s]"], added = build(dataset.root, out)
    row[f"written, {new} new [MB]"] = added["written [MB]"]
    shutil.rmtree(dataset.root / "pixieverse" / gone)
    (dataset.root / "slat" / f"{gone}.npz").unlink()
    row["CPU, one gone [s]"], less = build(dataset.root, out)
    if less["assets"] != count + new - 1:
        raise RuntimeError(f"{less} after {count} and {new} assets, less one")
    shutil.rmtree(out)
    return row


def add(
    dataset: Dataset, number: int, prefix: str, like: Path | None, shapes: Sequence[str]
) -> None:
    """Add an asset: one of a few shapes, by links to the files of the first of that shape."""
    variants = len(shapes) or VARIANTS
    name, first = f"{prefix}{number:06}", f"{prefix}{number % variants:06}"
    if number >= variants:
        take(dataset.root, first, dataset.root, name, os.link)
    elif like:
        take(like, shapes[number], dataset.root, name, shutil.copyfile)
    else:
        made = make_asset(number)
        dataset.write_grid(name, made.grid)
        dataset.write_slat(f"{name}.npz", made.coords, made.feats)


def files_of(root: Path, name: str) -> list[Path]:
    """Return the source files of an asset."""
    below = (root / "pixieverse" / name).rglob("*")
    return [*(path for path in below if path.is_file()), root / "slat" / f"{name}.npz"]


def take(root: Path, name: str, to: Path, copy: str, how: Callable[[Path, Path], Any]) -> None:
    """Copy or link the files of an asset to another root, or under another name."""
    for file in files_of(root, name):
        place = to / str(file.relative_to(root)).replace(name, copy)
        place.parent.mkdir(parents=True, exist_ok=True)
        how(file, place)


def build(sources: Path, out: Path) -> tuple[float, dict[str, float]]:
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), written()
    told = subprocess.run(
        [sys.executable, "-c", BUILD, str(sources), str(out)],
        check=True,
        env=environment(),
        capture_output=True,
        text=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    found = json.loads(told.stdout.splitlines()[-1])
    return round(spent, 1), {**found, "written [MB]": round((written() - begin) / 1e6)}


def written() -> int:
    """Return the bytes that the processes have written that this one started and that ended."""
    lines = (line.partition(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return next(int(value) for name, _, value in lines if name == "wchar")


if __name__ == "__main__":
    main()
