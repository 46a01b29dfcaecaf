"""The records inside the store: the provenance of each row is stored with it.

``asset/record`` holds them as JSON. It is replaced in one step with the arrays it
belongs to, the lines of ``assets.jsonl`` are made from it, and it is what the next
build compares with. What a record says is `slatprep.provenance`'s matter.
"""

from __future__ import annotations

from typing import Any

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
