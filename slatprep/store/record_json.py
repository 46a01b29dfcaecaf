"""Write and read records as JSON, within bounds, and turn them into columns; nothing else does.

`FOLDER` holds their published JSON Schemas, which ``tools/schema.py`` writes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import orjson

from slatprep.errors import StoreError
from slatprep.records import SourceFile, oddities_in
from slatprep.storage.documents import faults_told, read_as
from slatprep.storage.place import is_place
from slatprep.store.layout import ARRAYS, MAX_RECORD_BYTES, last_names
from slatprep.store.record import AssetRecord, BuildRecord, Record

FOLDER = Path(__file__).with_name("schema")

_Kind = TypeVar("_Kind")

_NAMES = 2**14
"""Bytes that other names may add to a record."""


class RecordError(StoreError):
    """A record that cannot be read; each fault is told with its place and value."""

    def __init__(self, where: str, faults: tuple[str, ...]) -> None:
        super().__init__(
            f"{where}: not a record that this version of slatprep reads ({'; '.join(faults[:3])}); "
            "build again to have it written anew"
        )
        self.faults = faults


def to_json(record: Record | BuildRecord, *, indent: bool = False) -> bytes:
    """Return a record as JSON in UTF-8: in one line, or indented; NaN becomes null."""
    option = orjson.OPT_SERIALIZE_NUMPY | (orjson.OPT_INDENT_2 if indent else 0)
    written: object = record
    if isinstance(record, AssetRecord) and not record.merged:
        # Only merged annotations have these entries.
        files = [_without(file, "source") for file in record.sources]
        written = {**_without(record, "merged"), "sources": files}
    return orjson.dumps(written, default=_plain, option=option)


def _without(entry: AssetRecord | SourceFile, name: str) -> dict[str, object]:
    return {one.name: getattr(entry, one.name) for one in fields(entry) if one.name != name}


def read_record(kind: type[_Kind], text: bytes | str, where: str) -> _Kind:
    """Read the record of a row or of a build; errors call it `where`.

    RecordError if it has another version or breaks its schema.
    """
    from pydantic import ValidationError

    try:
        return read_as(kind, text)
    except ValidationError as error:
        raise RecordError(where, faults_told(error)) from None


def faults_of(record: AssetRecord) -> tuple[str, ...]:
    """Return the faults for which a record could not be read back; none if it can be.

    A pass over the whole dataset may double the record's size by its `first_pass`. There is none
    over merged annotations, and of these only names may grow.
    """
    text = to_json(record)
    if len(text) > (MAX_RECORD_BYTES - _NAMES if record.merged else MAX_RECORD_BYTES // 2):
        return (f"{len(text):,} bytes",)
    try:
        read_record(AssetRecord, text, record.asset_id)
    except RecordError as error:
        return error.faults
    return ()


def build_id_of(head: object, digests: Iterable[tuple[str, bytes]]) -> str:
    """Return the id of a build: SHA-256, in hex, of what decides its store.

    `digests` are asset ids with `digest_of` their records, in any order; `head` is the rest.
    """
    first = orjson.dumps(head, option=orjson.OPT_SORT_KEYS)
    return hashlib.sha256(first + b"".join(digest for _, digest in sorted(digests))).hexdigest()


def digest_of(text: bytes) -> bytes:
    """Return the SHA-256 of a record's text, by which builds and stores identify it."""
    return hashlib.sha256(text).digest()


def _plain(value: object) -> Any:
    if isinstance(value, np.ndarray):  # not contiguous
        return value.tolist()
    if is_place(value):
        return str(value)
    raise TypeError(f"a record cannot hold {type(value).__name__} {value!r}")


def columns_of(record: AssetRecord) -> dict[str, Any]:
    """Return an asset's row of each ``asset/*`` array that follows from its record, by last name.

    An array of `slatprep.store.layout.ARRAYS` that has the name of an entry takes its value.
    ``property_ambiguity`` is in mapped units, because ranges come from the dataset.
    """
    alignment, judgement, counts = record.alignment, record.judgement, record.counts
    parts = (counts, alignment.quality, judgement, alignment, record)
    entries = {name: value for part in parts for name, value in vars(part).items()}
    moments = record.latents
    entries |= {
        "ambiguity": judgement.ambiguity.material_share,
        "property_ambiguity": judgement.ambiguity.property_change,
        "valid_share": counts.valid / counts.slat_voxels,
        "unusual": "\n".join(map(": ".join, oddities_in(record.warnings).items())),
        "merged": bool(record.merged),
        "key": np.frombuffer(bytes.fromhex(record.of_first_pass().key), np.uint8),
        "latent_mean": np.nan if moments is None else moments.mean,
        "latent_std": np.nan if moments is None else moments.std,
    }
    return {name: entries[name] for name in last_names("asset", ARRAYS) if name in entries}
