"""Provenance: what each row of a store was made from, by what, and how well.

One JSON record an asset, as lines of one file, and one record of the build
over them; both follow the JSON Schemas in ``slatprep/provenance/schema``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from importlib import metadata, resources
from pathlib import Path
from typing import Any, cast

import numpy as np
import orjson

from slatprep.geometry.voxels import boundary
from slatprep.parameters import BuildParameters
from slatprep.provenance.jsonable import jsonable
from slatprep.provenance.versions import library_versions
from slatprep.records import (
    PROPERTY_COLUMNS,
    Alignment,
    AssetResult,
    Candidate,
    Consensus,
    Normalization,
    Placement,
    Quality,
)

ASSET_RECORD = "slatprep-asset-record"
BUILD_RECORD = "slatprep-build-record"
RECORD_VERSION = 1

# These differ between runs, machines or folders without the content differing,
# so a build's id leaves them out.
_NOT_CONTENT = ("duration_s", "reason", "traceback")

_SORTED_LINE = orjson.OPT_SORT_KEYS | orjson.OPT_APPEND_NEWLINE


def content_parameters(parameters: BuildParameters) -> dict[str, Any]:
    """Return the parameters that decide an asset's row, without where its files lie."""
    return {"align": jsonable(parameters.align), "sample": jsonable(parameters.sample)}


def asset_record(
    result: AssetResult,
    parameters: BuildParameters,
    duration: float,
    *,
    traceback: str = "",
    code: str = "",
    key: str = "",
    alignment: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the record of one asset.

    Parameters
    ----------
    result : AssetResult
        What became of it.
    parameters : BuildParameters
        The build's parameters.
    duration : float
        Seconds spent on it.
    traceback : str
        Where an error of slatprep's own arose; empty otherwise.
    code : str
        Fingerprint of the code that made the numbers.
    key : str
        What the asset was made from and how, see `slatprep.pipeline.recipe`; empty
        where there is no result.
    alignment : mapping, optional
        What an older record of the same key says of the alignment.

    Returns
    -------
    dict
        JSON-ready; ``normalization`` and the clipped counts are filled in by
        `complete_record` once the whole dataset is known.
    """
    pair, field, latents = result.pair, result.field, result.latents
    sources = (field.sources if field else ()) + (latents.sources if latents else ())
    warnings = (field.warnings if field else ()) + (latents.warnings if latents else ())
    return {
        "format": ASSET_RECORD,
        "format_version": RECORD_VERSION,
        "asset_id": pair.asset_id,
        "object_id": pair.object_id,
        "view": pair.view,
        "category": pair.category,
        "status": str(result.status),
        "reason": result.reason,
        "traceback": traceback,
        "sources": jsonable(sources),
        "bounds": jsonable(field.bounds) if field else None,
        "parameters": content_parameters(parameters),
        "versions": library_versions(parameters.align),
        "code": code,
        "key": key,
        "alignment": alignment_entry(result) if alignment is None else dict(alignment),
        "before_settling": None,
        "normalization": None,
        "counts": counts_entry(result),
        "warnings": list(warnings),
        "duration_s": round(duration, 4),
    }


def complete_record(
    record: dict[str, Any],
    normalization: Normalization,
    clipped_voxels: Iterable[int],
    clipped_grid: Iterable[int],
) -> dict[str, Any]:
    """Return a record with what only the whole dataset could tell: ranges and clipped values."""
    clipped = {
        "voxel": dict(zip(PROPERTY_COLUMNS, map(int, clipped_voxels), strict=True)),
        "grid": dict(zip(PROPERTY_COLUMNS, map(int, clipped_grid), strict=True)),
    }
    return {
        **record,
        "normalization": jsonable(normalization),
        "counts": {**record["counts"], "clipped": clipped},
    }


def origin(parameters: BuildParameters) -> dict[str, Any]:
    """Return the parameters and versions that decide a store's bytes, without where files lie."""
    return {
        "name": parameters.name,
        "parameters": {
            **content_parameters(parameters),
            "consensus": jsonable(parameters.consensus),
            "normalize": jsonable(parameters.normalize),
            "store": jsonable(parameters.store),
        },
        "versions": {
            **library_versions(parameters.align),
            "zarr": metadata.version("zarr"),
            "joblib": metadata.version("joblib"),
        },
    }


def write_records(path: Path, records: Iterable[Mapping[str, Any]]) -> str:
    """Write records as JSON Lines and return the id of their content.

    Parameters
    ----------
    path : Path
        The file; use one from `staged` so that no half of it is ever seen.
    records : iterable of mapping
        In the order of their asset ids.

    Returns
    -------
    str
        SHA-256, in hex, of all that the records say except how long things
        took and in what words they failed.
    """

    def writing() -> Iterator[Mapping[str, Any]]:
        for record in records:
            file.write(orjson.dumps(record, option=orjson.OPT_APPEND_NEWLINE))
            yield record

    with path.open("wb") as file:
        return records_id(writing())


def records_id(records: Iterable[Mapping[str, Any]]) -> str:
    """Return the id of a build whose records these are, in the order of their asset ids."""
    digest = hashlib.sha256()
    for record in records:
        content = {k: v for k, v in record.items() if k not in _NOT_CONTENT}
        digest.update(orjson.dumps(content, option=_SORTED_LINE))
    return digest.hexdigest()


def load_schema(name: str) -> dict[str, Any]:
    """Return a published JSON Schema, ``asset_record`` or ``build_record``."""
    text = (
        resources.files("slatprep.provenance")
        .joinpath("schema", f"{name}.schema.json")
        .read_text("utf-8")
    )
    return cast(dict[str, Any], json.loads(text))


def alignment_entry(result: AssetResult) -> dict[str, Any] | None:
    """Return what a record says of an alignment; None where there is none."""
    alignment, ambiguity = result.alignment, result.ambiguity
    if alignment is None or ambiguity is None:
        return None
    return {
        "transform": jsonable(alignment.transform),
        "engine": alignment.engine,
        "model": alignment.model,
        "search": alignment.search,
        "quality": jsonable(alignment.quality),
        "candidates": jsonable(alignment.candidates),
        "score": jsonable(alignment.score),
        "placements": jsonable(alignment.placements),
        "settled_by": jsonable(alignment.settled_by),
        "ambiguity": {
            "material_share": jsonable(ambiguity.material_share),
            "property_change": jsonable(ambiguity.property_change),
            "margin": jsonable(ambiguity.margin),
        },
        "verdict": str(result.verdict),
        "verdict_reasons": list(result.verdict_reasons),
    }


def counts_entry(result: AssetResult) -> dict[str, Any] | None:
    """Return what a record counts, clipped values left out; None where there is no result."""
    field, latents, annotation = result.field, result.latents, result.annotation
    if field is None or latents is None or annotation is None:
        return None
    occupied = int(np.count_nonzero(field.occupancy))
    return {
        "occupied": occupied,
        "annotated": len(field.voxels),
        "unannotated": occupied - len(field.voxels),
        "boundary": int(np.count_nonzero(boundary(field.occupancy))),
        "slat_voxels": len(latents.coords),
        "valid": int(np.count_nonzero(annotation.valid)),
        "clipped": None,
    }


def alignment_of(entry: Mapping[str, Any]) -> Alignment:
    """Return the alignment that a record describes."""
    settled_by = entry["settled_by"]
    return Alignment(
        transform=np.array(entry["transform"]),
        engine=entry["engine"],
        model=entry["model"],
        search=entry["search"],
        quality=Quality(**entry["quality"]),
        candidates=tuple(
            Candidate(**{**c, "euler_degrees": c["euler_degrees"] and tuple(c["euler_degrees"])})
            for c in entry["candidates"]
        ),
        margin=_number(entry["ambiguity"]["margin"]),
        placements=tuple(
            Placement(np.array(p["transform"]), p["score"], p["displacement"])
            for p in entry["placements"]
        ),
        score=_number(entry["score"]),
        settled_by=settled_by
        and Consensus(
            np.array(settled_by["rotation"]), settled_by["winners"], settled_by["agreeing"]
        ),
    )


def _number(value: float | None) -> float:
    return float("nan") if value is None else value
