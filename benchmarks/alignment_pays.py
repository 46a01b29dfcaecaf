"""Measure how much better alignment helps: the same learner on labels of different alignments.

    python benchmarks/alignment_pays.py [--assets 42] [--levels 3 5 6 7] [--draws 12]

For each level, demo objects whose latents come from their true material are built into two
stores, by the protocol of SLAT-Phys (``--preset paper``) and by the default engine. The true
labels make a third set. The second store without failed alignments, which training omits,
makes a fourth. On each set, gradient-boosted trees learn the properties and the class of a
voxel from its latents and position. All are measured on the same other objects, by the
paper's metrics and against the truth, never against the labels of an alignment.

A draw samples the training objects with replacement, the same for all sets, and seeds the
trees. Intervals hold 95 % of the differences to the paper's labels over draws and over
resampled test objects, so they allow for the choice of both. Stores that are already in
--work are not built again.

scikit-learn comes with the extra ``paper`` (Open3D needs it).
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier, HistGradientBoostingRegressor
from threadpoolctl import threadpool_limits

from slatprep.demo import make_demo
from slatprep.learn.metrics import METRICS, score_asset
from slatprep.learn.predictions import VoxelPrediction
from slatprep.normalize import normalize_properties
from slatprep.parameters.files import load_parameters
from slatprep.pipeline.dataset import build_store
from slatprep.records import USABLE, Normalization
from slatprep.store import open_store

PRESETS = {"paper": "paper", "slatprep": "default"}
TRAIN_SEED, TEST_SEED = 11, 12
USED = "slatprep, failed left out"
RESAMPLES = 4000


class Voxels(NamedTuple):
    """The N SLAT voxels of one object: what each is judged by, and its labels where valid."""

    features: NDArray[np.float64]
    properties: NDArray[np.float64]
    material: NDArray[np.uint8]
    valid: NDArray[np.bool_]


Objects = dict[str, Voxels]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    add = parser.add_argument
    add("--assets", type=int, default=42, help="of each level, to learn from")
    add("--test-assets", type=int, default=42, help="of each level, to measure on")
    add("--levels", type=int, nargs="+", default=[3, 5, 6, 7])
    add("--draws", type=int, default=12, help="trainings on each set of labels")
    add("--voxels", type=int, default=500, help="of each object, to learn from")
    add("--test-voxels", type=int, default=1500, help="of each object, to measure on")
    add("--jobs", type=int, default=1, help="processes that build, threads that learn")
    add("--work", type=Path, default=Path("alignment-pays"))
    add("--csv", type=Path, help="also write every score there")
    options = parser.parse_args()
    threadpool_limits(options.jobs)
    rows: list[tuple[object, ...]] = []
    print("| level | labels of | objects | labels right |", " | ".join(METRICS), "|")
    print("| --- " * (4 + len(METRICS)) + "|", flush=True)
    for level in options.levels:
        folder = options.work / f"L{level}"
        sets, normalization = training_sets(folder, level, options.assets, options.jobs)
        config = demo(folder / "measure", level, options.test_assets, TEST_SEED)
        test = true_objects(config.parent, normalization, options.test_voxels)
        scores = {
            name: np.array([
                learn_and_score(objects, test, sets["truth"], options.voxels, draw)
                for draw in range(options.draws)
            ])
            for name, objects in sets.items()
        }  # fmt: skip
        for name, objects in sets.items():
            show(level, name, objects, sets["truth"], scores[name], scores["paper"])
            rows += [
                (level, name, draw, asset_id, *scores[name][draw, index])
                for draw in range(options.draws)
                for index, asset_id in enumerate(test)
            ]
    if options.csv:
        with options.csv.open("w", encoding="utf-8", newline="") as file:
            head = ("level", "labels of", "draw", "object", *METRICS)
            csv.writer(file).writerows([head, *rows])


def demo(folder: Path, level: int, assets: int, seed: int) -> Path:
    """Make demo objects; return their dataset definition."""
    return make_demo(folder, assets, seed, levels=(level,), latents="material").config


def training_sets(
    folder: Path, level: int, assets: int, jobs: int
) -> tuple[dict[str, Objects], Normalization]:
    """Return the objects of one level by whose labels they carry, and how they are normalised."""
    config = demo(folder / "learn", level, assets, TRAIN_SEED)
    stores = {}
    for name, preset in PRESETS.items():
        out = folder / f"{name}.zarr"
        if not out.exists():
            overrides = {"normalize": {"ranges": "dataset"}}
            build_store(load_parameters(config, overrides, preset), out, jobs=jobs)
        stores[name] = open_store(out)
    normalization = stores["slatprep"].normalization
    if any(store.normalization != normalization for store in stores.values()):
        raise SystemExit(f"{folder}: the stores normalise differently; their errors do not compare")
    sets: dict[str, Objects] = {name: {} for name in PRESETS}
    for name, store in stores.items():
        for asset in map(store.asset, store.ids):
            sets[name][asset.asset_id] = Voxels(
                features_of(asset.coords, asset.feats),
                asset.properties.astype(np.float64),
                asset.material,
                asset.valid,
            )
    usable = np.isin(stores["slatprep"].column("verdict"), USABLE)
    sets[USED] = {
        asset_id: sets["slatprep"][asset_id]
        for asset_id, used in zip(stores["slatprep"].ids, usable, strict=True)
        if used
    }
    sets["truth"] = true_objects(config.parent, normalization)
    return sets, normalization


def true_objects(folder: Path, normalization: Normalization, voxels: int | None = None) -> Objects:
    """Return demo objects with true labels, in every voxel or in some chosen at random."""
    objects = {}
    for path in sorted((folder / "truth").glob("*.npz")):
        with np.load(path) as truth, np.load(folder / "slat" / path.name) as slat:
            rows = np.arange(len(slat["coords"]))
            if voxels is not None:
                rows = np.random.default_rng(0).permutation(rows)[:voxels]
            properties = normalize_properties(truth["properties"][rows], normalization)
            objects[path.stem] = Voxels(
                features_of(slat["coords"][rows], slat["feats"][rows]),
                properties.astype(np.float64),
                truth["material"][rows],
                np.ones(len(rows), dtype=bool),
            )
    return objects


def features_of(coords: NDArray[np.uint8], feats: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return what the trees see of each voxel, (N, 11)."""
    return np.hstack([feats, coords]).astype(np.float64)


def learn_and_score(
    objects: Objects, test: Objects, pool: Objects, voxels: int, draw: int
) -> NDArray[np.float64]:
    """Learn from a draw of objects; return `METRICS` of each object of `test`, (objects, 5).

    The draw is of `pool`, so that it is the same for every set of labels; what
    a set does not have is not learnt from.
    """
    rng = np.random.default_rng(draw)
    chosen = rng.choice(sorted(pool), size=len(pool))
    rows = [rng.permutation(len(pool[name].material))[:voxels] for name in chosen]
    parts = []
    for name, row in zip(chosen, rows, strict=True):
        if name in objects:
            there = objects[name]
            row = row[there.valid[row]]
            parts.append((there.features[row], there.properties[row], there.material[row]))
    features, properties, material = (np.concatenate(part) for part in zip(*parts, strict=True))
    common = {"max_iter": 60, "early_stopping": False, "random_state": draw}
    models = [
        HistGradientBoostingRegressor(**common).fit(features, column) for column in properties.T
    ]
    classes = HistGradientBoostingClassifier(**common).fit(features, material)
    # One call for all objects: a call costs more than its voxels.
    seen = np.concatenate([one.features for one in test.values()])
    predicted = np.column_stack([model.predict(seen) for model in models])
    named = classes.predict(seen)
    ends = np.cumsum([len(one.material) for one in test.values()])[:-1]
    return np.array([
        score_asset(VoxelPrediction(values, number), one._asdict())
        for one, values, number in zip(
            test.values(), np.split(predicted, ends), np.split(named, ends), strict=True
        )
    ])  # fmt: skip


def show(
    level: int,
    name: str,
    objects: Objects,
    truth: Objects,
    scores: NDArray[np.float64],
    beside: NDArray[np.float64],
) -> None:
    """Print a row: means, and in brackets the interval of the difference to `beside`."""
    right = np.mean([
        (one.material == truth[key].material)[one.valid].mean()
        for key, one in objects.items() if one.valid.any()
    ])  # fmt: skip
    cells = [f"{value:.4f}" for value in scores.mean(axis=(0, 1))]
    if scores is not beside:
        rng = np.random.default_rng(0)
        draws, count = scores.shape[:2]
        apart = scores - beside
        resampled = np.array([
            apart[rng.integers(draws)][rng.integers(count, size=count)].mean(axis=0)
            for _ in range(RESAMPLES)
        ])  # fmt: skip
        ends = np.percentile(resampled, [2.5, 97.5], axis=0).T
        cells = [f"{cell} [{lo:+.4f}, {hi:+.4f}]"
                 for cell, (lo, hi) in zip(cells, ends, strict=True)]  # fmt: skip
    print(f"| L{level} | {name} | {len(objects)} | {right:.4f} |", " | ".join(cells), "|",
          flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
