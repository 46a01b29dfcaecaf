"""Finished assets on disk, between the pass that aligns and the pass that packs.

A worker leaves an asset's arrays here, in SI units, and hands the parent only
a `SpooledAsset`, so the parent's memory does not grow with voxels. A file is
named by its asset's key (see `slatprep.pipeline.recipe`), so what an interrupted build
finished is found again by the next one, and only by one that would write the
same. It appears under its name when it is whole; npz holds a checksum of
every array, so one that a power failure tore is known and done again.
"""

from __future__ import annotations

import hashlib
import uuid
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.geometry.voxels import flat_index
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
from slatprep.storage.atomic import writing

Arrays = dict[str, NDArray[Any]]

_VOXEL_ARRAYS = ("coords", "feats", "properties", "material", "valid", "distance")
_TORN = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)


@dataclass(frozen=True, slots=True)
class SpooledAsset:
    """What the parent keeps of one asset.

    Attributes
    ----------
    asset_id : str
        Id of the row.
    key : str
        Names its file in the spool.
    status : Status
        Only ``ok`` has arrays in the spool.
    reason : str
        Why not, in one line; empty where all is well.
    n_voxels, n_valid : int
        SLAT voxels, and those that found an annotation.
    n_placements : int
        Distinct placements that fit about as well as the one chosen.
    extent : ndarray of float64, shape (3, 2), or None
        What `slatprep.normalize.property_extent` gives.
    columns : dict
        The asset's row of each ``asset/*`` array, by the array's last name;
        ``property_ambiguity`` still in mapped units.
    """

    asset_id: str
    key: str
    status: Status
    reason: str = ""
    n_voxels: int = 0
    n_valid: int = 0
    n_placements: int = 0
    extent: NDArray[np.float64] | None = None
    columns: dict[str, Any] | None = None


class Spool:
    """A directory of finished assets.

    Parameters
    ----------
    directory : Path
        Where; it must exist.
    arrays : bool
        Whether arrays are kept, or records alone.
    """

    def __init__(self, directory: Path, arrays: bool = True) -> None:
        self.directory = directory
        self.arrays = arrays

    def put(self, result: AssetResult, key: str) -> SpooledAsset:
        """Write an asset's record, and its arrays if it has any; return what the parent keeps.

        Raises
        ------
        StoreError
            If the disk does not take it; names the asset.
        """
        arrays: Arrays = {"extent": np.empty(0)}
        if result.status is Status.OK:
            arrays = _arrays_of(result) if self.arrays else {}
            arrays["extent"] = property_extent(_of(result.field, result))
        with writing(result.pair.asset_id, self.directory):
            self._write(key, result.record, arrays)
        return spooled(key, result.record, arrays["extent"])

    def find(self, key: str) -> SpooledAsset | None:
        """Return a finished asset, or None if there is none under this key that is whole."""
        try:
            with np.load(self._path(key), allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}  # Reads, so checks, them all.
            record = orjson.loads(arrays["record"].tobytes())
        except _TORN:
            return None
        if self.arrays and "coords" not in arrays:
            return None  # Finished by an alignment without a store.
        return spooled(key, record, arrays["extent"])

    def holds_any(self) -> bool:
        """Whether anything at all is finished."""
        return any(self.directory.glob("[0-9a-f][0-9a-f]/*.npz"))

    def amend(self, key: str, changes: dict[str, Any]) -> None:
        """Replace entries of a finished asset's record."""
        with np.load(self._path(key), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files if name != "record"}
        record = self.record(key)
        with writing(record["asset_id"], self.directory):
            self._write(key, record | changes, arrays)

    def keep_only(self, keys: set[str]) -> None:
        """Remove everything but these assets' files."""
        for path in self.directory.rglob("*"):
            if path.is_file() and (path.stem not in keys or path.suffix != ".npz"):
                path.unlink()

    def record(self, key: str) -> dict[str, Any]:
        """Read an asset's record back."""
        with np.load(self._path(key), allow_pickle=False) as arrays:
            return cast(dict[str, Any], orjson.loads(arrays["record"].tobytes()))

    def voxels(self, key: str) -> Arrays:
        """Read an asset's rows of the ``voxel/*`` arrays, properties in SI units."""
        with np.load(self._path(key), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in _VOXEL_ARRAYS}

    def grid(self, key: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32]]:
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
        with np.load(self._path(key), allow_pickle=False) as arrays:
            occupancy = np.unpackbits(arrays["grid_occupancy"]).astype(bool)
            voxels, properties = arrays["grid_voxels"], arrays["grid_properties"]
            material_of_voxels = arrays["grid_material"]
        material = np.where(occupancy, np.uint8(UNANNOTATED), np.uint8(BACKGROUND))
        material[flat_index(voxels)] = material_of_voxels
        return material.reshape((RESOLUTION,) * 3), voxels, properties

    def _path(self, key: str) -> Path:
        return self.directory / key[:2] / f"{key}.npz"

    def _write(self, key: str, record: dict[str, Any], arrays: Arrays) -> None:
        path = self._path(key)
        path.parent.mkdir(exist_ok=True)
        # A name of its own: a worker that outlives a killed build may write the same asset.
        partial = path.with_suffix(f".{uuid.uuid4().hex}.partial")
        text = orjson.dumps(record)
        everything: dict[str, Any] = {**arrays, "record": np.frombuffer(text, np.uint8)}
        try:
            with partial.open("wb") as file:
                np.savez(file, **everything)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)


def key_of_failed(asset_id: str) -> str:
    """Return the key of an asset without a result: it is tried again in every build."""
    return f"none-{hashlib.sha256(asset_id.encode()).hexdigest()[:32]}"


def spooled(key: str, record: dict[str, Any], extent: NDArray[np.float64] | None) -> SpooledAsset:
    """Return what the parent keeps of an asset with this record."""
    status = Status(record["status"])
    if status is not Status.OK:
        return SpooledAsset(record["asset_id"], key, status, record["reason"])
    counts = record["counts"]
    return SpooledAsset(
        record["asset_id"],
        key,
        status,
        n_voxels=counts["slat_voxels"],
        n_valid=counts["valid"],
        n_placements=len(record["alignment"]["placements"]),
        extent=extent,
        columns=_columns(record),
    )


def _arrays_of(result: AssetResult) -> Arrays:
    field: MaterialField = _of(result.field, result)
    latents: StructuredLatents = _of(result.latents, result)
    annotation: Annotation = _of(result.annotation, result)
    return {
        "coords": latents.coords,
        "feats": latents.feats,
        "properties": annotation.properties,
        "material": annotation.material,
        "valid": annotation.valid,
        "distance": annotation.distance,
        "grid_occupancy": np.packbits(field.occupancy),
        "grid_voxels": field.voxels,
        "grid_material": field.material,
        "grid_properties": field.properties,
    }


def _of(part: Any, result: AssetResult) -> Any:
    if part is None:
        raise ValueError(f"{result.pair.asset_id}: status is ok, but arrays are missing")
    return part


def _columns(record: dict[str, Any]) -> dict[str, Any]:
    alignment, counts = record["alignment"], record["counts"]
    quality, ambiguity = alignment["quality"], alignment["ambiguity"]
    return {
        "object_id": record["object_id"],
        "view": record["view"],
        "category": record["category"],
        "transform": np.array(alignment["transform"], dtype=np.float64),
        "engine": alignment["engine"],
        "model": alignment["model"],
        "search": alignment["search"],
        "fitness": quality["fitness"],
        "inlier_rmse": quality["inlier_rmse"],
        "fitness_backward": quality["fitness_backward"],
        "inlier_rmse_backward": quality["inlier_rmse_backward"],
        "overlap": quality["overlap"],
        "margin": ambiguity["margin"],
        "ambiguity": ambiguity["material_share"],
        "property_ambiguity": ambiguity["property_change"],
        "valid_share": counts["valid"] / counts["slat_voxels"],
        "verdict": alignment["verdict"],
    }
