"""Attributes of a store's root as typed values; readers use no others."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar

import orjson
from annotated_types import MaxLen, MinLen

from slatprep import records
from slatprep.parameters import Length, SampleParameters
from slatprep.storage.documents import faults_in, read_as
from slatprep.store.contract import Finding
from slatprep.store.layout import FORMAT, FORMAT_VERSION


@dataclass(frozen=True)
class StoredRange:
    """The range of one property; see `slatprep.records.PropertyRange`."""

    log10: bool
    lo: float
    hi: float
    source: str

    def __post_init__(self) -> None:
        if not self.lo < self.hi:
            raise ValueError("lo must be less than hi")


@dataclass(frozen=True)
class StoredAlign:
    """The parameter of alignment that readers need: the correspondence radius [voxel]."""

    radius: Length


@dataclass(frozen=True)
class StoredSample(SampleParameters):
    """The parameters of the lookup; those that only newer versions know are ignored."""

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "ignore", "allow_inf_nan": False}


@dataclass(frozen=True)
class StoredParameters:
    """The parameters of a build that readers need."""

    align: StoredAlign
    sample: StoredSample


@dataclass(frozen=True)
class StoredBuild:
    """Origin of a store: parameters, versions, and the name of the dataset."""

    parameters: StoredParameters
    versions: dict[str, str]
    name: str = ""


@dataclass(frozen=True)
class RootAttributes:
    """The attributes that readers rely on; unknown attributes are ignored.

    `slatprep.store.writer.finish_store` writes them.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "ignore", "allow_inf_nan": False}

    format: Annotated[str, records.one_of(FORMAT)]
    format_version: Annotated[int, records.one_of(FORMAT_VERSION)]
    resolution: Annotated[int, records.one_of(records.RESOLUTION)]
    material_classes: tuple[records.ClassName, ...]
    property_columns: Annotated[
        tuple[records.PropertyName, ...], MinLen(1), MaxLen(records.MAX_PROPERTIES)
    ]
    normalization: dict[str, StoredRange]
    manifest: records.Digest
    build: StoredBuild
    property_units: tuple[str, ...]
    latents: records.LatentSpace

    def __post_init__(self) -> None:
        records.labels_of(self.material_classes)
        columns = set(self.property_columns)
        if not columns == self.normalization.keys() or len(columns) < len(self.property_columns):
            raise ValueError("property_columns and normalization must name the same properties")
        if len(self.property_units) != len(self.property_columns):
            raise ValueError("property_units must have a unit for each of property_columns")

    @property
    def ranges(self) -> records.Normalization:
        """The ranges as a record."""
        entries = [(name, self.normalization[name]) for name in self.property_columns]
        ranges = tuple(records.PropertyRange(name, e.log10, e.lo, e.hi) for name, e in entries)
        return records.Normalization(ranges, entries[0][1].source)

    @property
    def contents(self) -> records.Contents:
        """The store's properties, classes and latent space, as a record."""
        properties = (
            records.Property(name, unit, self.normalization[name].log10)
            for name, unit in zip(self.property_columns, self.property_units, strict=True)
        )
        return records.Contents(tuple(properties), self.material_classes, self.latents)


def read_attributes(attributes: Mapping[str, Any]) -> RootAttributes | tuple[Finding, ...]:
    """Return the attributes of a root as typed values, or a finding for each fault."""
    from pydantic import ValidationError

    try:
        return read_as(RootAttributes, orjson.dumps(attributes))
    except ValidationError as error:
        start = re.compile("Input should be |Value error, ")
        return tuple(
            Finding("zarr.json", "", f"attribute {at} is {value or 'missing'}", start.sub("", what))
            for at, what, value in faults_in(error)
        )


def width_findings(said: RootAttributes, metadata: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield a finding for each array whose number of columns differs from the attributes."""
    for name, attribute, columns in (
        ("voxel/feats", "latents", said.latents.channels),
        ("voxel/properties", "property_columns", len(said.property_columns)),
    ):
        array = metadata.get(name)
        shape = array.get("shape") if isinstance(array, dict) else None
        if isinstance(shape, list) and len(shape) == 2 and shape[1] != columns:
            what = f"attribute {attribute} says {columns} columns of {name}"
            yield Finding("zarr.json", "", what, f"{shape[1]!r}, as the array has")


def segments_of(ids: Sequence[str]) -> list[int]:
    """Return the first row of each segment: 0, and rows with a smaller id than the row before.

    >>> segments_of(["a", "d", "b", "c"])
    [0, 2]
    """
    return [0, *(row for row, (one, other) in enumerate(pairwise(ids), 1) if one > other)]


def store_attributes(
    normalization: records.Normalization, build: Mapping[str, object], contents: records.Contents
) -> dict[str, Any]:
    """Return the attributes of a store's root that decide its bytes, except those of its rows.

    `build` holds the parameters and versions that made the content, so that
    a store is understood without its manifests.
    """
    empty = contents.background
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "resolution": records.RESOLUTION,
        "material_classes": list(contents.classes),
        **({} if empty == records.BACKGROUND else {"background": empty}),
        "property_columns": [one.name for one in contents.properties],
        "property_units": [one.unit for one in contents.properties],
        "latents": asdict(contents.latents),
        "normalization": {
            r.name: {"log10": r.log10, "lo": r.lo, "hi": r.hi, "source": normalization.source}
            for r in normalization.ranges
        },
        "build": dict(build),
    }
