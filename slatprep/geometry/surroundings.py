"""What the cells around points hold, in shells of directions; a compiled inner loop."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

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
    """Look at the cells at some distances of points, and say how they are labelled.

    Parameters
    ----------
    grid : ndarray of uint8, shape (64, 64, 64)
        The label of each cell.
    points : ndarray of float, shape (N, 3)
        Points of the unit cube's frame; they may lie outside the cube.
    labels : ndarray of uint8, shape (N,)
        What to compare with.
    radii : tuple of int
        Distances in voxels; each shell has `DIRECTIONS` cells.
    empty : int
        The label of an empty cell; it lies also outside the grid.

    Returns
    -------
    others : ndarray of float32, shape (N, len(radii))
        Share of the shell's cells that are not empty whose label differs from
        the point's own; 0 where all are empty.
    solid : ndarray of float32, shape (N, len(radii))
        Share of the shell's cells that are not empty.
    """
    offsets = np.array(
        [_direction * radius for radius in radii for _direction in _directions()]
    ).reshape(len(radii), DIRECTIONS, 3)
    others = np.empty((len(points), len(radii)), dtype=np.float32)
    solid = np.empty_like(others)
    _look(
        grid,
        np.ascontiguousarray(points, dtype=np.float64),
        labels,
        np.rint(offsets).astype(np.int64),
        empty,
        others,
        solid,
    )
    return others, solid


def _directions() -> list[NDArray[np.float64]]:
    axes = [sign * np.eye(3)[axis] for axis in range(3) for sign in (1.0, -1.0)]
    signs = np.array(np.meshgrid(*[[1.0, -1.0]] * 3, indexing="ij")).reshape(3, 8).T
    return axes + [diagonal / math.sqrt(3.0) for diagonal in signs]


@njit(cache=True)
def _look(grid, points, labels, offsets, empty, others, solid):  # type: ignore[no-untyped-def]
    size = grid.shape[0]
    half = 0.5 * (RESOLUTION - 1)
    for m in range(points.shape[0]):
        a = int(np.rint(points[m, 0] * RESOLUTION + half))
        b = int(np.rint(points[m, 1] * RESOLUTION + half))
        c = int(np.rint(points[m, 2] * RESOLUTION + half))
        own = labels[m]
        for shell in range(offsets.shape[0]):
            there, differ = 0, 0
            for n in range(offsets.shape[1]):
                i, j, k = (
                    a + offsets[shell, n, 0],
                    b + offsets[shell, n, 1],
                    c + offsets[shell, n, 2],
                )
                if i < 0 or j < 0 or k < 0 or i >= size or j >= size or k >= size:
                    continue
                label = grid[i, j, k]
                if label == empty:
                    continue
                there += 1
                differ += label != own
            others[m, shell] = differ / there if there else 0.0
            solid[m, shell] = there / offsets.shape[1]
