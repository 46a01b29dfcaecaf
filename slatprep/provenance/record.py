"""The records of an asset and of a build: what was made from what, by what, and how well.

They are written by `to_json` and read by `read_record` and its siblings, and
nowhere else. A record that is read is checked: unknown keys, types, ranges and
digests. ``slatprep/provenance/schema`` holds the JSON Schemas, which
`slatprep.provenance.schemas` makes from these classes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal

import numpy as np
import orjson
from annotated_types import Ge, MaxLen, MinLen

from slatprep.errors import StoreError
from slatprep.parameters import AlignParameters, BuildParameters, SampleParameters
from slatprep.records import (
    PROPERTY_COLUMNS,
    Alignment,
    Count,
    Digest,
    InJson,
    Judgement,
    Normalization,
    SourceFile,
    Status,
    Verdict,
)
from slatprep.storage.place import is_place

if TYPE_CHECKING:
    from pydantic import TypeAdapter, ValidationError

RECORD_VERSION: Final = 2

_CHECKED: dict[str, object] = {
    "extra": "forbid",
    "allow_inf_nan": False,
    "use_attribute_docstrings": True,
}


def _named(versions: dict[str, str]) -> dict[str, str]:
    missing = {"slatprep", "python", "numpy", "scipy"} - versions.keys()
    if missing:
        raise ValueError(f"no version of {', '.join(sorted(missing))}")
    return versions


_TEXTS = {
    "type": "dict",
    "keys_schema": {"type": "str"},
    "values_schema": {"type": "str"},
    "max_length": 64,
}

Versions = Annotated[dict[str, str], InJson(_TEXTS, _named)]
"""Versions of slatprep, Python and the libraries that made the numbers, by name."""

Seconds = Annotated[float, Ge(0)]


@dataclass(frozen=True)
class StageParameters:
    """The parameters that decide an asset's row, without where its files lie."""

    align: AlignParameters
    sample: SampleParameters


@dataclass(frozen=True)
class PropertyCounts:
    """How many values, by property."""

    youngs_modulus: Count
    density: Count
    poissons_ratio: Count


@dataclass(frozen=True)
class Clipped:
    """Values outside the ranges in ``voxel/properties`` and in ``grid/properties``."""

    voxel: PropertyCounts
    grid: PropertyCounts


@dataclass(frozen=True)
class VoxelCounts:
    """Voxels of an asset."""

    occupied: Count
    """Occupied PixieVerse voxels."""
    annotated: Count
    """Those with a class 0..6 and properties that a material can have."""
    unannotated: Count
    """The others."""
    boundary: Count
    """Those that touch an empty voxel by a face."""
    slat_voxels: Count
    """SLAT voxels."""
    valid: Count
    """SLAT voxels with an annotation near enough."""
    unphysical: Count = 0
    """Of the unannotated those with a class, but properties that no material has."""
    clipped: Clipped | None = None
    """Values outside the ranges; null where no store was built."""


@dataclass(frozen=True, eq=False)
class FirstPass:
    """What was found for an asset alone, before the passes over the whole dataset."""

    key: Digest
    alignment: Alignment
    judgement: Judgement


@dataclass(frozen=True, eq=False, kw_only=True)
class AssetRecord:
    """What one row of a store was made from, by what, and how well.

    Lengths are in voxels, angles in degrees, times in seconds.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = _CHECKED

    format: Literal["slatprep-asset-record"] = "slatprep-asset-record"
    format_version: Literal[2] = RECORD_VERSION
    asset_id: Annotated[str, MinLen(1)]
    """Id of the row."""
    object_id: str
    """PixieVerse id of the object."""
    view: str
    """Image or seed the SLAT was made from; empty where there is one only."""
    category: str
    """PixieVerse category; empty where unknown."""
    status: Literal[Status.OK]
    """The asset is in the store."""
    sources: Annotated[tuple[SourceFile, ...], MinLen(2), MaxLen(16)]
    """The files that were read."""
    bounds: dict[str, object] | None
    """World bounds as clip_features.npz states them."""
    parameters: StageParameters
    """The parameters that decide this row."""
    versions: Versions
    """Versions of slatprep and of the libraries that made the numbers."""
    code: Digest
    """Fingerprint of the code that made the numbers."""
    key: Digest
    """What decides this row, as one hash: sources, parameters, libraries and code."""
    alignment: Alignment
    """The transform, how it was found, and how well it fits."""
    judgement: Judgement
    """What ties would change in the labels, the verdict and its reasons."""
    first_pass: FirstPass | None = None
    """What was found for the asset alone, where a pass over the whole dataset changed that."""
    normalization: Normalization | None = None
    """The ranges of the properties; null where no store was built."""
    counts: VoxelCounts
    """Voxels of the asset."""
    warnings: Annotated[tuple[str, ...], MaxLen(256)]
    """What a person should know about the sources."""
    duration_s: Seconds = 0.0
    """Seconds spent on the asset; 0 inside a store, where equal builds are equal bytes."""

    def without_duration(self) -> AssetRecord:
        """Return the record as a store holds it, the same in two builds of the same."""
        return replace(self, duration_s=0.0)

    def of_first_pass(self) -> AssetRecord:
        """Return the record as it was before the passes over the whole dataset."""
        first = self.first_pass
        if first is None:
            return self
        return replace(
            self,
            key=first.key,
            alignment=first.alignment,
            judgement=first.judgement,
            first_pass=None,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class FailedRecord:
    """Why an asset is not in the store."""

    __pydantic_config__: ClassVar[dict[str, object]] = _CHECKED

    format: Literal["slatprep-asset-record"] = "slatprep-asset-record"
    format_version: Literal[2] = RECORD_VERSION
    asset_id: Annotated[str, MinLen(1)]
    """Id that its row would have."""
    object_id: str
    """PixieVerse id of the object."""
    view: str
    """Image or seed the SLAT was made from; empty where there is one only."""
    category: str
    """PixieVerse category; empty where unknown."""
    status: Literal[Status.FAILED, Status.SKIPPED]
    """``skipped`` where a partner is missing, ``failed`` otherwise."""
    reason: Annotated[str, MinLen(1)]
    """Why the asset did not go in, in one line."""
    traceback: str = ""
    """Where an error of slatprep's own arose; empty otherwise."""
    parameters: StageParameters
    """The parameters of the build."""
    versions: Versions
    """Versions of slatprep and of the libraries that were used."""
    code: Digest
    """Fingerprint of the code."""
    duration_s: Seconds = 0.0
    """Seconds spent on the asset."""


Record = AssetRecord | FailedRecord
"""A line of ``assets.jsonl``; ``status`` says which."""


@dataclass(frozen=True)
class BuildCounts:
    """Voxels of a whole build."""

    voxels: Count
    """SLAT voxels."""
    valid: Count
    """SLAT voxels with an annotation near enough."""
    clipped: PropertyCounts
    """Values of ``voxel/properties`` outside the ranges."""
    unphysical: Count = 0
    """PixieVerse voxels with a class, but properties that no material has."""


def _word(words: Iterable[str]) -> InJson:
    return InJson({"type": "literal", "expected": [str(word) for word in words]})


@dataclass(frozen=True, eq=False, kw_only=True)
class BuildRecord:
    """One build of a store, over its asset records."""

    __pydantic_config__: ClassVar[dict[str, object]] = _CHECKED

    format: Literal["slatprep-build-record"] = "slatprep-build-record"
    format_version: Literal[2] = RECORD_VERSION
    id: Digest
    """SHA-256 of the asset records' content; the store's attribute ``manifest``."""
    name: str
    """Name of the dataset."""
    created: datetime
    """When the build ended."""
    duration_s: Seconds
    """Seconds that the build took."""
    platform: str
    """The machine's operating system."""
    store: str
    """Name of the store's directory."""
    records: str
    """Name of the file of asset records, beside this one."""
    parameters: BuildParameters
    """All parameters, with where the sources lay."""
    versions: Versions
    """Versions of slatprep and of its libraries."""
    normalization: Normalization
    """The ranges of the properties."""
    statuses: dict[Annotated[str, _word(Status)], Count]
    """Assets by status."""
    verdicts: dict[Annotated[str, _word(Verdict)], Count]
    """Assets in the store by verdict."""
    counts: BuildCounts
    """Voxels of the store."""


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


def to_json(record: Record | BuildRecord, *, indent: bool = False) -> bytes:
    """Return a record as JSON in UTF-8: in one line, or indented; NaN becomes null."""
    option = orjson.OPT_SERIALIZE_NUMPY | (orjson.OPT_INDENT_2 if indent else 0)
    return orjson.dumps(record, default=_plain, option=option)


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


def read_build_record(text: bytes | str, where: str) -> BuildRecord:
    """Read ``build.json``; see `read_record`."""
    record: BuildRecord = _read(BuildRecord, text, where)
    return record


def records_id(records: Iterable[Record]) -> str:
    """Return the id of a build: SHA-256, in hex, of its records in the order of asset ids.

    How long things took and in what words they failed are left out: they
    differ between runs, machines and folders without the content differing.
    """
    digest = hashlib.sha256()
    for record in records:
        if isinstance(record, AssetRecord):
            content: Record = record.without_duration()
        else:
            content = replace(record, duration_s=0.0, reason="", traceback="")
        digest.update(to_json(content))
    return digest.hexdigest()


def write_records(path: Path, records: Iterable[Record]) -> str:
    """Write records, in the order of their asset ids, as JSON Lines; return `records_id`."""

    def passing() -> Iterator[Record]:
        for record in records:
            file.write(to_json(record) + b"\n")
            yield record

    with path.open("wb") as file:
        return records_id(passing())


def property_counts(counts: Iterable[int]) -> PropertyCounts:
    """Return counts in the order of ``PROPERTY_COLUMNS`` by name."""
    return PropertyCounts(**dict(zip(PROPERTY_COLUMNS, map(int, counts), strict=True)))


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
        return adapter_of(kind).validate_json(text, strict=True)
    except ValidationError as error:
        raise RecordError(where, _faults(error)) from None


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
