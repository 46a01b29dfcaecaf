"""Pairs of shapes of one object that differ by lumps: near-perfect here, quite another there.

Two generations of one object, or a scan and a generation of it, differ like that: a chimney
more, other cushions, a thicker leg. Both sides are shapes of level 5 of the demo, hardly bent
and of nearly the same proportions; then pieces of either are added, left out, grown, thinned or
moved. The annotation is turned by a quarter turn and a tilt of up to 15 degrees.
"""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
from generations import Pair, filled_view
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from slatprep.demo.asset import make_asset
from slatprep.demo.difficulty import LEVELS
from slatprep.geometry.frames import VOXEL_SIZE, cube_symmetries, voxel_centres
from slatprep.geometry.voxels import boundary
from slatprep.records import RESOLUTION, MaterialField, StructuredLatents

BENDS, PROPORTIONS = (0.1, 1.2), (0.0, 0.06)
"""Of the shapes apart from lumps: bend [voxel, rms], and how far their proportions differ."""

MOST_LUMPS = 6
TILT = 15.0

Mask = NDArray[np.bool_]


def make_lumpy_pair(seed: int, index: int) -> Pair | None:
    """Make a pair; None of a symmetric object, or where hardly anything is left of one."""
    rng = np.random.default_rng([seed, index, 77])
    level = replace(
        LEVELS[5], bend=float(rng.uniform(*BENDS)), proportions=PROPORTIONS, damaged=False
    )
    with patch.dict(LEVELS, {5: level}):
        asset = make_asset(seed, index, levels=(5,), views=2)
    if asset.symmetric:
        return None
    first, second = asset.views
    solid, shell = filled_view(first), filled_view(second)
    for _ in range(rng.integers(1, MOST_LUMPS + 1)):
        if rng.uniform() < 0.5:
            solid = changed(rng, solid)
        else:
            shell = changed(rng, shell)
    coords = np.argwhere(boundary(shell)).astype(np.uint8)
    turns = cube_symmetries()
    quarter = turns[rng.integers(len(turns))].astype(float)
    if np.linalg.det(quarter) < 0:
        quarter = -quarter
    axis = rng.normal(size=3)
    angle = np.radians(rng.uniform(0.0, TILT))
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix() @ quarter
    shift = rng.uniform(-1.0, 1.0, 3) * VOXEL_SIZE
    occupancy = turned(solid, turn, shift)
    if min(len(coords), np.count_nonzero(occupancy)) < 200:
        return None
    voxels = np.argwhere(occupancy).astype(np.uint8)
    there = voxel_centres(voxels) @ turn.T + shift
    nearest = cKDTree(voxel_centres(first.coords)).query(there)[1]
    field = MaterialField(occupancy, voxels, first.material[nearest], first.properties[nearest])
    own = cKDTree(second.coords.astype(float)).query(coords)[1]
    shown = cKDTree(first.places).query(second.places[own])[1]
    places = (voxel_centres(first.coords)[shown] - shift) @ turn
    latents = StructuredLatents(coords, second.feats[own])
    return Pair(asset.name, asset.category, field, latents, second.material[own], places)


def turned(solid: Mask, turn: NDArray[np.float64], shift: NDArray[np.float64]) -> Mask:
    """Return a solid in a frame whose points x lie at ``turn @ x + shift`` of its own."""
    cells = np.argwhere(np.ones(solid.shape, dtype=bool))
    own = np.floor((voxel_centres(cells) @ turn.T + shift + 0.5) * RESOLUTION).astype(int)
    inside = ((own >= 0) & (own < RESOLUTION)).all(axis=1)
    occupied = np.zeros(len(cells), dtype=bool)
    occupied[inside] = solid[tuple(own[inside].T)]
    return occupied.reshape(solid.shape)


def changed(rng: np.random.Generator, solid: Mask) -> Mask:
    """Add, leave out, grow, thin or move a piece of a shape, at its skin."""
    skin = np.argwhere(boundary(solid))
    centre = skin[rng.integers(len(skin))]
    kind = rng.choice(["box", "ball", "hole", "grown", "thinned", "moved"])
    away = np.abs(np.indices(solid.shape) - centre[:, None, None, None])
    reach = rng.uniform(2.0, 7.0, 3) if kind in ("box", "ball", "hole") else rng.uniform(6, 16, 3)
    piece = (away <= reach[:, None, None, None]).all(axis=0)
    if kind == "ball":
        piece = ((away / reach[:, None, None, None]) ** 2).sum(axis=0) <= 1.0
    by = int(rng.integers(1, 4))
    if kind in ("box", "ball"):
        found = solid | piece
    elif kind == "hole":
        found = solid & ~piece
    elif kind == "grown":
        found = np.where(piece, ndimage.binary_dilation(solid, iterations=by), solid)
    elif kind == "thinned":
        found = np.where(piece, ndimage.binary_erosion(solid, iterations=by), solid)
    else:
        step = rng.integers(-4, 5, 3)
        there = ndimage.shift((solid & piece).astype(np.uint8), step, order=0).astype(bool)
        found = (solid & ~piece) | there
    return found if np.count_nonzero(found) > 0.4 * np.count_nonzero(solid) else solid
