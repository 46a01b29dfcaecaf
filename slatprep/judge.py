"""What an alignment is worth: what ties would change in the labels, and a verdict in one word."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slatprep.geometry.frames import places_of
from slatprep.normalize import to_mapped
from slatprep.parameters import SampleParameters
from slatprep.records import (
    Alignment,
    Ambiguity,
    Annotation,
    Judgement,
    MaterialField,
    Quality,
    StructuredLatents,
    Verdict,
)
from slatprep.sample import sample


@dataclass(frozen=True)
class Thresholds:
    """Where the verdicts part; docs/quality.md says how the numbers were chosen.

    Attributes
    ----------
    good_fitness, failed_fitness : float
        The lower one of the two fitnesses: at least the first is good, below
        the second is failed.
    good_valid_share : float
        Share of SLAT voxels with an annotation; below it the asset is doubtful.
    good_ambiguity : float
        Share of SLAT voxels whose class depends on the choice among placements
        that fit equally well; above it the asset is doubtful.
    """

    good_fitness: float = 0.8
    failed_fitness: float = 0.65
    good_valid_share: float = 0.9
    good_ambiguity: float = 0.05


THRESHOLDS = Thresholds()
"""The thresholds of `verdict_of`."""


def judge(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    annotation: Annotation,
    parameters: SampleParameters,
) -> Judgement:
    """Say what the alignment of an asset is worth.

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
    Judgement
        What ties would change, the verdict, and what kept it from being good.
    """
    ambiguity = measure_ambiguity(field, latents, alignment, annotation, parameters)
    verdict, reasons = verdict_of(
        alignment.quality,
        float(annotation.valid.mean()),
        ambiguity.material_share,
        len(alignment.placements),
    )
    return Judgement(ambiguity, verdict, reasons)


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
            annotation = sample(field, places, parameters)
        mapped = to_mapped(annotation.properties)
        for placement in alignment.placements:
            other = sample(field, places_of(latents.coords, placement.transform), parameters)
            differs |= other.material != annotation.material
            both = annotation.valid & other.valid
            if both.any():
                delta = np.abs(mapped - to_mapped(other.properties))[both]
                change = np.maximum(change, delta.mean(axis=0))
    return Ambiguity(
        material_share=float(differs.mean()),
        property_change=(float(change[0]), float(change[1]), float(change[2])),
    )


def verdict_of(
    quality: Quality, valid_share: float, ambiguity: float = 0.0, ties: int = 0
) -> tuple[Verdict, tuple[str, ...]]:
    """Say what an alignment is worth, and why.

    Parameters
    ----------
    quality : Quality
        How well the two surfaces lie on each other.
    valid_share : float
        Share of SLAT voxels that got an annotation, 0..1.
    ambiguity : float
        Share of SLAT voxels whose class depends on the choice among ties, 0..1.
    ties : int
        How many placements tie with the one chosen; 0 where that is not known.

    Returns
    -------
    verdict : Verdict
        ``good``, ``doubtful`` or ``failed``.
    reasons : tuple of str
        What kept it from being good; empty where it is.
    """
    limits = THRESHOLDS
    reasons = []
    failed = False
    sides = (
        ("PixieVerse boundary", quality.fitness),
        ("SLAT boundary", quality.fitness_backward),
    )
    for name, fitness in sides:
        if fitness < limits.good_fitness:
            reasons.append(
                f"only {fitness:.1%} of the {name} lies within {quality.radius:g} voxel of the "
                f"other side (good: {limits.good_fitness:.0%})"
            )
            failed = failed or fitness < limits.failed_fitness
    if valid_share < limits.good_valid_share:
        reasons.append(
            f"only {valid_share:.1%} of the SLAT voxels found an annotation "
            f"(good: {limits.good_valid_share:.0%})"
        )
    if ambiguity > limits.good_ambiguity:
        count = f"{ties} other" if ties else "other"
        reasons.append(
            f"{count} placements fit about as well and would change the "
            f"class of {ambiguity:.1%} of the voxels "
            f"(good: {limits.good_ambiguity:.0%})"
        )
    if failed:
        return Verdict.FAILED, tuple(reasons)
    return (Verdict.DOUBTFUL if reasons else Verdict.GOOD), tuple(reasons)
