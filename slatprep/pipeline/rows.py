"""The rows of the next store, whose arrays lie in the spool or in another store.

The other store is the existing store, or one from which assets are chosen or joined.
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
from slatprep.store.reader import Store, open_again, opened_elsewhere
from slatprep.store.record import AssetRecord
from slatprep.store.record_json import build_id_of, digest_of, to_json
from slatprep.store.records import StoredRecords
from slatprep.store.shard_writer import Written
from slatprep.workers.local import Jobs

PLACE_TOLERANCE = 2.0**-23
"""Largest difference of a place, in edges of the unit cube: the last bit of a float32, because
another machine may round the map differently."""

# Without these files rows cannot be identified, or nothing can be checked.
_NEEDED = ("asset/id/", "asset/offset/", f"{RECORD_ARRAY}/zarr.json", "file")


class SourceStore(Store):
    """An open store from which assets are taken; each process that gets it opens it once.

    It shares the data that the given store has read, and its open files.

    `damaged` are the damaged files of its records; `run` tells this opening from others.
    """

    def __init__(self, store: Store, damaged: frozenset[str] = frozenset()) -> None:
        vars(self).update(vars(store))  # The store's data are not read again.
        self.damaged = damaged
        # `StoredRecords(self)` would be a cycle, whose files stay open until it is collected.
        self.records = StoredRecords(store)
        # A process that lives on must not use data of an older store at the same path, whose
        # rows may have been in another order under the same build id.
        self.run = uuid.uuid4().hex

    def __reduce__(self) -> tuple[Callable[..., Store], tuple[object, ...]]:
        of = self.path, self.identity, self.damaged, self.run
        return opened_elsewhere, (_in_this_process, *of)

    @property
    def build(self) -> dict[str, Any]:
        """The store's attribute ``build``."""
        return dict(self.attributes["build"])

    @cached_property
    def files(self) -> dict[str, Written]:
        """Size and SHA-256 of each file by name, as the store holds them."""
        return digests_in(self)

    def record(self, asset_id: str) -> AssetRecord | None:
        """Return the record of an asset as its first pass left it; None if it is not there.

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
        """Return whether the store has the labels and places that an asset has now.

        If a pass over the whole dataset chose another alignment, the rows belong to that
        alignment, and only its places are compared.
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
def _in_this_process(path: Place, identity: str, damaged: frozenset[str], run: str) -> Store:
    return SourceStore(open_again(path, identity), damaged)


def checked_store(
    source: SourceStore, jobs: Jobs, below: str = ""
) -> tuple[SourceStore | None, tuple[str, ...]]:
    """Return the store, or None if no build can go on from it, and its faults.

    Its metadata are compared with the contract, and the files whose names begin with `below`
    with their digests. Other files are compared by size. Faults are in words, sorted by file.
    """
    findings = {*metadata_findings(source.path), *file_findings(source, jobs, below)[1]}
    damaged = tuple(map(str, sorted(findings)))
    files = frozenset(finding.file for finding in findings)
    if any(file.startswith(_NEEDED) for file in files):
        return None, damaged
    of_records = frozenset(file for file in files if file.startswith(RECORD_ARRAY))
    return SourceStore(source, of_records), damaged


IN_SPOOL = -1
"""Number of a store for a row that lies in the spool."""

MOST_BEHIND = 0.1
"""Largest number of assets that an update adds at the end, as a share of the others. Packing an
existing row takes a tenth of the time that a new asset takes."""

Names = Mapping[str, Any]
"""New names of an asset and its files, by field of its record; they change none of its numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class Row:
    """An asset that goes into a store, and where its arrays lie.

    Attributes
    ----------
    asset_id : str
        Id of the row.
    n_voxels : int
        Number of its SLAT voxels.
    key : str
        Key that names its file in the spool.
    columns : mapping of str to object
        For a row in the spool, its values of ``asset/*`` by last name; besides ``n_valid``,
        ``n_placements`` (distinct placements that fit about as well) and ``grid`` (the digest of
        its grid).
    store : int
        Number of the store that has the row, or `IN_SPOOL`.
    row : int
        Its row in that store.
    names : mapping of str to object, or None
        Names that differ from its record in that store.
    damaged : str
        Why, in words, an older store's data of the asset were not taken over.
    seen : bytes
        State of its sources as they were read; empty if they were not read.
    aligned : bool
        Whether this build aligned it; its plan may have said otherwise.
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
    aligned: bool = False

    @property
    def spooled(self) -> bool:
        """Whether its arrays lie in the spool."""
        return self.store == IN_SPOOL

    @property
    def where(self) -> Where:
        """The place of its arrays, for a task."""
        return self.key if self.spooled else (self.store, self.row, self.names)


# A plain tuple: tasks take one of every row to workers and back, and a named tuple is pickled in
# nine times the time.
Where = str | tuple[int, int, Names | None]
"""Place of a row's arrays: its key in the spool; or its store, its row there and its new names."""


def moments_of(rows: Sequence[Row], stores: Sequence[SourceStore]) -> list[LatentMoments | None]:
    """Return the moments of the latents of each row; None if they are not known."""
    columns = (column(name, rows, stores) for name in ("latent_mean", "latent_std"))
    return [
        None if np.isnan(mean).any() else LatentMoments(tuple(mean.tolist()), tuple(std.tolist()))
        for mean, std in zip(*columns, strict=True)
    ]


def slat_contents(store: NextStore | Store) -> list[bytes]:
    """Return size and moments of the SLAT of each row, which identify it; empty if unknown.

    A digest of its file would not identify it, because a file may hold the SLATs of all assets.
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
        Its rows, in order.
    stores : tuple of SourceStore
        The stores from which rows are taken.
    normalization : Normalization
        The ranges of its properties.
    contents : Contents
        Its properties, classes and latent space.
    build : mapping
        Its attribute ``build``.
    parameters : StoreParameters
        Sizes of its chunks and shards.
    replaces : bool
        Whether it replaces the one store from which rows are taken, so that the two may share
        files.
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
        """First row of each asset in ``voxel/*``, and the end of the last asset."""
        return [0, *accumulate(row.n_voxels for row in self.rows)]

    @cached_property
    def merged(self) -> bool:
        """Whether labels of any asset are merged from several annotations."""
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
        """Return whether another store equals this one: the same build, with rows in this order."""
        return self.build_id == other.about.manifest and self.ids == other.ids

    def column(self, name: str) -> NDArray[Any]:
        """Return an ``asset/*`` array by its last name; spooled rows have no clipped values yet."""
        if name == "id":
            return np.array(self.ids, object)
        if name == "offset":
            return np.array(self.offsets, np.int64)
        if name == "record_sha256":
            return self.digests
        if name == "property_ambiguity":
            return self._property_ambiguity()
        return column(name, self.rows, self.stores)

    def _property_ambiguity(self) -> NDArray[Any]:
        """Return this column, normalised like the properties.

        Stores have it in their own ranges. Spooled rows have it in mapped units, as records do,
        because ranges come from the dataset.
        """
        values = column("property_ambiguity", self.rows, self.stores)
        ranges = self.normalization.ranges
        other = [source.normalization.ranges != ranges for source in self.stores]
        mapped = [k for k, row in enumerate(self.rows) if row.spooled or other[row.store]]
        for k in mapped:
            if not (row := self.rows[k]).spooled:
                document = orjson.loads(self.stores[row.store].text(row.row))
                values[k] = document["judgement"]["ambiguity"]["property_change"]
        values[mapped] = normalize_change(values[mapped], self.normalization)
        return values


def column(name: str, rows: Sequence[Row], stores: Sequence[SourceStore]) -> NDArray[Any]:
    """Return an ``asset/*`` array (A, ...) of rows, by last name, as spool and stores hold it."""
    parts: list[tuple[list[int], Any]] = []
    if made := [k for k, row in enumerate(rows) if row.spooled]:
        parts.append((made, [rows[k].columns[name] for k in made]))
    for number, source in enumerate(stores):
        if at := [k for k, row in enumerate(rows) if row.store == number]:
            parts.append((at, source.column(name)[[rows[k].row for k in at]]))
    first = np.asarray(parts[0][1])
    dtype = object if first.dtype.kind == "U" else first.dtype
    values = np.empty((len(rows), *first.shape[1:]), dtype)
    for at, own in parts:
        values[at] = own
    for k, row in enumerate(rows):
        if row.names and name in row.names:
            values[k] = row.names[name]
    return values


def record_text(source: SourceStore, row: int, names: Names | None) -> bytes:
    """Return the record of a row of a store as JSON, with new names if there are any."""
    if names:
        return to_json(replace(source.records.read(row), **names))
    return source.text(row)


def in_order(rows: Sequence[Row], previous: SourceStore | None, compact: bool) -> list[Row]:
    """Return rows ordered by id, or as in the existing store with new rows last.

    The order is by id if `compact`, or if so many rows are new that packing all rows again costs
    no more than the new assets do.
    """
    by_id = sorted(rows, key=lambda row: row.asset_id)
    if compact or previous is None:
        return by_id
    place = {asset_id: row for row, asset_id in enumerate(previous.ids)}
    new = sum(row.asset_id not in place for row in rows)
    if new > MOST_BEHIND * len(place):
        return by_id
    return sorted(by_id, key=lambda row: place.get(row.asset_id, len(place)))
