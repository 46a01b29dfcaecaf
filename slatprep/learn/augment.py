"""Augmentation by the symmetries of the voxel lattice, which keep every target valid.

A quarter turn or a flip maps voxels to voxels, so it needs no interpolation. Young's modulus,
density, Poisson's ratio and the class are scalars of an isotropic material and do not change.
Scaling, shear or jitter are not offered: the object would no longer have the voxels that its
latents were made for.

Latents keep their values. Whether TRELLIS would give the turned object the same latents is not
known, so augmentation is off by default.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import require_one_of
from slatprep.geometry.frames import cube_symmetries
from slatprep.records import RESOLUTION

Augmentation = Literal["none", "upright", "all"]


def lattice_symmetries(kind: Augmentation) -> NDArray[np.int64]:
    """Return symmetries as signed permutation matrices (S, 3, 3), the identity first.

    ``none`` has the identity, ``upright`` the 8 quarter turns about z and flips that keep the z
    axis up, ``all`` the 48 of the cube. ConfigError if `kind` is none of these.
    """
    require_one_of("augmentation", kind, get_args(Augmentation))
    symmetries = cube_symmetries()
    if kind == "none":
        return symmetries[:1]
    return symmetries[symmetries[:, 2, 2] == 1] if kind == "upright" else symmetries


def move(
    coords: NDArray[np.int32], symmetry: NDArray[np.int64], resolution: int = RESOLUTION
) -> NDArray[np.int32]:
    """Move voxels (N, 3) of a grid by a symmetry (3, 3) about its centre.

    The matrix multiplies the voxel centres ``(i + 0.5) / resolution - 0.5``.
    """
    # Twice the distance from the centre is an odd integer, so the arithmetic is exact.
    doubled = 2 * coords.astype(np.int64) - (resolution - 1)
    moved = doubled @ symmetry.T
    return ((moved + (resolution - 1)) // 2).astype(np.int32)
