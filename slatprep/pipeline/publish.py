"""Publish a build: its records in the store and beside it."""

from __future__ import annotations

import json
import platform
import shutil
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from slatprep.errors import StoreError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.summary import BuildSummary
from slatprep.provenance import record as provenance
from slatprep.provenance.jsonable import jsonable
from slatprep.provenance.record import BUILD_RECORD, RECORD_VERSION, origin
from slatprep.records import Status
from slatprep.storage.place import storage_of
from slatprep.store.records import RecordWriter


def write_build_record(path: Path, summary: BuildSummary, parameters: BuildParameters) -> None:
    """Write the record of a build as one JSON document."""
    record = {
        "format": BUILD_RECORD,
        "format_version": RECORD_VERSION,
        "id": summary.manifest,
        "name": parameters.name,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "duration_s": round(summary.seconds, 3),
        "platform": platform.platform(),
        "store": summary.store.name if summary.store else None,
        "records": summary.records.name,
        "parameters": jsonable(parameters),
        "versions": origin(parameters)["versions"],
        "normalization": jsonable(summary.normalization),
        "statuses": summary.statuses,
        "verdicts": summary.verdicts,
        "counts": {
            "voxels": summary.n_voxels,
            "valid": summary.n_valid,
            "clipped": dict(summary.clipped),
        },
    }
    path.write_text(
        json.dumps(record, indent=2, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8"
    )


def write_all_records(store: Path, path: Path, records: Iterable[dict[str, Any]]) -> str:
    """Write all records to a file, and those of rows into the new store; return the build's id."""
    import zarr

    root = zarr.open_group(store, mode="r+", zarr_format=3, use_consolidated=False)
    writer = RecordWriter(root)

    def passing() -> Iterator[dict[str, Any]]:
        for record in records:
            if record["status"] == Status.OK:
                writer.add(record)
            yield record

    manifest = provenance.write_records(path, passing())
    writer.flush()
    return manifest


def publish_manifests(records: Path, summary: BuildSummary, parameters: BuildParameters) -> None:
    """Copy the records of a finished build to where people look for them.

    Raises
    ------
    StoreError
        If the disk does not take them.
    """
    folder = summary.records.parent
    try:
        with (
            storage_of(summary.records).staged() as records_file,
            storage_of(folder / "build.json").staged() as build_file,
        ):
            shutil.copyfile(records, records_file)
            write_build_record(build_file, summary, parameters)
    except OSError as error:
        raise StoreError(
            f"{folder}: the records cannot be written there ({error.strerror or error}); the store "
            "is complete and holds those of its assets. Run again to write them here"
        ) from error
