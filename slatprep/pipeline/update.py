"""The records of a build: inside the store with the rows, and beside it for people.

The store and its records are replaced in one step, because the records are an
array of it. The files beside it are copies; a build that was killed before it
could write them is noticed by the next one, which writes them then.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from slatprep.errors import StoreError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.asset import Bench
from slatprep.pipeline.plan import Action, PlannedAsset
from slatprep.pipeline.publish import publish_manifests
from slatprep.pipeline.spool import SpooledAsset, spooled
from slatprep.pipeline.summary import BuildSummary, problems_of, summarise
from slatprep.provenance import record as provenance
from slatprep.records import PROPERTY_COLUMNS, Normalization, Place, Status
from slatprep.storage.atomic import writing
from slatprep.storage.place import place_of, storage_of
from slatprep.store.reader import Store, is_store, open_store
from slatprep.store.records import StoredRecords


def previous_build(target: Place) -> tuple[Place, str] | None:
    """Return a store that later builds can go on from, and the id of its build."""
    try:
        store = open_store(target)
        return store.path, store.attributes["manifest"]
    except (StoreError, KeyError):
        return None  # Of another format version, or damaged: made anew.


def is_current(
    plan: Mapping[str, PlannedAsset] | None,
    others: Sequence[SpooledAsset],
    bench: Bench,
    given: Normalization | None,
) -> bool:
    """Whether the store that is there is the one that this build would write.

    Parameters
    ----------
    plan : mapping of str to PlannedAsset
        What is to be done by asset.
    others : sequence of SpooledAsset
        The assets that are not unchanged, none of which can go in.
    bench : Bench
        The build.
    given : Normalization or None
        Ranges that do not depend on the dataset.
    """
    store = _previous(bench)
    plan = plan or {}
    actions = [asset.action for asset in plan.values()]
    return (
        Action.REMOVE not in actions
        and not any(asset.names for asset in plan.values())
        and actions.count(Action.REUSE) == len(store)
        and store.attributes.get("build") == provenance.origin(bench.parameters)
        and (given is None or store.normalization == given)
        and provenance.records_id(_all_records(others, bench)) == store.attributes["manifest"]
    )


def repeat_summary(
    others: Sequence[SpooledAsset], bench: Bench, *, store: Place, manifests: Place, seconds: float
) -> BuildSummary:
    """Sum up a store that is current; write its records anew if they are not beside it."""
    previous = _previous(bench)
    assets: list[SpooledAsset] = []
    clipped = dict.fromkeys(PROPERTY_COLUMNS, 0)
    for record in _all_records(others, bench):
        assets.append(spooled("", record, None))
        if record["status"] == Status.OK:
            for name, count in record["counts"]["clipped"]["voxel"].items():
                clipped[name] += count
    summary = summarise(
        assets,
        store=store,
        records=manifests / "assets.jsonl",
        manifest=previous.attributes["manifest"],
        seconds=seconds,
        normalization=previous.normalization,
        clipped=clipped,
    )
    if not _published(manifests, summary.manifest):
        scratch = bench.spool.directory / "assets.jsonl"
        with writing(str(store), scratch.parent):
            provenance.write_records(scratch, _all_records(others, bench))
        publish_manifests(scratch, summary, bench.parameters)
    return summary


def _all_records(others: Sequence[SpooledAsset], bench: Bench) -> Iterator[dict[str, Any]]:
    """Yield the records of the store that is there and of the assets that cannot go in, by id."""
    stored = ({**record, "duration_s": 0.0} for record in StoredRecords(_previous(bench)))
    failed = (
        bench.spool.record(asset.key) for asset in sorted(others, key=lambda one: one.asset_id)
    )
    return heapq.merge(stored, failed, key=lambda record: record["asset_id"])


def _previous(bench: Bench) -> Store:
    if bench.previous is None:
        raise ValueError("there is no previous store")
    return open_store(bench.previous[0])


def _published(manifests: Place, manifest: str) -> bool:
    try:
        build = json.loads((manifests / "build.json").read_text(encoding="utf-8"))
        assets = storage_of(manifests / "assets.jsonl")
        return bool(build["id"] == manifest) and assets.size() > 0
    except (OSError, ValueError, KeyError, TypeError):
        return False


def nothing_usable(assets: Sequence[SpooledAsset], parameters: BuildParameters) -> str:
    """Say why there is no store."""
    problems = problems_of(assets)
    if not problems:
        return (
            f"no asset found in {parameters.pixieverse.root} and {parameters.slat.root}; "
            "expected files that match the patterns of the dataset definition"
        )
    listed = "".join(f"\n  {asset_id}: {reason}" for asset_id, reason in problems[:5])
    more = f"\n  and {len(problems) - 5} more" if len(problems) > 5 else ""
    return f"none of {len(problems)} assets can be used, so there is no store:{listed}{more}"


def places_of(out: Place, manifests: str | Place | None) -> tuple[Place, Path | None]:
    """Return where the store really lies, and the directory of its records if one is named."""
    folder = None if manifests is None else storage_of(place_of(manifests)).local
    if manifests is not None and folder is None:
        raise StoreError(f"{manifests}: expected a local folder for the records")
    path = storage_of(out).local
    if path is None:
        return out, folder
    try:
        empty = path.is_dir() and not any(path.iterdir())
        taken = path.exists() and not is_store(path) and not empty
        target = path.resolve()  # What a link points to is replaced, not the link.
    except OSError as error:
        raise StoreError(
            f"{out}: cannot be looked at ({error.strerror}); expected a path that may be read and "
            "written"
        ) from error
    if taken:
        raise StoreError(
            f"{out} exists and is not a slatprep store; expected a store to replace, or a new path"
        )
    return target, folder
