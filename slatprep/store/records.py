"""Read the records that a store holds of its rows."""

from __future__ import annotations

from collections.abc import Iterator

from slatprep.geometry.deformation import PlaceMap
from slatprep.records import Model
from slatprep.store.layout import RECORD_ARRAY, RECORDS_IN_CHUNK
from slatprep.store.reader import Store, StoredAsset
from slatprep.store.record import AssetRecord
from slatprep.store.record_json import read_asset_record

_CHUNKS_KEPT = 8
"""Chunks of texts in memory, 0.6 MB each."""


class StoredRecords:
    """The records of a store, by row or in order."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self._chunks: dict[int, list[str]] = {}

    def __iter__(self) -> Iterator[AssetRecord]:
        return (self.read(row) for row in range(len(self.store)))

    def of(self, name: str | int) -> AssetRecord:
        """Return the record of an asset, named as in `Store.match`; StoreError if there is none."""
        return self.read(self.store.match(name))

    def place_map(self, asset: StoredAsset) -> PlaceMap:
        """Return the map between the frames by which an asset was looked up.

        StoreError if the asset is deformed, and its record, which holds how, cannot be read.
        """
        if asset.columns["model"] in (Model.RIGID, Model.SIMILARITY):
            return PlaceMap(asset.transform)
        return PlaceMap(asset.transform, self.read(asset.index).alignment.deformation)

    def read(self, row: int) -> AssetRecord:
        """Return the record of a row; StoreError if it cannot be read."""
        where = f"{self.store.path}: {RECORD_ARRAY}, row {row}"
        return read_asset_record(self.text(row), where)

    def text(self, row: int) -> str:
        """Return the record of a row as its JSON, unchecked; StoreError where it cannot be read."""
        chunk, position = divmod(row, RECORDS_IN_CHUNK)
        # Assets are asked for nearly in order, of each segment.
        if chunk not in self._chunks:
            start = chunk * RECORDS_IN_CHUNK
            stop = min(start + RECORDS_IN_CHUNK, len(self.store))
            texts = self.store.read_rows(RECORD_ARRAY, start, stop)
            if len(self._chunks) == _CHUNKS_KEPT:
                del self._chunks[next(iter(self._chunks))]
            self._chunks[chunk] = [str(text) for text in texts]
        return self._chunks[chunk][position]
