"""The records beside a store, ``assets.jsonl`` and ``build.json``, against it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from typing import Any

import orjson

from slatprep.errors import StoreError
from slatprep.inspect.verify.assets import SourceRoots, schema_findings, stored_record
from slatprep.provenance.places import manifests_of
from slatprep.provenance.record import records_id
from slatprep.records import Place
from slatprep.storage.place import place_of
from slatprep.store.contract import MAX_METADATA_BYTES, Finding
from slatprep.store.reader import Store

BUILD, ASSETS = "build.json", "assets.jsonl"


def usual_manifests(store: Place) -> Place | None:
    """Return the folder of a store's records beside it, if there is one."""
    folder = manifests_of(store)
    return folder if (folder / BUILD).exists() or (folder / ASSETS).exists() else None


def source_roots(manifests: Place | None) -> SourceRoots:
    """Return where the sources lay when the store was built.

    Raises
    ------
    StoreError
        If no record says so.
    """
    advice = "name the roots with --pixieverse and --slat"
    if manifests is None:
        raise StoreError(f"no records beside the store say where its sources lie; {advice}")
    try:
        parameters = json.loads((manifests / BUILD).read_text(encoding="utf-8"))["parameters"]
        pixieverse = place_of(parameters["pixieverse"]["root"])
        slat = place_of(parameters["slat"]["root"])
        slat = slat.parent if slat.is_file() else slat
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StoreError(f"{manifests / BUILD}: names no sources ({error}); {advice}") from None
    return SourceRoots(pixieverse, slat)


def manifest_findings(store: Store, folder: Place) -> Iterator[Finding]:
    """Yield where the records of a build break their schemas or disagree with the store."""
    build_file, assets_file = str(folder / BUILD), str(folder / ASSETS)
    try:
        build = json.loads((folder / BUILD).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        yield Finding(build_file, "", f"cannot be read ({error})", "the record of the build")
        build = {}
    if build:
        yield from schema_findings(build_file, "", "build_record", build)
    manifest = store.attributes.get("manifest")
    if build and build.get("id") != manifest:
        yield Finding(build_file, "", f"id is {build.get('id')!r}", f"{manifest!r}, the store's")
        return
    seen: Counter[str] = Counter()
    faults: list[Finding] = []
    try:
        found = records_id(_checked(store, folder / ASSETS, seen, faults))
    except (OSError, ValueError) as error:
        yield Finding(assets_file, "", f"cannot be read ({error})", "a JSON record a line")
        return
    yield from faults
    if found != manifest:
        yield Finding(assets_file, "", f"its content has the id {found}", f"{manifest}")
    if build and build.get("statuses") != {**dict.fromkeys(_STATUSES, 0), **seen}:
        yield Finding(build_file, "", f"statuses are {build.get('statuses')}", f"{dict(seen)}")
    if build and build.get("counts", {}).get("voxels") != store.shape("voxel/coords")[0]:
        yield Finding(build_file, "", "counts other voxels", f"{store.shape('voxel/coords')[0]}")


_STATUSES = ("ok", "failed", "skipped")


def _in_store(store: Store, row: int) -> dict[str, Any] | None:
    try:
        return stored_record(store, row)
    except (StoreError, ValueError):
        return None


def _checked(
    store: Store, path: Place, seen: Counter[str], faults: list[Finding]
) -> Iterator[dict[str, Any]]:
    """Yield the records of a file one by one, and note what is wrong with each."""
    rows = {asset_id: row for row, asset_id in enumerate(store.ids)}
    with path.open("rb") as file:
        while line := file.readline(MAX_METADATA_BYTES):
            record = orjson.loads(line)
            if not isinstance(record, dict):
                raise ValueError("a line that is no JSON object")
            asset_id = str(record.get("asset_id", ""))
            seen[str(record.get("status"))] += 1
            content = {k: v for k, v in record.items() if k != "duration_s"}
            row = rows.get(asset_id)
            # One that equals the store's own has been held against the schema there.
            if row is None or content != _in_store(store, row):
                faults += schema_findings(str(path), asset_id, "asset_record", record)
                if record.get("status") == "ok":
                    what = "differs from asset/record"
                    faults.append(Finding(str(path), asset_id, what, "the same record"))
            yield record
