"""Align an object's annotations to the SLAT, look them up at its voxels, judge and merge them.

If there are several, each is aligned by itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from slatprep.align import align
from slatprep.errors import InputError
from slatprep.geometry.deformation import map_of
from slatprep.judge import judge, merged, voxel_confidence
from slatprep.parameters import BuildParameters, SampleParameters
from slatprep.readers import hash_sources, read_field, read_latents, source_digests
from slatprep.records import (
    Alignment,
    Annotation,
    AssetPair,
    Contribution,
    Finished,
    Judgement,
    MaterialField,
    SourceFile,
    StructuredLatents,
    Verdict,
)
from slatprep.sample import in_table, lacking, merge, sample
from slatprep.storage.faults import reached
from slatprep.store.record import MAX_SOURCES, StageParameters


def annotate(
    pair: AssetPair,
    field: MaterialField,
    latents: StructuredLatents,
    parameters: BuildParameters | StageParameters,
    alignment: Alignment | None = None,
    judgement: Judgement | None = None,
) -> Finished:
    """Align a field, look it up at the SLAT's voxels, and judge both.

    A given `alignment` or `judgement` of the same field and SLAT is used as it is.
    """
    reused = alignment is not None
    if alignment is None:
        alignment = align(field, latents, parameters.align)
    reached("asset reused" if reused else "asset aligned", pair.asset_id)
    annotation, judgement = look_up(field, latents, alignment, parameters.sample, judgement)
    return Finished(pair, field, latents, alignment, annotation, judgement)


def look_up(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    parameters: SampleParameters,
    judgement: Judgement | None = None,
) -> tuple[Annotation, Judgement]:
    """Look a field up at the SLAT's voxels, and judge both, unless a judgement is given."""
    annotation = sample(field, map_of(alignment).to_pixieverse(latents.centres), parameters)
    if judgement is None:
        judgement, likely = judge(field, latents, alignment, annotation, parameters)
    else:
        sure = judgement.confidence
        likely = voxel_confidence(field, latents, alignment, annotation, parameters, sure)
    return replace(annotation, confidence=likely), judgement


def process_several(
    pair: AssetPair, parameters: BuildParameters, known: tuple[Contribution, ...] = ()
) -> Finished:
    """Merge several annotations of an asset's object into one.

    An annotation is left out if it cannot be used, or if its alignment failed and another did not.
    Fields that occupy the same voxels share one alignment; results of an earlier build, `known`,
    are used. An annotation with only some properties, or without classes, adds to the others.
    Field, alignment, places and distances are those of the first merged annotation with all that
    the store holds. InputError if there is none, if the SLAT cannot be used, or if a file was
    replaced between its hashing, which gives the asset its key, and its reading.
    """
    sources, digests = hash_sources(pair)
    if len(sources) > MAX_SOURCES:
        what = f"has {len(pair.annotations):,} annotations in {len(sources):,} files to be merged"
        raise InputError(f"asset {pair.asset_id!r}", what, f"at most {MAX_SOURCES} files")
    annotated, faults = _annotations(pair, parameters, known, sources, digests)
    contents = pair.roots.contents
    good = [one for one in annotated if one.judgement.verdict is not Verdict.FAILED] or annotated
    lacks = {one.pair.sample: lacking(one.field, contents) for one in good}
    first = next((one for one in good if not lacks[one.pair.sample]), None)
    if first is None:
        what = "no annotation with all that the store holds can be used"
        reasons = [f"sample {sample} has no {', '.join(names)}" for sample, names in lacks.items()]
        reasons += [f"sample {sample}: {error}" for sample, error in faults.items()]
        raise _unusable(pair, what, reasons, "one that can be, to which others add")
    good = [first, *(one for one in good if one is not first)]
    parts = [in_table(one.annotation, one.field, contents) for one in good]
    annotation = merge(parts, contents.properties)
    told = {
        one.sample: Contribution(one.sample, (), faults[one.sample].below(one.roots.pixieverse))
        for one in pair.annotations
        if one.sample in faults
    }
    told |= {one.pair.sample: _contribution(one, first, one in good, sources) for one in annotated}
    contributions = tuple(told[one.sample] for one in pair.annotations)
    return replace(
        first,
        pair=pair,
        field=replace(first.field, warnings=_warnings(good, lacks, contributions)),
        annotation=annotation,
        judgement=merged(first.judgement, annotation),
        contributions=contributions,
        sources=sources,
        digests=digests,
        others=tuple(one.field for one in good[1:]),
    )


def _annotations(
    pair: AssetPair,
    parameters: BuildParameters,
    known: tuple[Contribution, ...],
    sources: tuple[SourceFile, ...],
    digests: Mapping[str, str],
) -> tuple[list[Finished], dict[str, InputError]]:
    """Return the annotations that can be used, and the faults of the others by sample."""
    before = {one.sample: one for one in known}
    latents: StructuredLatents | None = None
    annotated: list[Finished] = []
    faults: dict[str, InputError] = {}
    for one in pair.annotations:
        try:
            field = _in_order(read_field(one, parameters.sample.max_unphysical), pair)
        except InputError as error:
            faults[one.sample] = error
            continue
        if not set(field.sources) <= set(sources):
            raise _replaced(one)
        if latents is None:
            latents = read_latents(one)
            shared = latents if pair.slat_group else None
            if not source_digests(latents.sources, shared).items() <= digests.items():
                raise _replaced(one)
        found = before.get(one.sample)
        alignment = (found and found.alignment) or _same_alignment(field, annotated)
        judgement = found.judgement if found else None
        annotated.append(annotate(one, field, latents, parameters, alignment, judgement))
    if not annotated:
        if len(set(map(str, faults.values()))) == 1:
            raise next(iter(faults.values()))
        what = f"none of its {len(faults)} annotations can be used"
        reasons = [f"sample {sample}: {error}" for sample, error in faults.items()]
        raise _unusable(pair, what, reasons, "one that can be")
    return annotated, faults


def _in_order(field: MaterialField, pair: AssetPair) -> MaterialField:
    """Return a field with its properties in the order of the store."""
    own = [one.name for one in field.table]
    columns = [own.index(p.name) for p in pair.roots.contents.properties if p.name in own]
    table = tuple(field.table[column] for column in columns)
    return replace(field, properties=field.properties[:, columns], table=table)


def _warnings(
    good: list[Finished],
    lacks: Mapping[str, tuple[str, ...]],
    contributions: tuple[Contribution, ...],
) -> tuple[str, ...]:
    left_out = ((one.sample, one.left_out) for one in contributions if one.left_out)
    return (
        *(f"sample {one.pair.sample}: {text}" for one in good for text in one.field.warnings),
        *(f"sample {sample} has no {', '.join(names)}" for sample, names in lacks.items() if names),
        *(f"sample {sample} is left out: {why}" for sample, why in left_out),
    )


def _unusable(pair: AssetPair, what: str, reasons: Iterable[str], wanted: str) -> InputError:
    return InputError(f"asset {pair.asset_id!r}", f"{what} ({'; '.join(reasons)})", wanted)


def _replaced(one: AssetPair) -> InputError:
    what = f"a file of sample {one.sample} was replaced while the build read it"
    return InputError(f"asset {one.asset_id!r}", what, "files that stay; build again")


def _same_alignment(field: MaterialField, annotated: list[Finished]) -> Alignment | None:
    """Return the alignment of a field with the same geometry, as engines use nothing else."""
    for one in annotated:
        frames = [own.frame is None or own.frame.tobytes() for own in (field, one.field)]
        if frames[0] == frames[1] and np.array_equal(field.occupancy, one.field.occupancy):
            return one.alignment
    return None


def _contribution(
    one: Finished, first: Finished, is_good: bool, sources: tuple[SourceFile, ...]
) -> Contribution:
    """Return the contribution of an annotation that can be used; `first` is the record's."""
    left_out = "" if is_good else f"its alignment failed: {one.judgement.reasons[0]}"
    files = tuple(k for k, file in enumerate(sources) if file in one.field.sources)
    alignment = None if one.alignment is first.alignment else one.alignment
    return Contribution(one.pair.sample, files, left_out, alignment, one.judgement)
