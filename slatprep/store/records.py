"""The records inside the store: each row's provenance travels with the row.

``asset/record`` holds, as JSON, what ``assets.jsonl`` says of each asset in
the store, save how long it took, which is not the same in two builds. It is
replaced in one step with the arrays it speaks of, and it is what the next
build compares with.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import orjson

from slatprep.errors import StoreError
from slatprep.store.reader import Store, open_store

RECORD_ARRAY = "asset/record"

RECORDS_IN_CHUNK = 64
RECORDS_IN_SHARD = 1024
"""About 10 MB of text: what the parent holds at a time."""


def create_record_array(root: Any, n_assets: int, level: int) -> None:
    """Create the array in a new store."""
    from zarr.codecs import ZstdCodec

    root.create_array(
        RECORD_ARRAY,
        shape=(n_assets,),
        dtype=str,
        chunks=(RECORDS_IN_CHUNK,),
        shards=(RECORDS_IN_SHARD,),
        compressors=ZstdCodec(level=level),
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

    def add(self, record: Mapping[str, Any]) -> None:
        """Take the next row's record."""
        content = {name: value for name, value in record.items() if name != "duration_s"}
        self._texts.append(orjson.dumps(content).decode())
        if len(self._texts) == RECORDS_IN_SHARD:
            self.flush()

    def flush(self) -> None:
        """Write what has been taken."""
        stop = self._start + len(self._texts)
        if self._texts:
            self._array[self._start : stop] = np.array(self._texts, dtype=object)
        self._start, self._texts = stop, []


class StoredRecords:
    """The records of a store that is there, by asset id.

    Parameters
    ----------
    store : Store
        Any store; one without records has none to give.
    """

    def __init__(self, store: Store) -> None:
        self.store = store

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for start in range(0, len(self.store) if self._array is not None else 0, RECORDS_IN_CHUNK):
            yield from self._chunk(start // RECORDS_IN_CHUNK)

    def find(self, asset_id: str) -> dict[str, Any] | None:
        """Return an asset's record, or None where there is none."""
        row = self._rows.get(asset_id)
        if row is None:
            return None
        chunk, position = divmod(row, RECORDS_IN_CHUNK)
        return self._chunk(chunk)[position]

    @cached_property
    def ids(self) -> list[str]:
        """Ids of the assets that have a record, sorted."""
        return self.store.ids if self._array is not None else []

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {asset_id: row for row, asset_id in enumerate(self.ids)}

    @cached_property
    def _array(self) -> Any:
        return self.store.group.get(RECORD_ARRAY)

    def _chunk(self, number: int) -> list[dict[str, Any]]:
        # Assets are asked for nearly in order: the last chunk answers most of the time.
        if self._last[0] != number:
            rows = slice(number * RECORDS_IN_CHUNK, (number + 1) * RECORDS_IN_CHUNK)
            self._last = (number, [orjson.loads(str(text)) for text in self._array[rows]])
        return self._last[1]

    _last: tuple[int, list[dict[str, Any]]] = (-1, [])


@lru_cache(maxsize=1)
def stored_records(path: Path, manifest: str) -> StoredRecords | None:
    """Return the records of the store at a path, or None if there is none that can be read.

    `manifest`, the id of the build, keeps a process that lives on from
    answering with what it read of an older store.
    """
    try:
        return StoredRecords(open_store(path))
    except StoreError:
        return None
