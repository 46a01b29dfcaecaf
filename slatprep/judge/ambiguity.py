"""What ties between placements would change in the labels."""

from __future__ import annotations

import numpy as np

from slatprep.geometry.frames import places_of
from slatprep.normalize import to_mapped
from slatprep.parameters import SampleParameters
from slatprep.records import Alignment, Ambiguity, Annotation, MaterialField, StructuredLatents
from slatprep.sample import sample


def measure_ambiguity(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    annotation: Annotation,
    parameters: SampleParameters,
) -> Ambiguity:
    """Measure how the labels change between placements that fit about equally well.

    Parameters
    ----------
    field, latents : MaterialField, StructuredLatents
        The two sides of the asset.
    alignment : Alignment
        Its alignment; ``placements`` are the ones that tie with the best.
    annotation : Annotation
        What was looked up under its transform.
    parameters : SampleParameters
        How annotations are looked up.

    Returns
    -------
    Ambiguity
        The share of SLAT voxels whose class differs in any of the placements,
        and the largest mean absolute change of log10 Young's modulus, log10
        density and Poisson's ratio over the voxels valid in both.
    """
    differs = np.zeros(len(latents.coords), dtype=bool)
    change = np.zeros(3)
    if alignment.placements:
        if alignment.deformation is not None:
            # The others are known without a deformation: like is compared with like.
            places = places_of(latents.coords, alignment.transform)
            annotation = sample(field, places, parameters, labels_alone=True)
        mapped = to_mapped(annotation.properties)
        for placement in alignment.placements:
            places = places_of(latents.coords, placement.transform)
            other = sample(field, places, parameters, labels_alone=True)
            differs |= other.material != annotation.material
            both = annotation.valid & other.valid
            if both.any():
                delta = np.abs(mapped - to_mapped(other.properties))[both]
                change = np.maximum(change, delta.mean(axis=0))
    return Ambiguity(
        material_share=float(differs.mean()),
        property_change=(float(change[0]), float(change[1]), float(change[2])),
    )
