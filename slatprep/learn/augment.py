"""Augmentation by the symmetries of the voxel lattice, which keep every target valid.

A quarter turn or a flip maps voxels to voxels, so it needs no interpolation. Young's modulus,
density, Poisson's ratio and the class are scalars of an isotropic material and do not change.
Scaling, shear or jitter are not offered: the object would no longer have the voxels that its
latents were made for.

Latents keep their values. Whether TRELLIS would give the turned object the same latents is not
known, so augmentation is off by default.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.frames import cube_symmetries
from slatprep.records import RESOLUTION

Augmentation = Literal["none", "upright", "all"]


def lattice_symmetries(kind: Augmentation) -> NDArray[np.int64]:
    """Return the symmetries as signed permutation matrices.

    Parameters
    ----------
    kind : {"none", "upright", "all"}
        ``none``: the identity; ``upright``: the 8 quarter turns about z and flips that keep
        the z axis up; ``all``: the 48 of the cube.

    Returns
    -------
    ndarray of int64, shape (S, 3, 3)
        The first is the identity.
    """
    symmetries = cube_symmetries()
    if kind == "none":
        return symmetries[:1]
    return symmetries[symmetries[:, 2, 2] == 1] if kind == "upright" else symmetries


def move(
    coords: NDArray[np.int32], symmetry: NDArray[np.int64], resolution: int = RESOLUTION
) -> NDArray[np.int32]:
    """Move voxels by a symmetry about the centre of the grid.

    Parameters
    ----------
    coords : ndarray of int32, shape (N, 3)
        Voxels, 0 to resolution - 1.
    symmetry : ndarray of int64, shape (3, 3)
        Signed permutation matrix.
    resolution : int
        Voxels along each axis of the grid.

    Returns
    -------
    ndarray of int32, shape (N, 3)
        Indices of the voxel centres ``(i + 0.5) / resolution - 0.5`` multiplied by the matrix.
    """
    # Twice the distance from the centre is an odd integer, so the arithmetic is exact.
    doubled = 2 * coords.astype(np.int64) - (resolution - 1)
    moved = doubled @ symmetry.T
    return ((moved + (resolution - 1)) // 2).astype(np.int32)
