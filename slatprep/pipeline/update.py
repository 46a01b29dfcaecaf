"""Whether the store that is there is the one that a build would write."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slatprep.errors import StoreError
from slatprep.pipeline.context import BuildContext
from slatprep.pipeline.plan import Action, PlannedAsset
from slatprep.pipeline.previous import PreviousBuild
from slatprep.pipeline.publish import Destination, build_record, publish_manifests
from slatprep.pipeline.seen import (
    Found,
    Seen,
    bound_to,
    known_keys,
    look,
    read_seen,
    store_state,
    write_seen,
)
from slatprep.pipeline.spool import FailedAsset, SpooledAsset
from slatprep.pipeline.summary import BuildSummary, counts_in, summarise_build
from slatprep.provenance.files import ASSETS, BUILD, build_in
from slatprep.provenance.make import origin
from slatprep.provenance.record import BuildRecord, Record
from slatprep.provenance.record_json import (
    read_build_record,
    read_record,
    records_id,
    to_json,
    write_records,
)
from slatprep.readers import contents_of
from slatprep.readers.encoders import settle_latents
from slatprep.records import AssetPair, Contents, Normalization, Place
from slatprep.storage.atomic import writing
from slatprep.storage.documents import read_bounded
from slatprep.storage.place import storage_of
from slatprep.store import Store
from slatprep.store.contract import MAX_METADATA_BYTES
from slatprep.store.layout import segments_of


@dataclass(frozen=True)
class Wanted:
    """What a build is asked for.

    Attributes
    ----------
    ranges : Normalization or str
        Ranges that do not depend on the dataset, or where those of the dataset come from.
    compact : bool
        Rows by id, whatever the order of the store that is there.
    declared : Contents
        What the sources hold.
    """

    ranges: Normalization | str
    compact: bool
    declared: Contents

    def allows(self, store: Store, context: BuildContext) -> bool:
        """Whether a store of the right assets is the one that is asked for."""
        return (
            store.attributes.get("build") == origin(context.parameters)
            and self.ranges in (store.normalization, store.normalization.source)
            and not (self.compact and len(segments_of(store.ids)) > 1)
        )


@dataclass(frozen=True)
class Looked:
    """What a build saw of its sources before it read them, and what the last one saw.

    Attributes
    ----------
    states : dict of str to bytes
        State of each asset's sources.
    seen : Seen
        What the last build saw and found.
    known : dict of str to str
        Keys of the assets whose sources are as they were.
    recipe : str
        What tells parameters and code.
    """

    states: dict[str, bytes]
    seen: Seen
    known: dict[str, str]
    recipe: str

    @classmethod
    def at(
        cls, pairs: Sequence[AssetPair], context: BuildContext, place: Destination, rehash: bool
    ) -> Looked:
        """Look at the sources, and read what the last build saw."""
        slat = context.parameters.slat
        recipe = context.recipe.key("", {"": str((contents_of(context.parameters), slat))})
        states = look(pairs)
        seen = Seen()
        if context.previous is not None:
            bound = bound_to(context.previous.build_id, recipe)
            seen = read_seen(storage_of(place.records().parent).local, bound)
        return cls(states, seen, {} if rehash else known_keys(seen, states), recipe)

    def note(self, summary: BuildSummary, place: Destination, found: Mapping[str, Found]) -> None:
        """Write down what was seen and found of the assets of a store that is in place."""
        folder, path = (storage_of(p).local for p in (summary.records.parent, place.store))
        if folder is not None and path is not None:
            bound = bound_to(summary.build_id, self.recipe)
            state = store_state(path, record_files(folder), wait=True)
            write_seen(folder, bound, state, self.states, found)


def is_untouched(
    looked: Looked,
    pairs: Sequence[AssetPair],
    context: BuildContext,
    records: Place,
    wanted: Wanted,
) -> bool:
    """Whether sources, store and records are as the last build left them, by their states alone.

    Parameters
    ----------
    looked : Looked
        What this build and the last one saw.
    pairs : sequence of AssetPair
        The dataset.
    context : BuildContext
        The build; its store's files have not been read.
    records : Place
        The file of asset records.
    wanted : Wanted
        What is asked for.
    """
    previous, folder = context.previous, storage_of(records.parent).local
    path = None if previous is None else storage_of(previous.path).local
    seen = looked.seen
    if previous is None or path is None or folder is None or not seen.store:
        return False
    if not len(looked.known) == len(pairs) == len(seen.rows):
        return False
    if store_state(path, record_files(folder)) != seen.store:
        return False
    # Assets that could not go in, and are gone now, were part of the build's id.
    all_in = sum(build_in(folder).statuses.values()) == len(pairs)
    return all_in and wanted.allows(previous.store, context)


def record_files(folder: Path) -> list[Path]:
    """Return the files beside a store."""
    return [folder / ASSETS, folder / BUILD]


def is_current(
    plan: Mapping[str, PlannedAsset],
    others: Sequence[SpooledAsset | FailedAsset],
    context: BuildContext,
    wanted: Wanted,
    found: Mapping[str, Found],
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
    wanted : Wanted
        What is asked for.
    found : mapping of str to Found
        What was found of the unchanged assets.
    """
    previous = context.previous
    if previous is None or any(isinstance(asset, SpooledAsset) for asset in others):
        return False
    actions = [asset.action for asset in plan.values()]
    return (
        Action.REMOVE not in actions
        and not any(asset.names for asset in plan.values())
        and actions.count(Action.REUSE) == len(previous.store)
        and wanted.allows(previous.store, context)
        and _contents_of(previous.store, found, context, wanted) == previous.store.contents
        and records_id(_all_records(others, previous, context)) == previous.build_id
    )


def _contents_of(
    store: Store, found: Mapping[str, Found], context: BuildContext, wanted: Wanted
) -> Contents:
    """Return what a store of the assets that are there holds."""
    sizes = dict(zip(store.ids, np.diff(store.offsets).tolist(), strict=True))
    moments = [(sizes[asset_id], found[asset_id].latents) for asset_id in sorted(found)]
    standardised = context.parameters.slat.standardised
    latents = settle_latents(wanted.declared.latents, standardised, moments)
    return replace(wanted.declared, latents=latents)


def repeat_summary(
    others: Sequence[SpooledAsset | FailedAsset],
    context: BuildContext,
    place: Destination,
    seconds: float,
    clipped: Iterable[int],
    untouched: bool,
) -> BuildSummary:
    """Sum up a store that is current; write its records anew if they are not beside it.

    Parameters
    ----------
    others : sequence of SpooledAsset or FailedAsset
        The assets that are not in the store.
    context : BuildContext
        The build.
    place : Destination
        The store and its records.
    seconds : float
        What the build took.
    clipped : iterable of int
        Clipped values of voxels by property.
    untouched : bool
        Whether the records beside the store are known to be as they were written.
    """
    previous = context.previous
    if previous is None:
        raise ValueError("there is no previous store")
    failed = [asset for asset in others if isinstance(asset, FailedAsset)]
    summary = summarise_build(
        counts_in(previous.store),
        sorted(failed, key=lambda asset: asset.asset_id),
        store=place.out,
        records=place.records(previous.path),
        build_id=previous.build_id,
        seconds=seconds,
        normalization=previous.store.normalization,
        clipped=clipped,
    )
    if not _are_published(summary.records, build_record(summary, context.parameters), untouched):
        scratch = context.spool.directory / "assets.jsonl"
        with writing(str(place.out), scratch.parent):
            write_records(scratch, _all_records(others, previous, context))
        publish_manifests(scratch, summary, context.parameters)
    return summary


def found_before(keys: Mapping[str, str], previous: PreviousBuild, seen: Seen) -> dict[str, Found]:
    """Return what was found of the assets of a store, by id; what only the sources tell is NaN."""
    found = {}
    for asset_id, key in keys.items():
        known = seen.found(key)
        if known is None:
            record = previous.records.of(asset_id)
            voxels = record.counts.clipped.voxel if record.counts.clipped else {}
            clipped = np.array(list(voxels.values()), dtype=np.int64)
            known = Found(key, np.full((len(clipped), 2), np.nan), clipped, record.latents)
        found[asset_id] = known
    return found


def _all_records(
    others: Sequence[SpooledAsset | FailedAsset], previous: PreviousBuild, context: BuildContext
) -> Iterator[Record | bytes]:
    """Yield the records of the store that is there and of the assets that cannot go in, by id."""
    rows: list[tuple[str, int | str]] = [(a, row) for row, a in enumerate(previous.store.ids)]
    rows += [(asset.asset_id, asset.key) for asset in others]
    for _, at in sorted(rows, key=lambda row: row[0]):
        yield previous.text(at) if isinstance(at, int) else context.spool.record(at)


def _are_published(records: Place, wanted: BuildRecord, untouched: bool) -> bool:
    """Whether the records beside the store are those of a build, but for when and where it ran."""
    build_file = records.parent / "build.json"
    try:
        text = read_bounded(build_file, MAX_METADATA_BYTES)
        found = read_build_record(text, str(build_file))
        if untouched:
            return _same(found, wanted)
        with storage_of(records).open() as file:
            lines = iter(lambda: file.readline(MAX_METADATA_BYTES), b"")
            build_id = records_id(read_record(line, str(records)) for line in lines)
    except (OSError, ValueError, StoreError):
        return False
    return build_id == wanted.id and _same(found, wanted)


def _same(found: BuildRecord, wanted: BuildRecord) -> bool:
    run = {name: getattr(found, name) for name in ("created", "duration_s", "platform")}
    return to_json(found) == to_json(replace(wanted, **run))
