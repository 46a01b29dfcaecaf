"""Cost, memory and files of a build against the number of assets, with a straight line through.

    python benchmarks/scale.py 100 300 1000

Sources are small made assets; their files are linked, so that a thousand fit
anywhere. Time is CPU time of the build and its workers. A second build of the
same shows what it costs to find that nothing changed.
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
from pathlib import Path

import numpy as np
from checkout import environment
from support.synthetic import Dataset, make_asset

VARIANTS = 8
BUILD = """
import json, resource, sys
from pathlib import Path
from dataclasses import replace
from support.synthetic import Dataset
from slatprep import build_store
from slatprep.parameters import StoreParameters
parameters = replace(Dataset(Path(sys.argv[1])).parameters(), store=StoreParameters())
build_store(parameters, Path(sys.argv[2]), jobs=2)
from joblib.externals.loky import get_reusable_executor
get_reusable_executor().shutdown()
peak = lambda who: resource.getrusage(who).ru_maxrss / 1024
print(json.dumps([peak(resource.RUSAGE_SELF), peak(resource.RUSAGE_CHILDREN)]))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("assets", type=int, nargs="+")
    arguments = parser.parse_args()
    rows = []
    for count in arguments.assets:
        with tempfile.TemporaryDirectory(prefix="scale-") as folder:
            rows.append(measure(Path(folder), count))
            print(json.dumps(rows[-1]), flush=True)
    counts = np.array([row["assets"] for row in rows], dtype=float)
    for name in (
        "CPU [s]",
        "CPU, nothing changed [s]",
        "parent [MB]",
        "store [MB]",
        "records [MB]",
    ):
        values = np.array([row[name] for row in rows])
        slope, start = np.polyfit(counts, values, 1)
        worst = np.abs(values - start - slope * counts).max() / values.max()
        print(f"{name}: {start:.2f} + {slope:.5f} an asset, off by at most {worst:.1%}")


def measure(folder: Path, count: int) -> dict[str, float]:
    dataset = Dataset(folder / "sources")
    for number in range(count):
        if number < VARIANTS:
            dataset.add(f"a{number:06}", seed=number)
            continue
        like = f"a{number % VARIANTS:06}"
        grid = dataset.root / "pixieverse" / f"a{number:06}" / "sample_0" / "material_grid.npy"
        grid.parent.mkdir(parents=True)
        os.link(dataset.root / "pixieverse" / like / "sample_0" / "material_grid.npy", grid)
        made = make_asset(number % VARIANTS) if number < 2 * VARIANTS else None
        if made is None:
            os.link(
                dataset.root / "slat" / f"{like}.npz", dataset.root / "slat" / f"a{number:06}.npz"
            )
        else:
            dataset.write_slat(f"a{number:06}.npz", made.coords, made.feats + 1)
    out = folder / "s.zarr"
    spent, (parent, worker) = build(dataset.root, out)
    again, _ = build(dataset.root, out)
    files = [path.stat().st_size for path in out.rglob("*") if path.is_file()]
    begin = time.perf_counter()
    code = f"from slatprep.store import open_store; len(open_store({str(out)!r}))"
    subprocess.run([sys.executable, "-c", code], check=True, env=environment())
    row = {
        "assets": count,
        "CPU [s]": round(spent, 1),
        "CPU, nothing changed [s]": round(again, 1),
        "parent [MB]": round(parent),
        "worker [MB]": round(worker),
        "files": len(files),
        "store [MB]": round(sum(files) / 1e6, 2),
        "records [MB]": round((folder / "s.manifests" / "assets.jsonl").stat().st_size / 1e6, 2),
        "open, with start of Python [s]": round(time.perf_counter() - begin, 2),
    }
    shutil.rmtree(out)
    return row


def build(sources: Path, out: Path) -> tuple[float, list[float]]:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    told = subprocess.run(
        [sys.executable, "-c", BUILD, str(sources), str(out)],
        check=True,
        env=environment(),
        capture_output=True,
        text=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return spent, json.loads(told.stdout.splitlines()[-1])


if __name__ == "__main__":
    main()
