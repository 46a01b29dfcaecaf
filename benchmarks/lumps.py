"""Make pairs of shapes of one object that differ by lumps: near-perfect in places, wrong in others.

Two generations of one object, or a scan and a generation, differ in this way: an extra
chimney, other cushions, a thicker leg. Both sides are a solid of the demo, with the SLAT's bent
slightly; then pieces of either side are added, omitted, grown, thinned or moved. The annotation
is turned by a quarter turn and a tilt of up to 15 degrees, and half of the annotations are rough.
"""

from __future__ import annotations

import numpy as np
from generations import Pair
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from slatprep.demo.asset import make_asset
from slatprep.geometry.frames import VOXEL_SIZE, cube_symmetries, voxel_centres
from slatprep.geometry.voxels import boundary
from slatprep.records import BACKGROUND, RESOLUTION, MaterialField, StructuredLatents

MOST_BEND, ROUGHNESS = 1.5, 0.8
"""How far the SLAT's shape is bent, and a rough field's surface lies off it [voxel, rms]."""

MOST_LUMPS = 6
TILT = 15.0

_PIECES = ("box", "ball", "hole", "grown", "thinned", "moved")

Mask = NDArray[np.bool_]
Array = NDArray[np.float64]


def make_lumpy_pairs(seed: int, index: int, variants: int) -> list[Pair]:
    """Make some pairs of one object; none of a symmetric one."""
    asset = make_asset(seed, index, levels=(0,))
    if asset.symmetric:
        return []
    labels = asset.grid[..., 3].astype(np.int16)
    voxels = np.argwhere(asset.occupancy & (labels >= 0) & (labels != BACKGROUND))
    own = labels[tuple(voxels.T)].astype(np.uint8)
    tree, solid = cKDTree(voxel_centres(voxels)), ndimage.binary_fill_holes(asset.occupancy)
    pairs = []
    for variant in range(variants):
        rng = np.random.default_rng([seed, index, variant])
        pair = _make(rng, solid, tree, own, asset.name, asset.category)
        pairs += [] if pair is None else [pair]
    return pairs


def _make(
    rng: np.random.Generator, solid: Mask, tree: cKDTree, labels: NDArray[np.uint8],
    name: str, category: str,
) -> Pair | None:  # fmt: skip
    bend = _bend(rng, rng.uniform(0.0, MOST_BEND))
    cells = voxel_centres(np.argwhere(np.ones(solid.shape, dtype=bool)))
    shell = _at(solid, cells + bend.reshape(-1, 3)).reshape(solid.shape)
    for _ in range(rng.integers(0, MOST_LUMPS + 1)):
        if rng.uniform() < 0.5:
            solid = _changed(rng, solid)
        else:
            shell = _changed(rng, shell)
    turns = [turn for turn in cube_symmetries().astype(float) if np.linalg.det(turn) > 0]
    axis, angle = rng.normal(size=3), np.radians(rng.uniform(0.0, TILT))
    tilt = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    turn = tilt @ turns[rng.integers(len(turns))]
    shift = rng.uniform(-1.0, 1.0, 3) * VOXEL_SIZE
    occupancy = _at(solid, cells @ turn.T + shift).reshape(solid.shape)
    if rng.uniform() < 0.5:
        occupancy = _roughened(rng, occupancy)
    coords, voxels = np.argwhere(boundary(shell)), np.argwhere(occupancy)
    if min(len(coords), len(voxels)) < 200:
        return None
    material = labels[tree.query(voxel_centres(voxels) @ turn.T + shift)[1]]
    properties = np.ones((len(voxels), 3), dtype=np.float32)
    field = MaterialField(occupancy, voxels.astype(np.uint8), material, properties)
    there = voxel_centres(coords) + bend[tuple(coords.T)]
    latents = StructuredLatents(coords.astype(np.uint8), np.zeros((len(coords), 8), np.float32))
    own = labels[tree.query(there)[1]]
    return Pair(name, category, field, latents, own, (there - shift) @ turn)


def _bend(rng: np.random.Generator, voxels: float) -> Array:
    """Return a smooth displacement (64, 64, 64, 3) of so many voxels, rms."""
    waves = [
        ndimage.gaussian_filter(rng.normal(size=(RESOLUTION,) * 3), 10.0, mode="nearest")
        for _ in range(3)
    ]
    bend = np.stack(waves, axis=-1)
    found: Array = bend * (voxels * VOXEL_SIZE / np.sqrt((bend**2).sum(axis=-1).mean()))
    return found


def _roughened(rng: np.random.Generator, solid: Mask) -> Mask:
    noise = ndimage.gaussian_filter(rng.normal(size=solid.shape), 1.2)
    depth = ndimage.distance_transform_edt(solid) - ndimage.distance_transform_edt(~solid)
    rough: Mask = depth + ROUGHNESS * noise / noise.std() > 0.0
    return rough


def _at(solid: Mask, points: Array) -> Mask:
    """Look a solid up at points (N, 3) of its frame."""
    cells = np.floor((points + 0.5) * RESOLUTION).astype(int)
    inside = ((cells >= 0) & (cells < RESOLUTION)).all(axis=1)
    found: Mask = np.zeros(len(points), dtype=bool)
    found[inside] = solid[tuple(cells[inside].T)]
    return found


def _changed(rng: np.random.Generator, solid: Mask) -> Mask:
    """Add, leave out, grow, thin or move a piece of a shape, at its skin."""
    skin = np.argwhere(boundary(solid))
    centre, kind = skin[rng.integers(len(skin))], rng.choice(_PIECES)
    small = kind in ("box", "ball", "hole")
    reach = rng.uniform(*((2.0, 7.0) if small else (6.0, 16.0)), 3)[:, None, None, None]
    away = np.abs(np.indices(solid.shape) - centre[:, None, None, None]) / reach
    piece = (away**2).sum(axis=0) <= 1.0 if kind == "ball" else (away <= 1.0).all(axis=0)
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
        moved = ndimage.shift((solid & piece).astype(np.uint8), rng.integers(-4, 5, 3), order=0)
        found = (solid & ~piece) | moved.astype(bool)
    return found if found.sum() > 0.4 * solid.sum() else solid
