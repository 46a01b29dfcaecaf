"""Change the structure of voxel files (npz, HDF5, Zarr, PLY), and check that none is read wrongly.

    python benchmarks/fuzz_structure.py [--files 300] [--seed 0]

If a change loses or contradicts something, slatprep must refuse the file with its own error. If it
keeps all values, they must be read unchanged. Any other result is a fault: other values, another
exception, or more than 30 s.
"""

from __future__ import annotations

import argparse
import faulthandler
import io
import json
import random
import shutil
import sys
import tempfile
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from slatprep.demo import make_demo
from slatprep.errors import InputError
from slatprep.parameters.files import load_parameters
from slatprep.readers import discover, read_field

Change = Callable[[Path, random.Random], bool]
"""Changes a file; returns whether it still holds all values."""

Arrays = dict[str, np.ndarray]


def changed(arrays: Arrays, chance: random.Random) -> tuple[Arrays, bool]:
    """Return arrays, one of them changed, and whether they hold the same values."""
    name = chance.choice([n for n, a in arrays.items() if a.ndim])
    array, rows = arrays[name], len(arrays[name])
    ways: dict[str, tuple[Any, bool]] = {
        "rows lost": (array[: rows - chance.randrange(1, rows)], False),
        "a row more": (np.concatenate([array, array[:1]]), False),
        "an axis more": (array[None], False),
        "no rows": (array[:0], False),
        "text": (array.astype("S8"), False),
        "complex": (array.astype(complex), False),
        "big-endian": (array.astype(array.dtype.newbyteorder(">")), True),
        "wider": (array.astype(np.float64 if array.dtype.kind == "f" else np.int64), True),
        "in Fortran's order": (np.asfortranarray(array), True),
        "an end that is not finite": (with_last(array, np.nan), array.dtype.kind != "f"),
        "an end below 0": (with_last(array, -1), array.dtype.kind == "u"),
        "a scalar": (np.array(array.reshape(-1)[0]), False),
    }
    way = chance.choice([*ways, "lost", "renamed", "beside it another"])
    if way == "lost":
        return {n: a for n, a in arrays.items() if n != name}, False
    if way == "renamed":
        return {(f"{n}_" if n == name else n): a for n, a in arrays.items()}, False
    if way.startswith("beside"):
        return {**arrays, "other": np.zeros(3)}, True
    return {**arrays, name: ways[way][0]}, ways[way][1]


def with_last(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    if array.dtype.kind == "f" or (value < 0 and array.dtype.kind == "i"):
        array.reshape(-1)[-1] = value
    return array


def change_npz(path: Path, chance: random.Random) -> bool:
    with np.load(path) as archive:
        arrays, same = changed(dict(archive), chance)
    (np.savez if chance.random() < 0.5 else np.savez_compressed)(path, **arrays)
    if chance.random() < 0.15:
        with zipfile.ZipFile(path, "a") as more:
            buffer = io.BytesIO()
            np.save(buffer, np.zeros(3))
            more.writestr(next(iter(arrays)) + ".npy", buffer.getvalue())
        same = False
    return same


def change_hdf5(path: Path, chance: random.Random) -> bool:
    with h5py.File(path) as file:
        arrays = {name: file[name][()] for name in file}
    name = chance.choice(list(arrays))
    way = chance.choice(("arrays", "arrays", "packed", "grown", "link", "outside", "group"))
    same = way == "packed"
    if way == "arrays":
        arrays, same = changed(arrays, chance)
    with h5py.File(path, "w") as file:
        for key, array in arrays.items():
            if way == "packed":
                file.create_dataset(key, data=array, compression="gzip", chunks=True)
            elif key == name and way == "grown":
                shape = (2 * len(array), *array.shape[1:])
                held = file.create_dataset(key, shape, array.dtype, chunks=(64, *array.shape[1:]))
                held[: len(array)] = array
            elif key == name and way == "link":
                file[key] = h5py.SoftLink("/nowhere")
            elif key == name and way == "outside":
                file[key] = h5py.ExternalLink("/etc/passwd", "/x")
            elif key == name and way == "group":
                file.create_group(key)
            else:
                file[key] = array
    return same


def change_zarr(path: Path, chance: random.Random) -> bool:
    files = sorted(p for p in path.rglob("*") if p.is_file())
    chunks = [p for p in files if p.name != "zarr.json"]
    file = chance.choice(chunks if chance.random() < 0.5 else files)
    way = chance.choice(("lost", "empty", "cut", "json", "json", "json", "beside", "folder"))
    if way == "beside":
        (path / "notes.txt").write_text("x")
        return True
    if way == "json":
        file = chance.choice([p for p in files if p.name == "zarr.json"])
        document = json.loads(file.read_text())
        key = chance.choice(list(document))
        values = [None, 0, -1, 2**70, "x", [], {}, [2**40], [1], "int8", "float64", [{"name": "x"}]]
        document[key] = chance.choice(values)
        if chance.random() < 0.2:
            del document[key]
        file.write_text(json.dumps(document))
        return False
    file.unlink()
    if way == "folder":
        file.mkdir()
    elif way != "lost":
        file.write_bytes(b"" if way == "empty" else b"\0" * chance.randrange(1, 9))
    return False


def change_ply(path: Path, chance: random.Random) -> bool:
    import plyfile

    vertex = plyfile.PlyData.read(str(path))["vertex"].data
    way = chance.choice(("text", "big-endian", "column", "lost", "more", "rows", "head"))
    same = way in ("text", "big-endian", "column")
    names = list(vertex.dtype.names)
    if way == "column":
        chance.shuffle(names)
        vertex = vertex[names].copy()
    elif way == "lost":
        names.remove(chance.choice(names))
        vertex = vertex[names].copy()
    elif way == "rows":
        vertex = np.concatenate([vertex, vertex[:1]])
    vertex = np.array(vertex.tolist(), [(n, vertex.dtype[n].str) for n in vertex.dtype.names])
    order = ">" if way == "big-endian" else "<"
    described = plyfile.PlyElement.describe(vertex, "vertex")
    plyfile.PlyData([described], text=way == "text", byte_order=order).write(str(path))
    data = path.read_bytes()
    count = b"vertex %d" % len(vertex)
    if way == "more":
        path.write_bytes(
            data.replace(count, b"vertex %d" % (len(vertex) + chance.randrange(1, 99)))
        )
    elif way == "head":
        path.write_bytes(data.replace(b"property", b"proberty", chance.randrange(1, 3)))
    return same


FORMS: dict[str, tuple[str, Change]] = {
    "voxels-npz": ("npz", change_npz),
    "voxels-hdf5": ("h5", change_hdf5),
    "voxels-zarr": ("zarr", change_zarr),
    "voxels-ply": ("ply", change_ply),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=300, help="changed files of each form")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    faults = 0
    for form, (suffix, change) in FORMS.items():
        told: Counter[str] = Counter()
        with tempfile.TemporaryDirectory() as folder:
            make_demo(Path(folder, "demo"), 1, seed=0, source=form)  # type: ignore[arg-type]
            parameters = load_parameters(Path(folder, "demo", "dataset.toml"))
            pair = next(iter(discover(parameters)))
            assert pair.grid is not None
            path = Path(str(pair.grid))
            path = path.parent if suffix == "zarr" and path.name == "zarr.json" else path
            sound, kept = read_field(pair), Path(folder, "kept")
            (shutil.copytree if path.is_dir() else shutil.copyfile)(path, kept)
            for number in range(given.files):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
                (shutil.copytree if kept.is_dir() else shutil.copyfile)(kept, path)
                same = change(path, random.Random(f"{given.seed} {form} {number}"))
                faulthandler.dump_traceback_later(30, exit=True)
                try:
                    read = read_field(replace(pair))
                    equal = all(
                        np.array_equal(getattr(read, name), getattr(sound, name))
                        for name in ("voxels", "material", "properties", "occupancy")
                    )
                    outcome = "read as it was" if equal else "read otherwise"
                    if not equal and read.unphysical > sound.unphysical:
                        outcome = "read, and its unphysical values counted"
                    wrong = outcome if outcome == "read otherwise" else ""
                except InputError:
                    outcome, wrong = "refused", "refused, but sound" if same else ""
                except Exception:
                    outcome, wrong = "traceback", traceback.format_exc(limit=-4)
                faulthandler.cancel_dump_traceback_later()
                told[outcome] += 1
                if wrong:
                    faults += 1
                    print(f"{form} {number}: {wrong}", file=sys.stderr, flush=True)
        print(f"{form}: {dict(told)}", flush=True)
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
