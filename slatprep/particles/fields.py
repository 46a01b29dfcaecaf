"""Materials on voxels, from a store or predicted by a decoder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.errors import ConfigError, InputError
from slatprep.export.formats import require_solver_classes
from slatprep.geometry.deformation import PlaceMap
from slatprep.geometry.voxels import shown_in_cells
from slatprep.normalize import denormalize_properties
from slatprep.readers.files import ArraySpec, load_source, npz_arrays, npz_small_arrays
from slatprep.readers.slat import COORDS, check_coords
from slatprep.records import (
    BACKGROUND,
    MAX_LATENT_RESOLUTION,
    PROPERTY_COLUMNS,
    RESOLUTION,
    Normalization,
)
from slatprep.store import Store
from slatprep.store.records import StoredRecords

Points = Literal["slat", "grid"]

_SPECS = {
    "coords": COORDS,
    "material": ArraySpec(shapes=((None,),), kinds="iu"),
}
_PROPERTIES = ArraySpec(shapes=((None, 3),), kinds="f")
_MORE = {
    "properties_si": _PROPERTIES,
    "valid": ArraySpec(shapes=((None,),), kinds="b"),
    "resolution": ArraySpec(shapes=((),), kinds="iu"),
}


@dataclass(frozen=True)
class VoxelField:
    """Materials on voxels.

    Attributes
    ----------
    voxels : ndarray of uint8, shape (K, 3)
        The voxels that have a material, K >= 1, each once.
    material : ndarray of uint8, shape (K,)
        Class 0..6.
    properties : ndarray of float32, shape (K, 3)
        Young's modulus [Pa], density [kg/m^3], Poisson's ratio.
    place_map : PlaceMap, optional
        The map from the SLAT frame to the voxels' frame; None if the frames are the same.
    """

    voxels: NDArray[np.uint8]
    material: NDArray[np.uint8]
    properties: NDArray[np.float32]
    place_map: PlaceMap | None = None

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
    asset, columns = store.asset(name), store.columns_of(PROPERTY_COLUMNS)
    require_solver_classes(store)
    if points == "grid":
        grid = asset.field
        place_map = StoredRecords(store).place_map(asset)
        field = VoxelField(grid.voxels, grid.material, grid.properties[:, columns], place_map)
    else:
        valid = asset.valid
        values = asset.properties_si[valid][:, columns]
        cells, row = shown_in_cells(asset.coords[valid], store.contents.latents.resolution)
        field = VoxelField(cells, asset.material[valid][row], values[row])
    if len(field.voxels) == 0:
        raise ConfigError(
            f"{store.path}: no voxel of {asset.asset_id} has a material; expected an asset whose "
            "valid_share is above 0"
        )
    return field


def predicted_field(path: Path, normalization: Normalization | None) -> VoxelField:
    """Read predicted materials of the SLAT frame, as `slatprep export --format npz` writes them.

    The npz has ``coords``, ``material``, ``properties`` or ``properties_si``, and may have
    ``valid`` and ``resolution``. InputError if it cannot be used, ConfigError if its
    properties are normalised and `normalization` is None.
    """
    data, _ = load_source(path, path.parent, "slat")
    arrays = npz_arrays(data, path, _SPECS)
    arrays |= npz_arrays(data, path, _MORE, partial=True)
    side = int(arrays.get("resolution", RESOLUTION))
    if not 2 <= side <= MAX_LATENT_RESOLUTION:
        raise InputError(path, f"has a grid of {side}^3", f"2 to {MAX_LATENT_RESOLUTION} a side")
    coords = check_coords(arrays["coords"], path, side)
    material = arrays["material"]
    named = npz_small_arrays(data, path, ArraySpec(shapes=(), kinds="U"))[0].get("columns")
    if named is not None and tuple(named.tolist()) != PROPERTY_COLUMNS:
        raise InputError(  # Solvers need these columns.
            path, f"predicts {', '.join(map(str, named.ravel()))}", ", ".join(PROPERTY_COLUMNS)
        )
    values = arrays.get("properties_si")
    if values is None:
        values = npz_arrays(data, path, {"properties": _PROPERTIES})["properties"]
        if normalization is None:
            raise ConfigError(
                f"{path} holds normalised properties; name their store or their ranges "
                "(--store or --ranges), or save SI values as properties_si"
            )
        values = denormalize_properties(values, normalization)
    valid = arrays.get("valid", np.ones(len(coords), dtype=bool))
    lengths = {len(coords), len(material), len(values), len(valid)}
    if len(lengths) > 1 or not valid.any():
        raise InputError(
            path,
            f"has {len(coords)} coords, {len(material)} material, {len(values)} properties, "
            f"{np.count_nonzero(valid)} of {len(valid)} valid",
            "as many of each, and at least one valid voxel",
        )
    wrong = valid & ((material < 0) | (material >= BACKGROUND) | ~np.isfinite(values).all(axis=1))
    if wrong.any():
        first = int(np.argmax(wrong))
        raise InputError(
            path,
            f"row {first} has material {material[first]} and properties {values[first].tolist()}",
            "material 0..6 and finite properties in every valid row",
        )
    cells, row = shown_in_cells(coords[valid], side)
    material, values = material[valid].astype(np.uint8), values[valid].astype(np.float32)
    return VoxelField(cells, material[row], values[row])
