"""Finished assets as files, between the pass that aligns and the pass that packs.

A worker writes an asset's arrays here, in SI units, and returns to the parent only
a `slatprep.pipeline.rows.Row`, so the parent's memory does not grow with voxels. A file is
named by its asset's key (see `slatprep.pipeline.recipe`). So the next build finds what an
interrupted build finished, but only if it would write the same. A file gets its name when it is
whole, and has a checksum of every array. So damage by a power failure is noticed, and the asset is
done again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.normalize import property_extent
from slatprep.pipeline.rows import Row
from slatprep.records import (
    RESOLUTION,
    Annotation,
    MaterialField,
    Place,
    Property,
    StructuredLatents,
)
from slatprep.storage.arrays import ArrayFile, write_arrays
from slatprep.storage.atomic import writing
from slatprep.storage.faults import reached
from slatprep.storage.place import storage_of
from slatprep.storage.versions import BUILDER, is_spooled
from slatprep.store.record import AssetRecord
from slatprep.store.record_json import columns_of, digest_of, read_record, to_json

Arrays = dict[str, NDArray[Any]]
"""Arrays, or rows of them, by name."""

_ANNOTATION = tuple(field.name for field in fields(Annotation))
_TORN = (OSError, ValueError, KeyError, StoreError)


class Spool:
    """A directory of finished assets; a directory on a disk must exist.

    It keeps `arrays`, or only records.
    """

    def __init__(self, directory: Place, arrays: bool = True) -> None:
        self.directory = directory
        self.arrays = arrays

    def put(
        self,
        record: AssetRecord,
        field: MaterialField,
        latents: StructuredLatents,
        annotation: Annotation,
        others: Sequence[MaterialField] = (),
    ) -> Row:
        """Write an asset's record and arrays; return its row. StoreError if that fails.

        `others` are further fields whose annotations are merged; only their extent is kept.
        """
        least, most = np.array([property_extent(own, field.table) for own in (field, *others)]).T
        extent = np.stack([np.nanmin(least, axis=1), np.nanmax(most, axis=1)], axis=1)
        arrays: Arrays = {"extent": extent}
        if self.arrays:
            arrays |= {name: getattr(latents, name) for name in ("coords", "feats")}
            arrays["slat_resolution"] = np.array(latents.resolution)
            arrays |= {name: own for name, own in vars(annotation).items() if own is not None}
            arrays |= {
                "grid_occupancy": np.packbits(field.occupancy),
                "grid_voxels": field.voxels,
                "grid_material": field.material,
                "grid_properties": field.properties,
                "grid_table": np.array([(p.name, p.unit, str(p.log10)) for p in field.table]),
                "grid_classified": np.array(field.classified),
            }
        text = to_json(record)
        self._write(record.key, record.asset_id, text, arrays)
        return row_of(record, text, extent)

    def find(self, key: str) -> tuple[AssetRecord, Row] | None:
        """Return a finished asset, or None if there is no whole file under this key."""
        try:
            with self._open(key) as file:
                arrays = dict(file)  # This reads all arrays, and so checks them.
            text = arrays["record"].tobytes()
            record = read_record(AssetRecord, text, str(self._path(key)))
            extent = arrays["extent"]
        except _TORN:
            return None
        if self.arrays and "coords" not in arrays:
            return None  # An alignment without a store finished it.
        return record, row_of(record, text, extent)

    def holds_any(self) -> bool:
        """Return whether any asset is finished."""
        if (directory := storage_of(self.directory).local) is None:
            return any(name.endswith(".arrays") for name in storage_of(self.directory).files())
        return any(directory.glob("[0-9a-f][0-9a-f]/*.arrays"))

    def amend(self, record: AssetRecord) -> None:
        """Replace the record of a finished asset."""
        with self._open(record.key) as file:
            arrays = {name: file[name] for name in file if name != "record"}
        self._write(record.key, record.asset_id, to_json(record), arrays)

    def keep_only(self, keys: set[str], mark: str = "") -> list[str]:
        """Remove everything but these assets' files, if no other build is at work there.

        `mark` is the object that says that this build is at work; it is removed in any case.
        Return the marks of other builds; if there are any, no asset was removed. StoreError or
        OSError if the place cannot be listed, or the files cannot be removed.
        """
        storage = storage_of(self.directory)
        kept = {f"{key[:2]}/{key}.arrays" for key in keys}
        # Others may keep objects of their own below the URL of a store.
        ours = [n for n in storage.files() if storage.remote is None or is_spooled(n)]
        others = [n for n in ours if n.startswith(f"{BUILDER}-") and n != mark]
        storage.remove(n for n in ours if n not in kept and (n == mark or not others))
        return others

    def asset(self, key: str) -> tuple[AssetRecord, MaterialField, StructuredLatents, Annotation]:
        """Read an asset back: its record, field, SLAT and annotation."""
        with self._open(key) as arrays:
            text, field, voxels = arrays["record"].tobytes(), _field_in(arrays), _voxels_in(arrays)
            resolution = int(arrays["slat_resolution"])
        coords, feats = voxels.pop("coords"), voxels.pop("feats")
        latents = StructuredLatents(coords, feats, resolution=resolution)
        record = read_record(AssetRecord, text, str(self._path(key)))
        return record, field, latents, Annotation(**voxels)

    def record_text(self, key: str) -> bytes:
        """Read an asset's record back as its JSON, unchecked."""
        with self._open(key) as arrays:
            return arrays["record"].tobytes()

    def voxels(self, key: str) -> Arrays:
        """Read an asset's rows of the ``voxel/*`` arrays, properties in SI units."""
        with self._open(key) as arrays:
            return _voxels_in(arrays)

    def field(self, key: str) -> MaterialField:
        """Read an asset's PixieVerse field, without its sources."""
        with self._open(key) as arrays:
            return _field_in(arrays)

    def _path(self, key: str) -> Place:
        return self.directory / key[:2] / f"{key}.arrays"

    @contextmanager
    def _open(self, key: str) -> Iterator[ArrayFile]:
        with storage_of(self._path(key)).open_scattered() as file:
            yield ArrayFile(file)

    def _write(self, key: str, asset_id: str, record: bytes, arrays: Arrays) -> None:
        path, everything = self._path(key), {**arrays, "record": np.frombuffer(record, np.uint8)}
        with (
            writing(asset_id, self.directory),
            storage_of(path).staged_apart(path.parent) as partial,
            partial.open("wb") as file,
        ):
            write_arrays(file, everything)
        reached("asset spooled", asset_id)


def _voxels_in(arrays: ArrayFile) -> Arrays:
    there = (name for name in ("coords", "feats", *_ANNOTATION) if name in arrays)
    return {name: arrays[name] for name in there}


def _field_in(arrays: ArrayFile) -> MaterialField:
    occupancy = np.unpackbits(arrays["grid_occupancy"]).astype(bool)
    table = arrays["grid_table"].tolist()
    return MaterialField(
        occupancy=occupancy.reshape((RESOLUTION,) * 3),
        voxels=arrays["grid_voxels"],
        material=arrays["grid_material"],
        properties=arrays["grid_properties"],
        table=tuple(Property(name, unit, log10 == "True") for name, unit, log10 in table),
        classified=bool(arrays["grid_classified"]),
    )


def row_of(record: AssetRecord, text: bytes, extent: NDArray[np.float64]) -> Row:
    """Return the row of a finished asset, from its record and its properties' extent (P, 2)."""
    columns: dict[str, Any] = {
        **columns_of(record),
        "record_sha256": np.frombuffer(digest_of(text), np.uint8),
        "extent": extent,
        "clipped": np.zeros(len(extent), np.int64),  # Packing counts them.
        "clipped_grid": np.zeros(len(extent), np.int64),
        "n_valid": record.counts.valid,
        "n_placements": len(record.alignment.placements),
        "grid": next((file.sha256 for file in record.sources if file.role == "grid"), ""),
    }
    return Row(record.asset_id, record.counts.slat_voxels, record.key, columns)
