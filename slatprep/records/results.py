"""What is looked up at SLAT voxels, the ranges it is normalised by, and what comes of an asset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as with_default
from typing import Annotated, Literal

import numpy as np
from annotated_types import MaxLen, MinLen
from numpy.typing import NDArray

from slatprep.records.alignment import Alignment, Judgement
from slatprep.records.json_types import Count
from slatprep.records.sources import AssetPair, MaterialField, SourceFile, StructuredLatents
from slatprep.records.tables import MAX_PROPERTIES, PropertyName
from slatprep.records.words import Status


@dataclass(frozen=True, eq=False)
class Annotation:
    """Material and properties looked up at every SLAT voxel, in SI units.

    ``properties`` is (N, P) float32 in SI units, columns as in the field, NaN
    where not valid; ``material`` (N,) uint8, 255 where
    not valid; ``valid`` (N,) bool; ``distance`` (N,) float32, in voxels of the
    PixieVerse frame, to the annotation used; ``place`` (N, 3) float32, where the
    voxel was looked up, in the PixieVerse frame; ``confidence`` (N,) float32, how
    likely the class is right, 0 where not valid, None until that is judged.

    Merged of several, it has ``spread`` (N, P) float32, the standard deviation of each
    property, of log10 where it is normalised so, NaN where fewer than two are valid; and
    ``votes`` (N,) float32, the share of the valid ones that give its class, 0 where none is.
    """

    properties: NDArray[np.float32]
    material: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    distance: NDArray[np.float32]
    place: NDArray[np.float32]
    confidence: NDArray[np.float32] | None = None
    spread: NDArray[np.float32] | None = None
    votes: NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class Contribution:
    """One of several annotations of an object, and what became of it in the merge."""

    sample: str
    """Which it is."""
    sources: tuple[Count, ...]
    """Its files, by their positions among the record's sources."""
    left_out: str = ""
    """Why it is no part of the merge; empty where it is."""
    alignment: Alignment | None = None
    """The transform from its own frame; null where it could not be read."""
    judgement: Judgement | None = None
    """What that alignment is worth."""


@dataclass(frozen=True)
class PropertyRange:
    """How one property is mapped to [-1, 1].

    ``lo`` and ``hi`` are in the mapped unit: log10 of the SI value where
    ``log10`` is true, the SI value itself otherwise.
    """

    name: PropertyName
    log10: bool
    lo: float
    hi: float


@dataclass(frozen=True)
class Normalization:
    """The range of every property, in the order of the columns, and where they come from.

    ``source`` is ``dataset``, ``p1-p99`` or other percentiles of it, either of which may
    be ``of train by`` what parts the objects; ``pixie``; or the name of a file.
    """

    ranges: Annotated[tuple[PropertyRange, ...], MinLen(1), MaxLen(MAX_PROPERTIES)]
    source: str


@dataclass(frozen=True, eq=False)
class Finished:
    """An asset that went through all stages; properties in SI units.

    Merged of several annotations, it has a contribution for each, the files of all with
    their digests by role, as an asset's key takes them, and the fields that were merged
    after the first, whose field and alignment are its own.
    """

    pair: AssetPair
    field: MaterialField
    latents: StructuredLatents
    alignment: Alignment
    annotation: Annotation
    judgement: Judgement
    contributions: tuple[Contribution, ...] = ()
    sources: tuple[SourceFile, ...] = ()
    digests: Mapping[str, str] = with_default(default_factory=dict)
    others: tuple[MaterialField, ...] = ()


@dataclass(frozen=True)
class Failed:
    """An asset that cannot go in.

    ``reason`` says why in one line; ``traceback`` where, if slatprep itself is
    at fault.
    """

    pair: AssetPair
    status: Literal[Status.FAILED, Status.SKIPPED]
    reason: str
    traceback: str = ""
