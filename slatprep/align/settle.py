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
    """Exchange an alignment's placement for number `chosen` of its `placements`.

    The placement that was left comes first among the placements. The result has no deformation, and
    the old placement's quality: `refit` gives it its own.
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
    """Fit at the placement that `take` chose what the engine fits at the one it chooses.

    The quality is measured there. The default engine also refines the placement, sets its scale to
    one if that fits as well, and deforms it if that is earned.
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
