"""Measure costs that depend only on the number of assets, with tiny assets and known alignments.

    python benchmarks/half_million.py 500000

Sources are as small as their format allows, some hundred voxels on each side, and state their frame
(engine ``known``), so no search runs. Each step runs in a process of its own: the first build, a
build that finds no changes, an update by some new assets, opening, reading at random, verifying,
and the report. It prints wall time, CPU time with children and peak memory of each.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from checkout import environment
from support.synthetic import FEATS_MEAN, FEATS_STD

VARIANTS = 64
COLUMNS = (("density", "kg/m^3", "log10"), ("youngs_modulus", "Pa", "log10"),
           ("poisson_ratio", "1", "linear"))  # fmt: skip

BUILD = """
import gc, multiprocessing
from dataclasses import replace
from pathlib import Path
from slatprep.parameters import AlignParameters, BuildParameters, PixieverseSource, SlatSource
from slatprep.pipeline import asset, dataset
from slatprep.pipeline.asset import finish_asset
from slatprep.workers.local import single_threaded
root, once, stages = Path(sys.argv[1]), sys.argv[4] == "True", {}
computed, compute = {}, asset.process_asset
def repeated(pair, *others):
    shape = pair.grid.read_bytes(), pair.slat.read_bytes()
    if shape not in computed:
        computed[shape] = compute(pair, *others)
    one = computed[shape]
    named = lambda side, own: replace(side, sources=(
        replace(side.sources[0], path=own.name), *side.sources[1:]))
    return replace(one, pair=pair, field=named(one.field, pair.grid),
        latents=named(one.latents, pair.slat))
class Forked:
    '''Workers that have what was put in the place of a function here.'''
    def run_unordered(self, function, tasks, died=None):
        gc.freeze()
        calls = ((function, task) for task in tasks)
        with multiprocessing.get_context("fork").Pool(int(sys.argv[3])) as pool:
            yield from pool.imap_unordered(called, calls, 16 if function is finish_asset else 1)
    def require_shared(self, paths):
        pass
def called(call):
    with single_threaded():
        return call[0](*call[1])
if once:
    asset.process_asset = repeated
jobs = Forked() if once else int(sys.argv[3])
def timed(name, stage):
    def measured(*given, **named):
        begin, cpu = time.perf_counter(), time.process_time()
        result = stage(*given, **named)
        stages[name] = [round(time.perf_counter() - begin, 1), round(time.process_time() - cpu, 1)]
        print(name, stages[name], now(), file=sys.stderr, flush=True)
        return result
    return measured
def now():
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return f"{time.perf_counter():.0f} s, {pages * 4096 / 1e6:.0f} MB"
for name in ("_discover", "plan_assets", "finish", "settle_rows", "pack_store", "_publish"):
    setattr(dataset, name, timed(name.strip("_"), getattr(dataset, name)))
def progress(done, count):
    if done % 20_000 == 0:
        print(done, now(), file=sys.stderr, flush=True)
parameters = BuildParameters(PixieverseSource(root / "voxels", adapter="voxels"),
    SlatSource(root / "slat"), align=AlignParameters(engine="known"))
summary = dataset.build_store(parameters, Path(sys.argv[2]), jobs=jobs,
    assets_per_job=32, progress=progress)
told = {"assets": summary.statuses["ok"], "failed": summary.statuses["failed"],
    **{f"{name}, wall and CPU [s]": both for name, both in stages.items()}}
"""
OPEN = """
from slatprep.store import open_store
begin = time.perf_counter()
store = open_store(sys.argv[1])
told = {"assets": len(store), "ids": len(store.ids),
    "opening [ms]": round(1e3 * (time.perf_counter() - begin), 1)}
"""
READ = """
import numpy as np
from slatprep.store import open_store
store = open_store(sys.argv[1])
ids = np.random.default_rng(1).choice(np.array(store.ids), int(sys.argv[2]))
begin = time.perf_counter()
voxels = sum(len(store.asset(str(one)).coords) for one in ids)
told = {"reads": len(ids), "voxels": voxels,
    "a read [ms]": round(1e3 * (time.perf_counter() - begin) / len(ids), 3)}
"""
TAIL = """
peak = lambda who: round(resource.getrusage(who).ru_maxrss / 1024)
told |= {"parent [MB]": peak(resource.RUSAGE_SELF), "worker [MB]": peak(resource.RUSAGE_CHILDREN)}
print(json.dumps(told))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("assets", type=int)
    parser.add_argument("--new", type=int, default=50, help="assets that the update adds")
    parser.add_argument("--reads", type=int, default=1000, help="assets that are read at random")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--once", action="store_true", help="compute each shape once")
    parser.add_argument("--folder", type=Path, help="where to work, and what to go on with")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="half-million-") as folder:
        for row in measure(arguments.folder or Path(folder), arguments):
            print(json.dumps(row), flush=True)


def measure(folder: Path, arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    count, out, jobs = arguments.assets, folder / "s.zarr", str(arguments.jobs)
    build = (BUILD, folder, out, jobs, arguments.once)
    if not out.exists():
        begin = time.perf_counter()
        if not (folder / "slat").exists():
            add(folder, "m", count)
        yield {"step": "make the sources", "wall [s]": round(time.perf_counter() - begin, 1)}
        yield step("build", *build)
        yield {"step": "what is there", **sizes(out), "records [MB]": records(out)}
        yield step("nothing changed", *build)
        add(folder, "mm", arguments.new)
        yield step(f"{arguments.new} new", *build)
    yield step("open", OPEN, out)
    yield step("random reads", READ, out, arguments.reads)
    yield command_step("verify", out, "--sample", "1000", "--jobs", jobs)
    yield command_step("report", out, "--out", folder / "report.html", "--jobs", jobs)
    yield {"step": "page", "report [MB]": megabytes(folder / "report.html")}


def add(folder: Path, prefix: str, count: int) -> None:
    """Write so many assets of a few shapes, the voxels of a small box each."""
    made = []
    for variant in range(VARIANTS):
        rng = np.random.default_rng(variant)
        box = np.argwhere(np.ones((4, 4, 3 + variant % 4), bool)) + 24 + variant % 7
        rng.shuffle(box)
        density, modulus = rng.uniform(900, 1100, len(box)), rng.uniform(1e5, 1e6, len(box))
        sides = {"voxels": box.astype(np.uint8), "material": np.zeros(len(box), np.uint8),
                 "density": density, "youngs_modulus": modulus,
                 "poisson_ratio": np.full(len(box), 0.3)}  # fmt: skip
        feats = rng.normal(FEATS_MEAN, FEATS_STD, (len(box), 8)).astype(np.float32)
        made.append([packed(**sides), packed(coords=box.astype(np.uint8), feats=feats)])
    roots = folder / "voxels", folder / "slat"
    for root in roots:
        root.mkdir(exist_ok=True)
    columns = [dict(zip(("name", "unit", "scale"), one, strict=True)) for one in COLUMNS]
    about = roots[0] / "source.json"
    if not about.exists():
        about.write_text(json.dumps({"properties": columns, "aligned": True}))
    for number in range(count):
        for root, data in zip(roots, made[number % VARIANTS], strict=True):
            (root / f"{prefix}{number:06}.npz").write_bytes(data)


def packed(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def step(name: str, code: str, *arguments: Any) -> dict[str, Any]:
    begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    head = "import json, resource, sys, time\n"
    command = [sys.executable, "-c", head + code + TAIL, *map(str, arguments)]
    told = json.loads(run(command).splitlines()[-1])
    return {"step": name, **spent(begin, before), **told}


def command_step(name: str, *words: Any) -> dict[str, Any]:
    begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    code = (
        "import sys; from slatprep.cli import main\n"
        "try:\n main()\nfinally:\n import resource\n"
        " print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024, file=sys.stderr)"
    )
    run([sys.executable, "-c", code, name, *map(str, words), "--quiet"])
    return {"step": name, **spent(begin, before)}


def run(command: list[str]) -> str:
    told = subprocess.run(command, env=environment(), stdout=subprocess.PIPE, text=True, check=True)
    return told.stdout


def spent(begin: float, before: resource.struct_rusage) -> dict[str, float]:
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall [s]": round(time.perf_counter() - begin, 1), "CPU [s]": round(cpu, 1)}


def records(out: Path) -> float:
    lines = out.with_name("s.manifests").glob("assets*.jsonl")
    return round(sum(file.stat().st_size for file in lines) / 1e6, 1)


def sizes(out: Path) -> dict[str, float]:
    found = [(Path(folder) / name).stat().st_size for folder, _, names in os.walk(out)
             for name in names]  # fmt: skip
    return {"files": len(found), "store [MB]": round(sum(found) / 1e6, 1)}


def megabytes(file: Path) -> float:
    return round(file.stat().st_size / 1e6, 1)


if __name__ == "__main__":
    main()
