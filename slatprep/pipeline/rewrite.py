"""Write a store of rows of other stores, with their records; nothing is aligned again."""

from __future__ import annotations

import time
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
from slatprep.pipeline.pack import append_rows, arrays_in, owners, write_assets
from slatprep.pipeline.publish import Destination, publish_manifests, write_all_records
from slatprep.pipeline.spool import spooled
from slatprep.pipeline.summary import BuildSummary, counts_of, summarise_build
from slatprep.pipeline.work import work_beside, work_directory
from slatprep.provenance.files import build_in
from slatprep.provenance.places import manifests_beside
from slatprep.provenance.record import AssetRecord
from slatprep.provenance.record_json import adapter_of, build_id_of
from slatprep.provenance.stored import StoredRecords
from slatprep.records import Contents, Normalization, Place
from slatprep.storage.atomic import writing
from slatprep.storage.place import storage_of
from slatprep.store import Store
from slatprep.store.shard_writer import ShardWriter
from slatprep.store.writer import create_store, finish_store, merges, shards
from slatprep.workers import Progress

NO_ROOT, APART = "unknown", " | "
"""The root that a build's record gives for unknown sources, and what separates several roots."""

NO_EXTENT = np.empty((0, 2))


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
    names = ("pixieverse", "also", "slat", "pairing")
    named = {name: getattr(record.parameters, name) for name in names}
    places: dict[str, Any] = orjson.loads(orjson.dumps(named, default=str))
    return places


def write_rows(
    rows: Sequence[_Row],
    normalization: Normalization,
    build: dict[str, Any],
    out: str | Place,
    manifests: str | Place | None,
    progress: Progress | None,
    contents: Contents,
) -> BuildSummary:
    """Write a store of rows of others, with their records.

    Parameters
    ----------
    rows : sequence of (Source, int)
        The assets of the new store, in its order.
    normalization : Normalization
        The ranges of the new store; rows with other ranges are brought to them.
    build : dict
        Its attribute ``build``, as JSON has it.
    out, manifests, progress
        As for `slatprep.pipeline.join.subset_store`.
    contents : Contents
        What it holds.

    Raises
    ------
    ConfigError
        If it would replace one of them.
    StoreError
        If a row cannot be read or brought to the ranges, or the disk does not take the store.
    """
    begin = time.perf_counter()
    place = Destination(out, manifests)
    sources = list(dict.fromkeys(source for source, _ in rows))
    for source in sources:
        if _same_place(source.store.path, place.store):
            raise ConfigError(f"{place.out} is a store to take assets from; choose another path")
    parameters = _parameters(sources, build)
    assets, clipped = [], []
    for record in _records(rows, normalization):
        assets.append(spooled(record, NO_EXTENT))
        if record.counts.clipped:
            clipped.append(_counts(record.counts.clipped.voxel))
    with work_beside(place.store, look=place.look) as work:
        store, records = work.scratch / "store.zarr", work.scratch / "assets.jsonl"
        with writing(str(place.out), work_directory(place.store).parent):
            offsets = [0, *accumulate(asset.n_voxels for asset in assets)]
            merged = any(asset.merged for asset in assets)
            create_store(store, len(rows), offsets[-1], parameters.store, contents, merged)
            write_assets(store, assets, offsets, normalization)
            _copy_rows(store, rows, offsets, normalization, parameters.store, progress)
            own = enumerate(_records(rows, normalization))
            build_id = build_id_of(write_all_records(store, records, own).items())
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
                begin = int(source.store.offsets[row]) if shard.group == "voxel" else row
                span = begin + own.start, begin + own.stop
                names = arrays_in(shard.group, source.store.merges)
                changed = {name: change(source.records.rows(name, *span), name) for name in names}
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
