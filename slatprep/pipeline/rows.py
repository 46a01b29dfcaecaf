"""The rows of a store that is to be written: their arrays lie in the spool or in a store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import accumulate
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.normalize import normalize_change
from slatprep.parameters import StoreParameters
from slatprep.pipeline.previous import SourceStore
from slatprep.records import Contents, LatentMoments, Normalization, SourceFile
from slatprep.store.attributes import store_attributes
from slatprep.store.record import AssetRecord
from slatprep.store.record_json import build_id_of, digest_of, read_asset_record, to_json

IN_SPOOL = -1
"""In place of the number of a store."""

MOST_BEHIND = 0.1
"""The most assets that an update adds behind the others, as a share of those. To pack a row that is
there takes a tenth of the time that a new asset takes."""


@dataclass(frozen=True, slots=True)
class Names:
    """What an asset and its files are called now: no part of the work."""

    object_id: str
    view: str
    category: str
    sources: tuple[SourceFile, ...]

    def changed(self, record: AssetRecord) -> list[str]:
        """Return the names of the fields in which a record differs."""
        names = (field.name for field in fields(self))
        return [name for name in names if getattr(record, name) != getattr(self, name)]

    def applied(self, record: AssetRecord) -> AssetRecord:
        """Return a record with these names."""
        return replace(record, **{field.name: getattr(self, field.name) for field in fields(self)})


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
        ``n_placements``, its distinct placements that fit about as well, ``unusual``, what is
        unusual of its values, and ``grid``, the digest of its grid, too.
    store : int
        Which of the stores that rows are taken from has it; `IN_SPOOL` where none.
    row : int
        Its row there.
    names : Names or None
        Where its record there has other ones.
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


def moments_of(mean: Any, std: Any) -> LatentMoments | None:
    """Return the moments of channels (C,); None where they are NaN."""
    if np.isnan(mean).any():
        return None
    return LatentMoments(tuple(np.asarray(mean).tolist()), tuple(np.asarray(std).tolist()))


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
            if row.names is not None:
                text = record_text(self.stores[row.store], row.row, row.names)
                digests[at] = np.frombuffer(digest_of(text), np.uint8)
        return digests

    @cached_property
    def build_id(self) -> str:
        """The id of the build; equal ids mean the same assets, records, ranges and parameters."""
        head = store_attributes(self.normalization, self.build, self.contents)
        ids = (row.asset_id for row in self.rows)
        return build_id_of(head, zip(ids, map(bytes, self.digests), strict=True))

    def same_as(self, other: SourceStore) -> bool:
        """Whether another store is this one: the same build, in the same order of rows."""
        ids = [row.asset_id for row in self.rows]
        return self.build_id == other.store.about.manifest and ids == other.store.ids

    def column(self, name: str) -> NDArray[Any]:
        """Return an ``asset/*`` array by its last name; of what packing clips, what is known."""
        if name in ("id", "offset"):
            ids = [row.asset_id for row in self.rows]
            return np.array(ids, object) if name == "id" else np.array(self.offsets, np.int64)
        if name == "record_sha256":
            return self.digests
        values = column(name, self.rows, self.stores)
        if name == "property_ambiguity":
            # Of the spool in mapped units, as ranges come from the dataset.
            at = [k for k, row in enumerate(self.rows) if self._changes(row)]
            for k in at:
                row = self.rows[k]
                if not row.spooled:
                    document = orjson.loads(self.stores[row.store].text(row.row))
                    values[k] = document["judgement"]["ambiguity"]["property_change"]
            if at:
                values[at] = normalize_change(values[at], self.normalization)
        return values

    def _changes(self, row: Row) -> bool:
        """Whether a row's values are to be brought to the ranges."""
        return row.spooled or self.stores[row.store].normalization != self.normalization


def column(name: str, rows: Sequence[Row], stores: Sequence[SourceStore]) -> NDArray[Any]:
    """Return an ``asset/*`` array (A, ...) of rows, by its last name, as it lies there."""
    parts: list[tuple[list[int], Any]] = []
    made = [k for k, row in enumerate(rows) if row.spooled]
    if made:
        parts.append((made, [rows[k].columns[name] for k in made]))
    for number, source in enumerate(stores):
        at = [k for k, row in enumerate(rows) if row.store == number]
        if at:
            parts.append((at, source.store.column(name)[[rows[k].row for k in at]]))
    first = np.asarray(parts[0][1])
    values = np.empty(
        (len(rows), *first.shape[1:]), object if first.dtype.kind == "U" else first.dtype
    )
    for at, own in parts:
        values[at] = own
    for k, row in enumerate(rows):
        if row.names is not None and name in ("object_id", "view", "category"):
            values[k] = getattr(row.names, name)
    return values


def record_text(source: SourceStore, row: int, names: Names | None) -> bytes:
    """Return the record of a row of a store, with other names where there are any."""
    text = source.text(row)
    if names is None:
        return text
    where = f"{source.path}: record of row {row}"
    return to_json(names.applied(read_asset_record(text, where)))


def in_order(rows: Sequence[Row], previous: SourceStore | None, compact: bool) -> list[Row]:
    """Return rows by id, or as in the existing store with new ones last.

    They are by id if `compact`, and where so many are new that packing all rows again costs no
    more than they do.
    """
    by_id = sorted(rows, key=lambda row: row.asset_id)
    if compact or previous is None:
        return by_id
    place = {asset_id: row for row, asset_id in enumerate(previous.store.ids)}
    new = sum(row.asset_id not in place for row in rows)
    if new > MOST_BEHIND * len(place):
        return by_id
    return sorted(by_id, key=lambda row: place.get(row.asset_id, len(place)))
