"""Reference models for a decoder: the training mean, and a linear model of single voxels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.frames import voxel_centres
from slatprep.learn.predictions import VoxelPrediction
from slatprep.store import Store

COLUMNS = ("coords", "feats", "properties", "material", "valid")
"""The arrays of an asset that a baseline is fitted to."""

Rows = Mapping[str, NDArray[Any]]
"""Those arrays by name, as `Store.read` returns them."""


@dataclass(frozen=True)
class VoxelBaseline:
    """Targets as a linear function of a voxel's inputs.

    Attributes
    ----------
    name : str
        What tables and pictures call it.
    weights : ndarray of float64, shape (channels + 4, P + classes)
        From latents, position and 1 to properties and class indicators.
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
        inputs, targets = _inputs(rows)[valid], _targets(rows, contents.n_classes)[valid]
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
    # Of another grid than 64^3 on another scale, which the weights make up for.
    position = voxel_centres(rows["coords"])
    return np.hstack([rows["feats"], position, np.ones((len(position), 1))])


def _targets(rows: Rows, classes: int) -> NDArray[np.float64]:
    return np.hstack([rows["properties"], rows["material"][:, None] == np.arange(classes)])
