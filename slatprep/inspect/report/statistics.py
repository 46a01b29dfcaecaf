"""What the report counts: orientations, classes, and the spread of the properties."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.align.starts import distinct_starts
from slatprep.geometry.frames import split_transform
from slatprep.records import BACKGROUND, UNANNOTATED
from slatprep.store import StoredAsset

BINS = 64
"""Bins of the histograms of normalised properties, over [-1, 1]."""


@dataclass(frozen=True)
class Tally:
    """Counts over the voxels of an asset, or of many.

    Attributes
    ----------
    field : ndarray of int64, shape (P, 7, BINS)
        Annotated voxels of the PixieVerse field by property, class and bin.
    slat : ndarray of int64, shape (P, 7, BINS)
        Valid SLAT voxels by property, class and bin.
    classes : ndarray of int64, shape (8,)
        SLAT voxels of each class; the last counts those that are not valid.
    """

    field: NDArray[np.int64]
    slat: NDArray[np.int64]
    classes: NDArray[np.int64]

    def __add__(self, other: Tally) -> Tally:
        return Tally(self.field + other.field, self.slat + other.slat, self.classes + other.classes)


def no_tally(properties: int) -> Tally:
    """Return the tally of nothing, of so many properties."""
    # The classes of a material are those below BACKGROUND.
    shape = (properties, BACKGROUND, BINS)
    return Tally(
        np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.zeros(BACKGROUND + 1, np.int64)
    )


def tally(asset: StoredAsset) -> Tally:
    """Count the classes and property values of one asset's voxels."""
    annotated = asset.grid_material < BACKGROUND
    classes = np.where(asset.material == UNANNOTATED, BACKGROUND, asset.material)
    return Tally(
        field=_histograms(asset.grid_properties[:, annotated].T, asset.grid_material[annotated]),
        slat=_histograms(asset.properties[asset.valid], asset.material[asset.valid]),
        classes=np.bincount(classes, minlength=BACKGROUND + 1).astype(np.int64),
    )


def nearest_quarter_turn(transform: ArrayLike) -> tuple[int, float]:
    """Return which of the 24 quarter turns is nearest to a transform's rotation.

    Parameters
    ----------
    transform : array_like, shape (4, 4)
        PixieVerse frame to SLAT frame.

    Returns
    -------
    index : int
        Position in `quarter_turns`.
    angle : float
        Degrees between the two rotations.
    """
    rotation, _, _ = split_transform(transform)
    turns = np.stack([start.rotation for start in distinct_starts()])
    traces = np.einsum("kij,ij->k", turns, rotation)
    index = int(np.argmax(traces))
    cosine = np.clip((traces[index] - 1.0) / 2.0, -1.0, 1.0)
    return index, float(np.degrees(np.arccos(cosine)))


def quarter_turns() -> tuple[str, ...]:
    """Return in words where each of the 24 quarter turns takes x, y and z.

    Examples
    --------
    >>> quarter_turns()[0]
    'x→+x y→+y z→+z'
    """
    return tuple(_in_words(start.rotation) for start in distinct_starts())


def _in_words(rotation: NDArray[np.float64]) -> str:
    words = []
    for name, column in zip("xyz", rotation.T, strict=True):
        axis = int(np.argmax(np.abs(column)))
        words.append(f"{name}→{'+' if column[axis] > 0 else '−'}{'xyz'[axis]}")  # noqa: RUF001
    return " ".join(words)


def _histograms(properties: NDArray[np.float32], material: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Count normalised properties (N, 3) by property, class (N,) and bin."""
    bins = np.clip(((properties + 1.0) * (BINS / 2)).astype(np.int64), 0, BINS - 1)
    flat = material.astype(np.int64)[:, None] * BINS + bins
    counts: Sequence[NDArray[np.int64]] = [
        np.bincount(column, minlength=BACKGROUND * BINS) for column in flat.T
    ]
    return np.stack(counts).reshape(len(counts), BACKGROUND, BINS).astype(np.int64)
