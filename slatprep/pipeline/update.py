"""Whether the store that is there is the one that a build would write."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from slatprep.errors import StoreError
from slatprep.pipeline.context import BuildContext
from slatprep.pipeline.pack import settled_contents
from slatprep.pipeline.plan import Action, PlannedAsset
from slatprep.pipeline.previous import PreviousBuild
from slatprep.pipeline.publish import Destination, build_record, publish_manifests
from slatprep.pipeline.spool import FailedAsset, SpooledAsset, spooled
from slatprep.pipeline.summary import BuildSummary, summarise_build
from slatprep.provenance.make import origin
from slatprep.provenance.record import BuildRecord, Clipped, Record
from slatprep.provenance.record_json import (
    read_build_record,
    read_record,
    records_id,
    to_json,
    write_records,
)
from slatprep.records import Contents, Normalization, Place
from slatprep.storage.atomic import writing
from slatprep.storage.documents import read_bounded
from slatprep.storage.place import storage_of
from slatprep.store.contract import MAX_METADATA_BYTES


def is_current(
    plan: Mapping[str, PlannedAsset],
    others: Sequence[SpooledAsset | FailedAsset],
    context: BuildContext,
    ranges: Normalization | str,
    declared: Contents,
) -> bool:
    """Whether the store that is there is the one that this build would write.

    Parameters
    ----------
    plan : mapping of str to PlannedAsset
        What is to be done by asset.
    others : sequence of SpooledAsset or FailedAsset
        The assets that are not unchanged.
    context : BuildContext
        The build.
    ranges : Normalization or str
        Ranges that do not depend on the dataset, or where those of the dataset come from.
    declared : Contents
        What the sources hold.
    """
    previous = context.previous
    if previous is None or any(isinstance(asset, SpooledAsset) for asset in others):
        return False
    store = previous.store
    actions = [asset.action for asset in plan.values()]
    return (
        Action.REMOVE not in actions
        and not any(asset.names for asset in plan.values())
        and actions.count(Action.REUSE) == len(store)
        and store.attributes.get("build") == origin(context.parameters)
        and ranges in (store.normalization, store.normalization.source)
        and store.contents
        == settled_contents(
            (spooled(record, np.empty((0, 2))) for record in previous.records),
            declared,
            context.parameters.slat.standardised,
        )
        and records_id(_all_records(others, previous, context)) == previous.build_id
    )


def repeat_summary(
    others: Sequence[SpooledAsset | FailedAsset],
    context: BuildContext,
    place: Destination,
    seconds: float,
) -> BuildSummary:
    """Sum up a store that is current; write its records anew if they are not beside it."""
    previous = context.previous
    if previous is None:
        raise ValueError("there is no previous store")
    assets: list[SpooledAsset | FailedAsset] = [a for a in others if isinstance(a, FailedAsset)]
    clipped: list[Clipped] = []
    for record in previous.records:
        assets.append(spooled(record, np.empty((0, 2))))
        clipped += [record.counts.clipped] if record.counts.clipped else []
    summary = summarise_build(
        sorted(assets, key=lambda asset: asset.asset_id),
        store=place.out,
        records=place.records(previous.path),
        build_id=previous.build_id,
        seconds=seconds,
        normalization=previous.store.normalization,
        clipped=clipped,
    )
    if not _are_published(summary.records, build_record(summary, context.parameters)):
        scratch = context.spool.directory / "assets.jsonl"
        with writing(str(place.out), scratch.parent):
            write_records(scratch, _all_records(others, previous, context))
        publish_manifests(scratch, summary, context.parameters)
    return summary


def _all_records(
    others: Sequence[SpooledAsset | FailedAsset], previous: PreviousBuild, context: BuildContext
) -> Iterator[Record]:
    """Yield the records of the store that is there and of the assets that cannot go in, by id."""
    names = sorted((asset.asset_id, asset.key) for asset in others)
    failed = (context.spool.record(key) for _, key in names)
    stored: Iterator[Record] = iter(previous.records)
    return heapq.merge(stored, failed, key=lambda record: record.asset_id)


def _are_published(records: Place, wanted: BuildRecord) -> bool:
    """Whether the records beside the store are those of a build, but for when and where it ran."""
    build_file = records.parent / "build.json"
    try:
        text = read_bounded(build_file, MAX_METADATA_BYTES)
        found = read_build_record(text, str(build_file))
        with storage_of(records).open() as file:
            lines = iter(lambda: file.readline(MAX_METADATA_BYTES), b"")
            build_id = records_id(read_record(line, str(records)) for line in lines)
    except (OSError, ValueError, StoreError):
        return False
    run = {name: getattr(found, name) for name in ("created", "duration_s", "platform")}
    return build_id == wanted.id and to_json(found) == to_json(replace(wanted, **run))
