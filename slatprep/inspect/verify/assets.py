"""One asset: its values against their ranges, against its grid, and against its record."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.errors import InputError, StoreError
from slatprep.geometry.voxels import flat_index
from slatprep.inspect.check import TOLERANCES, look_up_again
from slatprep.provenance.record import load_schema
from slatprep.records import BACKGROUND, RESOLUTION, UNANNOTATED, Place
from slatprep.storage.files import file_digest
from slatprep.storage.place import storage_of
from slatprep.store.contract import Finding
from slatprep.store.layout import normalization_attribute
from slatprep.store.reader import Store, StoredAsset, open_store
from slatprep.store.records import RECORD_ARRAY
from slatprep.store.shard_reader import DamagedFileError


@dataclass(frozen=True)
class SourceRoots:
    """Where the sources lie: PixieVerse's root, and the folder of SLATs or of their one file."""

    pixieverse: Place
    slat: Place


def asset_findings(
    path: Place, rows: range, roots: SourceRoots | None, run: str
) -> tuple[list[Finding], int]:
    """Check some assets of a store.

    Parameters
    ----------
    path : Place
        The store.
    rows : range
        Which assets, by index.
    roots : SourceRoots or None
        Where the sources lie, if they are to be compared.
    run : str
        Something unique to this verification: whatever a process remembers of
        an earlier one, of files that may have changed since, is not used.

    Returns
    -------
    findings : list of Finding
        What is wrong with them.
    sources : int
        How many source files were compared.
    """
    store = _opened(path, run)
    findings: list[Finding] = []
    sources = 0
    for row in rows:
        asset_id = store.ids[row]
        try:
            asset = store.asset(asset_id)
            own = list(value_findings(asset)) or list(lookup_findings(asset))
            findings += own
        except DamagedFileError as error:
            findings.append(Finding(error.file, asset_id, error.fault, error.expected))
            continue
        except StoreError as error:
            findings.append(Finding("asset", asset_id, str(error), "an asset that can be read"))
            continue
        try:
            record = stored_record(store, row)
        except (StoreError, ValueError) as error:
            findings.append(Finding(RECORD_ARRAY, asset_id, f"no record ({error})", "one a row"))
            continue
        findings += record_findings(asset, record, store)
        if roots is not None:
            findings += source_findings(record, roots, run)
            sources += len(record.get("sources", ()))
    return findings, sources


def value_findings(asset: StoredAsset) -> Iterator[Finding]:
    """Yield values of an asset that the contract does not allow."""
    coords, valid, material = asset.coords, asset.valid, asset.material
    checks = {
        "voxel/coords": (
            coords.max(initial=0) < RESOLUTION,
            "a coordinate above 63",
            "0 to 63",
        ),
        "voxel/feats": (np.isfinite(asset.feats).all(), "NaN or infinite", "finite latents"),
        "voxel/material": (
            ((material < BACKGROUND) == valid).all() and (material[~valid] == UNANNOTATED).all(),
            "a class that does not go with valid",
            "0 to 6 where valid, 255 elsewhere",
        ),
        "voxel/properties": (
            _normalised(asset.properties.T, valid),
            "a property that does not go with valid",
            "-1 to 1 where valid, NaN elsewhere",
        ),
        "voxel/distance": (
            (asset.distance >= 0).all(),
            "negative or NaN",
            "a distance of 0 or more",
        ),
        "grid/material": (
            _IS_GRID_CLASS[asset.grid_material].all(),
            "an unknown class",
            "0 to 7, or 255",
        ),
        "grid/properties": (
            _normalised(asset.grid_properties, asset.grid_material < BACKGROUND),
            "a property that does not go with grid/material",
            "-1 to 1 where annotated, NaN elsewhere",
        ),
    }
    for where, (fine, what, expected) in checks.items():
        if not fine:
            yield Finding(where, asset.asset_id, what, expected)
    # Coordinates that are out of range, which was found above, may share a cell.
    if np.bincount(flat_index(coords)).max(initial=0) > 1:
        yield Finding("voxel/coords", asset.asset_id, "a coordinate occurs twice", "each once")


def lookup_findings(asset: StoredAsset) -> Iterator[Finding]:
    """Yield where an annotation is not what the grid and the transform give."""
    try:
        _, differences = look_up_again(asset)
    except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as error:
        yield Finding("asset", asset.asset_id, f"cannot be sampled ({error})", "sound parameters")
        return
    for where, difference in differences.items():
        # A NaN is no difference within bounds.
        wrong = np.count_nonzero(~(difference <= TOLERANCES[where]))
        if wrong:
            yield Finding(
                where,
                asset.asset_id,
                f"{wrong} of {len(difference)} voxels differ",
                "what the grid, the transform and the parameters give",
            )


def record_findings(
    asset: StoredAsset, record: Mapping[str, Any], store: Store
) -> Iterator[Finding]:
    """Yield where an asset's record breaks its schema or disagrees with the row."""
    # How long it took is left out of the store: it is not the same in two builds.
    complete = {**record, "duration_s": 0.0}
    faults = schema_findings(RECORD_ARRAY, asset.asset_id, "asset_record", complete)
    yield from faults
    if faults:
        return
    for name, said, held in _claims(asset, record, store):
        if said != held:
            yield Finding(
                RECORD_ARRAY, asset.asset_id, f"{name} is {said!r}", f"{held!r}, as the store has"
            )


def source_findings(record: Mapping[str, Any], roots: SourceRoots, run: str) -> Iterator[Finding]:
    """Yield sources of an asset that are gone or are not what its record says."""
    for source in record.get("sources", ()):
        root = roots.slat if source["role"] == "slat" else roots.pixieverse
        path = root / source["path"]
        expected = f"SHA-256 {source['sha256']}"
        try:
            file, _ = storage_of(root).locate(path)
            size = storage_of(file).size()
            if size != source["size"]:
                what = f"has {size} of {source['size']} bytes"
            elif _digest(file, run) != source["sha256"]:
                what = "its bytes changed"
            else:
                continue
        except InputError as error:
            what = error.fault
        except OSError as error:
            what = f"cannot be read ({error.strerror})"
        yield Finding(str(path), record["asset_id"], what, expected)


_IS_GRID_CLASS = np.isin(np.arange(256), (*range(BACKGROUND + 1), UNANNOTATED))


def _normalised(values: NDArray[np.float32], where: NDArray[np.bool_]) -> bool:
    """Whether values (..., rows) are in [-1, 1] at the rows of a mask and NaN at all others."""
    missing = np.isnan(values)
    return bool((missing == ~where).all() and (missing | (np.abs(values) <= 1)).all())


def _claims(
    asset: StoredAsset, record: Mapping[str, Any], store: Store
) -> Iterator[tuple[str, Any, Any]]:
    """Yield what a record says and what the store holds, by name."""
    columns, alignment, counts = asset.columns, record["alignment"], record["counts"]
    yield "asset_id", record["asset_id"], asset.asset_id
    yield "status", record["status"], "ok"
    for name in ("object_id", "view", "category"):
        yield name, record[name], str(columns[name])
    for name in ("engine", "model", "search", "verdict"):
        yield f"alignment/{name}", alignment[name], str(columns[name])
    yield "alignment/transform", alignment["transform"], asset.transform.tolist()
    for name in ("fitness", "inlier_rmse", "fitness_backward", "inlier_rmse_backward", "overlap"):
        yield f"alignment/quality/{name}", alignment["quality"][name], _number(columns[name])
    ambiguity = alignment["ambiguity"]
    yield "alignment/ambiguity/margin", ambiguity["margin"], _number(columns["margin"])
    share = ambiguity["material_share"]
    yield "alignment/ambiguity/material_share", share, _number(columns["ambiguity"])
    grid = asset.grid_material
    for name, count in (
        ("slat_voxels", len(asset.coords)),
        ("valid", asset.valid.sum()),
        ("annotated", (grid < BACKGROUND).sum()),
        ("occupied", (grid != BACKGROUND).sum()),
    ):
        yield f"counts/{name}", counts[name], int(count)
    yield "valid_share", counts["valid"] / counts["slat_voxels"], float(columns["valid_share"])
    normalization = record["normalization"] or {"ranges": [], "source": ""}
    said = {
        entry["name"]: {k: entry[k] for k in ("log10", "lo", "hi")}
        | {"source": normalization["source"]}
        for entry in normalization["ranges"]
    }
    yield "normalization", said, normalization_attribute(store.normalization)
    for name in ("align", "sample"):
        held = store.attributes["build"]["parameters"].get(name)
        yield f"parameters/{name}", record["parameters"].get(name), held


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def stored_record(store: Store, row: int) -> dict[str, Any]:
    """Return the record of a row.

    Raises
    ------
    StoreError, ValueError
        If it cannot be read, or is no JSON object.
    """
    record = orjson.loads(str(store.read_rows(RECORD_ARRAY, row, row + 1)[0]))
    if not isinstance(record, dict):
        raise ValueError("no JSON object")
    return record


def schema_findings(
    where: str, asset_id: str, schema: str, record: Mapping[str, Any]
) -> list[Finding]:
    """Return where a record breaks a published schema, three faults at most."""
    faults = sorted(_validator(schema).iter_errors(record), key=str)[:3]
    return [
        Finding(
            where,
            asset_id,
            f"{'/'.join(map(str, fault.instance_path)) or 'it'}: {fault.message[:120]}",
            "the published schema",
        )
        for fault in faults
    ]


@lru_cache(maxsize=1)
def _opened(path: Place, run: str) -> Store:
    return open_store(path)


@lru_cache(maxsize=2)
def _validator(schema: str) -> Any:
    from jsonschema_rs import Draft202012Validator

    return Draft202012Validator(load_schema(schema))


@lru_cache(maxsize=64)
def _digest(path: Place, run: str) -> str:
    # One file may hold the SLATs of many assets.
    return file_digest(path)
