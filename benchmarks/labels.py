"""Compare ways to look up labels, and measure what latents settle and what a model could learn.

    python benchmarks/labels.py lookup DIR [DIR ...]
    python benchmarks/labels.py witness DIR [--jobs N]
    python benchmarks/labels.py bound STORE [--shares 0.8 0.1 0.1]

Each DIR holds a dataset with truth, as `slatprep make-demo` writes it.

``lookup`` compares the nearest annotated voxel (the paper's way) with a vote of the 27 nearest
annotated voxels. Votes are weighted by a Gaussian of their distance (its width in voxels).
Properties are averaged over the voxels of the winning class, or taken from the nearest of them
("near"). It prints per level, with the transform that the default engine finds: the share of right
classes over all voxels and over those within two voxels of another class, and the mean absolute
error of log10 E, log10 density and Poisson's ratio.

``witness`` takes a dataset of ``make-demo --latents material``. It builds two stores in a temporary
folder, without and with the pass that compares labels with latents. An asset counts as tied if a
placement that fits as well as the chosen placement changes the class of more than 5 % of the
voxels; only voxels with a class under all tied placements count. It is settled right if no tied
placement would have over 2 % more right classes on these voxels. The 2 % allow for a ball, whose
placements form a continuum that may not include the true one. It also prints the assets without
a tie whose row changed, and the share of right classes of the assets that latents contradict and of
the worst assets that they do not contradict.

``bound`` takes a store of such a dataset, whose latents follow a known formula
(`slatprep.demo.latents`). The posterior mean of the properties, given a voxel's latents and
position and with the materials of the training voxels as the prior, has the lowest expected squared
error of all models that see one voxel at a time. A model with a lower error on the same validation
objects uses neighbouring voxels.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from engines import pairs_with_truth
from scipy.spatial import cKDTree

from slatprep.align import align
from slatprep.demo.latents import NOISE, clean_latents
from slatprep.geometry.frames import (
    RESOLUTION,
    apply_transform,
    invert_transform,
    places_of,
    voxel_centres,
)
from slatprep.inspect.score import read_truth
from slatprep.judge.ambiguity import HARMLESS
from slatprep.learn.dataset import Item, SlatDataset
from slatprep.normalize import denormalize_properties, to_mapped
from slatprep.parameters import AlignParameters, WitnessParameters
from slatprep.parameters.files import load_parameters
from slatprep.pipeline.dataset import build_store
from slatprep.readers import read_field, read_latents
from slatprep.readers.splits import Shares
from slatprep.records import UNANNOTATED
from slatprep.sample import sample
from slatprep.store import open_store
from slatprep.store.records import StoredRecords


def lookup(folders: list[Path]) -> None:
    sums: dict[tuple[int, str], list[np.ndarray]] = defaultdict(list)
    for folder in folders:
        for pair, path in pairs_with_truth(folder):
            with np.load(path) as file:
                truth = {key: file[key] for key in ("material", "properties", "level", "symmetric")}
            if truth["symmetric"]:
                continue
            field, latents = read_field(pair), read_latents(pair)
            transform = align(field, latents, AlignParameters()).transform
            here = apply_transform(invert_transform(transform), voxel_centres(latents.coords))
            tree = cKDTree(voxel_centres(field.voxels))
            distance, index = tree.query(here, k=27)
            distance = distance * RESOLUTION
            level = int(truth["level"])
            slat = cKDTree(latents.coords.astype(float))
            border = np.array(
                [
                    (truth["material"][near] != truth["material"][row]).any()
                    for row, near in enumerate(slat.query_ball_point(latents.coords, 2.0))
                ]
            )
            mapped = to_mapped(field.properties)
            wanted = to_mapped(truth["properties"])
            ways = {"nearest": (field.material[index[:, 0]], mapped[index[:, 0]])}
            for sigma in (0.5, 0.6, 0.75, 1.0):
                winner, properties, nearest = _vote(field.material, mapped, distance, index, sigma)
                ways[f"vote {sigma} mean"] = winner, properties
                ways[f"vote {sigma} near"] = winner, nearest
            for way, (material, properties) in ways.items():
                right = material == truth["material"]
                error = np.abs(properties - wanted).mean(axis=0)
                near = right[border].mean() if border.any() else np.nan
                sums[level, way].append(np.array([right.mean(), near, *error]))
    print("level  way            labels  at borders  log10 E  log10 density  Poisson's ratio")
    for (level, way), rows in sorted(sums.items()):
        share, border, *error = np.nanmean(rows, axis=0)
        print(f"L{level}     {way:<13}  {share:.4f}  {border:10.4f}", *(f"{e:9.4f}" for e in error))


def _vote(
    material: np.ndarray, mapped: np.ndarray, distance: np.ndarray, index: np.ndarray, sigma: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    weight = np.exp(-0.5 * (distance / sigma) ** 2) + 1e-12
    votes = np.stack([(weight * (material[index] == k)).sum(axis=1) for k in range(7)], axis=1)
    winner = votes.argmax(axis=1).astype(np.uint8)
    inside = weight * (material[index] == winner[:, None])
    properties = (inside[:, :, None] * mapped[index]).sum(axis=1) / inside.sum(axis=1)[:, None]
    first = (inside > 0).argmax(axis=1)  # neighbours come nearest first
    return winner, properties, mapped[index[np.arange(len(index)), first]]


LEEWAY = 0.02


def witness(folder: Path, jobs: int) -> None:
    parameters = load_parameters(folder / "dataset.toml", {})
    with tempfile.TemporaryDirectory() as scratch:
        stores = Path(scratch) / "alone.zarr", Path(scratch) / "heard.zarr"
        for store, settle in zip(stores, (False, True), strict=True):
            asked = WitnessParameters(settle=settle)
            build_store(replace(parameters, witness=asked), store, jobs=jobs)
        compare(folder, *stores)


def compare(folder: Path, alone: Path, heard: Path) -> None:
    before, after = open_store(alone), open_store(heard)
    counts = dict.fromkeys(("tied", "settled", "right before", "right after", "untied"), 0)
    touched, accused, spared = [], [], []
    for first, second in zip(StoredRecords(before), StoredRecords(after), strict=True):
        asset, again = before.asset(first.asset_id), after.asset(first.asset_id)
        truth = read_truth(folder / "truth" / f"{first.asset_id}.npz").material
        share = float((again.material == truth)[again.valid].mean())
        (accused if second.judgement.contradicted else spared).append(share)
        tied = [first.alignment.transform, *(p.transform for p in first.alignment.placements)]
        labels = np.stack(
            [
                sample(
                    asset.field, places_of(asset.latents.centres, t), first.parameters.sample
                ).material
                for t in tied
            ]
        )
        shared = (labels != UNANNOTATED).all(axis=0) & asset.valid & again.valid
        labels = labels[:, shared]
        if (labels != labels[0]).mean(axis=1).max() <= HARMLESS:
            counts["untied"] += 1
            if second.first_pass is not None:
                touched.append((first.asset_id, second.judgement.contradicted, share))
            continue
        best = (labels == truth[shared]).mean(axis=1).max() - LEEWAY
        counts["tied"] += 1
        counts["settled"] += second.alignment.settled_by is not None
        counts["right before"] += (asset.material == truth)[shared].mean() >= best
        counts["right after"] += (again.material == truth)[shared].mean() >= best
    print(*(f"{name}: {count}" for name, count in counts.items()), sep="\n")
    print(f"untied, touched: {len(touched)}")
    for asset_id, contradicted, share in touched:
        what = "contradicted" if contradicted else "settled"
        print(f"    {asset_id} {what}, {share:.3f} of its labels right")
    print("right labels of contradicted assets:", *(f"{share:.3f}" for share in sorted(accused)))
    print("the least of all others:", *(f"{share:.3f}" for share in sorted(spared)[:8]))


def bound(store: Path, shares: Sequence[float]) -> None:
    train, val = (
        SlatDataset(store, split, shares=Shares(*shares), verdicts="all")
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    questions = parser.add_subparsers(dest="question", required=True)
    way = questions.add_parser("lookup")
    way.add_argument("folders", type=Path, nargs="+")
    way = questions.add_parser("witness")
    way.add_argument("folder", type=Path)
    way.add_argument("--jobs", type=int, default=1)
    way = questions.add_parser("bound")
    way.add_argument("store", type=Path)
    way.add_argument("--shares", type=float, nargs=3, default=(0.8, 0.1, 0.1))
    given = vars(parser.parse_args())
    ways: dict[str, Any] = {"lookup": lookup, "witness": witness, "bound": bound}
    ways[given.pop("question")](**given)


if __name__ == "__main__":
    main()
