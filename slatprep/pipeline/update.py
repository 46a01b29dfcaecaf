"""Whether the existing store is already the one that a build would write."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.context import BuildContext
from slatprep.pipeline.plan import Action, PlannedAsset
from slatprep.pipeline.previous import PreviousBuild, previous_build
from slatprep.pipeline.publish import Destination, build_record, publish_manifests
from slatprep.pipeline.ranges import given_ranges, source_of
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
from slatprep.provenance.files import ASSETS, BUILD, build_in, lines_in
from slatprep.provenance.make import origin
from slatprep.provenance.record import BuildRecord, Record
from slatprep.provenance.record_json import (
    RecordText,
    build_id_of,
    digest_of,
    read_record,
    records_id,
    to_json,
    write_records,
)
from slatprep.readers import contents_of
from slatprep.readers.encoders import resolve_latents
from slatprep.records import AssetPair, Contents, Normalization, Place
from slatprep.storage.atomic import writing
from slatprep.storage.place import storage_of
from slatprep.store import Store
from slatprep.store.attributes import segments_of
from slatprep.workers.local import Jobs


@dataclass(frozen=True)
class Wanted:
    """What a build is asked for.

    Attributes
    ----------
    ranges : Normalization or str
        Ranges that do not depend on the dataset, or where those of the dataset come from.
    compact : bool
        Rows by id, whatever the order of the existing store.
    declared : Contents
        What the sources hold.
    """

    ranges: Normalization | str
    compact: bool
    declared: Contents

    @classmethod
    def of(cls, parameters: BuildParameters, compact: bool = False) -> Wanted:
        """Return what parameters ask for; raise `SlatprepError` if their files cannot be used."""
        declared = contents_of(parameters)
        given = given_ranges(parameters.normalize, declared.properties)
        return cls(given or source_of(parameters.normalize), compact, declared)

    @property
    def given(self) -> Normalization | None:
        """Ranges that do not depend on the dataset."""
        return self.ranges if isinstance(self.ranges, Normalization) else None

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


@dataclass(frozen=True, eq=False)
class Update:
    """A build that may find its store as it should be.

    Attributes
    ----------
    pairs : sequence of AssetPair
        The dataset.
    context : BuildContext
        The build. The files of its store have been read once it is `compared`.
    place : Destination
        The store and its records.
    wanted : Wanted
        What is asked for.
    looked : Looked
        What this build and the last one saw.
    begin : float
        When it began, by `time.perf_counter`.
    scratch : Path
        A folder of this build alone, where it writes.
    damaged : tuple of str
        What of the existing store is not as it was written.
    """

    pairs: Sequence[AssetPair]
    context: BuildContext
    place: Destination
    wanted: Wanted
    looked: Looked
    begin: float
    scratch: Path
    damaged: tuple[str, ...] = ()

    @classmethod
    def begun(
        cls,
        pairs: Sequence[AssetPair],
        context: BuildContext,
        place: Destination,
        wanted: Wanted,
        rehash: bool,
        begin: float = 0.0,
        scratch: Path = Path(),
    ) -> Update:
        """Look at the sources, and read what the last build saw; with `rehash` trust none of it."""
        own, parameters = context.parameters.pixieverse, context.parameters
        asked = (wanted.declared, parameters.slat, parameters.also, own.units, own.plausibility)
        recipe = context.recipe.key("", {"": str(asked)})
        states, seen = look(pairs), Seen()
        if context.previous is not None:
            bound = bound_to(context.previous.build_id, recipe)
            seen = read_seen(_seen_folder(place), bound)
        known = {} if rehash else known_keys(seen, states)
        looked = Looked(states, seen, known, recipe)
        return cls(pairs, context, place, wanted, looked, begin, scratch)

    @property
    def seconds(self) -> float:
        """What the build has taken so far."""
        return time.perf_counter() - self.begin

    @property
    def known(self) -> dict[str, str]:
        """Keys of the assets whose sources need not be hashed again."""
        return {} if self.damaged else self.looked.known

    def compared(self, jobs: Jobs) -> Update:
        """Return it with a store of which every file has been compared with its digest."""
        previous, damaged = previous_build(self.place.store, jobs)
        return replace(self, context=replace(self.context, previous=previous), damaged=damaged)

    def untouched(self) -> BuildSummary | None:
        """Sum up a store that is as the last build left it, with sources and records, by states.

        None where there is something to do.
        """
        previous, folder = self.context.previous, storage_of(self.place.records().parent).local
        seen, known = self.looked.seen, self.looked.known
        if previous is None or folder is None:
            return None
        if not len(known) == len(self.pairs) == len(seen.rows):
            return None
        if not self.as_left():
            return None
        # Assets that could not go in, and are gone now, were part of the build's id.
        all_in = sum(build_in(folder).statuses.values()) == len(self.pairs)
        if not all_in or not self.wanted.allows(previous.store, self.context):
            return None
        return self._repeated([], previous, seen.rows["clipped"].sum(axis=0), untouched=True)

    def as_left(self) -> bool:
        """Whether the files of the store and of its records are as the last build left them."""
        folder, path = (
            storage_of(p).local for p in (self.place.records().parent, self.place.store)
        )
        if folder is None or path is None or not self.looked.seen.store:
            return False
        return store_state(path, _record_files(folder)) == self.looked.seen.store

    def current(
        self, plan: Mapping[str, PlannedAsset], others: Sequence[SpooledAsset | FailedAsset]
    ) -> BuildSummary | None:
        """Sum up a store that is the one that this build would write; None where it is not.

        Parameters
        ----------
        plan : mapping of str to PlannedAsset
            What is to be done by asset.
        others : sequence of SpooledAsset or FailedAsset
            The assets that are not unchanged.
        """
        previous = self.context.previous
        if previous is None or self.damaged or any(isinstance(a, SpooledAsset) for a in others):
            return None
        same = {p.asset_id: p.key for p in plan.values() if p.action is Action.REUSE}
        gone = any(planned.action is Action.REMOVE for planned in plan.values())
        if gone or any(p.names for p in plan.values()) or len(same) != len(previous.store):
            return None
        if not self.wanted.allows(previous.store, self.context):
            return None
        found = _found_before(same, previous, self.looked.seen)
        if self._contents(previous.store, found) != previous.store.contents:
            return None
        digests = {asset_id: one.record for asset_id, one in found.items()}
        digests |= {a.asset_id: digest_of(self.context.spool.record(a.key)) for a in others}
        if build_id_of(digests.items()) != previous.build_id:
            return None
        clipped = np.sum([one.clipped for one in found.values()], axis=0)
        summary = self._repeated(others, previous, clipped, untouched=False)
        self.note(summary, found)
        return summary

    def note(self, summary: BuildSummary, found: Mapping[str, Found]) -> None:
        """Write down what was seen and found of the assets of a store that is in place."""
        folder, path = (storage_of(p).local for p in (summary.records.parent, self.place.store))
        bound, state = bound_to(summary.build_id, self.looked.recipe), b""
        if folder is not None and path is not None:
            state = store_state(path, _record_files(folder), wait=True)
        write_seen(_seen_folder(self.place), bound, state, self.looked.states, found)

    def _contents(self, store: Store, found: Mapping[str, Found]) -> Contents:
        """Return what a store of the assets that are there holds."""
        sizes = dict(zip(store.ids, np.diff(store.offsets).tolist(), strict=True))
        moments = [(sizes[asset_id], found[asset_id].latents) for asset_id in sorted(found)]
        declared, slat = self.wanted.declared, self.context.parameters.slat
        latents = resolve_latents(declared.latents, slat.standardised, moments)
        return replace(declared, latents=latents)

    def _repeated(
        self,
        others: Sequence[SpooledAsset | FailedAsset],
        previous: PreviousBuild,
        clipped: NDArray[np.int64],
        untouched: bool,
    ) -> BuildSummary:
        """Sum up a store that is current; write its records anew if they are not beside it.

        With `untouched` they are known to be as they were written.
        """
        failed = [asset for asset in others if isinstance(asset, FailedAsset)]
        summary = summarise_build(
            counts_in(previous.store),
            sorted(failed, key=lambda asset: asset.asset_id),
            store=self.place.out,
            records=self.place.records(previous.path),
            build_id=previous.build_id,
            seconds=self.seconds,
            normalization=previous.store.normalization,
            clipped=clipped,
        )
        parameters = self.context.parameters
        if not _are_published(summary.records, build_record(summary, parameters), untouched):
            file = self.scratch / ASSETS
            with writing(str(self.place.out), self.scratch):
                write_records(file, _all_records(others, previous, self.context))
            publish_manifests(file, summary, parameters)
        return summary


def _seen_folder(place: Destination) -> Path:
    """Return where it is kept what a build saw: with the records, if those are on the disk."""
    folder = storage_of(place.records().parent).local
    return folder or storage_of(place.store).work_folder().parent


def _record_files(folder: Path) -> list[Path]:
    """Return the files beside a store."""
    return [folder / ASSETS, folder / BUILD]


def _found_before(keys: Mapping[str, str], previous: PreviousBuild, seen: Seen) -> dict[str, Found]:
    """Return what was found of the assets of a store, by id; what only the sources tell is NaN."""
    found = {}
    for asset_id, key in keys.items():
        known = seen.found(key)
        if known is None:
            record = previous.records.of(asset_id)
            voxels = record.counts.clipped.voxel if record.counts.clipped else {}
            clipped = np.array(list(voxels.values()), dtype=np.int64)
            text = _text_of(asset_id, previous)
            unread = np.full((len(clipped), 2), np.nan)
            known = Found(key, unread, clipped, record.latents, digest_of(text))
        found[asset_id] = known
    return found


def _all_records(
    others: Sequence[SpooledAsset | FailedAsset], previous: PreviousBuild, context: BuildContext
) -> Iterator[Record | RecordText]:
    """Yield the records of the existing store and of the assets that cannot go in, by id."""
    keys = dict.fromkeys(previous.store.ids) | {asset.asset_id: asset.key for asset in others}
    for asset_id, key in sorted(keys.items()):
        yield context.spool.record(key) if key else _text_of(asset_id, previous)


def _text_of(asset_id: str, previous: PreviousBuild) -> RecordText:
    text = previous.text(previous.store.find(asset_id))
    return RecordText(asset_id, text, text)


def _are_published(records: Place, wanted: BuildRecord, untouched: bool) -> bool:
    """Whether the records beside the store are those of a build, but for when and where it ran."""
    try:
        found = build_in(records.parent)
        if untouched:
            return _same(found, wanted)
        build_id = records_id(read_record(line, at) for at, line in lines_in(records.parent))
    except StoreError:
        return False
    return build_id == wanted.id and _same(found, wanted)


def _same(found: BuildRecord, wanted: BuildRecord) -> bool:
    run = {name: getattr(found, name) for name in ("created", "duration_s", "platform")}
    return to_json(found) == to_json(replace(wanted, **run))
