"""The typed records that travel between the stages.

Two source files become rows of the store through read, align, sample, judge, normalise and pack.
Each stage takes the records of the previous one and returns its own; no class here touches a disk.
Classes with arrays compare by identity.

Frames: the *PixieVerse frame* and the *SLAT frame* are both the unit cube [-0.5, 0.5]^3 with voxel
``i`` centred at ``(i + 0.5) / 64 - 0.5`` on each axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as with_default
from typing import Annotated

import numpy as np
from annotated_types import MaxLen, MinLen
from numpy.typing import NDArray

from slatprep.records.alignment import (
    MIRRORED,
    Agreement,
    Alignment,
    Ambiguity,
    Candidate,
    Consensus,
    Deformation,
    FitFigures,
    Ground,
    Judgement,
    LatentChoice,
    Placement,
    Quality,
)
from slatprep.records.json_types import Count, Digest, InJson, Number, Share, one_of
from slatprep.records.sources import (
    FACTORS,
    LATENT_ROLES,
    LOG10,
    AssetPair,
    MaterialField,
    Place,
    Plausibility,
    SourceFile,
    SourceRoots,
    StructuredLatents,
    Units,
    oddities_in,
    oddity,
    table_of,
    to_si,
)
from slatprep.records.tables import (
    BACKGROUND,
    CLASS_COLOURS,
    CLASS_NAME,
    COLOURS,
    FEATS_MEAN,
    FEATS_STD,
    INK,
    MANY_BACKGROUND,
    MATERIAL_CLASSES,
    MATERIAL_COLOURS,
    MAX_CHANNELS,
    MAX_LATENT_RESOLUTION,
    MAX_NAME_BYTES,
    MAX_PROPERTIES,
    MUTED,
    PICTURE_FORMATS,
    PIXIEVERSE,
    PROPERTIES,
    PROPERTY_COLUMNS,
    RESOLUTION,
    SVG_SALT,
    TRELLIS,
    UNANNOTATED,
    UNANNOTATED_COLOUR,
    USABLE,
    ClassName,
    Contents,
    Engine,
    LatentMoments,
    LatentSpace,
    Model,
    Property,
    PropertyName,
    Search,
    Status,
    Verdict,
    labels_of,
    words_of,
)


@dataclass(frozen=True, eq=False)
class Annotation:
    """Class and properties at every SLAT voxel, in SI units.

    ``properties`` is (N, P) float32, columns as in the field, NaN where not valid; ``material``
    (N,) uint8, 255 where not valid; ``valid`` (N,) bool. ``distance`` (N,) float32 is the distance
    to the annotation used, in voxels of the PixieVerse frame. ``place`` (N, 3) float32 is the
    voxel's place in that frame. ``confidence`` (N,) float32 is the probability that the class is
    right, 0 where not valid, None until judged.

    A merged annotation has ``spread`` (N, P) float32, the standard deviation of each property. It
    is in log10 if the property is normalised in log10, NaN where fewer than two annotations are
    valid. ``votes`` (N,) float32 are the share of valid annotations that give its class, 0 without
    any.
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
    """One of several annotations of an object, and its part in the merge."""

    sample: str
    """Name of the annotation."""
    sources: tuple[Count, ...]
    """Its files, as indices of the record's sources."""
    left_out: str = ""
    """Why it is not merged; empty if it is."""
    alignment: Alignment | None = None
    """The alignment of its own frame; null if that is the record's, or if it could not be read."""
    judgement: Judgement | None = None
    """The judgement of its alignment; null if it could not be read."""


@dataclass(frozen=True)
class PropertyRange:
    """The interval of a property that is mapped to [-1, 1].

    ``lo`` and ``hi`` are in the mapped unit: log10 of the SI value if ``log10``, else the SI value
    itself.
    """

    name: PropertyName
    log10: bool
    lo: float
    hi: float


@dataclass(frozen=True)
class Normalization:
    """The range of every property, in the order of the columns, and the origin of the ranges.

    ``source`` is ``dataset``, ``p1-p99`` or other percentiles of it, ``pixie``, or the name of a
    file. If only the training objects count, it ends in ``of train by`` and the rule of splits.
    """

    ranges: Annotated[tuple[PropertyRange, ...], MinLen(1), MaxLen(MAX_PROPERTIES)]
    source: str

    @property
    def spans(self) -> NDArray[np.float64]:
        """``lo`` and ``hi`` of each property, (P, 2)."""
        return np.array([(one.lo, one.hi) for one in self.ranges])


@dataclass(frozen=True, eq=False)
class Finished:
    """An asset, or one of its several annotations, after all stages, in SI units.

    A merged asset has a contribution for each annotation, the files of all annotations, and their
    digests by role for the asset's key. `field` and `alignment` are the first annotation's;
    `others` are the fields of the further annotations.
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
