"""What decides an asset's row: when it need not be done again, and what its record says.

Three things decide an asset's row: what its sources hold, the parameters that
touch it, and the code with the libraries it computes with. A `Recipe` is the
last two; with the first it gives the asset's key, which its record keeps.
Work under the same key is the same work. Ranges, chunks, names and the times
of files are no part of it.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib import metadata
from typing import Any

import numpy as np
import orjson

from slatprep.align import engine_versions
from slatprep.geometry.voxels import boundary
from slatprep.parameters import BuildParameters
from slatprep.pipeline.fingerprint import code_fingerprint, packing_fingerprint
from slatprep.readers import source_digests
from slatprep.records import AssetPair, Failed, Finished, SourceFile, Status
from slatprep.store.record import (
    MAX_WARNINGS,
    AssetRecord,
    FailedRecord,
    StageParameters,
    VoxelCounts,
)


@dataclass(frozen=True)
class Recipe:
    """What an asset's numbers depend on besides its sources.

    Attributes
    ----------
    parameters : StageParameters
        Those that touch an asset.
    versions : dict of str to str
        Libraries that make the numbers.
    code : str
        Fingerprint of the code.
    """

    parameters: StageParameters
    versions: dict[str, str]
    code: str

    def key(self, asset_id: str, digests: Mapping[str, str]) -> str:
        """Return the key of an asset, SHA-256 in hex, from the digests of its sources."""
        parts = [asset_id, digests, self.parameters, self.versions, self.code]
        return hashlib.sha256(orjson.dumps(parts, option=orjson.OPT_SORT_KEYS)).hexdigest()

    def difference(self, record: AssetRecord, sources: Iterable[SourceFile]) -> str:
        """Say in one line why an asset with an older record has another key now."""
        before = asdict(record.parameters)
        for group, values in asdict(self.parameters).items():
            for name, value in values.items():
                if before[group][name] != value:
                    was = before[group][name]
                    return f"parameters changed: {group}.{name} was {was}, is {value}"
        for name, version in self.versions.items():
            if record.versions.get(name) != version:
                return f"libraries changed: {name} was {record.versions.get(name)}, is {version}"
        if record.code != self.code:
            return "code changed"
        old, new = source_digests(record.sources), source_digests(sources)
        roles = sorted(role for role in old | new if old.get(role) != new.get(role))
        return f"sources changed: {', '.join(roles)}"


def recipe_of(parameters: BuildParameters) -> Recipe:
    """Return the recipe of a build."""
    return Recipe(
        parameters=StageParameters(parameters.align, parameters.sample),
        versions=numeric_versions(parameters),
        code=code_fingerprint(),
    )


def build_of(parameters: BuildParameters) -> dict[str, Any]:
    """Return a store's attribute ``build``: its parameters, and what else decides its bytes."""
    versions = {
        **_environment(),
        **numeric_versions(parameters),
        "zarr": metadata.version("zarr"),
        "joblib": metadata.version("joblib"),
        "packing": packing_fingerprint(),
    }
    return origin(parameters, versions)


def origin(parameters: BuildParameters, versions: Mapping[str, str]) -> dict[str, Any]:
    """Return what decides a store's bytes, without where files lie, as its metadata hold it."""
    groups = ("align", "sample", "consensus", "witness", "normalize", "store")
    said = {group: getattr(parameters, group) for group in groups}
    document = {"name": parameters.name, "parameters": said, "versions": versions}
    return dict(orjson.loads(orjson.dumps(document)))


def numeric_versions(parameters: BuildParameters) -> dict[str, str]:
    """Return the versions of the libraries that make an asset's numbers."""
    return {
        "numpy": metadata.version("numpy"),
        "scipy": metadata.version("scipy"),
        **engine_versions(parameters.align),
    }


@lru_cache(maxsize=1)  # It takes longer than to read an asset.
def _environment() -> dict[str, str]:
    return {"slatprep": metadata.version("slatprep"), "python": platform.python_version()}


def record_of(asset: Finished, recipe: Recipe, key: str) -> AssetRecord:
    """Return the record of an asset that went through all stages, as the store will hold it."""
    field, latents = asset.field, asset.latents
    return AssetRecord(
        **_said_of(asset.pair, recipe),
        status=Status.OK,
        sources=asset.sources or field.sources + latents.sources,
        bounds=field.bounds,
        key=key,
        alignment=asset.alignment,
        judgement=asset.judgement,
        counts=_counts_of(asset),
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


def record_of_failed(asset: Failed, recipe: Recipe) -> FailedRecord:
    """Return the record of an asset that cannot go in."""
    return FailedRecord(
        **_said_of(asset.pair, recipe),
        status=asset.status,
        reason=asset.reason,
        traceback=asset.traceback,
    )


def _said_of(pair: AssetPair, recipe: Recipe) -> dict[str, Any]:
    """Return what the record of any asset says, whether it goes in or not."""
    names = ("asset_id", "object_id", "view", "category")
    return {
        **{name: getattr(pair, name) for name in names},
        "parameters": recipe.parameters,
        "versions": {**_environment(), **recipe.versions},
        "code": recipe.code,
    }


def _counts_of(asset: Finished) -> VoxelCounts:
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
