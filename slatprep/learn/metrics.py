"""Pixie's protocol as SLAT-Phys states it: means over voxels, then over objects."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.learn.baselines import COLUMNS, fit_baselines
from slatprep.learn.predictions import VoxelPrediction, check_prediction, open_predictions
from slatprep.learn.splits import select_assets
from slatprep.readers.splits import Shares, Split
from slatprep.records import Normalization, Place
from slatprep.store import open_store

METRICS = ("log10 E", "log10 density", "nu", "mean", "accuracy")
"""Mean squared errors in normalised space, their mean, and class accuracy.

The names are the columns of tables and CSV files.
"""

_SHORT = {"youngs_modulus": "E", "poissons_ratio": "nu"}


def metrics_of(normalization: Normalization) -> tuple[str, ...]:
    """Return the metrics for a store's properties: `METRICS` for those of PixieVerse."""
    names = (
        f"{'log10 ' if span.log10 else ''}{_SHORT.get(span.name, span.name)}"
        for span in normalization.ranges
    )
    return (*names, "mean", "accuracy")


Spread = Literal["se", "sd", "pixie", "pixie-std"]

SPREADS: dict[Spread, str] = {
    "se": "standard error",
    "sd": "standard deviation",
    "pixie": "standard error, of accuracy 1.645 standard errors, as Pixie prints",
    "pixie-std": "standard deviation by n, of accuracy 1.645 of them, as Pixie's std prints",
}
"""Kinds of `Measure.spreads` over objects: the first two with n - 1, the others as
vlongle/pixie's ``metrics.py`` prints them."""

_PIXIE_90 = 1.645
"""Standard errors in half of Pixie's 90 % interval for accuracy."""


@dataclass(frozen=True)
class Measure:
    """Scores over objects.

    Attributes
    ----------
    objects : int
        Number of objects.
    means, spreads : dict of str to float
        Mean over objects and its spread, see `SPREADS`, by metric; NaN if not defined.
    """

    objects: int
    means: dict[str, float]
    spreads: dict[str, float]


@dataclass(frozen=True)
class Evaluation:
    """Scores of predictions.

    Attributes
    ----------
    spread : str
        The kind of `Measure.spreads`, see `SPREADS`.
    overall : Measure
        Over all objects.
    categories : dict of str to Measure
        Over the objects of each category.
    missing : list of str
        Assets of the split without a prediction; they are not in the scores.
    converted : int
        Assets whose prediction was normalised by other ranges and was converted to the
        store's.
    baselines : dict of str to Measure
        The reference models on the same assets, see `slatprep.learn.baselines`; empty if the
        split train has no object.
    """

    spread: Spread
    overall: Measure
    categories: dict[str, Measure]
    missing: list[str]
    converted: int = 0
    baselines: dict[str, Measure] = field(default_factory=dict)


def score_asset(
    prediction: VoxelPrediction,
    properties: NDArray[np.float32],
    material: NDArray[np.uint8],
    valid: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Return the metrics (P + 2,) of an asset, in the order of `metrics_of`.

    They are means over its valid voxels, of which there must be one. `properties` (N, P) in [-1, 1]
    and `material` (N,) are the truth. Accuracy is NaN if no class was predicted.
    """
    errors = np.square(prediction.properties - properties)[valid].mean(axis=0)
    accuracy = np.nan
    if prediction.material is not None:
        accuracy = float((prediction.material == material)[valid].mean())
    return np.array([*errors, errors.mean(), accuracy])


def measure(scores: NDArray[np.float64], spread: Spread, names: Sequence[str] = METRICS) -> Measure:
    """Return mean and spread of scores (objects, metrics) over at least one object."""
    count = len(scores)
    deviation = np.full(len(names), np.nan)
    if count > 1:
        deviation = scores.std(axis=0, ddof=0 if spread == "pixie-std" else 1)
        if spread in ("se", "pixie"):
            deviation /= np.sqrt(count)
        if spread in ("pixie", "pixie-std"):
            deviation[list(names).index("accuracy")] *= _PIXIE_90
    means, spreads = (
        dict(zip(names, figures.tolist(), strict=True))
        for figures in (scores.mean(axis=0), deviation)
    )
    return Measure(count, means, spreads)


def average_objects(
    scores: Sequence[NDArray[np.float64]],
    objects: Sequence[str],
    categories: Sequence[str],
    spread: Spread,
    names: Sequence[str] = METRICS,
) -> tuple[Measure, dict[str, Measure]]:
    """Average assets per object, then objects, over all and per category.

    `scores` has the metrics (metrics,) of each asset. The views of an object count as one object.
    """
    _, first, number = np.unique(objects, return_index=True, return_inverse=True)
    rows = np.array(scores)
    per_object = np.array([rows[number == k].mean(axis=0) for k in range(len(first))])
    category = np.array(categories)[first]
    groups = {
        str(name): measure(per_object[category == name], spread, names)
        for name in np.unique(category)
    }
    return measure(per_object, spread, names), groups


def evaluate_store(
    predictions: Path,
    store_path: Place,
    split: Split | None = "test",
    shares: Shares = Shares(),  # noqa: B008 (immutable)
    spread: Spread = "se",
    verdicts: Collection[str] | None = None,
    max_ambiguity: float | None = None,
    splits: Mapping[str, Split] | None = None,
) -> Evaluation:
    """Measure predictions, as `open_predictions` reads them, against a store.

    `shares` are those of the training. `slatprep.learn.splits.select_assets` takes split and
    filters. InputError if no asset of the split has a prediction, or a prediction cannot be used.
    """
    store = open_store(store_path)
    object_ids, categories = store.column("object_id"), store.column("category")
    scored: list[int] = []
    scores: list[NDArray[np.float64]] = []
    missing: list[str] = []
    converted = 0
    select = partial(
        select_assets,
        store,
        shares=shares,
        verdicts=verdicts,
        max_ambiguity=max_ambiguity,
        splits=splits,
    )
    chosen, trained = select(split), select("train").tolist()
    baselines = fit_baselines(store, trained) if trained else ()
    theirs: list[list[NDArray[np.float64]]] = [[] for _ in baselines]
    with open_predictions(predictions) as read:
        for index in chosen.tolist():
            asset_id = store.ids[index]
            arrays = read(asset_id)
            if arrays is None:
                missing.append(asset_id)
                continue
            rows = store.read(index, COLUMNS)
            truth = rows["properties"], rows["material"], rows["valid"]
            source, ranges = f"{predictions}/{asset_id}", store.normalization
            prediction = check_prediction(source, arrays, rows["coords"], ranges, store.contents)
            converted += prediction.converted
            scored.append(index)
            if not store.contents.classes:
                prediction = replace(prediction, material=None)
            scores.append(score_asset(prediction, *truth))
            for one, own in zip(baselines, theirs, strict=True):
                own.append(score_asset(one.predict(rows), *truth))
    if not scored:
        raise InputError(
            predictions,
            f"has no prediction of an asset of split {split or 'all'}",
            f"ids of that split, such as {', '.join(missing[:3]) or 'none: the split is empty'}",
        )
    average = partial(
        average_objects,
        objects=[str(object_ids[k]) for k in scored],
        categories=[str(categories[k]) for k in scored],
        spread=spread,
        names=metrics_of(store.normalization),
    )
    overall, groups = average(scores)
    beside = {one.name: average(own)[0] for one, own in zip(baselines, theirs, strict=True)}
    return Evaluation(spread, overall, groups, missing, converted, beside)
