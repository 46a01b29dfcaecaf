"""The stores that a new one takes assets from: the one that is there, or those that are joined."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from slatprep.errors import StoreError
from slatprep.geometry.deformation import map_of
from slatprep.records import Finished, Normalization, Place
from slatprep.store.integrity import file_findings, metadata_findings
from slatprep.store.layout import RECORD_ARRAY, RECORDS_IN_SHARD
from slatprep.store.reader import Store, is_store, open_store
from slatprep.store.record import AssetRecord
from slatprep.store.records import StoredRecords
from slatprep.store.shard_writer import Written
from slatprep.workers.local import Jobs

PLACE_TOLERANCE = 2.0**-23
"""Edges of the unit cube by which a place may differ: the last bit of a float32, as another
machine may round the map otherwise."""

# Without these no row can be told from another, or nothing be checked.
_NEEDED = ("asset/id/", "asset/offset/", f"{RECORD_ARRAY}/zarr.json", "file")


class SourceStore:
    """A store that assets are taken from; each process that gets one opens it once.

    `damaged` are files of its records that are not as they were written.
    """

    def __init__(self, path: Place, damaged: frozenset[str] = frozenset()) -> None:
        self.path = path
        self.damaged = damaged
        # A process that lives on must not answer with what it read of an older store at the same
        # path, whose rows may have been in another order under the same id.
        self._run = uuid.uuid4().hex

    def __reduce__(self) -> tuple[Callable[..., SourceStore], tuple[object, ...]]:
        return _in_this_process, (self.path, self.damaged, self._run)

    @cached_property
    def store(self) -> Store:
        """The store, open."""
        return open_store(self.path)

    @cached_property
    def normalization(self) -> Normalization:
        """The ranges of its properties."""
        return self.store.normalization

    @property
    def build(self) -> dict[str, Any]:
        """Its attribute ``build``."""
        return dict(self.store.attributes["build"])

    @cached_property
    def files(self) -> dict[str, Written]:
        """Bytes and SHA-256 of its files by name, as it holds them."""
        store, files = self.store, self.store.shape("file/name")[0]
        names, *told = (store.read_rows(f"file/{n}", 0, files) for n in ("name", "size", "sha256"))
        return {
            str(name): Written(int(size), str(digest))
            for name, size, digest in zip(names, *told, strict=True)
        }

    @cached_property
    def records(self) -> StoredRecords:
        """Its records."""
        return StoredRecords(self.store)

    @cached_property
    def ids(self) -> frozenset[str]:
        """Ids of its assets."""
        return frozenset(self.store.ids)

    def record(self, asset_id: str) -> AssetRecord | None:
        """Return the record of an asset as its first pass left it, None where it is not there.

        Raises StoreError if its file is damaged, or another version of slatprep wrote it.
        """
        if asset_id not in self.ids:
            return None
        row = self.store.find(asset_id)
        file = f"{RECORD_ARRAY}/c/{row // RECORDS_IN_SHARD}"
        if file in self.damaged:
            raise StoreError(f"{file} is damaged")
        return self.records.read(row).of_first_pass()

    def text(self, row: int) -> bytes:
        """Return the record of a row as the store holds it, JSON in UTF-8."""
        return self.records.text(row).encode()

    def holds(self, asset: Finished) -> bool:
        """Whether the store's labels and places of an asset are those it has been given now.

        Where a pass over the whole dataset chose another alignment, the rows are of that one,
        and its places alone are compared.
        """
        row = self.store.find(asset.pair.asset_id)
        try:
            held = self.store.read(row, ("place", "material"))
            record = self.records.read(row)
        except StoreError:
            return False
        places = np.asarray(asset.annotation.place, np.float64)
        if record.first_pass is not None:
            places = map_of(record.alignment).to_pixieverse(asset.latents.centres)
        elif not np.array_equal(held["material"], asset.annotation.material):
            return False
        same_rows = held["place"].shape == places.shape
        return same_rows and bool((np.abs(held["place"] - places) <= PLACE_TOLERANCE).all())


@lru_cache(maxsize=16)
def _in_this_process(path: Place, damaged: frozenset[str], run: str) -> SourceStore:
    return SourceStore(path, damaged)


def store_there(target: Place) -> SourceStore | None:
    """Return the store at a path, none of its files compared; None where none can be opened."""
    try:
        return SourceStore(open_store(target).path)
    except StoreError:
        return None


def checked_store(
    target: Place, jobs: Jobs, below: str = ""
) -> tuple[SourceStore | None, tuple[str, ...]]:
    """Return the store at a path, None where no build can go on from it, and what is wrong.

    Its metadata are held against the contract, and the files whose names begin with `below`
    against their digests; of the others the sizes are compared. What is wrong is in words,
    sorted by file.
    """
    try:
        store = open_store(target)
    except StoreError as error:
        return None, (str(error),) if is_store(target) else ()
    findings = sorted({*metadata_findings(store.path), *file_findings(store, jobs, below)[1]})
    damaged = tuple(map(str, findings))
    files = frozenset(finding.file for finding in findings)
    if any(file.startswith(_NEEDED) for file in files):
        return None, damaged
    records = frozenset(file for file in files if file.startswith(RECORD_ARRAY))
    return SourceStore(store.path, records), damaged
