"""Make the records of assets."""

from __future__ import annotations

from importlib import metadata

import numpy as np
import orjson

from slatprep.geometry.voxels import boundary
from slatprep.parameters import BuildParameters
from slatprep.provenance.record import (
    MAX_WARNINGS,
    AssetRecord,
    FailedRecord,
    StageParameters,
    VoxelCounts,
)
from slatprep.provenance.versions import library_versions
from slatprep.records import Failed, Finished, Status


def record_of(asset: Finished, parameters: BuildParameters, code: str, key: str) -> AssetRecord:
    """Return the record of an asset that went through all stages, as the store will hold it.

    `code` is the fingerprint of the code that made the numbers, `key` what the asset was made from
    and how.
    """
    pair, field, latents = asset.pair, asset.field, asset.latents
    return AssetRecord(
        asset_id=pair.asset_id,
        object_id=pair.object_id,
        view=pair.view,
        category=pair.category,
        status=Status.OK,
        sources=asset.sources or field.sources + latents.sources,
        bounds=field.bounds,
        parameters=StageParameters(parameters.align, parameters.sample),
        versions=library_versions(parameters.align),
        code=code,
        key=key,
        alignment=asset.alignment,
        judgement=asset.judgement,
        counts=counts_of(asset),
        merged=asset.contributions,
        latents=latents.moments,
        warnings=_first(field.warnings + latents.warnings),
    )


def _first(warnings: tuple[str, ...]) -> tuple[str, ...]:
    """Return as many warnings as a record may hold, the last of them about the others."""
    if len(warnings) <= MAX_WARNINGS:
        return warnings
    kept = warnings[: MAX_WARNINGS - 1]
    return (*kept, f"{len(warnings) - len(kept):,} more warnings")


def record_of_failed(asset: Failed, parameters: BuildParameters, code: str) -> FailedRecord:
    """Return the record of an asset that cannot go in."""
    pair = asset.pair
    return FailedRecord(
        asset_id=pair.asset_id,
        object_id=pair.object_id,
        view=pair.view,
        category=pair.category,
        status=asset.status,
        reason=asset.reason,
        traceback=asset.traceback,
        parameters=StageParameters(parameters.align, parameters.sample),
        versions=library_versions(parameters.align),
        code=code,
    )


def counts_of(asset: Finished) -> VoxelCounts:
    """Count the voxels of an asset."""
    occupied = int(np.count_nonzero(asset.field.occupancy))
    return VoxelCounts(
        occupied=occupied,
        annotated=len(asset.field.voxels),
        unannotated=occupied - len(asset.field.voxels),
        boundary=int(np.count_nonzero(boundary(asset.field.occupancy))),
        slat_voxels=len(asset.latents.coords),
        valid=int(np.count_nonzero(asset.annotation.valid)),
        unphysical=asset.field.unphysical,
    )


def origin(parameters: BuildParameters) -> dict[str, object]:
    """Return what decides a store's bytes, without where files lie: its attribute ``build``."""
    groups = ("align", "sample", "consensus", "witness", "normalize", "store")
    document: dict[str, object] = orjson.loads(
        orjson.dumps(
            {
                "name": parameters.name,
                "parameters": {group: getattr(parameters, group) for group in groups},
                "versions": build_versions(parameters),
            }
        )
    )
    return document


def build_versions(parameters: BuildParameters) -> dict[str, str]:
    """Return the versions of everything that makes a store's bytes."""
    return {
        **library_versions(parameters.align),
        "zarr": metadata.version("zarr"),
        "joblib": metadata.version("joblib"),
    }
