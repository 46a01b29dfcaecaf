"""The best that any model of single voxels could do on demo latents that carry the material.

    python benchmarks/voxel_bound.py STORE

STORE is built from ``make-demo --latents material``, whose formula is known
(`slatprep.demo.latents`). The posterior mean of the properties given a voxel's
latents and position, with the materials of the training voxels as the prior, has
the least expected squared error of all models that look at one voxel at a time.
A lower error on the same validation objects has looked at the neighbours.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import numpy as np

from slatprep.demo.latents import NOISE, clean_latents
from slatprep.geometry.frames import voxel_centres
from slatprep.learn.dataset import Item, SlatDataset
from slatprep.normalize import denormalize_properties
from slatprep.readers.splits import Shares


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store", type=Path)
    parser.add_argument("--shares", type=float, nargs=3, default=(0.8, 0.1, 0.1))
    options = parser.parse_args()
    train, val = (
        SlatDataset(options.store, split, shares=Shares(*options.shares))
        for split in ("train", "val")
    )
    stuffs, counts = stuffs_of(train)
    normalization = train.store.normalization
    scores = [score(val[k], stuffs, counts, normalization) for k in range(len(val))]
    errors = np.mean([error for error, _ in scores], axis=0)
    print(f"{len(stuffs)} materials in {len(train)} training objects, {len(val)} to validate on")
    print("MSE of E, density, nu:", *(f"{error:.4f}" for error in errors))
    print(f"MSE {errors.mean():.4f}, accuracy {np.mean([right for _, right in scores]):.4f}")


def stuffs_of(dataset: SlatDataset) -> tuple[np.ndarray, np.ndarray]:
    """Return the materials of a dataset, (S, 4) of properties and class, and their voxels (S,)."""
    total: Counter[tuple[float, ...]] = Counter()
    for item in (dataset[k] for k in range(len(dataset))):
        rows = np.column_stack([item.properties.numpy(), item.material.numpy()])
        found, counts = np.unique(rows[item.valid.numpy()], axis=0, return_counts=True)
        total.update(dict(zip(map(tuple, found.tolist()), counts.tolist(), strict=True)))
    return np.array(list(total)), np.array(list(total.values()), dtype=np.float64)


def score(item: Item, stuffs: np.ndarray, counts: np.ndarray, normalization) -> tuple:
    """Return the squared errors (3,) and the accuracy of the posterior on one asset."""
    coords, feats = item.coords.numpy().astype(np.uint8), item.feats.numpy()
    chances = np.empty((len(feats), len(stuffs)))
    si = denormalize_properties(stuffs[:, :3], normalization)
    for k, stuff in enumerate(stuffs):
        same = np.full(len(feats), int(stuff[3]), np.uint8)
        clean = clean_latents(
            voxel_centres(coords), same, np.broadcast_to(si[k], (len(feats), 3)).copy()
        )
        chances[:, k] = np.log(counts[k]) - np.square(feats - clean).sum(1) / (2 * NOISE**2)
    chances = np.exp(chances - chances.max(axis=1, keepdims=True))
    chances /= chances.sum(axis=1, keepdims=True)
    valid = item.valid.numpy()
    error = np.square(chances @ stuffs[:, :3] - item.properties.numpy())[valid].mean(axis=0)
    classes = (chances @ (stuffs[:, 3:] == np.arange(8))).argmax(axis=1)
    return error, (classes == item.material.numpy())[valid].mean()


if __name__ == "__main__":
    main()
