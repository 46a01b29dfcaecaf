"""The records inside the store: each row's provenance travels with the row.

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
    """Writes the records of a new store in order, a shard at a time.

    Parameters
    ----------
    root : zarr.Group
        The store, with the array created.
    """

    def __init__(self, root: Any) -> None:
        self._array = root[RECORD_ARRAY]
        self._start = 0
        self._texts: list[str] = []

    def add(self, record: bytes) -> None:
        """Take the next row's record, JSON in UTF-8."""
        self._texts.append(record.decode())
        if len(self._texts) == RECORDS_IN_SHARD:
            self.flush()

    def flush(self) -> None:
        """Write what has been taken."""
        stop = self._start + len(self._texts)
        if self._texts:
            self._array[self._start : stop] = np.array(self._texts, dtype=object)
        self._start, self._texts = stop, []
