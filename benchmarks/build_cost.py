"""Measure what a build costs beyond reading its inputs and writing the same arrays, step by step.

    slatprep make-demo demo --assets 200
    python benchmarks/build_cost.py demo/dataset.toml
    python benchmarks/build_cost.py demo/dataset.toml --times 8  # as many as PixieVerse has
    python benchmarks/build_cost.py demo/dataset.toml --full

Times are CPU seconds of the process and its children, so other work on the machine hardly
matters. Verifying, and two jobs compared with one, are in wall-clock seconds and need two free
cores. Every step runs once before it is timed, so no compilation is measured.

With --times, hard links give each asset this number of ids. A few assets then stand for a
dataset as large as PixieVerse.

--full measures the same with assets whose SLAT has every voxel of the grid, or every other
voxel. Their PixieVerse grid is one of the dataset, a cube, two voxels or dust.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import tempfile
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from slatprep.inspect.verify import verify_store
from slatprep.parameters import BuildParameters, PairingParameters, PixieverseSource, SlatSource
from slatprep.parameters.files import load_parameters
from slatprep.pipeline import annotate, destination
from slatprep.pipeline import asset as process
from slatprep.pipeline import dataset as build
from slatprep.readers import discover
from slatprep.store.integrity import open_for_writing
from slatprep.store.writer import create_store

STEPS = {
    "read_field": process,
    "read_latents": process,
    "align": annotate,
    "sample": annotate,
    "judge": annotate,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--no-jobs", action="store_true", help="leave out two jobs against one")
    parser.add_argument("--full", action="store_true", help="add SLATs that fill the grid")
    parser.add_argument("--times", type=int, default=1, help="ids that each asset goes in under")
    arguments = parser.parse_args()
    parameters = load_parameters(arguments.dataset)
    # Beside the dataset, as links cannot lead to another disk.
    folder = Path(tempfile.mkdtemp(prefix="build-cost-", dir=arguments.dataset.absolute().parent))
    try:
        if arguments.times > 1:
            parameters = repeated(parameters, folder, arguments.times)
        report = measure(parameters, folder, jobs=not arguments.no_jobs and not arguments.full)
        if arguments.full:
            report = {"usual": report}
            for name in write_full(discover(parameters)[0].grid, folder):
                sources = PixieverseSource(folder / name), SlatSource(folder / name / "slat")
                report[name] = measure(BuildParameters(*sources), folder / name, jobs=False)
    finally:
        shutil.rmtree(folder)
    print(json.dumps(report, indent=2))


def measure(parameters: BuildParameters, folder: Path, jobs: bool) -> dict[str, Any]:
    pairs = discover(parameters)
    for pair in pairs[:3]:
        process.process_asset(pair, parameters)
    steps: dict[str, float] = defaultdict(float)
    rooms = {
        **STEPS, "finish_asset": process, "pack_store": build, "replace_directory": destination
    }  # fmt: skip
    for name, room in rooms.items():
        setattr(room, name, timed(getattr(room, name), steps, name))
    begin, clock = cpu(), time.perf_counter()
    summary = build.build_store(parameters, folder / "s.zarr")
    whole, wall = cpu() - begin, time.perf_counter() - clock
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    least = reading_alone(pairs) + writing_alone(folder / "s.zarr", folder / "w.zarr", parameters)
    inside = sum(steps[name] for name in STEPS)
    count = len(pairs)

    def per_asset(seconds: float) -> float:
        return round(1e3 * seconds / count, 1)

    report = {
        "assets": count,
        "voxels": summary.n_voxels,
        "build [CPU ms/asset]": per_asset(whole),
        "read and write alone [CPU ms/asset]": per_asset(least),
        "ratio": round(whole / least, 2),
        **{f"{name} [CPU ms/asset]": per_asset(steps[name]) for name in STEPS},
        "spool and records [CPU ms/asset]": per_asset(steps["finish_asset"] - inside),
        "pack [CPU ms/asset]": per_asset(steps["pack_store"]),
        "flush and replace [CPU ms/asset]": per_asset(steps["replace_directory"]),
        "peak memory of one job [MB]": round(peak / 1024),
    }
    if jobs:
        begin = time.perf_counter()
        build.build_store(parameters, folder / "2.zarr", jobs=2)
        both = time.perf_counter() - begin
        report["wall, one job [s]"] = round(wall, 1)
        report["wall, two jobs [s]"] = round(both, 1)
        report["two jobs over one"] = round(wall / both, 2)
        begin = time.perf_counter()
        if not verify_store(folder / "2.zarr", jobs=2).ok:
            raise SystemExit("the store does not verify")
        verified = time.perf_counter() - begin
        report["wall, verifying with two jobs [s]"] = round(verified, 1)
        report["wall, from sources to a verified store with two jobs [s]"] = round(
            both + verified, 1
        )
        children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        report["peak memory of a worker [MB]"] = round(children / 1024)
    return report


def repeated(parameters: BuildParameters, folder: Path, times: int) -> BuildParameters:
    """Link the files of each asset under so many ids; return the dataset of all."""
    sides: dict[str, Any] = {"pixieverse": parameters.pixieverse, "slat": parameters.slat}
    for pair in discover(parameters):
        for side, file in (("pixieverse", pair.grid), ("pixieverse", pair.mask),
                           ("pixieverse", pair.bounds), ("slat", pair.slat)):  # fmt: skip
            if file is None:
                continue
            name = Path(str(file)).relative_to(Path(sides[side].root).absolute()).as_posix()
            for number in range(times):
                link = folder / side / name.replace(pair.object_id, f"{pair.object_id}-{number}")
                link.parent.mkdir(parents=True, exist_ok=True)
                os.link(str(file), link)
    own = {side: replace(source, root=folder / side) for side, source in sides.items()}
    return replace(parameters, pairing=PairingParameters(), **own)


def write_full(usual: Any, folder: Path) -> list[str]:
    """Write assets of one or half of all voxels each, as far from usual as sources may be."""
    rng = np.random.default_rng(0)
    cells = np.argwhere(np.ones((64, 64, 64), dtype=bool))
    cube = cells[(np.abs(cells - 31.5) < 12).all(axis=1)]
    slats = {"full": cells, "checkered": cells[cells.sum(axis=1) % 2 == 0]}
    grids = {"cube": cube, "two voxels": cells[:2], "dust": cells[rng.random(len(cells)) < 0.01]}
    for slat, voxels in slats.items():
        for grid in ("usual", "full", *grids):
            place = folder / f"{slat}, {grid}"
            (place / "a" / "sample_0").mkdir(parents=True)
            (place / "slat").mkdir()
            values = np.zeros((64, 64, 64, 4), dtype=np.float32)
            values[..., 3] = 7
            for part, stuff in ((0, (1e3, 1e5, 0.3, 0)), (1, (8e3, 2e11, 0.28, 1))):
                values[tuple(grids.get(grid, cells)[part::2].T)] = stuff
            np.save(
                place / "a" / "sample_0" / "material_grid.npy",
                np.load(usual) if grid == "usual" else values,
            )
            feats = rng.normal(0.0, 2.0, (len(voxels), 8)).astype(np.float32)
            np.savez(place / "slat" / "a.npz", coords=voxels.astype(np.uint8), feats=feats)
    return [f"{slat}, {grid}" for slat in slats for grid in ("usual", "full", *grids)]


def reading_alone(pairs: list[Any]) -> float:
    begin = cpu()
    for pair in pairs:
        np.load(pair.grid)
        if pair.mask:
            np.load(pair.mask)
        with np.load(pair.slat) as arrays:
            _ = [arrays[name] for name in arrays.files]
    return cpu() - begin


def writing_alone(built: Path, new: Path, parameters: BuildParameters) -> float:
    """Write the arrays of a store again, a shard at a time, their values in memory."""
    source = zarr.open_group(built, mode="r")
    rows = source["voxel/coords"].shape[0]
    begin = cpu()
    create_store(new, source["asset/id"].shape[0], rows, parameters.store)
    root = open_for_writing(new)
    spent = cpu() - begin
    for group in ("asset", "voxel", "grid"):
        for name, array in root[group].arrays():
            step = (array.shards or array.chunks)[0]
            for start in range(0, array.shape[0], step):
                values = source[f"{group}/{name}"][start : start + step]
                begin = cpu()
                array[start : start + step] = values
                spent += cpu() - begin
    return spent


def timed(function: Any, steps: dict[str, float], name: str) -> Any:
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        begin = cpu()
        try:
            return function(*args, **kwargs)
        finally:
            steps[name] += cpu() - begin

    return wrapped


def cpu() -> float:
    return time.process_time()


if __name__ == "__main__":
    main()
