"""Reference models for a decoder: the training mean, and a linear model of single voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.frames import voxel_centres
from slatprep.learn.dataset import Item, SlatDataset


@dataclass(frozen=True)
class VoxelBaseline:
    """Targets as a linear function of a voxel's inputs.

    Attributes
    ----------
    weights : ndarray of float64, shape (channels + 4, P + classes)
        From latents, position and 1 to properties and class indicators.
    properties : int
        Number of properties P.
    """

    weights: NDArray[np.float64]
    properties: int

    def predict(self, item: Item) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return properties (N, P), within [-1, 1], and classes (N,)."""
        outputs = _inputs(item) @ self.weights
        split = self.properties
        return np.clip(outputs[:, :split], -1, 1), outputs[:, split:].argmax(axis=1)

    def error(self, dataset: SlatDataset) -> float:
        """Return the mean squared error of the properties, a mean over assets."""
        errors = []
        for item in (dataset[k] for k in range(len(dataset))):
            predicted, _ = self.predict(item)
            valid = item.valid.numpy()
            errors.append(np.square(predicted - item.properties.numpy())[valid].mean())
        return float(np.mean(errors))


def fit_baselines(dataset: SlatDataset) -> tuple[VoxelBaseline, VoxelBaseline]:
    """Fit both reference models to a dataset in one pass; all valid voxels weigh the same.

    The first gives the mean and the most frequent class of all voxels, the second is a
    least-squares fit.
    """
    contents = dataset.store.contents
    size, count = contents.latents.channels + 4, len(contents.properties)
    squares = np.zeros((size, size))
    products = np.zeros((size, count + contents.n_classes))
    for item in (dataset[k] for k in range(len(dataset))):
        valid = item.valid.numpy()
        inputs, targets = _inputs(item)[valid], _targets(item, contents.n_classes)[valid]
        squares += inputs.T @ inputs
        products += inputs.T @ targets
    # The last input is 1, so its products are the sum of the targets and the count.
    mean = np.zeros_like(products)
    mean[-1] = products[-1] / squares[-1, -1]
    linear = np.linalg.lstsq(squares, products, rcond=None)[0]
    return VoxelBaseline(mean, count), VoxelBaseline(np.asarray(linear, np.float64), count)


def _inputs(item: Item) -> NDArray[np.float64]:
    # Of another grid than 64^3 on another scale, which the weights make up for.
    position = voxel_centres(item.coords.numpy())
    return np.hstack([item.feats.numpy(), position, np.ones((len(position), 1))])


def _targets(item: Item, classes: int) -> NDArray[np.float64]:
    indicators = item.material.numpy()[:, None] == np.arange(classes)
    return np.hstack([item.properties.numpy(), indicators])
