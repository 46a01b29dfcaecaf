"""One annotation of an object: aligned to the SLAT, looked up at its voxels, judged."""

from __future__ import annotations

from dataclasses import dataclass, replace

from slatprep.align import align
from slatprep.align.deformation import map_of
from slatprep.judge import judge, voxel_confidence
from slatprep.parameters import BuildParameters
from slatprep.provenance.record import StageParameters
from slatprep.records import (
    Alignment,
    Annotation,
    AssetPair,
    Judgement,
    MaterialField,
    StructuredLatents,
)
from slatprep.sample import sample
from slatprep.storage.faults import reached


@dataclass(frozen=True, eq=False)
class Annotated:
    """One annotation of an object, looked up at the SLAT's voxels through its own alignment."""

    pair: AssetPair
    field: MaterialField
    alignment: Alignment
    judgement: Judgement
    annotation: Annotation


def annotate(
    pair: AssetPair,
    field: MaterialField,
    latents: StructuredLatents,
    parameters: BuildParameters | StageParameters,
    alignment: Alignment | None = None,
    judgement: Judgement | None = None,
) -> Annotated:
    """Align a field, look it up at the SLAT's voxels, and judge both.

    Parameters
    ----------
    pair : AssetPair
        Where the files of both sides lie.
    field : MaterialField
        The annotation, in the PixieVerse frame.
    latents : StructuredLatents
        The SLAT.
    parameters : BuildParameters or StageParameters
        How to align and to look up.
    alignment, judgement : Alignment and Judgement, optional
        What is known of the same field and SLAT; it stands.
    """
    reused = alignment is not None
    if alignment is None:
        alignment = align(field, latents, parameters.align)
    reached("asset reused" if reused else "asset aligned", pair.asset_id)
    annotation = sample(field, map_of(alignment).to_pixieverse(latents.centres), parameters.sample)
    if judgement is None:
        judgement, likely = judge(field, latents, alignment, annotation, parameters.sample)
    else:
        confidence = judgement.confidence
        likely = voxel_confidence(field, latents, alignment, annotation, confidence)
    return Annotated(pair, field, alignment, judgement, replace(annotation, confidence=likely))
