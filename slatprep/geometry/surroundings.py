"""What the cells around points hold, in shells of directions; a compiled inner loop."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.kernel import kernel
from slatprep.records import RESOLUTION

DIRECTIONS = 14
"""Cells looked at in each shell: along the axes and the diagonals of space."""


def shares_around(
    grid: NDArray[np.uint8],
    points: NDArray[np.floating],
    labels: NDArray[np.uint8],
    radii: tuple[int, ...],
    empty: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Look at the cells at some distances of points (N, 3), and say how they are labelled.

    Each of the `radii` (voxels) is a shell of `DIRECTIONS` cells; outside the grid all are `empty`.
    Returns shares (N, len(radii)): of the cells that are not empty those whose label differs from
    the point's own, 0 where all are empty; and of all cells those that are not empty.
    """
    # Beyond twice the largest radius no cell of a shell lies in the grid.
    margin = 2 * max(radii)
    padded = np.pad(grid, margin, constant_values=empty)
    directions = _directions() if any(radii) else [np.zeros(3)]
    steps = np.rint([[direction * radius for direction in directions] for radius in radii])
    side = len(padded)
    others = np.empty((len(points), len(radii)), dtype=np.float32)
    solid = np.empty_like(others)
    _look(
        padded.reshape(-1),
        np.ascontiguousarray(points, dtype=np.float64),
        labels,
        (steps @ (side * side, side, 1)).astype(np.int64),
        side,
        margin,
        empty,
        others,
        solid,
    )
    return others, solid


def _directions() -> list[NDArray[np.float64]]:
    axes = [sign * np.eye(3)[axis] for axis in range(3) for sign in (1.0, -1.0)]
    signs = np.array(np.meshgrid(*[[1.0, -1.0]] * 3, indexing="ij")).reshape(3, 8).T
    return axes + [diagonal / math.sqrt(3.0) for diagonal in signs]


@kernel()
def _look(cells, points, labels, steps, side, margin, empty, others, solid):  # type: ignore[no-untyped-def]
    half = 0.5 * (RESOLUTION - 1)
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
                # Unsigned, so that no negative index has to be provided for.
                label = cells[np.uint64(place + steps[shell, n])]
                there += label != empty
                differ += (label != empty) & (label != own)
            others[m, shell] = differ / there if there else 0.0
            solid[m, shell] = there / steps.shape[1]
