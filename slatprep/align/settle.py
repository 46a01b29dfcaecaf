"""Take another of an asset's tied placements, and refit it with the asset's engine."""

from __future__ import annotations

import math
from dataclasses import replace

from slatprep.align.quality import measure_quality
from slatprep.geometry.frames import Array, displacement
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
    """Replace an alignment's placement by entry `chosen` of its `placements`.

    The old placement becomes the first of the placements. The result has no deformation, and still
    the old placement's quality, which `refit` replaces.
    """
    placement = alignment.placements[chosen]
    # `_apart_from` sets the displacement.
    left = Placement(alignment.transform, alignment.score, 0.0)
    others = [p for k, p in enumerate(alignment.placements) if k != chosen]
    return replace(
        alignment,
        transform=placement.transform,
        # The deformation was fitted to the old placement.
        model=Model.SIMILARITY if alignment.deformation is not None else alignment.model,
        deformation=None,
        figures=None,
        score=placement.score,
        margin=math.nan,  # Its score may be below that of the placement that was left.
        placements=_apart_from(placement.transform, (left, *others), latents),
        settled_by=by,
    )


def refit(
    alignment: Alignment,
    field: MaterialField,
    latents: StructuredLatents,
    parameters: AlignParameters,
) -> Alignment:
    """Refit the placement that `take` chose, as the engine does with its own choice.

    The quality is measured anew. The default engine also refines the placement, sets its scale to
    one if that fits as well, and deforms it if that is earned.
    """
    if alignment.engine is Engine.FIELD:
        from slatprep.align.field import refined_at

        alignment = refined_at(alignment, field, latents, parameters)
        others = _apart_from(alignment.transform, alignment.placements, latents)
        alignment = replace(alignment, placements=others)
    quality = measure_quality(
        field, latents, alignment.transform, parameters.radius, alignment.ground
    )
    return replace(alignment, quality=quality)


def _apart_from(
    transform: Array, others: tuple[Placement, ...], latents: StructuredLatents
) -> tuple[Placement, ...]:
    return tuple(
        replace(p, displacement=displacement(p.transform, transform, latents.centres))
        for p in others
    )
