"""Finished assets on disk, between the pass that aligns and the pass that packs.

A worker leaves an asset's arrays here, in SI units, and hands the parent only
a `SpooledAsset`, so the parent's memory does not grow with voxels. Files are
named by a hash: an asset id need not be a file name.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from slatprep.normalize import property_extent
from slatprep.records import (
    BACKGROUND,
    RESOLUTION,
    UNANNOTATED,
    Annotation,
    AssetResult,
    MaterialField,
    Status,
    StructuredLatents,
)


@dataclass(frozen=True, slots=True)
class SpooledAsset:
    """What the parent keeps of one asset.

    Attributes
    ----------
    asset_id : str
        Id of the row.
    status : Status
        Only ``ok`` has arrays in the spool.
    reason : str
        Why not, in one line; empty where all is well.
    n_voxels, n_valid : int
        SLAT voxels, and those that found an annotation.
    extent : ndarray of float64, shape (3, 2), or None
        What `slatprep.normalize.property_extent` gives.
    columns : dict
        The asset's row of each ``asset/*`` array, by the array's last name;
        ``property_ambiguity`` still in mapped units.
    """

    asset_id: str
    status: Status
    reason: str = ""
    n_voxels: int = 0
    n_valid: int = 0
    extent: NDArray[np.float64] | None = None
    columns: dict[str, Any] | None = None


class Spool:
    """A directory of finished assets.

    Parameters
    ----------
    directory : Path
        Where; made with the first asset.
    arrays : bool
        Whether arrays are kept, or records alone.
    """

    def __init__(self, directory: Path, arrays: bool = True) -> None:
        self.directory = directory
        self.arrays = arrays

    def put(self, result: AssetResult) -> SpooledAsset:
        """Write an asset's record, and its arrays if it has any; return what the parent keeps."""
        asset_id = result.pair.asset_id
        path = self._path(asset_id, ".json")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(result.record, allow_nan=False), encoding="utf-8")
        if result.status is not Status.OK:
            return SpooledAsset(asset_id, result.status, result.reason)
        field, latents, annotation = _arrays_of(result)
        if self.arrays:
            np.savez(
                self._path(asset_id, ".npz"),
                coords=latents.coords,
                feats=latents.feats,
                properties=annotation.properties,
                material=annotation.material,
                valid=annotation.valid,
                distance=annotation.distance,
                grid_occupancy=np.packbits(field.occupancy),
                grid_voxels=field.voxels,
                grid_material=field.material,
                grid_properties=field.properties,
            )
        return SpooledAsset(
            asset_id,
            result.status,
            n_voxels=len(latents.coords),
            n_valid=int(annotation.valid.sum()),
            extent=property_extent(field),
            columns=_columns(result),
        )

    def record(self, asset_id: str) -> dict[str, Any]:
        """Read an asset's record back."""
        text = self._path(asset_id, ".json").read_text(encoding="utf-8")
        return cast(dict[str, Any], json.loads(text))

    def voxels(self, asset_id: str) -> dict[str, NDArray[Any]]:
        """Read an asset's rows of the ``voxel/*`` arrays, properties in SI units."""
        names = ("coords", "feats", "properties", "material", "valid", "distance")
        with np.load(self._path(asset_id, ".npz"), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in names}

    def grid(
        self, asset_id: str
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32]]:
        """Read an asset's PixieVerse field.

        Returns
        -------
        material : ndarray of uint8, shape (64, 64, 64)
            As in ``grid/material``: 7 background, 255 occupied but not annotated.
        voxels : ndarray of uint8, shape (K, 3)
            The annotated voxels.
        properties : ndarray of float32, shape (K, 3)
            Their properties in SI units.
        """
        with np.load(self._path(asset_id, ".npz"), allow_pickle=False) as arrays:
            occupancy = np.unpackbits(arrays["grid_occupancy"]).astype(bool)
            voxels, properties = arrays["grid_voxels"], arrays["grid_properties"]
            material_of_voxels = arrays["grid_material"]
        material = np.where(occupancy, np.uint8(UNANNOTATED), np.uint8(BACKGROUND))
        material = material.reshape((RESOLUTION,) * 3)
        material[tuple(voxels.T)] = material_of_voxels
        return material, voxels, properties

    def _path(self, asset_id: str, suffix: str) -> Path:
        key = hashlib.sha256(asset_id.encode()).hexdigest()[:32]
        return self.directory / key[:2] / f"{key}{suffix}"


def _arrays_of(result: AssetResult) -> tuple[MaterialField, StructuredLatents, Annotation]:
    field, latents, annotation = result.field, result.latents, result.annotation
    if field is None or latents is None or annotation is None:
        raise ValueError(f"{result.pair.asset_id}: status is ok, but arrays are missing")
    return field, latents, annotation


def _columns(result: AssetResult) -> dict[str, Any]:
    pair, alignment, annotation = result.pair, result.alignment, result.annotation
    ambiguity, verdict = result.ambiguity, result.verdict
    if alignment is None or annotation is None or ambiguity is None or verdict is None:
        raise ValueError(f"{pair.asset_id}: status is ok, but the alignment is missing")
    quality = alignment.quality
    return {
        "object_id": pair.object_id,
        "view": pair.view,
        "category": pair.category,
        "transform": alignment.transform,
        "engine": alignment.engine,
        "model": alignment.model,
        "search": alignment.search,
        "fitness": quality.fitness,
        "inlier_rmse": quality.inlier_rmse,
        "fitness_backward": quality.fitness_backward,
        "inlier_rmse_backward": quality.inlier_rmse_backward,
        "overlap": quality.overlap,
        "margin": ambiguity.margin,
        "ambiguity": ambiguity.material_share,
        "property_ambiguity": ambiguity.property_change,
        "valid_share": float(annotation.valid.mean()),
        "verdict": str(verdict),
    }
