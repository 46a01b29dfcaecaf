"""Measure how the labels differ between tied placements."""

from __future__ import annotations

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

MOST_VOXELS = 32_768
"""Largest number of voxels that are all compared under ties: as many as TRELLIS trains on."""

FEWER = 4
"""Larger SLATs compare at most `MOST_VOXELS` over this: enough for a share to 1 percent."""


def thinning(voxels: int) -> int:
    """Return the number of a SLAT's voxels over `MOST_VOXELS`, rounded up."""
    return max(1, -(-voxels // MOST_VOXELS))


def measure_ambiguity(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    parameters: SampleParameters,
) -> Ambiguity:
    """Measure how the labels change between placements that fit about equally well.

    The alignment's transform is compared with the ``placements`` that tie, without a deformation,
    as they have none. The share counts SLAT voxels that have other labels (`compare_labels`) in
    any of them. The change of a property is the largest mean absolute change, over the voxels valid
    in both; of log10 if it is normalised so.

    If there are more than `MOST_VOXELS` voxels, an even choice of at most a fourth of that number
    is compared.
    """
    times = thinning(len(latents.coords))
    # The step is odd, as an even one would take only some layers of a grid in order.
    few = slice(None, None, FEWER * times + 1 if times > 1 else 1)
    centres = latents.centres[few]
    differs = np.zeros(len(centres), dtype=bool)
    change = np.zeros(len(field.table))
    if alignment.placements:
        transforms = alignment.transform, *(one.transform for one in alignment.placements)
        best, *others = (
            sample(field, places_of(centres, transform), parameters, labels_alone=True)
            for transform in transforms
        )
        for other in others:
            own, mean = compare_labels(field, best, other)
            differs |= own
            change = np.maximum(change, mean)
    return Ambiguity(
        material_share=float(differs.mean()),
        property_change=tuple(change.tolist()),
    )


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
