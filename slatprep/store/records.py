"""The records of a store: one for each of its rows, and the manifests beside it.

Only `lines_of` makes the content of a file of lines, from one shard of ``asset/record``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import lru_cache, partial
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
"""Number of chunks of texts kept in memory, 0.6 MB each."""


class StoredRecords:
    """The records of a store, by row or in order."""

    def __init__(self, store: Store) -> None:
        self.store = store
        # Callers ask for rows nearly in order, within each segment. A method of this object would
        # be a cycle, and the store's files stay open until it is collected.
        self._texts = lru_cache(_CHUNKS_KEPT)(partial(_texts_in, store))

    def __iter__(self) -> Iterator[AssetRecord]:
        return (self.read(row) for row in range(len(self.store)))

    def of(self, name: str | int) -> AssetRecord:
        """Return the record of an asset, named as in `Store.match`; StoreError if there is none."""
        return self.read(self.store.match(name))

    def place_map(self, asset: StoredAsset) -> PlaceMap:
        """Return the map between the frames by which an asset's labels were read.

        StoreError if the asset is deformed, and the record with its deformation cannot be read.
        """
        if asset.columns["model"] in (Model.RIGID, Model.SIMILARITY):
            return PlaceMap(asset.transform)
        return PlaceMap(asset.transform, self.read(asset.index).alignment.deformation)

    def read(self, row: int) -> AssetRecord:
        """Return the record of a row; StoreError if it cannot be read."""
        where = f"{self.store.path}: {RECORD_ARRAY}, row {row}"
        return read_record(AssetRecord, self.text(row), where)

    def text(self, row: int) -> str:
        """Return the record of a row as its JSON, unchecked; StoreError if it cannot be read."""
        chunk, position = divmod(row, RECORDS_IN_CHUNK)
        return self._texts(chunk)[position]


def _texts_in(store: Store, chunk: int) -> list[str]:
    """Return the records of the rows in a chunk, as JSON."""
    start = chunk * RECORDS_IN_CHUNK
    stop = min(start + RECORDS_IN_CHUNK, len(store))
    return [str(text) for text in store.read_rows(RECORD_ARRAY, start, stop)]


BUILD, ASSETS, SEVERAL, ERRORS = "build.json", "assets.jsonl", "assets-*.jsonl", "decoys.json"

MAX_BUILD_BYTES = 32 * 2**20
"""Largest size of a `build.json`; it lists only as many failed assets as fit."""

_LINES = re.compile(r"assets(-\d{5,})?\.jsonl")


def file_names(assets: int) -> list[str]:
    """Return the names of the files of lines: one for each shard of the assets' records.

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
    """Return the files of lines in a folder whose name is not among `names`."""
    there = (file for file in folder.iterdir() if _LINES.fullmatch(file.name))
    return sorted(file for file in there if file.name not in names)


def build_text(folder: Place) -> bytes:
    """Return the record of a build as it is in its file; StoreError if it cannot be read."""
    try:
        return read_bounded(folder / BUILD, MAX_BUILD_BYTES)
    except (OSError, ValueError) as error:
        raise StoreError(f"{folder / BUILD}: cannot be read ({error})") from None


def build_in(folder: Place) -> BuildRecord:
    """Read the record of a build; StoreError if it cannot be read."""
    return read_record(BuildRecord, build_text(folder), str(folder / BUILD))


def manifests_of(store: Place) -> Place:
    """Return the folder of a store's records: ``demo.manifests`` beside ``demo.zarr``.

    For a version on an object store it lies beside all versions. For a link to a store it lies
    beside the store.
    """
    if isinstance(store, Path) and store.is_symlink():
        store = store.resolve()
    if is_version(store):
        return store.parent.parent / MANIFESTS / store.name
    return store.parent / f"{store.name.removesuffix('.zarr')}.manifests"


def found_manifests(store: Place, build: str) -> Place | None:
    """Return the folder of a store's records, or None if there is none.

    The folder beside the store is taken, or that of `make align`, if it has the record of `build`.
    If neither has it, it is the folder beside the store. StoreError if that cannot be reached.
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
