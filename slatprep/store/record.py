"""Records of an asset and of a build: sources, parameters, versions and quality.

Only `slatprep.store.record_json` writes and reads them. It checks the keys, types, ranges and
digests of a record that it reads. ``slatprep/store/schema`` holds the JSON Schemas, which
``tools/schema.py`` makes from these classes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from typing import Annotated, ClassVar, Final, Literal

from annotated_types import Ge, MaxLen, MinLen

from slatprep.parameters import AlignParameters, BuildParameters, SampleParameters
from slatprep.records import (
    MAX_PROPERTIES,
    Alignment,
    Contribution,
    Count,
    Digest,
    InJson,
    Judgement,
    LatentMoments,
    Normalization,
    PropertyName,
    SourceFile,
    Status,
    Verdict,
    one_of,
)

RECORD_VERSION: Final = 1

MAX_SOURCES = MAX_WARNINGS = 256
"""Largest number of an asset's files, and of its warnings; each annotation has several files."""

_CHECKED: dict[str, object] = {
    "extra": "forbid",
    "allow_inf_nan": False,
    "use_attribute_docstrings": True,
}


def _named(versions: dict[str, str]) -> dict[str, str]:
    if missing := {"slatprep", "python", "numpy", "scipy"} - versions.keys():
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
    """The parameters that decide an asset's row, without the places of its files."""

    align: AlignParameters
    sample: SampleParameters


PropertyCounts = Annotated[dict[PropertyName, Count], MaxLen(MAX_PROPERTIES)]
"""Number of values of each property, by its name."""


@dataclass(frozen=True)
class VoxelCounts:
    """Voxels of an asset."""

    occupied: Count
    """Occupied PixieVerse voxels."""
    annotated: Count
    """Occupied voxels with a class, and properties that a material can have."""
    unannotated: Count
    """Occupied voxels that are not annotated."""
    boundary: Count
    """Occupied voxels that touch an empty voxel by a face."""
    slat_voxels: Count
    """SLAT voxels."""
    valid: Count
    """SLAT voxels with an annotation near enough."""
    unphysical: Count = 0
    """Unannotated voxels with a class, but properties that no material has."""


@dataclass(frozen=True, eq=False)
class FirstPass:
    """Result for an asset by itself, before the passes over the whole dataset."""

    key: Digest
    alignment: Alignment
    judgement: Judgement


@dataclass(frozen=True, eq=False, kw_only=True)
class AssetRecord:
    """Sources, parameters, versions and quality of one row of a store.

    Lengths are in voxels, angles in degrees, times in seconds.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = _CHECKED

    format: Literal["slatprep-asset-record"] = "slatprep-asset-record"
    format_version: Literal[1] = RECORD_VERSION
    asset_id: Annotated[str, MinLen(1)]
    """Id of the row."""
    object_id: str
    """PixieVerse id of the object."""
    view: str
    """Image or seed the SLAT was made from; empty if there is only one."""
    category: str
    """PixieVerse category; empty if unknown."""
    status: Literal[Status.OK]
    """The asset is in the store."""
    sources: Annotated[tuple[SourceFile, ...], MinLen(2), MaxLen(MAX_SOURCES)]
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
    """Hash of what decides this row: sources, parameters, libraries and code."""
    alignment: Alignment
    """The transform, how it was found, and how well it fits."""
    judgement: Judgement
    """The ambiguity, which is what ties would change in the labels; the verdict and its reasons."""
    first_pass: FirstPass | None = None
    """Result for the asset by itself, if a pass over the whole dataset changed it."""
    counts: VoxelCounts
    """Voxels of the asset."""
    merged: Annotated[tuple[Contribution, ...], MaxLen(MAX_SOURCES)] = ()
    """One entry for each annotation of the object, if there are several; left out of the text if
    there is one. The record's other entries describe the first merged annotation, except for the
    judgement's expected accuracy and the valid voxels."""
    latents: LatentMoments | None = None
    """Mean and standard deviation of each channel of its latents, as the file holds them."""
    warnings: Annotated[tuple[str, ...], MaxLen(MAX_WARNINGS)]
    """Remarks about the sources that a person should know."""

    @property
    def contributions(self) -> tuple[Contribution, ...]:
        """``merged`` with the record's alignment wherever an annotation has that one."""
        return tuple(
            replace(one, alignment=self.alignment) if one.judgement and not one.alignment else one
            for one in self.merged
        )

    def of_first_pass(self) -> AssetRecord:
        """Return the record as it was before the passes over the whole dataset."""
        if (first := self.first_pass) is None:
            return self
        return replace(
            self,
            key=first.key,
            alignment=first.alignment,
            judgement=first.judgement,
            first_pass=None,
        )


StatusOfFailed = Literal[Status.FAILED, Status.SKIPPED]
"""Status of an asset that is not in the store."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FailedRecord:
    """Record of an asset that is not in the store, with the reason."""

    __pydantic_config__: ClassVar[dict[str, object]] = _CHECKED

    format: Literal["slatprep-asset-record"] = "slatprep-asset-record"
    format_version: Literal[1] = RECORD_VERSION
    asset_id: Annotated[str, MinLen(1)]
    """Id that its row would have."""
    object_id: str
    """PixieVerse id of the object."""
    view: str
    """Image or seed the SLAT was made from; empty if there is only one."""
    category: str
    """PixieVerse category; empty if unknown."""
    status: StatusOfFailed
    """``skipped`` if a partner is missing, ``failed`` otherwise."""
    reason: Annotated[str, MinLen(1)]
    """Why the asset is not in the store, in one line."""
    traceback: str = ""
    """Traceback of an internal error of slatprep; empty otherwise."""
    parameters: StageParameters
    """The parameters of the build."""
    versions: Versions
    """Versions of slatprep and of the libraries that were used."""
    code: Digest
    """Fingerprint of the code."""


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


@dataclass(frozen=True, eq=False, kw_only=True)
class BuildRecord:
    """One build of a store as a whole; each asset has a record of its own."""

    __pydantic_config__: ClassVar[dict[str, object]] = _CHECKED

    format: Literal["slatprep-build-record"] = "slatprep-build-record"
    format_version: Literal[1] = RECORD_VERSION
    id: Digest
    """SHA-256 of what decides the store, asset records included; its attribute ``manifest``."""
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
    """Name of the file of asset records beside this file; with a ``*`` if there are several."""
    parameters: BuildParameters
    """All parameters, with the places of the sources."""
    versions: Versions
    """Versions of slatprep and of its libraries."""
    normalization: Normalization
    """The ranges of the properties."""
    statuses: dict[Annotated[str, one_of(*map(str, Status))], Count]
    """Assets by status."""
    verdicts: dict[Annotated[str, one_of(*map(str, Verdict))], Count]
    """Assets in the store by verdict."""
    counts: BuildCounts
    """Voxels of the store."""
    failed: tuple[FailedRecord, ...] = ()
    """The assets that could not go in, by id; only the first of them if they are very many."""
