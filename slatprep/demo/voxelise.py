"""Voxelise the surface and the inside of a solid.

TRELLIS voxelises the surface of a mesh (Open3D's ``create_from_triangle_mesh_within_bounds``): a
voxel is occupied if the surface meets its cube. Here the surface is the zero set of a signed
distance bound, and cubes are subdivided to find whether they meet it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.frames import voxel_centres
from slatprep.records import RESOLUTION

Distance = Callable[[NDArray[np.float64]], NDArray[np.float64]]

_BLOCK, _HALVINGS = 4, 3
_HALF_DIAGONAL = 3.0**0.5 / 2.0
_CORNERS = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def voxelise(
    distance: Distance, side: int = RESOLUTION
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the surface voxels and the filled voxels of a solid, (side, side, side) each.

    `distance` maps points (P, 3) of the cube [-0.5, 0.5]^3 to (P,): positive outside, otherwise
    negative or zero, in magnitude at most the distance to the surface. It may be cut off at any
    value above 0.054, half the diagonal of a block of 4 voxels of 64. `side` is a multiple of 64.

    A cube whose centre is farther from the surface than half its diagonal does not meet it; a cube
    with points on both sides does. Other cubes are halved three times. This misses only a surface
    that enters a cube by less than a tenth of a voxel, between the sampled points.
    """
    near, inside = _near_voxels(distance, side)
    candidates = np.argwhere(near)
    met = _changes_sign(distance, candidates, inside)
    met[~met] = _subdivide(distance, candidates[~met], inside)
    surface = np.zeros_like(inside)
    surface[tuple(candidates[met].T)] = True
    return surface, surface | inside


def _near_voxels(distance: Distance, side: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the voxels that the surface may meet, and whether each voxel's centre is inside."""
    blocks = side // _BLOCK
    index = np.argwhere(np.ones((blocks,) * 3, dtype=bool))
    at_blocks = distance(voxel_centres(index, blocks)).reshape((blocks,) * 3)
    ones = np.ones((_BLOCK,) * 3, dtype=bool)
    inside = np.kron(at_blocks <= 0, ones)
    near = np.kron(np.abs(at_blocks) <= _HALF_DIAGONAL / blocks, ones)
    voxels = np.argwhere(near)
    at_voxels = distance(voxel_centres(voxels, side))
    inside[tuple(voxels.T)] = at_voxels <= 0
    near[tuple(voxels.T)] = np.abs(at_voxels) <= _HALF_DIAGONAL / side
    return near, inside


def _changes_sign(
    distance: Distance, voxels: NDArray[np.intp], inside: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return whether the surface separates a corner of each voxel from the voxel's centre."""
    corners = (voxels[:, None] + _CORNERS).reshape(-1, 3).T
    side = len(inside)
    lattice = np.zeros((side + 1,) * 3, dtype=bool)
    lattice[tuple(corners)] = True
    needed = np.argwhere(lattice)
    lattice[tuple(needed.T)] = distance(needed / side - 0.5) <= 0
    differs = lattice[tuple(corners)].reshape(-1, 8) != inside[tuple(voxels.T)][:, None]
    return np.asarray(differs.any(axis=1))


def _subdivide(
    distance: Distance, voxels: NDArray[np.intp], inside: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return whether the surface separates the centre of a halved cube from the voxel's centre."""
    met, own = np.zeros(len(voxels), dtype=bool), inside[tuple(voxels.T)]
    owner = np.arange(len(voxels))
    centres = voxel_centres(voxels, len(inside))
    edge = 1.0 / len(inside)
    for _ in range(_HALVINGS):
        edge /= 2.0
        centres = (centres[:, None, :] + (_CORNERS - 0.5) * edge).reshape(-1, 3)
        owner = np.repeat(owner, len(_CORNERS))
        value = distance(centres)
        met[owner[(value <= 0) != own[owner]]] = True
        keep = (np.abs(value) <= _HALF_DIAGONAL * edge) & ~met[owner]
        centres, owner = centres[keep], owner[keep]
    return met
