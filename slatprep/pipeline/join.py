"""Stores made of stores: some assets of one, or those of several, without aligning again.

Rows and records are taken over as they are. Ranges stay too, so a subset keeps
the ranges of the dataset that it was chosen from; only stores that each have
ranges of their own dataset are brought to the ranges of all of them.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.errors import ConfigError, StoreError
from slatprep.normalize import denormalize_properties, normalize_properties
from slatprep.parameters import BuildParameters, StoreParameters
from slatprep.pipeline.pack import (
    append_rows,
    arrays_in,
    owners,
    settled_contents,
    stored_rows,
    write_assets,
)
from slatprep.pipeline.publish import Destination, publish_manifests, write_all_records
from slatprep.pipeline.spool import spooled
from slatprep.pipeline.summary import BuildSummary, counts_of, summarise_build
from slatprep.pipeline.work import work_beside, work_directory
from slatprep.provenance.files import build_in
from slatprep.provenance.places import manifests_beside
from slatprep.provenance.record import AssetRecord
from slatprep.provenance.record_json import adapter_of
from slatprep.provenance.stored import StoredRecords
from slatprep.records import Contents, Normalization, Place, PropertyRange
from slatprep.storage.atomic import writing
from slatprep.storage.place import storage_of
from slatprep.store import Store, open_store
from slatprep.store.layout import FORMAT_VERSION
from slatprep.store.shard_writer import ShardWriter
from slatprep.store.writer import create_store, finish_store, merges, shards
from slatprep.workers import Progress

NO_ROOT, APART = "unknown", " | "
"""What a build's record says of sources that no record told of, and what stands between the
roots of sources that lie apart."""

_NO_EXTENT = np.empty((0, 2))


@dataclass(frozen=True, eq=False)
class Source:
    """A store that assets are taken from."""

    store: Store
    records: StoredRecords
    build: dict[str, Any]
    """Its attribute ``build``."""
    places: dict[str, Any]
    """Where its sources lay, as ``build.json`` says; unknown without it."""


_Row = tuple[Source, int]
"""An asset: where it is taken from, and its index there."""


def subset_store(
    store: str | Place,
    out: str | Place,
    assets: Iterable[str],
    *,
    manifests: str | Place | None = None,
    progress: Progress | None = None,
) -> BuildSummary:
    """Make a store of some assets of another.

    Its bytes are those of a build of the same assets with the same given ranges.

    Parameters
    ----------
    store : str or Place
        The store to choose from; it stays as it is.
    out : str or Place
        The new store, a path or URL; one that is there is replaced in one step.
    assets : iterable of str
        Ids, or beginnings of ids that no other has.
    manifests : str or Path, optional
        Folder of its records; by default beside it.
    progress : callable, optional
        Called with the shards written and those there are.

    Returns
    -------
    BuildSummary
        What the new store holds.

    Raises
    ------
    ConfigError
        If no asset is named, or `out` is the store itself.
    StoreError
        If the store lacks an asset, cannot be read, or is of an older format;
        or the disk does not take the new one.
    """
    source = _source(store)
    chosen = {source.store.match(name) for name in assets}
    rows = [(source, row) for row in sorted(chosen, key=source.store.ids.__getitem__)]
    if not rows:
        raise ConfigError(f"no asset of {source.store.path} is chosen; expected one at least")
    contents = source.store.contents
    ranges = source.store.normalization
    return write_rows(rows, ranges, source.build, out, manifests, progress, contents)


def concat_stores(
    stores: Iterable[str | Place],
    out: str | Place,
    *,
    manifests: str | Place | None = None,
    progress: Progress | None = None,
) -> BuildSummary:
    """Make one store of the assets of several.

    Stores with the same ranges are joined byte by byte. Where each has those
    of its own dataset, properties are brought to the ranges that span all of
    them, by way of SI units in float32: right to 1e-6 of a range.

    Parameters
    ----------
    stores : iterable of str or Place
        Two or more; they stay as they are.
    out, manifests, progress
        As for `subset_store`.

    Returns
    -------
    BuildSummary
        What the new store holds.

    Raises
    ------
    ConfigError
        If there are fewer than two, or they do not go together: an id is in two
        of them, parameters of alignment or look-up differ, or ranges differ
        that do not come from the datasets.
    StoreError
        If one cannot be read or is of an older format, or the disk does not
        take the new one.
    """
    sources = [_source(store) for store in stores]
    if len(sources) < 2:
        raise ConfigError(f"{len(sources)} stores to join; expected two or more")
    rows = [(source, row) for source in sources for row in range(len(source.store))]
    times = Counter(source.store.ids[row] for source, row in rows)
    twice = sorted(asset_id for asset_id, count in times.items() if count > 1)
    if twice:
        raise ConfigError(
            f"{len(twice)} ids are in more than one store, such as {', '.join(twice[:3])}; "
            "expected each once: leave them out of one with `slatprep subset`"
        )
    build, contents = _common_build(sources), _common_contents(sources)
    normalization = _common_ranges(sources)
    rows.sort(key=lambda row: row[0].store.ids[row[1]])
    return write_rows(rows, normalization, build, out, manifests, progress, contents)


def _source(place: str | Place) -> Source:
    store = open_store(place)
    if store.format_version != FORMAT_VERSION:
        raise StoreError(
            f"{store.path} has format {store.format_version}, and {FORMAT_VERSION} is written; "
            "build it again"
        )
    return Source(store, StoredRecords(store), store.attributes["build"], places_of_sources(store))


def places_of_sources(store: Store) -> dict[str, Any]:
    """Return where a store's sources lay; nothing where no record beside it is of its build."""
    folder = manifests_beside(store.path)
    if folder is None:
        return {}
    try:
        record = build_in(folder)
    except StoreError:
        return {}  # The store does not need it, and `slatprep verify` names it.
    if record.id != store.attributes["manifest"]:
        return {}
    named = {name: getattr(record.parameters, name) for name in ("pixieverse", "slat", "pairing")}
    places: dict[str, Any] = orjson.loads(orjson.dumps(named, default=str))
    return places


def _common_build(sources: Sequence[Source]) -> dict[str, Any]:
    """Return the attribute ``build`` of the joined store; versions that differ are all named."""
    first = sources[0]
    for other in sources[1:]:
        both = first.build["parameters"], other.build["parameters"]
        for group in sorted({*both[0], *both[1]} - {"store", "normalize"}):
            ours, theirs = (parameters.get(group) for parameters in both)
            if theirs != ours:
                raise ConfigError(
                    f"{other.store.path} was built with [{group}] {theirs}, {first.store.path} "
                    f"with {ours}; expected the same: build one of them again"
                )
    versions: dict[str, list[str]] = {}
    for source in sources:
        for name, version in source.build["versions"].items():
            versions.setdefault(name, []).append(version)
    return {
        **first.build,
        "name": " + ".join(dict.fromkeys(s.build["name"] for s in sources if s.build["name"])),
        "versions": {name: ", ".join(dict.fromkeys(found)) for name, found in versions.items()},
    }


def _common_ranges(sources: Sequence[Source]) -> Normalization:
    """Return the ranges that all have, or those that span all datasets'."""
    ranges = [source.store.normalization for source in sources]
    if all(one == ranges[0] for one in ranges):
        return ranges[0]
    for source, one in zip(sources, ranges, strict=True):
        if one.source != "dataset":
            raise ConfigError(
                f"{source.store.path} has ranges from {one.source!r}, not those of the others; "
                "expected the same in all, or in each those of its dataset: build with --ranges"
            )
    spans = (
        PropertyRange(same[0].name, same[0].log10, min(r.lo for r in same), max(r.hi for r in same))
        for same in zip(*(one.ranges for one in ranges), strict=True)
    )
    return Normalization(tuple(spans), "dataset")


def _common_contents(sources: Sequence[Source]) -> Contents:
    """Return what all stores hold; moments of latents that a build measured are pooled."""
    first = sources[0].store.contents
    for source in sources[1:]:
        other = source.store.contents
        for name in ("properties", "classes"):
            if getattr(other, name) != getattr(first, name):
                raise ConfigError(
                    f"{source.store.path} has other {name} than {sources[0].store.path}; "
                    "expected the same tables in both"
                )
        if replace(other.latents, mean=(), std=()) != replace(first.latents, mean=(), std=()):
            raise ConfigError(
                f"{source.store.path} has latents of {other.latents.encoder!r} (standardised: "
                f"{other.latents.standardised}), {sources[0].store.path} of "
                f"{first.latents.encoder!r} ({first.latents.standardised}); expected the same"
            )
    if all(source.store.contents == first for source in sources):
        return first
    unknown = replace(first, latents=replace(first.latents, mean=(), std=()))
    rows = (spooled(record, _NO_EXTENT) for source in sources for record in source.records)
    return settled_contents(rows, unknown, "as said")


def write_rows(
    rows: Sequence[_Row],
    normalization: Normalization,
    build: dict[str, Any],
    out: str | Place,
    manifests: str | Place | None,
    progress: Progress | None,
    contents: Contents,
    in_place: bool = False,
) -> BuildSummary:
    """Write a store of rows of others, in their order; `in_place` it may replace one of them."""
    begin = time.perf_counter()
    place = Destination(out, manifests)
    sources = list(dict.fromkeys(source for source, _ in rows))
    for source in sources:
        if not in_place and _same_place(source.store.path, place.store):
            raise ConfigError(f"{place.out} is a store to take assets from; choose another path")
    parameters = _parameters(sources, build)
    assets, clipped = [], []
    for record in _records(rows, normalization):
        assets.append(spooled(record, _NO_EXTENT))
        if record.counts.clipped:
            clipped.append(_counts(record.counts.clipped.voxel))
    with work_beside(place.store, look=place.look) as work:
        store, records = work.scratch / "store.zarr", work.scratch / "assets.jsonl"
        with writing(str(place.out), work_directory(place.store).parent):
            offsets = [0, *accumulate(asset.n_voxels for asset in assets)]
            several = any(asset.several for asset in assets)
            create_store(store, len(rows), offsets[-1], parameters.store, contents, several)
            write_assets(store, assets, offsets, normalization)
            _copy_rows(store, rows, offsets, normalization, parameters.store, progress)
            own = enumerate(_records(rows, normalization))
            build_id = write_all_records(store, records, own)
            finish_store(store, normalization, build_id, build, contents)
            place.replace(store)
        summary = summarise_build(
            counts_of(assets),
            (),
            store=place.out,
            records=place.records(),
            build_id=build_id,
            seconds=time.perf_counter() - begin,
            normalization=normalization,
            clipped=np.sum(clipped, axis=0, dtype=np.int64),
        )
        publish_manifests(records, summary, parameters, build["versions"])
        place.publish()
    return summary


def _same_place(one: Place, other: Place) -> bool:
    """Whether two places are one, whatever leads there."""
    here, there = storage_of(one).local, storage_of(other).local
    if here is None or there is None:
        return one == other
    return here.resolve() == there.resolve()


def _records(rows: Iterable[_Row], normalization: Normalization) -> Iterator[AssetRecord]:
    """Yield the records of rows, with the ranges they have in the new store."""
    for source, row in rows:
        record = source.records.read(row)
        if record.normalization != normalization:
            clipped = record.counts.clipped
            if clipped is None or np.any([*_counts(clipped.voxel), *_counts(clipped.grid)]):
                raise StoreError(
                    f"{source.store.path}: values of {record.asset_id} were clipped to its ranges, "
                    "so it cannot be brought to others; build it again"
                )
            record = replace(record, normalization=normalization)
        yield record


def _counts(counts: Any) -> list[int]:
    return list(counts.values())


def _copy_rows(
    path: Any,
    rows: Sequence[_Row],
    offsets: Sequence[int],
    normalization: Normalization,
    parameters: StoreParameters,
    progress: Progress | None,
) -> None:
    """Write the shards of all arrays that have rows of voxels or grids."""
    everything = list(shards([""] * len(rows), offsets, parameters))
    for done, shard in enumerate(everything):
        if progress:
            progress(done, len(everything))
        with ExitStack() as stack:
            writers = {
                name: stack.enter_context(ShardWriter(path, name, shard.rows[0]))
                for name in arrays_in(shard.group, merges(path))
            }
            for asset, own in owners(shard, *shard.rows):
                source, row = rows[shard.first + asset]
                change = _renormaliser(source.store.normalization, normalization)
                values_of = stored_rows(source.store, shard.group, row, own, source.records.rows)
                changed = {name: change(values, name) for name, values in values_of.items()}
                append_rows(writers, changed, own.stop - own.start)


def _renormaliser(
    old: Normalization, new: Normalization
) -> Callable[[NDArray[Any], str], NDArray[Any]]:
    """Return what brings the rows of an array, by its name, from one set of ranges to another."""
    before, after = ([span.hi - span.lo for span in ranges.ranges] for ranges in (old, new))
    scale = np.divide(before, after)

    def change(values: NDArray[Any], name: str) -> NDArray[Any]:
        if old != new and name == "voxel/spread":
            return (values * scale).astype(np.float32)
        if old == new or not name.endswith("/properties"):
            return values
        last = np.moveaxis(values, 1, -1)  # (N, 3), or of a grid (1, x, y, z, 3)
        changed = normalize_properties(denormalize_properties(last, old), new)
        return np.ascontiguousarray(np.moveaxis(changed, -1, 1))

    return change


def _parameters(sources: Sequence[Source], build: dict[str, Any]) -> BuildParameters:
    """Return what the build's record says: the parameters, and where all sources lay."""
    places: dict[str, Any] = {"pixieverse": {"root": NO_ROOT}, "slat": {"root": NO_ROOT}}
    if all(source.places == sources[0].places for source in sources):
        places |= sources[0].places
    else:
        for side in ("pixieverse", "slat"):
            roots = (source.places.get(side, {}).get("root", NO_ROOT) for source in sources)
            places[side] = {"root": APART.join(dict.fromkeys(roots))}
    document = {"name": build["name"], **places, **build["parameters"]}
    try:
        parameters: BuildParameters = adapter_of(BuildParameters).validate_json(
            orjson.dumps(document), strict=True
        )
    except ValueError as error:
        path = sources[0].store.path
        raise StoreError(
            f"{path}: its attribute build does not say how it was built ({error}); build it again"
        ) from None
    return parameters
