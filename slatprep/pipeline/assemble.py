"""Put a store together beside its place: arrays, records, attributes and digests."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slatprep.parameters import BuildParameters
from slatprep.pipeline.carry import KeptAsset, Row
from slatprep.pipeline.pack import Packed, pack_store
from slatprep.pipeline.publish import write_all_records
from slatprep.pipeline.ranges import dataset_ranges
from slatprep.pipeline.rows import Rows
from slatprep.pipeline.spool import FailedAsset, Spool
from slatprep.pipeline.summary import Counts, counts_in
from slatprep.pipeline.work import Work
from slatprep.provenance.make import origin
from slatprep.provenance.record import Clipped, property_counts
from slatprep.provenance.record_json import (
    RecordText,
    build_id_of,
    completed,
    read_asset_record,
    to_json,
)
from slatprep.records import Normalization
from slatprep.storage.place import storage_of
from slatprep.storage.upload import Staged
from slatprep.store import open_store
from slatprep.store.records import RECORDS_IN_SHARD
from slatprep.store.writer import finish_store
from slatprep.workers.local import Jobs, run_in_order

_RECORDS_A_TASK = 64


@dataclass(frozen=True)
class Assembled:
    """A new store that is not in place yet, and what goes into the summary of it.

    ``clipped`` has the values of voxels outside the ranges, (A, P) by row and property;
    ``staged`` what is not in ``store``, as an object store has it already; ``digests`` those of
    all records, by asset id.
    """

    store: Path
    records: Path
    build_id: str
    normalization: Normalization
    counts: Counts
    clipped: NDArray[np.int64]
    staged: Staged
    digests: Mapping[str, bytes]


def assemble(
    rows: Rows,
    given: Normalization | None,
    work: Work,
    parameters: BuildParameters,
    jobs: Jobs,
    standing: Mapping[str, bytes],
) -> Assembled:
    """Normalise and pack the rows of a store, then write its records and its root attributes.

    Parameters
    ----------
    rows : Rows
        What goes in.
    given : Normalization or None
        Ranges that do not depend on the dataset.
    work : Work
        Where the store is made, and where the assets lie.
    parameters : BuildParameters
        The build's.
    jobs : int or Workers
        Worker processes, or a cluster's.
    standing : mapping of str to bytes
        Digests, by asset id, of records that are not written to the file of records.
    """
    normalization, contents, carried = given, rows.contents, rows.carried
    if normalization is None and carried is not None:
        normalization = carried.previous.store.normalization
    if normalization is None:
        normalization = dataset_ranges(
            rows.made, work.spool, parameters.normalize, jobs, contents.properties
        )
    store, records = work.scratch / "store.zarr", work.scratch / "assets.jsonl"
    how, remote = parameters.store, storage_of(work.shards).remote
    packed = pack_store(
        store, work.spool, rows.usable, normalization, how, jobs, contents, carried, remote
    )
    texts = _completed_records(work.spool, rows, normalization, packed, jobs, standing)
    digests = write_all_records(store, records, texts, packed.records, standing)
    build_id = build_id_of(digests.items())
    build, files = origin(parameters), (packed.digests, packed.elsewhere)
    finish_store(store, normalization, build_id, build, contents, *files)
    counts, clipped = counts_in(open_store(store)), packed.clipped["voxel"]
    before = storage_of(carried.previous.path).remote if carried else None
    staged = Staged(packed.elsewhere, packed.digests, remote, before, packed.copied)
    return Assembled(store, records, build_id, normalization, counts, clipped, staged, digests)


def _completed_records(
    spool: Spool,
    rows: Rows,
    normalization: Normalization,
    packed: Packed,
    jobs: Jobs,
    standing: Container[str],
) -> Iterator[tuple[int, RecordText]]:
    """Yield rows and records of a build by asset id, with the ranges and what they clip.

    Records that neither the store nor the file lacks are left out.
    """
    everything: list[tuple[int, Row | FailedAsset]] = [*enumerate(rows.usable)]
    everything += [(-1, asset) for asset in rows.failed]
    everything.sort(key=lambda one: one[1].asset_id)
    made = [(row, one.key) for row, one in everything if not isinstance(one, KeptAsset)]
    counts = np.stack([packed.clipped["voxel"], packed.clipped["grid"]], axis=1)
    parts = (made[at : at + _RECORDS_A_TASK] for at in range(0, len(made), _RECORDS_A_TASK))
    tasks = (
        (spool, [(key, None if row < 0 else counts[row]) for row, key in part], normalization)
        for part in parts
    )
    records = chain.from_iterable(run_in_order(complete_records, tasks, jobs))
    for row, asset in everything:
        if isinstance(asset, KeptAsset):
            if asset.asset_id in standing and row // RECORDS_IN_SHARD in packed.records:
                continue
            carried = rows.carried
            if carried is None:
                raise ValueError("there is no store to take records from")
            text = carried.previous.text(asset.row)
            if asset.names is not None:
                where = f"{carried.previous.path}: record of {asset.asset_id}"
                text = to_json(asset.names.applied(read_asset_record(text, where)))
            yield row, RecordText(asset.asset_id, text, text)
        else:
            yield row, next(records)


def complete_records(
    spool: Spool,
    assets: Sequence[tuple[str, NDArray[np.int64] | None]],
    normalization: Normalization,
) -> list[RecordText]:
    """Read records of finished assets, and add the ranges and what they clip.

    Parameters
    ----------
    spool : Spool
        Where they lie.
    assets : sequence of (str, ndarray of int64 or None)
        Their keys; of those that go in, the clipped values, (2, P), of voxels and of the grid.
    normalization : Normalization
        The ranges.
    """
    records = []
    for key, counts in assets:
        clipped = None
        if counts is not None:
            clipped = Clipped(*(property_counts(own, normalization) for own in counts))
        records.append(completed(spool.record_text(key), normalization, clipped))
    return records
