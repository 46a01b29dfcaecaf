"""Sets of voxels: boundaries, fillings, indices."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.geometry.frames import VOXEL_SIZE, voxel_centres
from slatprep.records import RESOLUTION, Ground


def boundary(occupancy: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the occupied voxels of a grid (n, n, n) that touch an empty one by a face.

    The outside of the grid counts as empty. These voxels are the source points of the alignment
    in SLAT-Phys, "Physics-to-SLAT Annotation Alignment".
    """
    padded = np.pad(np.ascontiguousarray(occupancy, dtype=bool), 1)
    # In a flattened grid a neighbour lies at a fixed offset, which numpy reads far faster.
    flat = padded.reshape(-1)
    buried = flat.copy()
    for step in np.array(padded.strides):
        buried[step:] &= flat[:-step]
        buried[:-step] &= flat[step:]
    return np.asarray((flat & ~buried).reshape(padded.shape)[1:-1, 1:-1, 1:-1])


def bounding_box(occupancy: NDArray[np.bool_]) -> tuple[slice, slice, slice]:
    """Return the slices of the smallest box that holds all occupied voxels of a grid (a, b, c).

    Raise ValueError if no voxel is occupied.
    """
    # numpy reduces the first axis ten times as fast as others.
    seen = occupancy.any(axis=0)
    planes = occupancy.reshape(len(occupancy), -1)
    along = np.any(planes, axis=1), np.any(seen, axis=1), np.any(seen, axis=0)
    if not seen.any():
        raise ValueError("an empty voxel set has no bounding box")
    x, y, z = (np.flatnonzero(occupied)[[0, -1]].tolist() for occupied in along)
    return slice(x[0], x[1] + 1), slice(y[0], y[1] + 1), slice(z[0], z[1] + 1)


def filled(occupancy: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Fill a voxel set (n, n, n), n <= 64: add what no path over faces connects to the outside."""
    from slatprep.geometry.fill import outside_of

    return ~outside_of(occupancy)


FOOT = 1.5
"""Depth, in voxels, to which objects are continued below the top of their ground."""


def above(occupancy: NDArray[np.bool_], ground: Ground | None) -> NDArray[np.bool_]:
    """Return the filled set's voxels above the ground; `occupancy` itself without ground.

    The set is filled first, as a hollow object would be open where it stood on the ground. Voxels
    just above the ground are continued below its top, down to `FOOT`.
    """
    if ground is None:
        return occupancy
    x, y, z = ground.normal[:, None] * voxel_centres(np.arange(RESOLUTION))
    depths = (ground.height - (x[:, None, None] + y[:, None] + z)) / VOXEL_SIZE
    higher: NDArray[np.bool_] = filled(occupancy) & (depths < 0.0)
    below = np.argwhere((depths >= 0.0) & (depths < FOOT))
    # Rounding moves a position by sqrt(3) / 2 at most.
    steps = depths[tuple(below.T)] + 0.9
    over = np.rint(below + steps[:, None] * ground.normal).astype(np.intp)
    inside = ((over >= 0) & (over < RESOLUTION)).all(axis=1)
    stands = higher[tuple(over[inside].T)]
    higher[tuple(below[inside][stands].T)] = True
    return higher


def voxels_of(occupancy: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the indices (N, 3) uint8 of the occupied voxels, in C order."""
    # numpy finds the indices of one axis far faster than those of three.
    return voxels_at(np.flatnonzero(occupancy), occupancy.shape)


def voxels_at(
    cells: NDArray[np.intp], shape: tuple[int, ...] = (RESOLUTION,) * 3
) -> NDArray[np.uint8]:
    """Return the voxels (N, 3) uint8 at indices of the flattened grid; undo `flat_index`."""
    voxels = np.empty((len(cells), 3), dtype=np.uint8)
    rest = cells.astype(np.uint32)  # Narrow numbers are divided four times as fast.
    for axis in (2, 1, 0):
        side = np.uint32(shape[axis])
        above = rest // side
        voxels[:, axis] = rest - above * side
        rest = above
    return voxels


def outer_boundary(occupancy: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the boundary voxels (B, 3) uint8 of a set with its inside filled, in C order.

    A SLAT has voxels inside the object where its parts meet, and the boundary of a
    solid has none there. So both sides are compared by their outer boundaries.
    """
    return voxels_of(boundary(filled(occupancy)))


def flat_index(voxels: ArrayLike, side: int = RESOLUTION) -> NDArray[np.intp]:
    """Return the index (N,) of each voxel (N, 3) in the flattened grid (side,)*3, in C order."""
    x, y, z = np.asarray(voxels).T
    flat: NDArray[np.intp] = x.astype(np.intp)
    for one in (y, z):
        flat *= side
        flat += one
    return flat


def shown_in_cells(
    voxels: NDArray[np.uint8], resolution: int
) -> tuple[NDArray[np.uint8], NDArray[np.intp]]:
    """Return the cells (M, 3) of the 64^3 grid that voxels of any grid occupy, with rows (M,).

    A cell is occupied if its centre lies in a voxel, or if a voxel's centre lies in it. So a voxel
    of a coarser grid has several cells. A cell may have several voxels of a finer grid, the first
    of which counts. Voxels of a 64^3 grid stay as they are; other cells are in C order.
    """
    if resolution == RESOLUTION:
        return voxels, np.arange(len(voxels))
    index = voxels.astype(np.intp)
    if resolution > RESOLUTION:
        cells = (2 * index + 1) * RESOLUTION // (2 * resolution)
        _, first = np.unique(flat_index(cells), return_index=True)
        return cells[first].astype(np.uint8), first
    rows = np.full((resolution,) * 3, -1, dtype=np.intp)
    rows[tuple(index.T)] = np.arange(len(index))
    steps = (2 * np.arange(RESOLUTION) + 1) * resolution // (2 * RESOLUTION)
    rows = rows[np.ix_(steps, steps, steps)]
    return voxels_of(rows >= 0), rows[rows >= 0]


def occupancy_of(voxels: ArrayLike, resolution: int = RESOLUTION) -> NDArray[np.bool_]:
    """Return the (64, 64, 64) occupancy of voxels (N, 3) of a grid; see `shown_in_cells`."""
    if resolution != RESOLUTION:
        voxels, _ = shown_in_cells(np.asarray(voxels, dtype=np.uint8), resolution)
    occupancy = np.zeros(RESOLUTION**3, dtype=bool)
    occupancy[flat_index(voxels)] = True
    return occupancy.reshape((RESOLUTION,) * 3)
