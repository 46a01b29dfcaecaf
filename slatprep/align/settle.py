"""Take another one of an asset's tied placements, and fit there what its engine fits."""

from __future__ import annotations

from dataclasses import replace

from slatprep.align.quality import measure_quality
from slatprep.geometry.frames import displacement
from slatprep.parameters import AlignParameters
from slatprep.records import (
    Alignment,
    Consensus,
    Engine,
    LatentChoice,
    MaterialField,
    Model,
    Placement,
    StructuredLatents,
)


def take(
    alignment: Alignment, chosen: int, latents: StructuredLatents, by: Consensus | LatentChoice
) -> Alignment:
    """Exchange an alignment's placement for a tied one.

    Parameters
    ----------
    alignment : Alignment
        As an engine found it.
    chosen : int
        Number of the placement in ``placements``, from 0.
    latents : StructuredLatents
        The SLAT, over whose voxels displacements are measured.
    by : Consensus or LatentChoice
        What chose it.

    Returns
    -------
    Alignment
        With the transform of the chosen placement, `settled_by` set, and the
        placement that was left first among the placements. It has no
        deformation, and the old one's quality: `refit` gives it its own.
    """
    placement = alignment.placements[chosen]
    # Scores are relative to the best fit; the one that was left had it.
    left = Placement(alignment.transform, alignment.score, 0.0)
    others = [p for k, p in enumerate(alignment.placements) if k != chosen]
    return replace(
        alignment,
        transform=placement.transform,
        # A deformation was fitted to the placement that is left.
        model=Model.SIMILARITY if alignment.deformation is not None else alignment.model,
        deformation=None,
        figures=None,
        score=placement.score,
        placements=_apart_from(placement, (left, *others), latents),
        settled_by=by,
    )


def refit(
    alignment: Alignment,
    field: MaterialField,
    latents: StructuredLatents,
    parameters: AlignParameters,
) -> Alignment:
    """Fit at an alignment's placement what its engine fits at the one it chooses.

    Parameters
    ----------
    alignment : Alignment
        What `take` returned.
    field, latents : MaterialField, StructuredLatents
        The two sides; only their geometry is used.
    parameters : AlignParameters
        What the asset was aligned with.

    Returns
    -------
    Alignment
        With the quality measured there. Of the default engine also refined,
        its scale set to one if that fits as well, and deformed if that is earned.
    """
    if alignment.engine is Engine.FIELD:
        from slatprep.align.field import refined_at

        alignment = refined_at(alignment, field, latents, parameters)
        placement = Placement(alignment.transform, alignment.score, 0.0)
        others = _apart_from(placement, alignment.placements, latents)
        alignment = replace(alignment, placements=others)
    quality = measure_quality(
        field, latents, alignment.transform, parameters.radius, alignment.ground
    )
    return replace(alignment, quality=quality)


def _apart_from(
    placement: Placement, others: tuple[Placement, ...], latents: StructuredLatents
) -> tuple[Placement, ...]:
    return tuple(
        replace(p, displacement=displacement(p.transform, placement.transform, latents.centres))
        for p in others
    )
