"""Measure how the labels differ between tied placements."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.frames import places_of
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
    annotation: Annotation,
    parameters: SampleParameters,
) -> Ambiguity:
    """Measure how the labels change between placements that fit about equally well.

    `annotation` is the lookup under the alignment's transform, with which its ``placements`` tie.
    The share counts SLAT voxels whose class or properties differ (`far_apart`) in any of them. The
    change of a property is the largest mean absolute change, over the voxels valid in both; of
    log10 if it is normalised so.
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
        if alignment.deformation is not None:
            # The other placements have no deformation, so the best one is compared without it.
            places = places_of(latents.centres, alignment.transform)
            annotation = sample(field, places, parameters, labels_alone=True)
        material, valid = annotation.material[few], annotation.valid[few]
        properties = annotation.properties[few]
        for placement in alignment.placements:
            places = places_of(centres, placement.transform)
            other = sample(field, places, parameters, labels_alone=True)
            differs |= other.material != material
            both = valid & other.valid
            # Most voxels keep their properties, so log10 is taken of the changed ones only.
            columns = zip(properties.T, other.properties.T, strict=True)
            rows = np.flatnonzero(both & np.any([one != two for one, two in columns], axis=0))
            mapped = to_mapped(properties[rows], field.table)
            others = to_mapped(other.properties[rows], field.table)
            delta = np.abs(mapped - others).sum(axis=0)
            change = np.maximum(change, delta / max(1, np.count_nonzero(both)))
            differs[rows] |= far_apart(field, mapped, others)
    return Ambiguity(
        material_share=float(differs.mean()),
        property_change=tuple(change.tolist()),
    )


def far_apart(
    field: MaterialField, one: NDArray[np.float64], other: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which rows of two arrays of mapped properties (N, P) have notably different ones.

    A property differs by more than counts as the same where annotations are merged, and by more
    than `NOTABLE`.
    """
    least = NOTABLE * np.ptp(property_extent(field), axis=1)
    limits = same_within(np.maximum(np.abs(one), np.abs(other)), field.table, least)
    return np.asarray((np.abs(one - other) > limits).any(axis=1))
