"""Materials on voxels, from a store or predicted by a decoder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.errors import ConfigError, InputError, require_one_of
from slatprep.export.formats import Points as Points
from slatprep.export.formats import require_solver_classes
from slatprep.geometry.deformation import PlaceMap
from slatprep.geometry.frames import voxel_centres
from slatprep.geometry.voxels import shown_in_cells
from slatprep.learn.predictions import GivenPrediction, read_npz
from slatprep.normalize import PIXIE_RANGES, denormalize_properties
from slatprep.readers.pixieverse import UNLABELLED
from slatprep.readers.voxel_sets import physical
from slatprep.records import (
    BACKGROUND,
    MAX_LATENT_RESOLUTION,
    PIXIEVERSE,
    PROPERTIES,
    PROPERTY_COLUMNS,
    RESOLUTION,
    Normalization,
)
from slatprep.store import Store
from slatprep.store.records import StoredRecords


@dataclass(frozen=True)
class VoxelField:
    """Materials on voxels.

    Attributes
    ----------
    voxels : ndarray of uint8, shape (K, 3)
        The voxels of a grid of `resolution` that have a material, K >= 1, each once.
    material : ndarray of uint8, shape (K,)
        Class 0..6.
    properties : ndarray of float32, shape (K, 3)
        Young's modulus [Pa], density [kg/m^3], Poisson's ratio.
    place_map : PlaceMap, optional
        The map from the SLAT frame to the voxels' frame; None if the frames are the same.
    resolution : int
        Voxels along each axis: 64, or more for a SLAT of a finer grid.
    surface : ndarray of uint8, shape (M, 3), optional
        The SLAT's cells of the 64^3 grid, if the voxels are those of a PixieVerse field.
    """

    voxels: NDArray[np.uint8]
    material: NDArray[np.uint8]
    properties: NDArray[np.float32]
    place_map: PlaceMap | None = None
    resolution: int = RESOLUTION
    surface: NDArray[np.uint8] | None = None

    @classmethod
    def of_slat(
        cls,
        coords: NDArray[np.uint8],
        side: int,
        material: NDArray[np.uint8],
        properties: NDArray[np.float32],
    ) -> Self:
        """Return a field of SLAT voxels of any grid; voxels of a coarser one are cells of 64^3."""
        if side > RESOLUTION:
            return cls(coords, material, properties, resolution=side)
        cells, row = shown_in_cells(coords, side)
        return cls(cells, material[row], properties[row])

    @property
    def cells(self) -> NDArray[np.uint8]:
        """The cells (M, 3) of the 64^3 grid that the voxels occupy."""
        return shown_in_cells(self.voxels, self.resolution)[0]

    def nearest(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Return distance (N,), in 1/64 of the cube's edge, and row of the nearest voxel.

        The points (N, 3) lie in the SLAT frame.
        """
        located = self.locate(points)
        if self.resolution == RESOLUTION:
            from slatprep.geometry.nearest import VoxelIndex

            return VoxelIndex(self.voxels).nearest(located)
        from scipy.spatial import cKDTree

        apart, row = cKDTree(voxel_centres(self.voxels, self.resolution)).query(located)
        return apart * RESOLUTION, row

    def locate(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points (N, 3) of the SLAT frame to the frame of the voxels."""
        if self.place_map is None:
            return np.asarray(points, dtype=np.float64)
        return self.place_map.to_pixieverse(points)


def stored_field(store: Store, name: str | int, points: Points = "slat") -> VoxelField:
    """Return an asset's materials at its valid SLAT voxels, or at its field's voxels (``grid``).

    StoreError if the store has no such asset, lacks a property, or has classes that solvers do not
    know. ConfigError if no voxel of the asset has a material.
    """
    require_one_of("points", points, get_args(Points))
    asset, columns = store.asset(name), store.columns_of(PROPERTY_COLUMNS)
    require_solver_classes(store)
    if points == "grid":
        grid = asset.field
        place_map, (surface, _) = StoredRecords(store).place_map(asset), asset.cells
        values = grid.properties[:, columns]
        field = VoxelField(grid.voxels, grid.material, values, place_map, surface=surface)
    else:
        valid = asset.valid
        values = asset.properties_si[valid][:, columns]
        side = store.contents.latents.resolution
        field = VoxelField.of_slat(asset.coords[valid], side, asset.material[valid], values)
    if len(field.voxels) == 0:
        raise ConfigError(
            f"{store.path}: no voxel of {asset.asset_id} has a material; expected an asset whose "
            "valid_share is above 0"
        )
    return field


def predicted_field(path: Path, normalization: Normalization | None) -> VoxelField:
    """Read predicted materials of the SLAT frame: the npz of `slatprep predict` or of an export.

    It has ``coords``, ``material`` or ``logits``, and ``properties_si`` or ``properties``, which
    are normalised by its own ``ranges`` or else by `normalization`. InputError if it cannot be
    used or a material cannot have its values, ConfigError if the ranges are not known.
    """
    given = GivenPrediction(path, read_npz(path))
    given.require_names(PIXIEVERSE)  # Solvers need these.
    side = given.side(RESOLUTION)
    if not 2 <= side <= MAX_LATENT_RESOLUTION:
        raise InputError(path, f"has a grid of {side}^3", f"2 to {MAX_LATENT_RESOLUTION} a side")
    if "coords" not in given.arrays:
        raise InputError(path, f"has {', '.join(given.arrays) or 'nothing'}", "coords")
    coords = given.voxels(side)
    valid = given.valid(len(coords))
    if not valid.any():
        raise InputError(path, f"none of {len(coords)} voxels is valid", "a valid voxel")
    material = given.classes(valid, BACKGROUND + 1)
    if material is None:
        raise InputError(path, f"has {', '.join(given.arrays)}", "material or logits as well")
    if not (valid := valid & (material != UNLABELLED)).any():
        fault = "all classes have the same score in every valid row"
        raise InputError(path, fault, "logits that differ between the classes")
    if "properties_si" in given.arrays:
        values = given.finite("properties_si", valid, len(PROPERTIES)).astype(np.float32)
    elif "properties" in given.arrays:
        ranges = given.ranges(PIXIE_RANGES.ranges) or normalization
        if ranges is None:
            raise ConfigError(
                f"{path} holds normalised properties; name their store or their ranges "
                "(--store or --ranges), or save SI values as properties_si"
            )
        values = denormalize_properties(given.normalised(valid, ranges.ranges), ranges)
    else:
        raise InputError(path, f"has {', '.join(given.arrays)}", "properties or properties_si")
    fine = (material < BACKGROUND) & physical(values, PROPERTIES).all(axis=1)
    if (wrong := valid & ~fine).any():
        first = int(np.argmax(wrong))
        raise InputError(
            path,
            f"row {first} has class {material[first]} and properties {values[first].tolist()}",
            f"in every valid row class 0..6, {', '.join(one.allowed for one in PROPERTIES)}",
        )
    classes = material[valid].astype(np.uint8)
    return VoxelField.of_slat(coords[valid], side, classes, values[valid])
