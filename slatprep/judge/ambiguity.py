"""What ties between placements would change in the labels."""

from __future__ import annotations

import numpy as np

from slatprep.geometry.frames import places_of
from slatprep.normalize import property_extent, to_mapped
from slatprep.parameters import SampleParameters
from slatprep.records import Alignment, Ambiguity, Annotation, MaterialField, StructuredLatents
from slatprep.sample import sample

NOTABLE = 0.1
"""Share of a property's extent in the field from which on it counts as another one."""


MOST_VOXELS = 32_768
"""Voxels up to which each is looked at under ties: as many as TRELLIS trains on."""

FEWER = 4
"""Of more voxels at most a fourth of that number is looked at: enough for a share to 1 percent."""


def thinning(voxels: int) -> int:
    """Return how many times `MOST_VOXELS` go into the voxels of a SLAT, rounded up."""
    return max(1, -(-voxels // MOST_VOXELS))


def measure_ambiguity(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    annotation: Annotation,
    parameters: SampleParameters,
) -> Ambiguity:
    """Measure how the labels change between placements that fit about equally well.

    `annotation` is what was looked up under the alignment's transform; its ``placements`` tie with
    it. The share is of SLAT voxels whose class differs in any of them; without classes, a property
    by more than `NOTABLE`. The change of a property is the largest mean absolute one, of log10
    where it is normalised so, over the voxels valid in both. Of more than `MOST_VOXELS` voxels at
    most a fourth of that is looked at, evenly chosen.
    """
    times = thinning(len(latents.coords))
    # An odd step: an even one would, of a grid in order, take some layers alone.
    few = slice(None, None, FEWER * times + 1 if times > 1 else 1)
    centres = latents.centres[few]
    differs = np.zeros(len(centres), dtype=bool)
    change = np.zeros(len(field.table))
    if alignment.placements:
        if alignment.deformation is not None:
            # The others have no deformation, so the best is compared without its own.
            places = places_of(latents.centres, alignment.transform)
            annotation = sample(field, places, parameters, labels_alone=True)
        material, valid = annotation.material[few], annotation.valid[few]
        properties = annotation.properties[few]
        for placement in alignment.placements:
            places = places_of(centres, placement.transform)
            other = sample(field, places, parameters, labels_alone=True)
            differs |= other.material != material
            both = valid & other.valid
            if both.any():
                # Most voxels are looked up in the same place: there is nothing to take log10 of.
                columns = zip(properties.T, other.properties.T, strict=True)
                rows = np.flatnonzero(both & np.any([one != two for one, two in columns], axis=0))
                mapped = to_mapped(properties[rows], field.table)
                delta = np.abs(mapped - to_mapped(other.properties[rows], field.table))
                change = np.maximum(change, delta.sum(axis=0) / np.count_nonzero(both))
                if not field.classified:
                    span = np.ptp(property_extent(field), axis=1)
                    differs[rows] |= (delta > NOTABLE * span).any(axis=1)
    return Ambiguity(
        material_share=float(differs.mean()),
        property_change=tuple(change.tolist()),
    )
