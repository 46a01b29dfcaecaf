"""Recipes and records: they tell what decides an asset's row, and when it stays the same.

Three things decide an asset's row: the content of its sources, the parameters
that affect it, and the code with its libraries. A `Recipe` holds the last two.
With the first it gives the asset's key, which its record keeps. Equal keys mean
equal work. Ranges, chunks, names and the times of files are not part of the key.
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
from slatprep.normalize import ranges_from_extents
from slatprep.parameters import BuildParameters, NormalizeParameters, is_split_file, percentiles_of
from slatprep.pipeline.fingerprint import code_fingerprint, packing_fingerprint
from slatprep.readers import contents_of, source_digests
from slatprep.readers.ranges import pixie_ranges, read_ranges
from slatprep.readers.splits import read_id_file
from slatprep.records import AssetPair, Contents, Finished, Normalization, SourceFile, Status
from slatprep.storage.place import place_of
from slatprep.store import Store
from slatprep.store.record import (
    MAX_WARNINGS,
    AssetRecord,
    FailedRecord,
    StageParameters,
    StatusOfFailed,
    VoxelCounts,
)


@dataclass(frozen=True)
class Recipe:
    """Everything besides its sources on which an asset's numbers depend.

    `parameters` are those that affect an asset, `versions` those of the libraries that make the
    numbers, and `code` is the fingerprint of the code.
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
        # The record does not tell units, adapter, encoder and plausibility, which the key has.
        return f"sources changed: {', '.join(roles)}" if roles else "how sources are read changed"


def recipe_of(parameters: BuildParameters) -> Recipe:
    """Return the recipe of a build."""
    stages = StageParameters(parameters.align, parameters.sample)
    return Recipe(stages, engine_versions(parameters.align), code_fingerprint())


@dataclass(frozen=True)
class Wanted:
    """The request to a build: its parameters, and everything that follows from them alone.

    Attributes
    ----------
    parameters : BuildParameters
        Sources and methods.
    recipe : Recipe
        What decides an asset's row.
    build : mapping
        What else decides the store's bytes, as in its attribute ``build``.
    ranges : Normalization or str
        Ranges that do not depend on the dataset, or a text that says how they depend on it.
    declared : Contents
        What the sources hold.
    compact : bool
        Whether rows are ordered by id, whatever the order of the existing store.
    """

    parameters: BuildParameters
    recipe: Recipe
    build: Mapping[str, object]
    ranges: Normalization | str
    declared: Contents
    compact: bool

    @classmethod
    def of(cls, parameters: BuildParameters, compact: bool = False) -> Wanted:
        """Return what parameters ask for; raise `SlatprepError` if their files cannot be used."""
        declared = contents_of(parameters)
        ranges = _ranges_of(parameters.normalize, declared)
        recipe = recipe_of(parameters)
        others = {name: metadata.version(name) for name in ("zarr", "joblib")}
        versions = {**_environment(), **recipe.versions, **others, "packing": packing_fingerprint()}
        return cls(parameters, recipe, origin(parameters, versions), ranges, declared, compact)

    @property
    def passes(self) -> bool:
        """Whether passes over the whole dataset may place assets anew."""
        return self.parameters.consensus.settle or self.parameters.witness.settle

    def has_ranges(self, store: Store) -> bool:
        """Return whether a store of the right assets has the ranges that are asked for."""
        ranges = self.ranges
        if ranges == "dataset":  # A subset or joined store may have ranges of other assets.
            extents = store.column("extent")
            ranges = ranges_from_extents(extents, ranges, self.declared.properties)
        return ranges in (store.normalization, store.normalization.source)

    def allows(self, store: Store) -> bool:
        """Return whether a store of the right assets is the one that is asked for."""
        compact = len(store.attributes["segments"]) <= 1 or not self.compact
        return store.attributes["build"] == self.build and self.has_ranges(store) and compact


def _ranges_of(parameters: NormalizeParameters, declared: Contents) -> Normalization | str:
    """Return ranges that do not depend on the dataset, or a text that says how they depend on it.

    The text changes whenever the ranges could. InputError if a file cannot be used.
    """
    ranges, by = parameters.ranges, parameters.split_by
    if ranges == "pixie":
        return pixie_ranges(declared.properties)
    if ranges != "dataset" and not percentiles_of(ranges):
        return read_ranges(place_of(ranges), declared.properties)
    if parameters.objects == "all":
        return ranges
    if is_split_file(by):
        digest = hashlib.sha256(read_id_file(place_of(by))).hexdigest()
        by = f"{place_of(by).name}, sha256 {digest[:12]}"
    return f"{ranges} of train by {by}"


def origin(parameters: BuildParameters, versions: Mapping[str, str]) -> dict[str, Any]:
    """Return what decides a store's bytes, without places of files, as its metadata hold it."""
    groups = ("align", "sample", "consensus", "witness", "normalize", "store")
    said = {group: getattr(parameters, group) for group in groups}
    whole = {"name": parameters.name, "parameters": said, "versions": versions}
    document = dict(orjson.loads(orjson.dumps(whole)))
    # Of files the names alone: what they hold is in the store's ranges and in their source.
    normalize = document["parameters"]["normalize"]
    normalize["ranges"] = place_of(normalize["ranges"]).name
    if is_split_file(by := normalize["split_by"]):
        normalize["split_by"] = place_of(by).name
    return document


@lru_cache(maxsize=1)  # This takes longer than reading an asset.
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
    """Return as many warnings as a record may hold; the last one counts the others."""
    if len(warnings) <= MAX_WARNINGS:
        return warnings
    kept = warnings[: MAX_WARNINGS - 1]
    return (*kept, f"{len(warnings) - len(kept):,} more warnings")


def record_of_failed(
    pair: AssetPair,
    recipe: Recipe,
    reason: str,
    traceback: str = "",
    status: StatusOfFailed = Status.FAILED,
) -> FailedRecord:
    """Return the record of an asset that cannot go in; `traceback` is of an internal error."""
    said = _said_of(pair, recipe)
    return FailedRecord(**said, reason=reason, traceback=traceback, status=status)


def _said_of(pair: AssetPair, recipe: Recipe) -> dict[str, Any]:
    """Return the entries that every asset's record has, whether the asset goes in or not."""
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
