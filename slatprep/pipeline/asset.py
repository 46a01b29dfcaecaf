"""The way of one asset: from its two source files to annotated SLAT voxels.

`process_asset` is the method, stage by stage. `finish_asset` is the task a
worker gets: it does that, or uses what was done before, leaves the result in
the spool and turns an asset's faults into its status.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from slatprep.align import align
from slatprep.errors import MissingPartnerError, SlatprepError
from slatprep.judge import judge, measure_ambiguity
from slatprep.parameters import BuildParameters
from slatprep.pipeline.plan import Action, PlannedAsset, previous_record
from slatprep.pipeline.recipe import Recipe
from slatprep.pipeline.spool import Spool, SpooledAsset, key_of_failed
from slatprep.provenance import record as provenance
from slatprep.readers import read_field, read_latents
from slatprep.readers.identity import source_digests
from slatprep.records import (
    Alignment,
    AssetPair,
    AssetResult,
    MaterialField,
    Place,
    Status,
    StructuredLatents,
)
from slatprep.sample import sample


def process_asset(pair: AssetPair, parameters: BuildParameters) -> AssetResult:
    """Take one asset from its two source files to annotated SLAT voxels.

    Parameters
    ----------
    pair : AssetPair
        Where its files lie.
    parameters : BuildParameters
        How to align and to look up.

    Returns
    -------
    AssetResult
        With properties in SI units: ranges come from the whole dataset.

    Raises
    ------
    InputError
        If a source cannot be used or a partner is missing.
    """
    field, latents = read_field(pair), read_latents(pair)
    alignment = align(field, latents, parameters.align)
    return annotate_asset(pair, field, latents, alignment, parameters)


def annotate_asset(
    pair: AssetPair,
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    parameters: BuildParameters,
) -> AssetResult:
    """Look an aligned asset up, and say what its alignment is worth."""
    annotation = sample(field, latents.coords, alignment.transform, parameters.sample)
    ambiguity = measure_ambiguity(field, latents, alignment, annotation, parameters.sample)
    verdict, reasons = judge(alignment.quality, float(annotation.valid.mean()), ambiguity)
    return AssetResult(
        pair=pair,
        status=Status.OK,
        field=field,
        latents=latents,
        alignment=alignment,
        annotation=annotation,
        ambiguity=ambiguity,
        verdict=verdict,
        verdict_reasons=reasons,
    )


@dataclass(frozen=True)
class Bench:
    """What every task of a build has in common.

    Attributes
    ----------
    parameters : BuildParameters
        The build's.
    recipe : Recipe
        What they and the code come to.
    spool : Spool
        Where finished assets go.
    previous : (Place, str) or None
        The store that is there, and its build's id.
    strict : bool
        Raise an asset's fault instead of noting it.
    """

    parameters: BuildParameters
    recipe: Recipe
    spool: Spool
    previous: tuple[Place, str] | None
    strict: bool


def finish_asset(pair: AssetPair, planned: PlannedAsset | None, bench: Bench) -> SpooledAsset:
    """Bring one asset into the spool, with no more work than it needs.

    Parameters
    ----------
    pair : AssetPair
        Where its files lie.
    planned : PlannedAsset or None
        What was found of earlier work; None where there is none.
    bench : Bench
        The rest.

    Returns
    -------
    SpooledAsset
        An asset that cannot go in has a status that says so.

    Raises
    ------
    StoreError
        If the disk does not take it.
    SlatprepError
        With `strict`, the asset's own fault.
    """
    begin = time.perf_counter()
    if planned is not None and planned.action is Action.RESUME:
        finished = _resumed(planned, bench)
        if finished is not None:
            return finished
    try:
        result, key, alignment = _result_of(pair, planned, bench)
    except Exception as error:
        # A fault in one asset, even of slatprep's own, must not cost the others.
        if bench.strict:
            raise
        status = Status.SKIPPED if isinstance(error, MissingPartnerError) else Status.FAILED
        reason, trace = _reason(error)
        return put_failure(pair, status, reason, bench, time.perf_counter() - begin, trace)
    seconds = time.perf_counter() - begin
    code = bench.recipe.code
    record = provenance.asset_record(
        result, bench.parameters, seconds, code=code, key=key, alignment=alignment
    )
    return bench.spool.put(replace(result, record=record), key)


def worker_died(pair: AssetPair, planned: PlannedAsset | None, bench: Bench) -> SpooledAsset:
    """Note an asset that twice cost the worker its life, the second time alone."""
    reason = "its worker process was killed twice, probably because memory ran out"
    if bench.strict:
        raise SlatprepError(f"{pair.asset_id}: {reason}")
    return put_failure(pair, Status.FAILED, reason, bench)


def put_failure(
    pair: AssetPair,
    status: Status,
    reason: str,
    bench: Bench,
    seconds: float = 0.0,
    trace: str = "",
) -> SpooledAsset:
    """Leave the record of an asset that cannot go in."""
    result = AssetResult(pair, status, reason)
    record = provenance.asset_record(
        result, bench.parameters, seconds, code=bench.recipe.code, traceback=trace
    )
    return bench.spool.put(replace(result, record=record), key_of_failed(pair.asset_id))


def _result_of(
    pair: AssetPair, planned: PlannedAsset | None, bench: Bench
) -> tuple[AssetResult, str, Mapping[str, Any] | None]:
    """Return an asset's result, its key, and the alignment that a record told, if one did."""
    field, latents = read_field(pair), read_latents(pair)
    digests = source_digests(
        (*field.sources, *latents.sources), latents if pair.slat_group else None
    )
    key = bench.recipe.key(pair.asset_id, digests)
    record = None
    if planned is not None and planned.action is Action.REUSE:
        record = previous_record(bench.previous, pair.asset_id)
    if record is None or record["key"] != key:  # The files may have changed since the plan.
        alignment = align(field, latents, bench.parameters.align)
        return annotate_asset(pair, field, latents, alignment, bench.parameters), key, None
    transform = record["alignment"]["transform"]
    annotation = sample(field, latents.coords, transform, bench.parameters.sample)
    result = AssetResult(pair, Status.OK, field=field, latents=latents, annotation=annotation)
    return result, key, record["alignment"]


def _resumed(planned: PlannedAsset, bench: Bench) -> SpooledAsset | None:
    """Return what an interrupted build finished, under the names things have now."""
    finished = bench.spool.find(planned.key)
    if finished is None or not planned.names:
        return finished
    bench.spool.amend(planned.key, planned.names)
    return bench.spool.find(planned.key)


def _reason(error: Exception) -> tuple[str, str]:
    """Return why an asset cannot go in, in one line, and where slatprep itself is at fault."""
    line = " ".join(str(error).split())
    if isinstance(error, SlatprepError):
        return line, ""
    if isinstance(error, MemoryError):
        return f"memory ran out ({line or 'no more could be had'}); run with fewer jobs", ""
    reason = f"internal error, please report: {type(error).__name__}: {line}"
    return reason, traceback.format_exc()
