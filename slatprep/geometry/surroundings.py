"""Measure how the cells around points are labelled, in shells; a compiled inner loop."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.kernel import kernel
from slatprep.records import RESOLUTION

DIRECTIONS = 14
"""Number of cells in each shell: along the axes and the space diagonals."""


def labelled(
    voxels: NDArray[np.uint8], labels: NDArray[np.uint8], reach: int, empty: int
) -> NDArray[np.uint8]:
    """Return a grid of cells with a margin: the labels (K,) of voxels (K, 3), else `empty`."""
    # With this margin the shells of points up to `reach` outside the grid stay in the array.
    cells = np.full((RESOLUTION + 4 * reach,) * 3, empty, dtype=np.uint8)
    _label(voxels, labels, 2 * reach, cells)
    return cells


def shares_around(
    cells: NDArray[np.uint8],
    points: NDArray[np.floating],
    labels: NDArray[np.uint8],
    radii: tuple[int, ...],
    empty: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return how the cells at some distances from points (N, 3) are labelled.

    `cells` come from `labelled`, and no radius is above its reach. Each of the `radii` (voxels) is
    a shell of `DIRECTIONS` cells. Return two arrays of shares (N, len(radii)). The first is the
    share of non-empty cells whose label differs from the point's own, 0 if all are empty. The
    second is the share of all cells that are not empty.
    """
    steps = np.rint([[direction * radius for direction in _directions()] for radius in radii])
    side = len(cells)
    found: tuple[NDArray[np.float32], NDArray[np.float32]] = _look(
        cells.reshape(-1), np.ascontiguousarray(points, dtype=np.float64), labels,
        (steps @ (side * side, side, 1)).astype(np.int64), side, empty,
    )  # fmt: skip
    return found


def _directions() -> list[NDArray[np.float64]]:
    axes = [sign * np.eye(3)[axis] for axis in range(3) for sign in (1.0, -1.0)]
    signs = np.array(np.meshgrid(*[[1.0, -1.0]] * 3, indexing="ij")).reshape(3, 8).T
    return axes + [diagonal / math.sqrt(3.0) for diagonal in signs]


@kernel()
def _label(voxels, labels, margin, cells):  # type: ignore[no-untyped-def]
    for m in range(len(voxels)):
        cells[voxels[m, 0] + margin, voxels[m, 1] + margin, voxels[m, 2] + margin] = labels[m]


@kernel()
def _look(cells, points, labels, steps, side, empty):  # type: ignore[no-untyped-def]
    others = np.empty((len(points), len(steps)), np.float32)
    solid = np.empty_like(others)
    half, margin = 0.5 * (RESOLUTION - 1), (side - RESOLUTION) // 2
    low, high = margin // 2, side - 1 - margin // 2
    for m in range(points.shape[0]):
        a = int(np.rint(points[m, 0] * RESOLUTION + half)) + margin
        b = int(np.rint(points[m, 1] * RESOLUTION + half)) + margin
        c = int(np.rint(points[m, 2] * RESOLUTION + half)) + margin
        if min(a, b, c) < low or max(a, b, c) > high:
            others[m], solid[m] = 0.0, 0.0
            continue
        own = labels[m]
        place = (a * side + b) * side + c
        for shell in range(steps.shape[0]):
            there, differ = 0, 0
            for n in range(steps.shape[1]):
                # Unsigned, so that the compiler need not handle negative indices.
                label = cells[np.uint64(place + steps[shell, n])]
                there += label != empty
                differ += (label != empty) & (label != own)
            others[m, shell] = differ / there if there else 0.0
            solid[m, shell] = there / steps.shape[1]
    return others, solid
