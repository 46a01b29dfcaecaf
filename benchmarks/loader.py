"""Compare loading for training from a store with the same loop over npz files.

    python benchmarks/loader.py STORE [--repeats 5]

Writes each asset's coords, feats, properties, material and valid as an npz
file, plain and compressed. It then reads all assets in the same shuffled order in
each way, in turn, so that a busy machine slows all ways alike. It checks that all ways
give the same tensors. Prints milliseconds of CPU time per asset (median over
repeats) and the size on disk.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from slatprep.learn import FEATS_MEAN, FEATS_STD, IGNORED, SlatDataset

COLUMNS = ("coords", "feats", "properties", "material", "valid")
_MEAN, _STD = np.array(FEATS_MEAN, np.float32), np.array(FEATS_STD, np.float32)


def from_npz(path: Path) -> dict[str, torch.Tensor]:
    with np.load(path) as file:
        rows = {name: file[name] for name in COLUMNS}
    valid, material = rows["valid"], rows["material"].astype(np.int64)
    material[~valid] = IGNORED
    arrays = {
        "coords": rows["coords"].astype(np.int32),
        "feats": (rows["feats"] - _MEAN) / _STD,
        "properties": np.where(valid[:, None], rows["properties"], np.float32(0)),
        "material": material,
        "valid": valid,
    }
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    dataset = SlatDataset(arguments.store, verdicts="all")
    order = np.random.default_rng(0).permutation(len(dataset)).tolist()
    with tempfile.TemporaryDirectory() as name:
        folders = {kind: Path(name) / kind for kind in ("npz", "compressed npz")}
        for folder in folders.values():
            folder.mkdir()
        for k, index in enumerate(dataset.indices.tolist()):
            rows = dataset.store.read(index, COLUMNS)
            np.savez(folders["npz"] / f"{k}.npz", **rows)
            np.savez_compressed(folders["compressed npz"] / f"{k}.npz", **rows)
        for k in order:
            item, file = dataset[k], from_npz(folders["npz"] / f"{k}.npz")
            assert all(torch.equal(getattr(item, name), file[name]) for name in COLUMNS)

        loops: dict[str, Callable[[int], object]] = {
            "store": dataset.__getitem__,
            **{
                kind: lambda k, folder=folder: from_npz(folder / f"{k}.npz")
                for kind, folder in folders.items()
            },
        }
        seconds: dict[str, list[float]] = {kind: [] for kind in loops}
        for _ in range(arguments.repeats):
            for kind, read in loops.items():
                start = time.process_time()
                for k in order:
                    read(k)
                seconds[kind].append((time.process_time() - start) / len(order))
        sizes = {
            kind: sum(f.stat().st_size for f in folder.iterdir())
            for kind, folder in folders.items()
        }
    voxel = [arguments.store / "voxel" / column for column in COLUMNS]
    sizes["store"] = sum(f.stat().st_size for part in voxel for f in part.rglob("*") if f.is_file())
    voxels = int(np.diff(dataset.store.offsets).mean())
    print(f"{len(dataset)} assets of {voxels:,} voxels on average")
    for kind, times in seconds.items():
        print(f"{kind:15} {1000 * statistics.median(times):7.2f} ms  {sizes[kind] / 1e6:8.1f} MB")


if __name__ == "__main__":
    main()
