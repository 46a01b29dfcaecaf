"""Put a store together beside its place: arrays, records, attributes and digests."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
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
from slatprep.provenance.make import complete_record, origin
from slatprep.provenance.record import AssetRecord, Clipped, Record, property_counts
from slatprep.provenance.record_json import read_asset_record, to_json
from slatprep.records import Normalization
from slatprep.store import open_store
from slatprep.store.writer import finish_store
from slatprep.workers.local import Jobs


@dataclass(frozen=True)
class Assembled:
    """A new store that is not in place yet, and what goes into the summary of it.

    ``clipped`` has the values of voxels outside the ranges, (A, P) by row and property.
    """

    store: Path
    records: Path
    build_id: str
    normalization: Normalization
    counts: Counts
    clipped: NDArray[np.int64]


def assemble(
    rows: Rows,
    given: Normalization | None,
    work: Work,
    parameters: BuildParameters,
    jobs: Jobs,
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
    """
    normalization, contents, carried = given, rows.contents, rows.carried
    if normalization is None and carried is not None:
        normalization = carried.previous.store.normalization
    if normalization is None:
        normalization = dataset_ranges(
            rows.made, work.spool, parameters.normalize, jobs, contents.properties
        )
    store, records = work.scratch / "store.zarr", work.scratch / "assets.jsonl"
    packed = pack_store(
        store, work.spool, rows.usable, normalization, parameters.store, jobs, contents, carried
    )
    completed = _completed_records(work.spool, rows, normalization, packed)
    build_id = write_all_records(store, records, completed, packed.records)
    finish_store(store, normalization, build_id, origin(parameters), contents, known=packed.digests)
    counts, clipped = counts_in(open_store(store)), packed.clipped["voxel"]
    return Assembled(store, records, build_id, normalization, counts, clipped)


def _completed_records(
    spool: Spool, rows: Rows, normalization: Normalization, packed: Packed
) -> Iterator[tuple[int, Record | bytes]]:
    """Yield rows and records of a build by asset id, with the ranges and what they clip."""
    everything: list[tuple[int, Row | FailedAsset]] = [*enumerate(rows.usable)]
    everything += [(-1, asset) for asset in rows.failed]
    for row, asset in sorted(everything, key=lambda one: one[1].asset_id):
        if isinstance(asset, KeptAsset):
            carried = rows.carried
            if carried is None:
                raise ValueError("there is no store to take records from")
            text = carried.previous.text(asset.row)
            if asset.names is not None:
                where = f"{carried.previous.path}: record of {asset.asset_id}"
                text = to_json(asset.names.applied(read_asset_record(text, where)))
            yield row, text
            continue
        record = spool.record(asset.key)
        if isinstance(record, AssetRecord):
            clipped = Clipped(
                *(property_counts(packed.clipped[g][row], normalization) for g in ("voxel", "grid"))
            )
            record = complete_record(record, normalization, clipped)
        yield row, record
