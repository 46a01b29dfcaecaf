"""Measure how the labels differ between tied placements."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.frames import Array, places_of
from slatprep.normalize import property_extent, to_mapped
from slatprep.parameters import SampleParameters
from slatprep.records import Alignment, Ambiguity, Annotation, MaterialField, StructuredLatents
from slatprep.sample import same_within, sample

NOTABLE = 0.1
"""Smallest change of a property that counts, as a share of its extent in the field."""

HARMLESS = 0.05
"""Largest share of voxels whose labels change between ties that count as one placement."""

MOST_VOXELS = 32_768
"""Largest number of voxels that are all compared under ties: as many as TRELLIS trains on."""

FEWER = 4
"""Most ties of larger SLATs are compared at `MOST_VOXELS` over this: enough for a share to 1 %."""


def measure_ambiguity(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    annotation: Annotation,
    parameters: SampleParameters,
) -> tuple[Ambiguity, NDArray[np.float32]]:
    """Measure how the labels change between placements that fit about equally well.

    The alignment's transform is compared with the ``placements`` that tie, without a deformation,
    as they have none; `annotation` is the lookup under the alignment. The share counts SLAT voxels
    that have other labels (`compare_labels`) in any of them. The change of a property is the
    largest mean absolute change, over the voxels valid in both; of log10 if it is normalised so.

    The second result is `Surroundings.tied` (N,). If there are more than `MOST_VOXELS` voxels, it
    follows from some of the ties, and an even choice of voxels tells the share and the change.
    """
    ties, by = alignment.placements, alignment.settled_by
    best, differs = annotation, np.zeros(len(latents.coords), dtype=bool)
    change, tied = np.zeros(len(field.table)), np.zeros(len(differs), dtype=np.float32)
    times = max(1, -(-len(differs) // MOST_VOXELS))
    # The step is odd, as an even one would take only some layers of a grid in order.
    every, few = slice(None), slice(None, None, FEWER * times + 1 if times > 1 else 1)

    def under(transform: Array, rows: slice) -> Annotation:
        places = places_of(latents.centres[rows], transform)
        return sample(field, places, parameters, labels_alone=True)

    if ties and alignment.deformation is not None:
        best = under(alignment.transform, every)
    some = range(0, len(ties), times)
    for number, placement in enumerate(ties):
        rows = every if number in some else few
        other = under(placement.transform, rows)
        own, mean = compare_labels(field, _labels_at(best, rows), other)
        differs[rows] |= own
        change = np.maximum(change, mean)
        if rows is every:
            tied += own & other.valid
    if ties:
        others = len(ties) / (len(ties) + 1)
        tied *= np.float32(others / len(some))
        if tied.mean() <= HARMLESS:
            tied[:] = 0.0  # Ties count as one: the chosen labels are right as often.
        elif by is not None:
            tied *= np.float32(np.nan_to_num(1.0 - by.probability) / others)
    share = float(differs[few].mean())
    return Ambiguity(material_share=share, property_change=tuple(change.tolist())), tied


def _labels_at(annotation: Annotation, rows: slice) -> Annotation:
    names = "properties", "material", "valid"
    return replace(annotation, **{name: getattr(annotation, name)[rows] for name in names})


def compare_labels(
    field: MaterialField, one: Annotation, other: Annotation
) -> tuple[NDArray[np.bool_], Array]:
    """Return which voxels (N,) have other labels in `other`, and the mean changes (P,).

    Other labels are another class, or notably other properties. A property, compared where both
    are valid, must differ by more than counts as the same where annotations are merged. If it is
    not normalised in log10, it must also differ by `NOTABLE`.
    """
    differs, both = one.material != other.material, one.valid & other.valid
    # Most voxels keep their properties, so log10 is taken of the changed ones only.
    columns = zip(one.properties.T, other.properties.T, strict=True)
    rows = np.flatnonzero(both & np.any([own != its for own, its in columns], axis=0))
    first, second = (to_mapped(of.properties[rows], field.table) for of in (one, other))
    delta = np.abs(first - second)
    limits = same_within(np.maximum(np.abs(first), np.abs(second)), field.table, notable(field))
    differs[rows] |= (delta > limits).any(axis=1)
    return differs, delta.sum(axis=0) / max(1, np.count_nonzero(both))


@lru_cache(maxsize=1)
def notable(field: MaterialField) -> Array:
    """Return `NOTABLE` changes (P,) of a field's properties, 0 for those in log10."""
    spans = np.ptp(property_extent(field), axis=1)
    return np.where([one.log10 for one in field.table], 0.0, NOTABLE * spans)
