"""The records of a store: those that it holds of its rows, and the manifests beside it.

A file of lines is derived from one shard of ``asset/record`` by `lines_of`, and by nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.geometry.deformation import PlaceMap
from slatprep.records import Model, Place
from slatprep.storage.documents import read_bounded
from slatprep.storage.versions import MANIFESTS, is_version
from slatprep.store.layout import RECORD_ARRAY, RECORDS_IN_CHUNK, RECORDS_IN_SHARD
from slatprep.store.reader import Store, StoredAsset
from slatprep.store.record import AssetRecord, BuildRecord
from slatprep.store.record_json import read_record

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
        return read_record(AssetRecord, self.text(row), where)

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


BUILD, ASSETS, SEVERAL, ERRORS = "build.json", "assets.jsonl", "assets-*.jsonl", "decoys.json"

MAX_BUILD_BYTES = 32 * 2**20
"""No `build.json` is larger: it lists as many of the assets that could not go in as fit."""

_LINES = re.compile(r"assets(-\d{5,})?\.jsonl")


def file_names(assets: int) -> list[str]:
    """Return the names of the files of lines, one for each shard of the records of so many assets.

    >>> file_names(5), file_names(1025)
    (['assets.jsonl'], ['assets-00000.jsonl', 'assets-00001.jsonl'])
    """
    shards = -(-assets // RECORDS_IN_SHARD)
    return [ASSETS] if shards == 1 else [f"assets-{shard:05d}.jsonl" for shard in range(shards)]


def lines_of(store: Store, shard: int) -> bytes:
    """Return the records of a shard's rows, a line each; StoreError if they are damaged."""
    start = shard * RECORDS_IN_SHARD
    texts = store.read_rows(RECORD_ARRAY, start, min(start + RECORDS_IN_SHARD, len(store)))
    return "".join(f"{text}\n" for text in texts).encode()


def stale_files(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the files of lines in a folder that have none of these names."""
    there = (file for file in folder.iterdir() if _LINES.fullmatch(file.name))
    return sorted(file for file in there if file.name not in names)


def build_text(folder: Place) -> bytes:
    """Return the record of a build as it is in its file; StoreError if it cannot be read."""
    try:
        return read_bounded(folder / BUILD, MAX_BUILD_BYTES)
    except (OSError, ValueError) as error:
        raise StoreError(f"{folder / BUILD}: cannot be read ({error})") from None


def build_in(folder: Place) -> BuildRecord:
    """Read the record of a build; StoreError where it cannot be."""
    return read_record(BuildRecord, build_text(folder), str(folder / BUILD))


def manifests_of(store: Place) -> Place:
    """Return the folder of a store's records: ``demo.manifests`` beside ``demo.zarr``.

    Those of a version on an object store lie beside all versions; those of a store behind a link
    lie beside the store.
    """
    if isinstance(store, Path) and store.is_symlink():
        store = store.resolve()
    if is_version(store):
        return store.parent.parent / MANIFESTS / store.name
    return store.parent / f"{store.name.removesuffix('.zarr')}.manifests"


def found_manifests(store: Place, build: str) -> Place | None:
    """Return the folder of a store's records, None where there is none.

    Beside the store, or where `make align` leaves them: the one that is of the store's `build`;
    else what lies beside it. StoreError if nobody can tell.
    """
    named = store.parent.parent if is_version(store) else store
    folder = manifests_of(store)
    for one in (folder, Path("manifests/build") / named.name.removesuffix(".zarr")):
        with suppress(StoreError):
            if build_in(one).id == build:
                return one
    files = (folder / BUILD, folder / ASSETS)
    try:
        return folder if any(file.exists() for file in files) else None
    except OSError as error:
        raise StoreError(f"{folder}: cannot be reached ({error.strerror})") from None
