"""Prepare what a picture of an alignment shows: two voxel sets, their classes, and errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.deformation import PlaceMap
from slatprep.geometry.frames import (
    VOXEL_SIZE,
    apply_transform,
    split_transform,
    voxel_centres,
)
from slatprep.geometry.voxels import boundary, occupancy_of, outer_boundary, voxels_of
from slatprep.inspect.pictures.canvas import DISTANCE_COLOURS
from slatprep.inspect.pictures.voxels import View, view_rotation
from slatprep.records import COLOURS, RESOLUTION
from slatprep.store.reader import StoredAsset
from slatprep.store.records import StoredRecords

FARTHEST = 3.0
"""Upper end of the scale of distances [voxel]."""

VIEWPOINTS = ((300.0, 22.0), (60.0, 22.0), (205.0, 50.0))
"""Azimuth and elevation [degree] of the three views of a picture."""


class Placed(NamedTuple):
    """Voxels (K, 3), the class of each (K,), and the transform (4, 4) to the picture's frame."""

    voxels: NDArray[np.uint8]
    material: NDArray[np.uint8]
    transform: NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """An asset, ready to be drawn.

    Attributes
    ----------
    before, after : Placed
        Boundary voxels of the PixieVerse field, in its own frame and moved by the transform; class
        255 if not annotated.
    slat : ndarray of uint8, shape (N, 3)
        Cells of the 64^3 grid that SLAT voxels occupy.
    slat_material : ndarray of uint8, shape (N,)
        Class that each cell received in the lookup; 255 if not valid.
    surface : ndarray of uint8, shape (M, 3)
        Outer voxels of the SLAT, at which errors are measured.
    error, error_before : ndarray of float64, shape (M,)
        Distance [voxel] of each to the nearest outer voxel of the PixieVerse field, after and
        before the alignment. With a deformation, "before" uses the transform alone.
    deformed : Placed or None
        If the asset has a deformation, the deformed PixieVerse field on the SLAT's grid: boundary
        of the cells whose centre maps into an occupied voxel.
    displacement : ndarray of float64, shape (N,)
        Distance [voxel] by which the deformation moves the place of each SLAT voxel.
    labels : tuple of str
        Names of the classes.
    tied : ndarray of float64, shape (4, 4), or None
        Transform of the best open tie, if there is one.
    """

    before: Placed
    after: Placed
    slat: NDArray[np.uint8]
    slat_material: NDArray[np.uint8]
    surface: NDArray[np.uint8]
    error: NDArray[np.float64]
    error_before: NDArray[np.float64]
    deformed: Placed | None
    displacement: NDArray[np.float64]
    labels: tuple[str, ...]
    tied: NDArray[np.float64] | None = None

    @property
    def placed(self) -> Placed:
        """The PixieVerse field in the SLAT frame, deformation included."""
        return self.deformed or self.after

    @property
    def displacement_scale(self) -> float:
        """Upper end of the scale of displacements: the largest one, rounded up to a whole voxel."""
        return max(float(np.ceil(self.displacement.max())), 1.0)


def scene_of(asset: StoredAsset) -> Scene:
    """Return the scene of a stored asset.

    Raises StoreError if the asset is deformed and its record, with the deformation, is unreadable.
    """
    occupancy = asset.grid_material != asset.store.contents.background
    shell = voxels_of(boundary(occupancy))
    outer = outer_boundary(occupancy)
    cells, row = asset.cells
    surface = outer_boundary(occupancy_of(cells))
    way = StoredRecords(asset.store).place_map(asset)
    similar = PlaceMap(asset.transform)
    before = PlaceMap(np.eye(4)) if way.deformation is None else similar
    moved = asset.place - similar.to_pixieverse(asset.latents.centres)
    field = Placed(shell, asset.grid_material[tuple(shell.T)], np.eye(4))
    return Scene(
        before=field,
        after=field._replace(transform=asset.transform),
        slat=cells,
        slat_material=asset.material[row],
        surface=surface,
        error=surface_distance(surface, outer, way),
        error_before=surface_distance(surface, outer, before),
        deformed=None if way.deformation is None else _deformed(asset, way),
        displacement=np.linalg.norm(moved[row], axis=1) / VOXEL_SIZE,
        labels=asset.store.contents.labels,
    )


def _deformed(asset: StoredAsset, way: PlaceMap) -> Placed:
    cells = np.indices((RESOLUTION,) * 3, dtype=np.uint8).reshape(3, -1).T
    found = np.rint((way.places(cells) + 0.5) * RESOLUTION - 0.5).astype(np.intp)
    inside = ((found >= 0) & (found < RESOLUTION)).all(axis=1)
    background = asset.store.contents.background
    material = np.full(len(cells), background, dtype=np.uint8)
    material[inside] = asset.grid_material[tuple(found[inside].T)]
    grid = material.reshape((RESOLUTION,) * 3)
    shell = voxels_of(boundary(grid != background))
    return Placed(shell, grid[tuple(shell.T)], np.eye(4))


def surface_distance(
    slat: NDArray[np.uint8], pixieverse: NDArray[np.uint8], way: PlaceMap
) -> NDArray[np.float64]:
    """Return the distance (M,) [voxel] of each SLAT voxel to the nearest PixieVerse voxel.

    Surface voxels (M, 3) and (K, 3) are each in their own frame; `way` maps between the frames.
    """
    from slatprep.geometry.nearest import VoxelIndex

    _, _, scale = split_transform(way.transform)
    distance, _ = VoxelIndex(pixieverse).nearest(way.to_pixieverse(voxel_centres(slat)))
    return np.asarray(distance * scale)


def views(scene: Scene, size: int) -> tuple[View, ...]:
    """Return the three views, at one scale at which all voxel sets fit."""
    sets = (scene.before, scene.after, scene.placed)
    field = [apply_transform(one.transform, voxel_centres(one.voxels)) for one in sets]
    points = np.concatenate([*field, voxel_centres(scene.slat)])
    placed = []
    for azimuth, elevation in VIEWPOINTS:
        rotation = view_rotation(azimuth, elevation)
        seen = points @ rotation.T
        low, high = seen.min(axis=0), seen.max(axis=0)
        placed.append((rotation, rotation.T @ ((low + high) / 2), (high - low)[:2].max() / 2))
    # Two voxels leave room for the diagonal of voxels at the edge, and for the outline.
    half_width = max(reach for _, _, reach in placed) + 2 * VOXEL_SIZE
    return tuple(View(rotation, centre, float(half_width), size) for rotation, centre, _ in placed)


def class_colours(material: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the colour (N, 3) in 0..1 of each material id (N,)."""
    return COLOURS[material] / 255.0


def distance_colours(
    distance: NDArray[np.float64], farthest: float = FARTHEST
) -> NDArray[np.float64]:
    """Return the colour (N, 3) in 0..1 of each distance (N,) in voxels, up to `farthest`."""
    stops = np.array([rgb(colour) for colour in DISTANCE_COLOURS])
    along = np.linspace(0, farthest, len(stops))
    return np.stack([np.interp(distance, along, stops[:, c]) for c in range(3)], axis=-1)


def rgb(colour: str) -> NDArray[np.float64]:
    """Return a colour like ``#FF8000`` as three numbers in 0..1."""
    return np.frombuffer(bytes.fromhex(colour[1:]), dtype=np.uint8) / 255.0
