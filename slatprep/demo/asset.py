"""Make a demo asset: both sides of an object, and the truth."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slatprep.demo.catalogue import CATALOGUE
from slatprep.demo.difficulty import (
    LEVELS,
    QUARTER_TURNS,
    SAME_SHAPE_LEVELS,
    Frames,
    draw_frames,
    generate,
)
from slatprep.demo.latents import LatentKind, make_latents
from slatprep.demo.nerf import EMPTY, UNLABELLED, damage, nerf_field
from slatprep.demo.shapes import Solid
from slatprep.demo.voxelise import voxelise
from slatprep.geometry.frames import nearest_similarity, voxel_centres
from slatprep.geometry.voxels import boundary
from slatprep.records import BACKGROUND, RESOLUTION, TRELLIS, LatentSpace

# Each random choice has a stream of its own, so that one option of the demo
# does not change the draws of another.
_SHAPE, _FRAME, _DAMAGE, _LATENTS, _HABIT, _GENERATED = range(6)

# A quarter turn about z, from one view to the next.
_QUARTER = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])

# Distance bounds of bent shapes are less tight, so they are needed over a longer range.
_GENERATED_REACH = 0.12


@dataclass(frozen=True)
class DemoView:
    """A SLAT of an object, with the truth.

    Attributes
    ----------
    view : str
        Name of the view; empty if the object has only one.
    coords : ndarray of uint8, shape (N, 3)
        SLAT voxels in C order.
    feats : ndarray of float32, shape (N, channels)
        Latents.
    transform : ndarray of float64, shape (4, 4)
        PixieVerse frame to SLAT frame; for a generated shape, the least-squares similarity
        from `places` to the SLAT voxels.
    material : ndarray of uint8, shape (N,)
        True class of each SLAT voxel.
    properties : ndarray of float32, shape (N, 3)
        True Young's modulus, density and Poisson's ratio of each SLAT voxel, in SI units.
    places : ndarray of float64, shape (N, 3), or None
        True place of each SLAT voxel's centre in the PixieVerse frame; None on levels without
        a generated shape or a NeRF's field.
    """

    view: str
    coords: NDArray[np.uint8]
    feats: NDArray[np.float32]
    transform: NDArray[np.float64]
    material: NDArray[np.uint8]
    properties: NDArray[np.float32]
    places: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class DemoAsset:
    """An object of the demo; ``grid`` (64, 64, 64, 4) float32 has PixieVerse's format."""

    object_id: str
    name: str
    category: str
    level: int
    symmetric: bool
    grid: NDArray[np.float32]
    occupancy: NDArray[np.bool_]
    views: tuple[DemoView, ...]


def object_id(seed: int, index: int) -> str:
    """Return the id of an object: 32 hex digits, like Objaverse's ids."""
    return hashlib.sha256(f"slatprep demo {seed} {index}".encode()).hexdigest()[:32]


def make_asset(
    seed: int,
    index: int,
    *,
    levels: tuple[int, ...] = SAME_SHAPE_LEVELS,
    views: int = 1,
    latents: LatentKind = "placeholder",
    habitual_share: float = 0.0,
    space: LatentSpace = TRELLIS,
    one_frame: bool = False,
) -> DemoAsset:
    """Make asset number `index` of a demo dataset; it depends on these arguments alone.

    Parameters
    ----------
    seed, index : int
        Seed of the dataset and number of the asset in it.
    levels : tuple of int
        Levels of difficulty, which assets take in turn.
    views : int
        Number of SLATs of the object. Each is a quarter turn about z from the previous one, and
        each generated shape differs.
    latents : {"placeholder", "material"}
        Noise, or latents that depend on the material; see `slatprep.demo.latents`.
    habitual_share : float
        Share of assets whose PixieVerse side has the dataset's common quarter
        turn; each of the others has any of the 24 quarter turns.
    space : LatentSpace
        The space of the latents; its resolution is 64 times or divided by a power of two.
    one_frame : bool
        Whether both sides come from the same mesh, so that the transform is the identity.
        Allowed only for level 0 and one view.

    Returns
    -------
    DemoAsset
        Both sides of the object, as the real pipelines would give them, with the truth.
    """
    categories = tuple(CATALOGUE)
    turn, place = divmod(index, len(categories))
    category = categories[place]
    # Adding `turn` gives each category all levels over time.
    level = levels[(index + turn) % len(levels)]
    model = CATALOGUE[category](np.random.default_rng([seed, index, _SHAPE]), turn)
    difficulty = LEVELS[level]
    solid = Solid(model.parts, *([_GENERATED_REACH] if difficulty.generated else []))

    rng = np.random.default_rng([seed, index, _FRAME])
    quarter = int(rng.integers(len(QUARTER_TURNS)))
    if rng.uniform() < habitual_share:
        quarter = int(np.random.default_rng([seed, _HABIT]).integers(len(QUARTER_TURNS)))
    frames = draw_frames(rng, solid, difficulty, QUARTER_TURNS[quarter])
    if one_frame:
        frames = replace(frames, pixieverse=frames.slat)
    stuff = _pixieverse_side(solid, frames)
    skin = frames.pixieverse.to_object(voxel_centres(np.argwhere(boundary(stuff >= 0))))
    rng = np.random.default_rng([seed, index, _DAMAGE])
    if difficulty.nerf:
        stuff = nerf_field(rng, stuff, frames.pixieverse.rotation[:, 2], len(solid.stuffs))
    elif difficulty.damaged:
        stuff = damage(rng, stuff, frames.pixieverse_distance(solid), len(solid.stuffs))
    made = []
    for v in range(views):
        heading = np.linalg.matrix_power(_QUARTER, v).astype(np.float64)
        seen = replace(frames, slat=replace(frames.slat, rotation=heading))
        if difficulty.generated:
            rng = np.random.default_rng([seed, index, _GENERATED, v])
            seen = generate(rng, seen, difficulty.bend, solid, skin)
        rng = np.random.default_rng([seed, index, _LATENTS, v])
        name = f"view_{v}" if views > 1 else ""
        view = _slat_side(rng, name, solid, seen, latents, space)
        made.append(view if difficulty.has_places else replace(view, places=None))
    return DemoAsset(
        object_id(seed, index),
        model.name,
        category,
        level,
        model.symmetric,
        _material_grid(solid, stuff),
        stuff != EMPTY,
        tuple(made),
    )


def _pixieverse_side(solid: Solid, frames: Frames) -> NDArray[np.int16]:
    """Return the index of each voxel's stuff (64, 64, 64); `EMPTY` if the voxel has none."""
    filled = np.argwhere(voxelise(frames.pixieverse_distance(solid))[1])
    stuff = np.full((RESOLUTION,) * 3, EMPTY, dtype=np.int16)
    centres = frames.pixieverse.to_object(voxel_centres(filled))
    stuff[tuple(filled.T)] = solid.stuff_at(centres)
    return stuff


def _material_grid(solid: Solid, stuff: NDArray[np.int16]) -> NDArray[np.float32]:
    """Return density, Young's modulus, Poisson's ratio and class (64, 64, 64, 4)."""
    material, properties = solid.table()
    grid = np.zeros((*stuff.shape, 4), dtype=np.float32)
    grid[..., 3] = BACKGROUND
    grid[stuff == UNLABELLED, 3] = -1
    known = stuff >= 0
    grid[known, :3] = properties[stuff[known]][:, [1, 0, 2]]
    grid[known, 3] = material[stuff[known]]
    return grid


def _slat_side(
    rng: np.random.Generator,
    view: str,
    solid: Solid,
    frames: Frames,
    latents: LatentKind,
    space: LatentSpace,
) -> DemoView:
    resolution = space.resolution
    surface = voxelise(frames.slat_distance(solid), max(resolution, RESOLUTION))[0]
    # The surface meets a coarse voxel if it meets a fine voxel inside.
    fine = len(surface) // resolution
    blocks = surface.reshape((resolution, fine) * 3)
    coords = np.argwhere(np.any(blocks, axis=(1, 3, 5))).astype(np.uint8)
    centres = voxel_centres(coords, resolution)
    material, properties = solid.table()
    stuff = solid.stuff_at(frames.slat_to_object(centres))
    feats = make_latents(rng, latents, centres, material[stuff], properties[stuff], space)
    places = frames.places(centres)
    # Without a distortion, the truth is the transform of the poses.
    transform = nearest_similarity(places, centres) if frames.distortion else frames.transform()
    return DemoView(view, coords, feats, transform, material[stuff], properties[stuff], places)
