"""The annotated points of an asset, which several formats write."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.export.formats import Points
from slatprep.geometry.frames import voxel_centres
from slatprep.records import BACKGROUND, MATERIAL_CLASSES, PROPERTY_COLUMNS
from slatprep.store import Store, StoredAsset
from slatprep.store.records import StoredRecords


class AnnotatedPoints(NamedTuple):
    """Points with materials: positions (N, 3) in either frame's unit cube, SI values (N, P)."""

    in_slat: NDArray[np.float64]
    in_pixieverse: NDArray[np.float64]
    material: NDArray[np.uint8]
    values: NDArray[np.float32]
    distance: NDArray[np.float32]

    def solid(self, asset: StoredAsset) -> NDArray[np.float32]:
        """Return Young's modulus [Pa], density [kg/m^3] and Poisson's ratio, (N, 3)."""
        return self.values[:, asset.store.columns_of(PROPERTY_COLUMNS)]


def require_solver_classes(store: Store) -> None:
    """Raise StoreError for a store with other classes than those that a solver knows."""
    if store.contents.classes not in (MATERIAL_CLASSES, ()):
        raise StoreError(
            f"{store.path} has classes of its own ({', '.join(store.contents.classes)}); expected "
            f"those of PhysGaussian's solver ({', '.join(MATERIAL_CLASSES[:BACKGROUND])}), or none"
        )


def annotated_points(asset: StoredAsset, points: Points) -> AnnotatedPoints:
    """Return the valid SLAT voxels, or the annotated voxels of the field at distance 0."""
    if points == "grid":
        field = asset.field
        centres = voxel_centres(field.voxels)
        return AnnotatedPoints(
            StoredRecords(asset.store).place_map(asset).to_slat(centres),
            centres,
            field.material,
            field.properties,
            np.zeros(len(field.material), dtype=np.float32),
        )
    valid = asset.valid
    return AnnotatedPoints(
        asset.latents.centres[valid],
        asset.place[valid].astype(np.float64),
        asset.material[valid],
        asset.properties_si[valid],
        asset.distance[valid],
    )
