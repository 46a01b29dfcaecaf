"""Sets of voxels: boundaries, fillings, indices."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.records import RESOLUTION


def boundary(occupancy: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the occupied voxels that touch an empty one by a face.

    The outside of the grid counts as empty, so a full grid's boundary is its
    outermost layer.

    Parameters
    ----------
    occupancy : ndarray of bool, shape (n, n, n)
        Occupied voxels.

    Returns
    -------
    ndarray of bool, shape (n, n, n)
        The boundary voxels, a subset of `occupancy`.

    Notes
    -----
    The source points of the alignment in SLAT-Phys, "Physics-to-SLAT
    Annotation Alignment".
    """
    padded = np.pad(np.asarray(occupancy, dtype=bool), 1)
    inner = padded[1:-1, 1:-1, 1:-1]
    buried = padded[:-2, 1:-1, 1:-1] & padded[2:, 1:-1, 1:-1]
    buried &= padded[1:-1, :-2, 1:-1]
    buried &= padded[1:-1, 2:, 1:-1]
    buried &= padded[1:-1, 1:-1, :-2]
    buried &= padded[1:-1, 1:-1, 2:]
    surface: NDArray[np.bool_] = inner & ~buried
    return surface


def bounding_box(occupancy: NDArray[np.bool_]) -> tuple[slice, slice, slice]:
    """Return the slices of the smallest box that holds all occupied voxels of a grid (a, b, c).

    Raises
    ------
    ValueError
        If no voxel is occupied.
    """
    slices = []
    for axis in range(3):
        others = tuple(a for a in range(3) if a != axis)
        occupied = np.flatnonzero(occupancy.any(axis=others))
        if len(occupied) == 0:
            raise ValueError("an empty voxel set has no bounding box")
        slices.append(slice(int(occupied[0]), int(occupied[-1]) + 1))
    return slices[0], slices[1], slices[2]


def filled(occupancy: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a voxel set with its inside filled.

    Parameters
    ----------
    occupancy : ndarray of bool, shape (n, n, n)
        A shell or a solid; n <= 64.

    Returns
    -------
    ndarray of bool, shape (n, n, n)
        The set and every empty voxel that no path over faces joins with the
        outside of the grid.
    """
    from slatprep.geometry.fill import outside_of

    return ~outside_of(occupancy)


def voxels_of(occupancy: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the indices (N, 3) uint8 of the occupied voxels, in C order."""
    # By way of flat indices, as numpy finds those of one axis far faster than those of three.
    places = np.unravel_index(np.flatnonzero(occupancy), occupancy.shape)
    return np.stack(places, axis=1, dtype=np.uint8, casting="unsafe")


def outer_boundary(occupancy: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the boundary voxels (B, 3) uint8 of a set with its inside filled, in C order.

    A SLAT has voxels inside the object wherever its parts meet, which the
    boundary of a solid cannot have; both sides are compared by this one.
    """
    return voxels_of(boundary(filled(occupancy)))


def flat_index(voxels: ArrayLike) -> NDArray[np.intp]:
    """Return the place (N,) of each voxel (N, 3) in the flattened grid, in C order."""
    index = np.asarray(voxels).astype(np.intp)
    flat: NDArray[np.intp] = (index[:, 0] * RESOLUTION + index[:, 1]) * RESOLUTION + index[:, 2]
    return flat


def occupancy_of(voxels: ArrayLike) -> NDArray[np.bool_]:
    """Return the (64, 64, 64) occupancy of a list of voxels (N, 3)."""
    occupancy = np.zeros(RESOLUTION**3, dtype=bool)
    occupancy[flat_index(voxels)] = True
    return occupancy.reshape((RESOLUTION,) * 3)
