"""Counts, moments and histograms of an asset's voxels before and after the lookup.

Tallies of several assets are added with ``+``. Moments are merged by the pairwise update of
Chan, Golub and LeVeque ("Updating Formulae and a Pairwise Algorithm for Computing Sample
Variances", 1979), which stays accurate for any number of assets.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.normalize import denormalize_properties
from slatprep.store import Store

DRAWN_BINS = 64
"""Number of bins of a histogram that is drawn, and of each axis of the joint one, over [-1, 1]."""

Voxels = Iterable[NDArray[Any]]
"""Classes and normalised properties of voxels."""


SIDES = ("field", "slat")
"""Names of the sides: the PixieVerse field before the lookup, the SLAT's voxels after it."""


@dataclass(frozen=True, eq=False)
class Tally:
    """Sums over the voxels of one or more assets; the first axis of every array is `SIDES`.

    C is the number of labels, P the number of properties.

    Attributes
    ----------
    assets, voxels : ndarray of int64, shape (2, C + 1)
        Number of assets that have voxels of each class, and of these voxels; the last entry
        is for voxels without an annotation.
    weights : ndarray of float64, shape (2, C + 1)
        Total weight of these voxels.
    histogram : ndarray of float64, shape (2, P, C, bins)
        Weight by property, class and bin of the normalised value, over [-1, 1].
    sums : ndarray of float64, shape (2, P, C, bins)
        Weighted sum of the normalised values in each bin: the bin's mean is exact if all are equal.
    joint : ndarray of float64, shape (2, DRAWN_BINS, DRAWN_BINS)
        Weight by bins of the first two properties; zero if there is only one.
    mean, squares : ndarray of float64, shape (2, 2, P, C)
        Weighted mean, and weighted sum of squared differences from it, of the
        normalised values and of the values in SI units.
    least, most : ndarray of float64, shape (2, P, C)
        Smallest and largest normalised value; inf and -inf if there are no voxels.
    """

    assets: NDArray[np.int64]
    voxels: NDArray[np.int64]
    weights: NDArray[np.float64]
    histogram: NDArray[np.float64]
    sums: NDArray[np.float64]
    joint: NDArray[np.float64]
    mean: NDArray[np.float64]
    squares: NDArray[np.float64]
    least: NDArray[np.float64]
    most: NDArray[np.float64]

    def __add__(self, other: Tally) -> Tally:
        weights = np.stack([self.weights, other.weights])
        mean, squares = pooled(
            weights[:, :, None, None, :-1],
            np.stack([self.mean, other.mean]),
            np.stack([self.squares, other.squares]),
            axis=0,
        )
        least, most = np.minimum(self.least, other.least), np.maximum(self.most, other.most)
        names = ("assets", "voxels", "weights", "histogram", "sums", "joint")
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        return Tally(**sums, mean=mean, squares=squares, least=least, most=most)


def pooled(
    weights: NDArray[np.float64], mean: NDArray[np.float64], squares: NDArray[np.float64], axis: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Merge means and sums of squared differences, shaped like `weights`, along an axis.

    Both results are 0 where all weights are 0.
    """
    total = weights.sum(axis=axis, keepdims=True)
    centre = (weights * mean).sum(axis=axis, keepdims=True) / np.where(total > 0, total, 1.0)
    merged = (squares + weights * (mean - centre) ** 2).sum(axis=axis)
    return centre.squeeze(axis), merged


def no_tally(store: Store, bins: int) -> Tally:
    """Return the tally of no voxels of a store, for a number of bins."""
    properties = np.zeros((len(store.normalization.ranges), 0), np.float32)
    material = np.zeros(0, np.uint8)
    return tally(store, (material, properties), (material, properties.T), bins)


def tally(store: Store, field: Voxels, slat: Voxels, bins: int, by_asset: bool = False) -> Tally:
    """Tally the voxels of one asset of a store in `bins` of the normalised values over [-1, 1].

    `field` and `slat` are classes and normalised properties, shaped like ``grid/*`` ((R, R, R)
    and (P, R, R, R)) and ``voxel/*`` ((N,) and (N, P)). With `by_asset`, all voxels of a side
    together have weight 1; otherwise each voxel has weight 1.
    """
    (grid, values), (material, properties) = field, slat
    labels = store.contents.n_labels
    before = grid[grid != store.contents.background], values[:, grid < labels]
    after = material, properties[material < labels].T
    sides = [_side(store, of, own, bins, by_asset) for of, own in (before, after)]
    return Tally(**{name: np.stack([one[name] for one in sides]) for name in sides[0]})


def _side(
    store: Store,
    material: NDArray[np.uint8],
    properties: NDArray[np.float32],
    bins: int,
    by_asset: bool,
) -> dict[str, NDArray[Any]]:
    """Tally voxels (N,) of one side; `properties` (P, K) are those of voxels with a class."""
    labels = store.contents.n_labels
    weight = np.float64(1.0 / max(len(material), 1) if by_asset else 1.0)
    classes = np.minimum(material, labels)
    counts = np.bincount(classes, minlength=labels + 1).astype(np.int64)
    own = classes[classes < labels].astype(np.int64)
    values = np.stack([properties, denormalize_properties(properties.T, store.normalization).T])
    values = values.astype(np.float64)
    size, shape = labels * bins, (len(properties), labels, bins)
    places = own * bins + _bins(properties, bins)
    histogram = [np.bincount(row, minlength=size) for row in places]
    sums = [np.bincount(*pair, minlength=size) for pair in zip(places, values[0], strict=True)]
    joint: NDArray[np.float64] = np.zeros(DRAWN_BINS**2)
    if len(properties) > 1:
        first, second = _bins(properties[:2], DRAWN_BINS)
        joint += np.bincount(first * DRAWN_BINS + second, minlength=DRAWN_BINS**2) * weight
    mean, squares = np.zeros((2, 2, len(properties), labels))
    least, most = (np.full(mean.shape[1:], end) for end in (np.inf, -np.inf))
    for index in np.flatnonzero(counts[:-1]):
        chosen = values[:, :, own == index]
        mean[..., index] = chosen.mean(axis=-1)
        squares[..., index] = ((chosen - mean[..., index, None]) ** 2).sum(axis=-1) * weight
        least[:, index], most[:, index] = chosen[0].min(axis=-1), chosen[0].max(axis=-1)
    return {
        "assets": (counts > 0).astype(np.int64),
        "voxels": counts,
        "weights": counts * weight,
        "histogram": np.stack(histogram).reshape(shape) * weight,
        "sums": np.stack(sums).reshape(shape) * weight,
        "joint": joint.reshape(DRAWN_BINS, DRAWN_BINS),
        "mean": mean,
        "squares": squares,
        "least": least,
        "most": most,
    }


def _bins(values: NDArray[np.float32], bins: int) -> NDArray[np.int64]:
    """Return the index of each value's bin among equal bins over [-1, 1]."""
    places: NDArray[np.int64] = ((values + 1.0) * (bins / 2)).astype(np.int64)
    return np.clip(places, 0, bins - 1)
