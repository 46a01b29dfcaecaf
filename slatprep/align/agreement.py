"""Measure how evenly two surfaces fit: by direction, by block of space, and on each side.

Two shapes of the same object differ in a few places and agree elsewhere. Shapes of two different
objects disagree in most directions. Means over all samples hardly tell these cases apart.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.frames import Array
from slatprep.records import Agreement

BLOCK = 8.0
"""Edge of a block of space, in voxels."""

_LEAST = 12
"""Smallest number of samples with which a direction counts."""

_MOST = 4.0
"""Upper limit, in voxels, of the difference in a direction."""

_AXES = np.array([axes for axes in product((-1.0, 0.0, 1.0), repeat=3) if any(axes)])
UNIT_DIRECTIONS: Array = _AXES / np.linalg.norm(_AXES, axis=1, keepdims=True)
"""The 26 directions of a cube's faces, edges and corners."""


def agreement_of(slat: Array, pixieverse: Array, normals: Array, places: Array) -> Agreement:
    """Measure the agreement of two surfaces.

    `slat` (N,) and `pixieverse` (M,) are residuals in voxels. `normals` (N+M, 3), unit vectors, and
    `places` (N+M, 3), in voxels, belong to the samples of both sides, SLAT first.
    """
    apart = np.abs(np.concatenate([slat, pixieverse]))
    near, middle, counts = _by_direction(apart, normals)
    median, samples = _by_block(apart, places)
    total = samples.sum()
    weights = counts / counts.sum()
    return Agreement(
        directions_near=float(weights @ np.minimum(near, _MOST)),
        directions_middle=float(weights @ np.minimum(middle, _MOST)),
        directions_worst=float(min(np.sort(near)[-2:][0], _MOST)),
        blocks_near=float(samples[median <= 0.5].sum() / total),
        blocks_middle=float(samples[median <= 1.0].sum() / total),
        blocks_far=float(samples[median <= 1.5].sum() / total),
        within_slat=shares_within(np.abs(slat), 0.5, 1.0, 1.5),
        within_pixieverse=shares_within(np.abs(pixieverse), 0.5, 1.0, 1.5),
    )


def shares_within(apart: Array, *limits: float) -> tuple[float, float, float]:
    """Return the share of the distances `apart` (N,) within each of three limits."""
    near, middle, far = (float((apart <= limit).mean()) for limit in limits)
    return near, middle, far


def _by_direction(apart: Array, normals: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """Return the 0.3 quantile and the median of `apart`, and the sample count, by direction."""
    groups = np.argmax(normals @ UNIT_DIRECTIONS.T, axis=1)
    counts = np.bincount(groups, minlength=len(UNIT_DIRECTIONS))
    if counts.max() < _LEAST:
        groups, counts = np.zeros_like(groups), np.array([len(apart)])
    order, first = _sorted_by(groups, apart, counts)
    use = counts >= min(_LEAST, counts.max())
    last = counts[use] - 1
    near, middle = (apart[order[first[use] + (p * last).astype(np.intp)]] for p in (0.3, 0.5))
    return near, middle, counts[use]


def blocks_of(places: Array) -> NDArray[np.intp]:
    """Return the number (N,) of the block of space in which each of the places (N, 3) lies."""
    cells = np.floor(places / BLOCK).astype(np.intp)
    cells -= cells.min(axis=0)
    # The factors exceed the number of blocks along an axis, so each block has its own number.
    numbers = cells @ np.array([1 << 32, 1 << 16, 1])
    return np.unique(numbers, return_inverse=True)[1].reshape(-1)


def _by_block(apart: Array, places: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the median of `apart` and the sample count in each block of space."""
    groups = blocks_of(places)
    counts = np.bincount(groups)
    order, first = _sorted_by(groups, apart, counts)
    median: Array = apart[order[first + (counts - 1) // 2]]
    return median, counts


def _sorted_by(
    groups: NDArray[np.intp], values: Array, counts: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the order of `values` by group and then by size, and each group's first index."""
    return np.lexsort((values, groups)), np.cumsum(counts) - counts
