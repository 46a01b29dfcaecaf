"""What better alignment buys: the same training on stores of different alignment.

    python benchmarks/alignment_pays.py [--assets 70] [--levels 1 2] [--seeds 3] [--epochs 6]

For each level, demo objects whose latents come from their true material are
built into a store by the protocol of SLAT-Phys (``--preset paper``) and into
one by the default engine; a third has the true labels in every voxel. The
small decoder is trained on each in the same way, and every one is measured on
the same other objects **against their truth**, the paper's metrics over all
SLAT voxels, never against labels that an alignment gave. Only the seed of
weights and order differs between runs of one store; the spread printed is the
standard deviation over them. What is done already in --work is not done again.
"""

from __future__ import annotations

import argparse
import csv
import shutil
from pathlib import Path

import numpy as np
import torch
import zarr

from slatprep.demo import make_demo
from slatprep.learn.dataset import SlatDataset, SlatLoader
from slatprep.learn.decoder import make_decoder
from slatprep.learn.metrics import METRICS, measure, score_asset
from slatprep.learn.predictions import VoxelPrediction
from slatprep.learn.splits import Shares
from slatprep.learn.train import TrainParameters, train
from slatprep.normalize import normalize_properties
from slatprep.parameters.files import load_parameters
from slatprep.pipeline.dataset import build_store
from slatprep.store import open_store

PRESETS = {"paper": "paper", "slatprep": "default"}
TRAIN_SEED, TEST_SEED = 11, 12
SHARES = Shares(0.8, 0.15, 0.05)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--assets", type=int, default=70, help="of each level, to learn from")
    parser.add_argument("--test-assets", type=int, default=42, help="of each level, to measure on")
    parser.add_argument("--levels", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--epochs", type=int, default=6)
    parser.add_argument("--work", type=Path, default=Path("alignment-pays"))
    parser.add_argument("--csv", type=Path, help="also write every run there")
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for level in options.levels:
        folder = options.work / f"L{level}"
        for name, store in stores(folder, level, options.assets).items():
            labels = label_accuracy(store, folder / "learn" / "truth")
            test = demo_store(folder, "measure", level, options.test_assets, TEST_SEED)
            for seed in range(options.seeds):
                run = folder / "runs" / f"{name}-{seed}"
                parameters = TrainParameters(
                    size="small", epochs=options.epochs, learning_rate=3e-3, shares=SHARES,
                    seed=seed,
                )  # fmt: skip
                train(store, run, parameters)
                truth = folder / "measure" / "truth"
                scores = against_truth(run, store, test, truth)
                rows.append((level, name, seed, labels, *scores))
                print(*(f"{v:.4f}" if isinstance(v, float) else v for v in rows[-1]), flush=True)
    if options.csv:
        with options.csv.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows([("level", "labels of", "seed", "right", *METRICS), *rows])
    show(rows)


def stores(folder: Path, level: int, assets: int) -> dict[str, Path]:
    """Build the stores of one level, all of the same objects."""
    built = {
        name: demo_store(folder, "learn", level, assets, TRAIN_SEED, preset)
        for name, preset in PRESETS.items()
    }
    ranges = {open_store(store).normalization for store in built.values()}
    assert len(ranges) == 1, "the stores normalise differently, so their errors do not compare"
    built["truth"] = folder / "learn-truth.zarr"
    if not built["truth"].exists():
        write_truth_store(built["slatprep"], built["truth"], folder / "learn" / "truth")
    return built


def demo_store(
    folder: Path, name: str, level: int, assets: int, seed: int, preset: str = "default"
) -> Path:
    """Make demo objects and build them into a store, unless that is done."""
    out = folder / f"{name}-{preset}.zarr"
    if not out.exists():
        demo = make_demo(folder / name, assets, seed, levels=(level,), latents="material")
        build_store(load_parameters(demo.config, {}, preset), out)
    return out


def write_truth_store(source: Path, out: Path, truths: Path) -> None:
    """Copy a store and put the true labels into every voxel."""
    partial = out.with_suffix(".partial")
    shutil.copytree(source, partial, dirs_exist_ok=True)
    store = open_store(source)
    truth = [read_truth(truths, asset_id) for asset_id in store.ids]
    root = zarr.open_group(partial, mode="r+")
    properties = np.concatenate(
        [normalize_properties(t["properties"], store.normalization) for t in truth]
    )
    root["voxel/properties"][:] = properties
    root["voxel/material"][:] = np.concatenate([t["material"] for t in truth])
    root["voxel/valid"][:] = True
    partial.rename(out)


def read_truth(truths: Path, asset_id: str) -> dict[str, np.ndarray]:
    """Return true ``material`` (N,) and SI ``properties`` (N, 3) of an asset's SLAT voxels."""
    with np.load(truths / f"{asset_id}.npz") as file:
        return {key: file[key] for key in ("material", "properties")}


def label_accuracy(path: Path, truths: Path) -> float:
    """Return the share of labelled voxels whose class is right, a mean over assets."""
    store, shares = open_store(path), []
    for index, asset_id in enumerate(store.ids):
        rows = store.read(index, ("material", "valid"))
        right = rows["material"] == read_truth(truths, asset_id)["material"]
        shares.append(right[rows["valid"]].mean() if rows["valid"].any() else 0.0)
    return float(np.mean(shares))


@torch.no_grad()
def against_truth(run: Path, trained_on: Path, test: Path, truths: Path) -> list[float]:
    """Return `METRICS` of a run's best epoch on other objects, against their truth."""
    model = make_decoder("small").eval()
    model.load_state_dict(torch.load(run / "best.pt", weights_only=True)["model"])
    normalization = open_store(trained_on).normalization
    scores = []
    for batch in SlatLoader(SlatDataset(test)):
        predicted = model(batch.coords, batch.feats)
        truth = read_truth(truths, batch.asset_ids[0])
        prediction = VoxelPrediction(
            predicted.properties.double().numpy(), predicted.logits.argmax(1).numpy()
        )
        target = normalize_properties(truth["properties"], normalization)
        everywhere = np.ones(len(target), dtype=bool)
        scores.append(score_asset(prediction, target, truth["material"], everywhere))
    return list(measure(np.array(scores), "sd").means.values())


def show(rows: list[tuple]) -> None:
    """Print a table, mean and standard deviation over seeds."""
    print("| level | labels of | labels right |", " | ".join(METRICS), "|")
    print("| --- " * (3 + len(METRICS)) + "|")
    for key in dict.fromkeys(row[:2] for row in rows):
        chosen = [row for row in rows if row[:2] == key]
        values = np.array([row[4:] for row in chosen])
        spread = values.std(axis=0, ddof=1) if len(values) > 1 else np.full(len(METRICS), np.nan)
        cells = [f"{m:.4f} ± {s:.4f}" for m, s in zip(values.mean(axis=0), spread, strict=True)]
        print(f"| L{key[0]} | {key[1]} | {chosen[0][3]:.4f} |", " | ".join(cells), "|")


if __name__ == "__main__":
    main()
