"""The records inside the store: the provenance of each row is stored with it.

``asset/record`` holds, as JSON, what ``assets.jsonl`` says of each asset in
the store, save how long it took, which is not the same in two builds. It is
replaced in one step with the arrays it belongs to, and it is what the next
build compares with. What a record says is `slatprep.provenance`'s matter.
"""

from __future__ import annotations

from typing import Any

import numpy as np

RECORD_ARRAY = "asset/record"

MAX_RECORD_BYTES = 2**20
"""No record is larger; most take some 10 kB."""

RECORDS_IN_CHUNK = 64
RECORDS_IN_SHARD = 1024
"""About 10 MB of text: what the parent holds at a time."""


def create_record_array(root: Any, n_assets: int, level: int) -> None:
    """Create the array in a new store."""
    from zarr.codecs import Crc32cCodec, ZstdCodec

    root.create_array(
        RECORD_ARRAY,
        shape=(n_assets,),
        dtype=str,
        chunks=(RECORDS_IN_CHUNK,),
        shards=(RECORDS_IN_SHARD,),
        compressors=(ZstdCodec(level=level), Crc32cCodec()),
        fill_value="",
        dimension_names=("asset",),
        attributes={"description": "provenance of the row, as JSON"},
    )


class RecordWriter:
    """Writes the records of a new store in any order, each shard when all of its rows are there.

    Parameters
    ----------
    root : zarr.Group
        The store, with the array created.
    taken : frozenset of int
        Shards that have been taken over.
    """

    def __init__(self, root: Any, taken: frozenset[int] = frozenset()) -> None:
        self._array = root[RECORD_ARRAY]
        self._taken = taken
        self._waiting: dict[int, dict[int, str]] = {}

    def add(self, row: int, record: bytes) -> None:
        """Take a row's record, JSON in UTF-8."""
        shard = row // RECORDS_IN_SHARD
        if shard in self._taken:
            return
        texts = self._waiting.setdefault(shard, {})
        texts[row] = record.decode()
        start = shard * RECORDS_IN_SHARD
        stop = min(start + RECORDS_IN_SHARD, self._array.shape[0])
        if len(texts) == stop - start:
            rows = self._waiting.pop(shard)
            self._array[start:stop] = np.array([rows[row] for row in range(start, stop)], object)
