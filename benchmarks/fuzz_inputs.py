"""Feed damaged source files to the readers, and to whole builds.

    python benchmarks/fuzz_inputs.py [--files 5000] [--builds 200] [--seed 0] [--format NAME ...]

Files of a demo dataset are damaged in many cheap ways: flipped and replaced bytes, cuts,
insertions, truncation, blocks of zeros, damaged headers, impossible values, and arrays damaged
before they are put into a sound archive. slatprep must refuse a file with its own error or read a
valid record; if another library can read the file too, the values must be the same. A process that
crashes, hangs (20 s per file) or takes more than 600 MB counts as a fault, as does any other
exception. Files are read in separate processes, so a crash is one fault and not the end.

Whole builds take datasets in which three of four assets have one damaged file. Each build must
finish with the sound assets, and the store must pass `slatprep verify`.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from fuzz_damage import FORMS, Form, damage, damage_slat

from slatprep.demo import make_demo
from slatprep.errors import ConfigError, InputError, StoreError
from slatprep.inspect.verify import verify_store
from slatprep.normalize import PIXIE_RANGES, denormalize_properties
from slatprep.parameters import (
    BuildParameters,
    PairingParameters,
    PixieverseSource,
    SlatSource,
)
from slatprep.pipeline.dataset import build_store
from slatprep.readers import discover, read_field, read_latents
from slatprep.records import AssetPair, MaterialField, StructuredLatents

SECONDS_A_FILE = 20
MEGABYTES = 600
FILES_IN_PROCESS = 250
ASSETS_IN_BUILD = 40

# --- one file ---------------------------------------------------------------------------------


def check_field(pair: AssetPair) -> None:
    """Read a field; what is read must be valid, and what numpy reads from the same bytes."""
    field = read_field(pair)
    require_valid_field(field)
    values = np.load(pair.grid, allow_pickle=False)
    place = tuple(field.voxels.T)
    if values.shape[-1] == 4 and values.shape[0] == 64:
        wanted = values[place][:, (1, 0, 2)].astype(np.float32)
    else:
        wanted = np.stack([values[k][place] for k in (1, 0, 2)], axis=1).astype(np.float32)
        wanted = denormalize_properties(np.clip(wanted, -1, 1), PIXIE_RANGES)
    require(np.array_equal(wanted, field.properties), "properties differ from numpy's")


def require_valid_field(field: MaterialField) -> None:
    require(len(field.voxels) == len(field.material) == len(field.properties) > 0, "row counts")
    require(bool(field.occupancy[tuple(field.voxels.T)].all()), "annotated but not occupied")
    require(int(field.material.max()) <= 6, "an unknown class")
    require(bool(np.isfinite(field.properties).all()), "a property that is not finite")
    require(bool((field.properties[:, :2] > 0).all()), "a modulus or density of 0 or less")
    ratio = field.properties[:, 2]
    require(bool(((ratio >= -1) & (ratio <= 0.5)).all()), "a Poisson's ratio beyond [-1, 0.5]")
    json.dumps(field.bounds, allow_nan=False)


def check_latents(pair: AssetPair, original: StructuredLatents, form: str) -> None:
    """Read latents; what is read must be valid, and what numpy or the original has."""
    latents = read_latents(pair)
    coords, feats = latents.coords, latents.feats
    require(coords.dtype == np.uint8 and feats.dtype == np.float32, "dtypes")
    require(coords.shape == (len(feats), 3) and feats.shape[1:] == (8,), "shapes")
    require(len(np.unique(coords, axis=0)) == len(coords) > 0, "a coordinate twice, or none")
    require(int(coords.max()) < 64 and bool(np.isfinite(feats).all()), "values")
    if pair.slat.suffix == ".npz":
        with np.load(pair.slat, allow_pickle=False) as arrays:
            require(np.array_equal(arrays["coords"][:, -3:], coords), "coords differ from numpy's")
            require(np.array_equal(arrays["feats"], feats), "feats differ from numpy's")
    elif "fletcher32" in form:
        # Every chunk has a checksum: a value may be missing, never another.
        rows = min(len(coords), len(original.coords))
        require(np.array_equal(coords[:rows], original.coords[:rows]), "coords changed unnoticed")
        require(np.array_equal(feats[:rows], original.feats[:rows]), "feats changed unnoticed")


def check_pairs(parameters: BuildParameters) -> None:
    """Pair by a damaged map, metadata or categories; pairs must stay below their roots."""
    before = ""
    for pair in discover(parameters):
        require(pair.asset_id > before, "asset ids out of order")
        before = pair.asset_id
        require(re.fullmatch(r"[A-Za-z0-9._%-]+", pair.asset_id) is not None, "an id that is none")
        require(isinstance(pair.category, str), "a category that is no text")
        for place in (pair.grid, pair.mask, pair.slat):
            path = None if place is None else Path(str(place))
            inside = path is None or path.is_relative_to(parameters.pixieverse.root.parent)
            require(inside and ".." not in (path.parts if path else ()), "a path out of its root")


def require(fine: bool, what: str) -> None:
    if not fine:
        raise AssertionError(what)


def worker(form: str, seed: int, first: int, last: int, demo: Path, scratch: Path) -> None:
    """Damage and read files `first` to `last`; print what became of them as JSON."""
    kind = FORMS[form]
    parameters = demo_parameters(demo, kind)
    pair = next(iter(discover(parameters)))
    target = target_of(pair, parameters, kind)
    original = target.read_bytes()
    whole = read_latents(pair) if kind.role == "slat" else None
    local = isolated(pair, parameters, kind, target, scratch)
    results: Counter[str] = Counter()
    faults: list[str] = []
    for number in range(first, last):
        (scratch / "at").write_text(str(number))
        faulthandler.dump_traceback_later(SECONDS_A_FILE, exit=True)
        rng = np.random.default_rng((seed, number))
        data = damage_slat(original, rng) if kind.rebuilt else damage(original, rng)
        local.file.write_bytes(data)
        try:
            local.check(whole, form)
            results["read"] += 1
        except (InputError, ConfigError):
            results["refused"] += 1
        except Exception:
            faults.append(f"{form} {number}: {traceback.format_exc(limit=-3)}")
    faulthandler.cancel_dump_traceback_later()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    if peak > MEGABYTES:
        faults.append(f"{form} {first} to {last}: {peak} MB")
    print(json.dumps({"results": results, "faults": faults, "peak": peak}))


@dataclass(frozen=True)
class Local:
    """The damaged file, and what reads it."""

    file: Path
    check: Callable[[StructuredLatents | None, str], None]


def isolated(
    pair: AssetPair, parameters: BuildParameters, kind: Form, target: Path, scratch: Path
) -> Local:
    """Return a place for the damaged file, and the check that reads it there."""
    if kind.role in ("map", "metadata", "categories"):
        file = scratch / target.name
        key = "categories" if kind.role == "categories" else "map"
        changed = replace(parameters, pairing=replace(parameters.pairing, **{key: file}))
        return Local(file, lambda *_: check_pairs(changed))
    file = scratch / f"{kind.role}{target.suffix}"
    root = {"slat": scratch} if kind.role == "slat" else {"pixieverse": scratch}
    files = {kind.role: file}
    if kind.role != "slat":
        for role in ("grid", "mask", "bounds"):
            source = getattr(pair, role)
            if role != kind.role and source is not None:
                files[role] = Path(shutil.copy(source, scratch / f"{role}{source.suffix}"))
    moved = replace(pair, roots=replace(pair.roots, **root), **files)
    if kind.role == "slat":
        return Local(file, lambda whole, form: check_latents(moved, whole, form))
    return Local(file, lambda *_: check_field(moved))


def target_of(pair: AssetPair, parameters: BuildParameters, kind: Form) -> Path:
    pairing = {
        "map": parameters.pairing.map,
        "metadata": parameters.pairing.map,
        "categories": parameters.pairing.categories,
    }
    return Path(pairing.get(kind.role) or getattr(pair, kind.role))


def demo_parameters(demo: Path, kind: Form) -> BuildParameters:
    slat = demo / "slat"
    if kind.recipe.get("slat_form") == "hdf5-groups":
        slat = slat / "latents.h5"
    maps = {"map": demo / "map.csv", "metadata": demo / "metadata.csv"}
    pairing = PairingParameters(map=maps.get(kind.role), categories=demo / "obj_ids_metadata.json")
    return BuildParameters(PixieverseSource(demo / "pixieverse"), SlatSource(slat), pairing=pairing)


# --- all files --------------------------------------------------------------------------------


def prepare(demo: Path, kind: Form, assets: int) -> None:
    """Make the demo of a form, with the files that it lacks."""
    import h5py

    recipe = {**kind.recipe}
    packed = recipe.get("slat_form") == "hdf5-packed"
    if packed:
        recipe["slat_form"] = "hdf5"
    make_demo(demo, assets, seed=0, **recipe)
    ids = sorted(path.name for path in (demo / "pixieverse").iterdir() if path.is_dir())
    lines = [f"{name},{name},front" for name in ids]
    (demo / "map.csv").write_text("\n".join(["object_id,slat_id,view", *lines]) + "\n")
    for name in ids:
        np.savez(
            demo / "pixieverse" / name / "clip_features.npz",
            min_bounds=np.full(3, -0.5),
            max_bounds=np.full(3, 0.5),
            voxel_size=np.float64(1 / 64),
            grid_shape=np.array([64, 64, 64]),
        )
    for path in (demo / "slat").glob("*.h5") if packed else ():
        with h5py.File(path) as file:
            arrays = {name: file[name][()] for name in ("coords", "feats")}
        options = {"compression": "gzip", "shuffle": True, "fletcher32": True}
        with h5py.File(path, "w") as file:
            for name, array in arrays.items():
                file.create_dataset(name, data=array, chunks=(512, array.shape[1]), **options)


def fuzz_form(form: str, files: int, seed: int, folder: Path) -> dict[str, object]:
    """Damage `files` files of a format; return what became of them."""
    demo = folder / "demo"
    prepare(demo, FORMS[form], 3 if FORMS[form].role in ("map", "metadata", "categories") else 1)
    total: Counter[str] = Counter()
    faults: list[str] = []
    peak, first = 0, 0
    while first < files:
        scratch = Path(tempfile.mkdtemp(dir=folder))
        last = min(first + FILES_IN_PROCESS, files)
        call = [sys.executable, __file__, "--worker", form, str(seed), str(first), str(last)]
        done = subprocess.run(
            [*call, str(demo), str(scratch)], capture_output=True, text=True, check=False
        )
        if done.returncode:
            at = int((scratch / "at").read_text())
            faults.append(f"{form} {at}: exit code {done.returncode}: {done.stderr[-2000:]}")
            total["lost with a crash"] += at - first
            first = at + 1
        else:
            report = json.loads(done.stdout)
            total.update(report["results"])
            faults += report["faults"]
            peak = max(peak, report["peak"])
            first = last
        shutil.rmtree(scratch)
    return {"results": dict(total), "faults": faults, "peak": peak}


def fuzz_builds(assets: int, seed: int, folder: Path) -> dict[str, object]:
    """Build datasets in which most assets have a damaged file, and verify what comes out."""
    demo = folder / "whole"
    make_demo(demo, ASSETS_IN_BUILD, seed=1)
    parameters = BuildParameters(PixieverseSource(demo / "pixieverse"), SlatSource(demo / "slat"))
    pairs = list(discover(parameters))
    total: Counter[str] = Counter()
    faults: list[str] = []
    for first in range(0, assets, ASSETS_IN_BUILD):
        target = folder / "damaged"
        shutil.copytree(demo, target)
        for number, pair in enumerate(pairs):
            if number % 4 == 0:
                continue
            rng = np.random.default_rng((seed, 1, first + number))
            kinds = [Path(str(path)) for path in (pair.grid, pair.mask, pair.slat) if path]
            file = target / kinds[rng.integers(len(kinds))].relative_to(demo)
            slat = file.suffix == ".npz" and rng.random() < 0.7
            data = file.read_bytes()
            file.write_bytes(damage_slat(data, rng) if slat else damage(data, rng))
        damaged = BuildParameters(
            PixieverseSource(target / "pixieverse"), SlatSource(target / "slat")
        )
        try:
            summary = build_store(damaged, folder / "damaged.zarr")
            total.update(summary.statuses)
            sound = -(-len(pairs) // 4)
            if summary.statuses["ok"] < sound:
                faults.append(f"build {first}: {summary.statuses}, {sound} of them sound")
            internal = [why for _, why in summary.problems if "internal error" in why]
            checked = verify_store(folder / "damaged.zarr", sources=True)
            faults += internal + [str(finding) for finding in checked.findings]
        except StoreError as error:
            faults.append(f"build {first}: {error}")
        for path in (target, folder / "damaged.zarr", folder / "damaged.manifests"):
            shutil.rmtree(path, ignore_errors=True)
    return {"results": dict(total), "faults": faults}


def main() -> None:
    if sys.argv[1:2] == ["--worker"]:
        form, seed, first, last, demo, scratch = sys.argv[2:]
        worker(form, int(seed), int(first), int(last), Path(demo), Path(scratch))
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=5000, help="damaged files of each format")
    parser.add_argument("--builds", type=int, default=200, help="assets through whole builds")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--format", action="append", choices=FORMS, help="only these")
    options = parser.parse_args()
    faults: list[str] = []
    print(f"{'format':40} {'files':>7} {'refused':>8} {'read':>7} {'faults':>7} {'MB':>5}")
    for form in options.format or FORMS:
        with tempfile.TemporaryDirectory() as folder:
            report = fuzz_form(form, options.files, options.seed, Path(folder))
        results = Counter(report["results"])
        faults += report["faults"]
        print(
            f"{form:40} {options.files:7} {results['refused']:8} {results['read']:7} "
            f"{len(report['faults']):7} {report['peak']:5}",
            flush=True,
        )
    if options.builds:
        with tempfile.TemporaryDirectory() as folder:
            report = fuzz_builds(options.builds, options.seed, Path(folder))
        faults += report["faults"]
        print(f"whole builds: {report['results']}, {len(report['faults'])} faults")
    for fault in faults[:20]:
        print(fault, file=sys.stderr)
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
