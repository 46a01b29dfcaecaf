"""The records of a build: inside the store with the rows, and beside it for people.

The store and its records are replaced in one step, because the records are an
array of it. The files beside it are copies; a build that was killed before it
could write them is noticed by the next one, which writes them then.
"""

from __future__ import annotations

import heapq
import json
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slatprep import provenance
from slatprep.errors import StoreError
from slatprep.parameters import BuildParameters
from slatprep.plan import Action, PlannedAsset
from slatprep.process import Bench
from slatprep.records import PROPERTY_COLUMNS, Normalization, Status
from slatprep.remote import RemotePath
from slatprep.store.asset_records import RecordWriter, StoredRecords
from slatprep.store.reader import Store, is_store, open_store
from slatprep.store.spool import SpooledAsset, spooled, writing
from slatprep.summary import BuildSummary, summarise


def previous_build(target: Path) -> tuple[Path, str] | None:
    """Return a store that later builds can go on from, and the id of its build."""
    try:
        if not is_store(target):
            return None
        store = open_store(target)
        return store.path, store.attributes["manifest"]
    except (StoreError, KeyError):
        return None  # Of another format version, or damaged: made anew.


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
            _staged(summary.records) as records_file,
            _staged(folder / "build.json") as build_file,
        ):
            shutil.copyfile(records, records_file)
            provenance.write_build_record(build_file, summary, parameters)
    except OSError as error:
        raise StoreError(
            f"{folder}: the records cannot be written there ({error.strerror or error}); the store "
            "is complete and holds those of its assets. Run again to write them here"
        ) from error


@contextmanager
def _staged(path: Path) -> Iterator[Path]:
    """Yield a local file that takes its place at `path` when it is whole."""
    if not isinstance(path, RemotePath):
        with provenance.staged(path) as file:
            yield file
        return
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, path.name)
        yield file
        path.upload(file)


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
    others: Sequence[SpooledAsset], bench: Bench, *, store: Path, manifests: Path, seconds: float
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


def _published(manifests: Path, manifest: str) -> bool:
    try:
        build = json.loads((manifests / "build.json").read_text(encoding="utf-8"))
        return bool(build["id"] == manifest) and (manifests / "assets.jsonl").stat().st_size > 0
    except (OSError, ValueError, KeyError, TypeError):
        return False
