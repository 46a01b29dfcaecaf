"""Records as JSON: written, and read with bounds, in this one place."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import orjson

from slatprep.errors import StoreError
from slatprep.provenance.record import AssetRecord, BuildRecord, Clipped, Record
from slatprep.records import Normalization, SourceFile, Status
from slatprep.storage.place import is_place
from slatprep.store.records import MAX_RECORD_BYTES

if TYPE_CHECKING:
    from pydantic import TypeAdapter, ValidationError

_FAULTS = 64


class RecordError(StoreError):
    """A record that cannot be read.

    Parameters
    ----------
    where : str
        The file, and the line or row in it.
    faults : tuple of str
        What is wrong, each with its place in the record and the value there.
    """

    def __init__(self, where: str, faults: tuple[str, ...]) -> None:
        super().__init__(
            f"{where}: not a record that this version of slatprep reads ({'; '.join(faults[:3])}); "
            "build again to have it written anew"
        )
        self.faults = faults


class RecordText(NamedTuple):
    """A record as a line of ``assets.jsonl``, and as what of it counts in `records_id`."""

    asset_id: str
    line: bytes
    content: bytes


def to_json(record: Record | BuildRecord, *, indent: bool = False) -> bytes:
    """Return a record as JSON in UTF-8: in one line, or indented; NaN becomes null."""
    option = orjson.OPT_SERIALIZE_NUMPY | (orjson.OPT_INDENT_2 if indent else 0)
    written: object = record
    if isinstance(record, AssetRecord) and not record.merged:
        # What there is of merged annotations alone is not written of others.
        files = [_without(file, "source") for file in record.sources]
        written = {**_without(record, "merged"), "sources": files}
    return orjson.dumps(written, default=_plain, option=option)


def _without(entry: AssetRecord | SourceFile, name: str) -> dict[str, object]:
    return {one.name: getattr(entry, one.name) for one in fields(entry) if one.name != name}


def read_record(text: bytes | str, where: str) -> Record:
    """Read a line of ``assets.jsonl``.

    Parameters
    ----------
    text : bytes or str
        JSON.
    where : str
        What errors call it.

    Raises
    ------
    RecordError
        If it is no record of this version, or breaks its schema.
    """
    record: Record = _read(Record, text, where)
    return record


def read_asset_record(text: bytes | str, where: str) -> AssetRecord:
    """Read the record of a row; see `read_record`."""
    record: AssetRecord = _read(AssetRecord, text, where)
    return record


def faults_of(record: AssetRecord) -> tuple[str, ...]:
    """Return why nobody could read a record back, before it is written; nothing where one can.

    It may grow to twice its size, by what was found before a pass over the whole dataset.
    """
    text = to_json(record)
    if len(text) > MAX_RECORD_BYTES // 2:
        return (f"{len(text):,} bytes",)
    try:
        read_asset_record(text, record.asset_id)
    except RecordError as error:
        return error.faults
    return ()


def completed(text: bytes, normalization: Normalization, clipped: Clipped | None) -> RecordText:
    """Add to a record what only the whole dataset can tell.

    Parameters
    ----------
    text : bytes
        What `to_json` gave for it. It is not checked again, which takes ten times as long.
    normalization : Normalization
        The ranges.
    clipped : Clipped or None
        Values outside of them; None for an asset that is not in the store, whose record stays.
    """
    document = orjson.loads(text)
    if clipped is not None:
        document["normalization"] = normalization
        document["counts"]["clipped"] = clipped
    return RecordText(document["asset_id"], orjson.dumps(document), counting(document))


def counting(document: dict[str, Any]) -> bytes:
    """Return what of a record's JSON counts in `records_id`, whatever format it is of."""
    left_out = {"duration_s": 0.0, "reason": "", "traceback": ""}
    kept = {name: empty for name, empty in left_out.items() if name in document}
    return orjson.dumps(document | kept)


def read_build_record(text: bytes | str, where: str) -> BuildRecord:
    """Read ``build.json``; see `read_record`."""
    record: BuildRecord = _read(BuildRecord, text, where)
    return record


def records_id(records: Iterable[Record | RecordText]) -> str:
    """Return the id of the build that has these records, in any order; see `build_id_of`.

    How long things took and in what words they failed are left out: they
    differ between runs, machines and folders without the content differing.
    """
    return build_id_of((record.asset_id, digest_of(record)) for record in records)


def build_id_of(digests: Iterable[tuple[str, bytes]]) -> str:
    """Return the id of a build: SHA-256, in hex, of its records' in the order of asset ids.

    So that an update need not read the records of assets that did not change.
    """
    return hashlib.sha256(b"".join(digest for _, digest in sorted(digests))).hexdigest()


def digest_of(record: Record | RecordText) -> bytes:
    """Return the SHA-256 of what of a record counts in a build's id."""
    return hashlib.sha256(content_of(record)).digest()


def content_of(record: Record | RecordText) -> bytes:
    """Return what of a record counts in `records_id`; of a row's it is what its store holds."""
    if isinstance(record, RecordText):
        return record.content
    if isinstance(record, AssetRecord):
        return to_json(record.without_duration())
    return to_json(replace(record, duration_s=0.0, reason="", traceback=""))


def write_records(path: Path, records: Iterable[Record | RecordText]) -> dict[str, bytes]:
    """Write records, in their order, as JSON Lines; return `digest_of` each by asset id."""
    digests = {}
    with path.open("wb") as file:
        for record in records:
            line = record.line if isinstance(record, RecordText) else to_json(record)
            file.write(line + b"\n")
            digests[record.asset_id] = digest_of(record)
    return digests


@lru_cache(maxsize=4)
def adapter_of(kind: Any) -> TypeAdapter[Any]:
    """Return what reads a kind of record, and knows its JSON Schema."""
    # Late: pydantic takes a third of a second that a command without records does not have.
    from pydantic import Field, TypeAdapter

    if kind is Record:
        return TypeAdapter(Annotated[Record, Field(discriminator="status")])
    return TypeAdapter(kind)


def _read(kind: Any, text: bytes | str, where: str) -> Any:
    from pydantic import ValidationError

    try:
        read = adapter_of(kind).validate_json(text, strict=True)
    except ValidationError as error:
        raise RecordError(where, _faults(error)) from None
    if isinstance(read, AssetRecord) and (faults := tuple(_table_faults(read))):
        raise RecordError(where, faults)
    return read


def _table_faults(record: AssetRecord) -> Iterator[str]:
    """Yield where a record does not have the properties that its ranges name."""
    if record.normalization is None:
        return
    names = [one.name for one in record.normalization.ranges]
    for at, of in (
        ("judgement", record.judgement),
        ("first_pass/judgement", record.first_pass and record.first_pass.judgement),
    ):
        if of and len(of.ambiguity.property_change) != len(names):
            yield f"{at}/ambiguity/property_change: should have a number for each of {names}"
    if clipped := record.counts.clipped:
        for group in ("voxel", "grid"):
            if list(getattr(clipped, group)) != names:
                yield f"counts/clipped/{group}: should have the properties {names}"


def _faults(error: ValidationError) -> tuple[str, ...]:
    faults = []
    # A stranger's record may have any number.
    found = error.errors(include_url=False)[:_FAULTS]
    found_at = [fault["loc"] for fault in found]
    for fault in found:
        at = fault["loc"]
        if any(other[: len(at)] == at and other != at for other in found_at):
            continue  # A list that is too short without the faulty item is no fault of its own.
        # Of a record that may be one of two kinds the first step names the kind.
        steps = [str(step) for step in at if step not in tuple(Status)]
        shown = "" if fault["type"] == "missing" else f", found {str(fault['input'])[:60]!r}"
        faults.append(f"{'/'.join(steps) or 'it'}: {fault['msg']}{shown}")
    return tuple(faults)


def _plain(value: object) -> Any:
    if isinstance(value, np.ndarray):  # not contiguous
        return value.tolist()
    if is_place(value):
        return str(value)
    raise TypeError(f"a record cannot hold {type(value).__name__} {value!r}")
