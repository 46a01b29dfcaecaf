"""The rows of a store that is to be written: their arrays lie in the spool or in another store.

Rows are taken from the store that is there, or from those that are joined.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import accumulate
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.geometry.deformation import map_of
from slatprep.normalize import normalize_change
from slatprep.parameters import StoreParameters
from slatprep.records import Contents, Finished, LatentMoments, Normalization, Place
from slatprep.store.attributes import store_attributes
from slatprep.store.integrity import digests_in, file_findings, metadata_findings
from slatprep.store.layout import RECORD_ARRAY, RECORDS_IN_SHARD
from slatprep.store.reader import Store, open_store
from slatprep.store.record import AssetRecord
from slatprep.store.record_json import build_id_of, digest_of, to_json
from slatprep.store.records import StoredRecords
from slatprep.store.shard_writer import Written
from slatprep.workers.local import Jobs

PLACE_TOLERANCE = 2.0**-23
"""Edges of the unit cube by which a place may differ: the last bit of a float32, as another
machine may round the map otherwise."""

# Without these no row can be told from another, or nothing be checked.
_NEEDED = ("asset/id/", "asset/offset/", f"{RECORD_ARRAY}/zarr.json", "file")


class SourceStore(Store):
    """An open store that assets are taken from; each process that gets one opens it once.

    What the given store has read, and its open files, are shared with it.

    `damaged` are files of its records that are not as they were written.
    """

    def __init__(self, store: Store, damaged: frozenset[str] = frozenset()) -> None:
        vars(self).update(vars(store))  # What was read of it is not read again.
        self.damaged = damaged
        # `StoredRecords(self)` would be a circle, whose files stay open until it is collected.
        self.records = StoredRecords(store)
        # A process that lives on must not answer with what it read of an older store at the same
        # path, whose rows may have been in another order under the same id.
        self._run = uuid.uuid4().hex

    def __reduce__(self) -> tuple[Callable[..., SourceStore], tuple[object, ...]]:
        return _in_this_process, (self.path, self.damaged, self._run)

    @property
    def build(self) -> dict[str, Any]:
        """Its attribute ``build``."""
        return dict(self.attributes["build"])

    @cached_property
    def files(self) -> dict[str, Written]:
        """Bytes and SHA-256 of its files by name, as it holds them."""
        return digests_in(self)

    def record(self, asset_id: str) -> AssetRecord | None:
        """Return the record of an asset as its first pass left it, None where it is not there.

        Raises StoreError if its file is damaged, or another version of slatprep wrote it.
        """
        if asset_id not in self:
            return None
        row = self.find(asset_id)
        file = f"{RECORD_ARRAY}/c/{row // RECORDS_IN_SHARD}"
        if file in self.damaged:
            raise StoreError(f"{file} is damaged")
        return self.records.read(row).of_first_pass()

    def text(self, row: int) -> bytes:
        """Return the record of a row as the store holds it, JSON in UTF-8."""
        return self.records.text(row).encode()

    def has_labels_of(self, asset: Finished) -> bool:
        """Whether the store's labels and places of an asset are those it has been given now.

        Where a pass over the whole dataset chose another alignment, the rows are of that one,
        and its places alone are compared.
        """
        row = self.find(asset.pair.asset_id)
        try:
            held = self.read(row, ("place", "material"))
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
    return SourceStore(open_store(path), damaged)


def checked_store(
    source: SourceStore, jobs: Jobs, below: str = ""
) -> tuple[SourceStore | None, tuple[str, ...]]:
    """Return the store, None where no build can go on from it, and what is wrong.

    Its metadata are held against the contract, and the files whose names begin with `below`
    against their digests; of the others the sizes are compared. What is wrong is in words,
    sorted by file.
    """
    findings = {*metadata_findings(source.path), *file_findings(source, jobs, below)[1]}
    damaged = tuple(map(str, sorted(findings)))
    files = frozenset(finding.file for finding in findings)
    if any(file.startswith(_NEEDED) for file in files):
        return None, damaged
    records = frozenset(file for file in files if file.startswith(RECORD_ARRAY))
    return SourceStore(source, records), damaged


IN_SPOOL = -1
"""In place of the number of a store."""

MOST_BEHIND = 0.1
"""The most assets that an update adds behind the others, as a share of those. To pack a row that is
there takes a tenth of the time that a new asset takes."""

Names = Mapping[str, Any]
"""What an asset and its files are called now, by field of its record; no part of the work."""


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """An asset that goes into a store, and where its arrays lie.

    Attributes
    ----------
    asset_id : str
        Id of the row.
    n_voxels : int
        Its SLAT voxels.
    key : str
        Names its file in the spool.
    columns : mapping of str to object
        What its record says in ``asset/*`` by last name, of a row in the spool; ``n_valid`` and
        ``n_placements``, its distinct placements that fit about as well, and ``grid``, the digest
        of its grid, too.
    store : int
        Which of the stores that rows are taken from has it; `IN_SPOOL` where none.
    row : int
        Its row there.
    names : mapping of str to object, or None
        Those that its record there has otherwise.
    damaged : str
        Why, in words, what an older store holds of it was not taken over.
    seen : bytes
        State of its sources as they were read; empty where they were not.
    """

    asset_id: str
    n_voxels: int
    key: str = ""
    columns: Mapping[str, Any] = field(default_factory=dict)
    store: int = IN_SPOOL
    row: int = 0
    names: Names | None = None
    damaged: str = ""
    seen: bytes = b""

    @property
    def spooled(self) -> bool:
        """Whether its arrays lie in the spool."""
        return self.store == IN_SPOOL

    @property
    def where(self) -> Where:
        """Where its arrays lie, for a task."""
        return self.key if self.spooled else (self.store, self.row, self.names)


Where = str | tuple[int, int, Names | None]
"""Where a row's arrays lie: its key in the spool, or its store, its row there and its new names."""


def moments_of(rows: Sequence[Row], stores: Sequence[SourceStore]) -> list[LatentMoments | None]:
    """Return the moments of the latents of each row; None where they are not known."""
    columns = (column(name, rows, stores) for name in ("latent_mean", "latent_std"))
    return [
        None if np.isnan(mean).any() else LatentMoments(tuple(mean.tolist()), tuple(std.tolist()))
        for mean, std in zip(*columns, strict=True)
    ]


def slat_contents(store: NextStore | Store) -> list[bytes]:
    """Return what tells the SLAT of each row from others, its size and moments; empty if unknown.

    A digest of its file would not: a file may hold those of all assets.
    """
    means, stds = store.column("latent_mean"), store.column("latent_std")
    told = np.column_stack([np.diff(store.offsets), means, stds])
    return [b"" if np.isnan(own[-1]) else own.tobytes() for own in told]


@dataclass(frozen=True, eq=False)
class NextStore:
    """A store that is to be written.

    Attributes
    ----------
    rows : sequence of Row
        Its assets, in its order.
    stores : tuple of SourceStore
        Those that rows are taken from.
    normalization : Normalization
        The ranges of its properties.
    contents : Contents
        What it holds.
    build : mapping
        Its attribute ``build``.
    parameters : StoreParameters
        Sizes of its chunks and shards.
    replaces : bool
        Whether it takes the place of the one store that rows are taken from, so that the two
        may have files in common.
    """

    rows: Sequence[Row]
    stores: tuple[SourceStore, ...]
    normalization: Normalization
    contents: Contents
    build: Mapping[str, object]
    parameters: StoreParameters
    replaces: bool = False

    @cached_property
    def ids(self) -> list[str]:
        """Ids of its assets."""
        return [row.asset_id for row in self.rows]

    @cached_property
    def offsets(self) -> list[int]:
        """First row of each asset in ``voxel/*``, and the last one's end."""
        return [0, *accumulate(row.n_voxels for row in self.rows)]

    @cached_property
    def merged(self) -> bool:
        """Whether labels of any asset are merged of several annotations."""
        return bool(column("merged", self.rows, self.stores).any())

    @cached_property
    def digests(self) -> NDArray[np.uint8]:
        """SHA-256 of the record of each row, (A, 32)."""
        digests: NDArray[np.uint8] = column("record_sha256", self.rows, self.stores)
        for at, row in enumerate(self.rows):
            if row.names:
                text = record_text(self.stores[row.store], row.row, row.names)
                digests[at] = np.frombuffer(digest_of(text), np.uint8)
        return digests

    @cached_property
    def build_id(self) -> str:
        """The id of the build; equal ids mean the same assets, records, ranges and parameters."""
        head = store_attributes(self.normalization, self.build, self.contents)
        return build_id_of(head, zip(self.ids, map(bytes, self.digests), strict=True))

    def same_as(self, other: SourceStore) -> bool:
        """Whether another store is this one: the same build, in the same order of rows."""
        return self.build_id == other.about.manifest and self.ids == other.ids

    def column(self, name: str) -> NDArray[Any]:
        """Return an ``asset/*`` array by its last name; of what packing clips, what is known."""
        if name in ("id", "offset"):
            return np.array(self.ids, object) if name == "id" else np.array(self.offsets, np.int64)
        if name == "record_sha256":
            return self.digests
        values = column(name, self.rows, self.stores)
        if name == "property_ambiguity":
            # Of the spool in mapped units, as ranges come from the dataset.
            other = [source.normalization != self.normalization for source in self.stores]
            at = [k for k, row in enumerate(self.rows) if row.spooled or other[row.store]]
            for k, row in ((k, self.rows[k]) for k in at if not self.rows[k].spooled):
                document = orjson.loads(self.stores[row.store].text(row.row))
                values[k] = document["judgement"]["ambiguity"]["property_change"]
            if at:
                values[at] = normalize_change(values[at], self.normalization)
        return values


def column(name: str, rows: Sequence[Row], stores: Sequence[SourceStore]) -> NDArray[Any]:
    """Return an ``asset/*`` array (A, ...) of rows, by its last name, as it lies there."""
    parts: list[tuple[list[int], Any]] = []
    made = [k for k, row in enumerate(rows) if row.spooled]
    if made:
        parts.append((made, [rows[k].columns[name] for k in made]))
    for number, source in enumerate(stores):
        at = [k for k, row in enumerate(rows) if row.store == number]
        if at:
            parts.append((at, source.column(name)[[rows[k].row for k in at]]))
    first = np.asarray(parts[0][1])
    values = np.empty(
        (len(rows), *first.shape[1:]), object if first.dtype.kind == "U" else first.dtype
    )
    for at, own in parts:
        values[at] = own
    for k, row in enumerate(rows):
        if row.names and name in row.names:
            values[k] = row.names[name]
    return values


def record_text(source: SourceStore, row: int, names: Names | None) -> bytes:
    """Return the record of a row of a store, with other names where there are any."""
    if names:
        return to_json(replace(source.records.read(row), **names))
    return source.text(row)


def in_order(rows: Sequence[Row], previous: SourceStore | None, compact: bool) -> list[Row]:
    """Return rows by id, or as in the existing store with new ones last.

    They are by id if `compact`, and where so many are new that packing all rows again costs no
    more than they do.
    """
    by_id = sorted(rows, key=lambda row: row.asset_id)
    if compact or previous is None:
        return by_id
    place = {asset_id: row for row, asset_id in enumerate(previous.ids)}
    new = sum(row.asset_id not in place for row in rows)
    if new > MOST_BEHIND * len(place):
        return by_id
    return sorted(by_id, key=lambda row: place.get(row.asset_id, len(place)))
