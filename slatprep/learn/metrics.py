"""Pixie's protocol as SLAT-Phys states it: means over voxels, then over objects.

Two reference models are measured beside predictions: the training mean, and a linear model of
single voxels.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.frames import voxel_centres
from slatprep.learn.predictions import VoxelPrediction
from slatprep.records import Normalization
from slatprep.store import Store

METRICS = ("log10 E", "log10 density", "nu", "mean", "accuracy")
"""Mean squared errors in normalised space, their mean, and class accuracy.

The names are the columns of tables and CSV files.
"""

OURS = "these predictions"
"""Name of the method whose predictions are for SLAT voxels."""

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

COLUMNS = ("coords", "feats", "properties", "material", "valid")
"""The arrays of an asset that a baseline is fitted to and measured on."""

Rows = Mapping[str, NDArray[Any]]
"""Arrays of an asset by name, as `Store.read` returns them."""


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


def score_asset(prediction: VoxelPrediction, truth: Rows) -> NDArray[np.float64]:
    """Return the metrics (P + 2,) of an asset, in the order of `metrics_of`.

    They are means over its valid voxels, at least one. `truth` has ``properties``
    (N, P) in [-1, 1], ``material`` (N,) and ``valid`` (N,). Accuracy is NaN if no class was
    predicted.
    """
    valid = truth["valid"]
    errors = np.square(prediction.properties - truth["properties"])[valid].mean(axis=0)
    accuracy = np.nan
    if prediction.material is not None:
        accuracy = float((prediction.material == truth["material"])[valid].mean())
    return np.array([*errors, errors.mean(), accuracy])


def measure(scores: NDArray[np.float64], spread: Spread, names: Sequence[str] = METRICS) -> Measure:
    """Return mean and spread of scores (objects, metrics) over at least one object.

    Where objects have NaN as a score, it is measured over the others.
    """
    means, spreads = {}, {}
    for name, column in zip(names, scores.T, strict=True):
        own = column[~np.isnan(column)]
        means[name] = float(own.mean()) if own.size else np.nan
        deviation = np.nan
        if own.size > 1:
            deviation = float(own.std(ddof=0 if spread == "pixie-std" else 1))
            if spread in ("se", "pixie"):
                deviation /= np.sqrt(own.size)
            if spread in ("pixie", "pixie-std") and name == "accuracy":
                deviation *= _PIXIE_90
        spreads[name] = float(deviation)
    return Measure(len(scores), means, spreads)


Measures = dict[str, Measure]
"""Scores by the name of a method."""


def means_of_objects(
    objects: NDArray[np.str_], rows: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Average the rows (A, ...) of assets over the assets of each object: (O, ...).

    Return the first asset of each object, too. Where an object has NaN alone, the mean is NaN.
    """
    _, first, number = np.unique(objects, return_index=True, return_inverse=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Mean of empty slice")  # No view has a class.
        means = [np.nanmean(rows[number == k], axis=0) for k in range(len(first))]
    return first, np.array(means)


def average_methods(
    store: Store,
    scored: Mapping[int, Sequence[NDArray[np.float64]]],
    methods: Sequence[str],
    spread: Spread,
) -> tuple[Measures, dict[str, Measures]]:
    """Average the metrics of methods over assets per object, then over objects.

    `scored` has the metrics (metrics,) of each method by asset. The views of an object count as one
    object. Returns the measures over all objects, and the measures by category.
    """
    objects, categories = (
        np.array([str(column[index]) for index in scored])
        for column in (store.column("object_id"), store.column("category"))
    )
    first, per_object = means_of_objects(objects, np.array(list(scored.values())))
    category, names = categories[first], metrics_of(store.normalization)

    def measures(chosen: NDArray[np.bool_]) -> Measures:
        own = per_object[chosen]
        return {name: measure(own[:, k], spread, names) for k, name in enumerate(methods)}

    groups = {str(name): measures(category == name) for name in np.unique(category)}
    return measures(np.ones(len(first), dtype=bool)), groups


@dataclass(frozen=True)
class VoxelBaseline:
    """Targets as a linear function of a voxel's inputs.

    Attributes
    ----------
    name : str
        Its name in tables and pictures.
    weights : ndarray of float64, shape (channels + 4, P + classes)
        Map from latents, position and 1 to properties and class indicators.
    properties : int
        Number of properties P.
    """

    name: str
    weights: NDArray[np.float64]
    properties: int

    def predict(self, rows: Rows) -> VoxelPrediction:
        """Return properties (N, P), within [-1, 1], and classes (N,) if there are any."""
        outputs = _inputs(rows) @ self.weights
        properties, classes = np.split(outputs, [self.properties], axis=1)
        material = classes.argmax(axis=1) if classes.size else None
        return VoxelPrediction(np.clip(properties, -1, 1), material)


def fit_baselines(store: Store, assets: Iterable[int]) -> tuple[VoxelBaseline, VoxelBaseline]:
    """Fit both reference models to assets in one pass; all valid voxels weigh the same.

    The first gives the mean and the most frequent class of all voxels, the second is a
    least-squares fit.
    """
    contents = store.contents
    size, count = contents.latents.channels + 4, len(contents.properties)
    squares = np.zeros((size, size))
    products = np.zeros((size, count + contents.n_classes))
    for index in assets:
        rows = store.read(index, COLUMNS)
        valid = rows["valid"]
        classes = rows["material"][:, None] == np.arange(contents.n_classes)
        inputs, targets = _inputs(rows)[valid], np.hstack([rows["properties"], classes])[valid]
        squares += inputs.T @ inputs
        products += inputs.T @ targets
    # The last input is 1, so its products are the sum of the targets and the count.
    mean = np.zeros_like(products)
    mean[-1] = products[-1] / squares[-1, -1]
    linear = np.linalg.lstsq(squares, products, rcond=None)[0]
    return (
        VoxelBaseline("mean of the training voxels", mean, count),
        VoxelBaseline("linear in each voxel", np.asarray(linear, np.float64), count),
    )


def _inputs(rows: Rows) -> NDArray[np.float64]:
    # Voxels of another grid than 64^3 give another scale, for which the weights compensate.
    position = voxel_centres(rows["coords"])
    return np.hstack([rows["feats"], position, np.ones((len(position), 1))])
