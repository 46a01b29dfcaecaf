"""Process one asset, from its two source files to annotated SLAT voxels.

`process_asset` runs the stages. `finish_asset` is the task of a worker: it
runs the stages or uses earlier results, writes the result to the spool, and
turns an asset's faults into its status. `compile_kernels` runs all stages once
before workers start. Numba compiles a kernel at its first call and keeps it on disk; without that,
each worker would compile all kernels, at the same time.
"""

from __future__ import annotations

import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from joblib.externals.loky import cpu_count
from numba.core import event

from slatprep.align import align
from slatprep.align.deform import deform_if_earned
from slatprep.align.pose import Similarity
from slatprep.align.surface import surfaces_of
from slatprep.errors import InputError, MissingPartnerError, SlatprepError, StoreError, in_unicode
from slatprep.geometry.deformation import map_of
from slatprep.geometry.frames import voxel_centres
from slatprep.geometry.kernel import KEPT
from slatprep.geometry.voxels import voxels_of
from slatprep.judge import judge
from slatprep.parameters import AlignParameters, BuildParameters, SampleParameters
from slatprep.pipeline.annotate import annotate, process_several
from slatprep.pipeline.plan import Action, BuildContext, PlannedAsset
from slatprep.pipeline.recipe import Recipe, record_of, record_of_failed
from slatprep.pipeline.rows import Row
from slatprep.pipeline.seen import as_read
from slatprep.pipeline.spool import Spool
from slatprep.readers import read_field, read_latents, reading_of, source_digests
from slatprep.records import (
    RESOLUTION,
    AssetPair,
    Finished,
    MaterialField,
    Model,
    Status,
    StructuredLatents,
)
from slatprep.sample import sample
from slatprep.storage.faults import reached
from slatprep.storage.states import noting
from slatprep.store.record import AssetRecord, FailedRecord, StatusOfFailed
from slatprep.store.record_json import faults_of

_REASON, _TRACEBACK = 4_000, 100_000
"""Largest lengths of a failure's reason and traceback, which may contain a stranger's names."""

_DIFFERS = "what the store holds of it is not what its record and its sources give"


def process_asset(
    pair: AssetPair, parameters: BuildParameters, known: AssetRecord | None = None
) -> Finished:
    """Take one asset from its two source files to annotated SLAT voxels, in SI units.

    `known` is an earlier build's record of the same sources, parameters and code; its alignment and
    judgement are taken over. InputError if a source cannot be used or a partner is missing.
    """
    if pair.others:
        return process_several(pair, parameters, known.contributions if known else ())
    field = read_field(pair, parameters.sample.max_unphysical)
    latents = read_latents(pair)
    reached("asset read", pair.asset_id)
    alignment, judgement = (known.alignment, known.judgement) if known else (None, None)
    return annotate(pair, field, latents, parameters, alignment, judgement)


def finish_asset(
    pair: AssetPair, planned: PlannedAsset, context: BuildContext
) -> Row | FailedRecord:
    """Bring one asset into the spool, with no more work than it needs; return its row.

    `planned` says which earlier work can be used. StoreError if the spool cannot be written; with
    `strict`, the asset's own fault is raised.
    """
    reached("asset begun", pair.asset_id)
    if planned.action is Action.RESUME and (resumed := _resumed(planned, context.spool)):
        return resumed
    try:
        with noting() as noted:
            repeated = _repeated(pair, planned, context)
            asset = repeated or process_asset(pair, context.parameters)
        key = _key(asset, context.recipe)
        record = record_of(asset, context.recipe, key)
        if faults := faults_of(record):
            what = f"what was found is more than a record may hold ({'; '.join(faults[:3])})"
            expected = "fewer annotations" if pair.others else "sources of a usual kind"
            raise InputError(f"asset {pair.asset_id!r}", what, expected)
    except Exception as error:
        # A fault in one asset, even of slatprep's own, must not cost the others.
        if context.strict:
            raise
        return record_of_failed(pair, context.recipe, *_why(error))
    row = context.spool.put(record, asset.field, asset.latents, asset.annotation, asset.others)
    aligned = repeated is None
    # With another key its sources changed since the plan, and the store was right.
    differs = aligned and planned.action is Action.REUSE and planned.key == key
    damaged = _DIFFERS if differs else ""
    return replace(row, damaged=damaged, seen=as_read(pair, noted), aligned=aligned)


def fail_asset(pair: AssetPair, planned: PlannedAsset, context: BuildContext) -> FailedRecord:
    """Record as failed an asset that killed its worker twice, the second time alone."""
    reason = "its worker process was killed twice, probably because memory ran out"
    if context.strict:
        raise SlatprepError(f"{pair.asset_id}: {reason}")
    return record_of_failed(pair, context.recipe, reason)


def _repeated(pair: AssetPair, planned: PlannedAsset, context: BuildContext) -> Finished | None:
    """Return an asset made anew by its stored record; None if no record is still valid."""
    if context.previous is None or planned.action is not Action.REUSE:
        return None
    try:
        known = context.previous.record(pair.asset_id)
    except StoreError:
        return None
    asset = process_asset(pair, context.parameters, known)
    same = _key(asset, context.recipe) == planned.key and context.previous.has_labels_of(asset)
    return asset if same else None


def _key(asset: Finished, recipe: Recipe) -> str:
    """Return the key that follows from the sources as they were read."""
    digests = asset.digests  # Of merged annotations, hashed before they were read.
    if not digests:
        sources = asset.field.sources + asset.latents.sources
        shared = asset.latents if asset.pair.slat_group else None
        digests = source_digests(sources, shared) | reading_of(asset.pair.roots)
    return recipe.key(asset.pair.asset_id, digests)


def _resumed(planned: PlannedAsset, spool: Spool) -> Row | None:
    """Return the row of an asset that an interrupted build finished, with its current names."""
    found = spool.find(planned.key)
    if found and planned.names:
        spool.amend(replace(found[0], **planned.names))
        found = spool.find(planned.key)
    return found and replace(found[1], seen=planned.seen)


def _why(error: Exception) -> tuple[str, str, StatusOfFailed]:
    """Return a failure's reason in one line, the traceback of an internal error, the status."""
    line, trace = in_unicode(" ".join(str(error).split())), ""
    if len(line) > _REASON:
        line = f"{line[:_REASON]} ..."
    if isinstance(error, MemoryError):
        line = f"memory ran out ({line or 'no more could be had'}); run with fewer jobs"
    elif not isinstance(error, SlatprepError):
        line = f"internal error, please report: {type(error).__name__}: {line}"
        trace = in_unicode(traceback.format_exc())[-_TRACEBACK:]
    missing = isinstance(error, MissingPartnerError)
    return line, trace, Status.SKIPPED if missing else Status.FAILED


WHEN = (
    "once after installing"
    if KEPT
    else "in each process, as no cache folder can be written to (NUMBA_CACHE_DIR names one)"
)
"""Words for the user on when kernels are compiled."""


class _Watch(event.Listener):
    """Starts a second process when the first kernel has been compiled, and notes it."""

    def __init__(self, note: Callable[[str], None] | None) -> None:
        self.note = note
        self.helper: subprocess.Popen[bytes] | None = None
        self._depth = 0

    def on_start(self, _event: Any) -> None:
        self._depth += 1

    def on_end(self, _event: Any) -> None:
        self._depth -= 1
        if self._depth or self.helper is not None:
            return
        if KEPT and cpu_count() > 1:
            code = "from slatprep.pipeline.asset import _compile_others; _compile_others()"
            self.helper = subprocess.Popen([sys.executable, "-c", code])
        if self.note:
            self.note(f"compiling the numerical kernels, {WHEN}; it may take a minute")
        self.note = None


def compile_kernels(note: Callable[[str], None] | None = None) -> None:
    """Compile all kernels of alignment, sampling and judgement, and keep them on disk.

    `note` is called with a line if a kernel must be compiled, and again at the end. A second
    process compiles half of the kernels. If all are compiled already, this takes 1 s, once per
    process.
    """
    start, watch = time.monotonic(), _Watch(note)
    try:
        with event.install_listener("numba:compile", watch):
            _process_a_bent_shape()
        if watch.helper is not None:
            watch.helper.wait()
    except BaseException:
        if watch.helper is not None:
            watch.helper.kill()
        raise
    if note and watch.note is None:
        note(f"compiled in {time.monotonic() - start:.0f} s")


def _bent_shape() -> tuple[MaterialField, StructuredLatents]:
    """Return an L-shaped field, and its SLAT, which is bent, stretched, and has a stray voxel."""
    occupied = np.zeros((RESOLUTION,) * 3, dtype=bool)
    occupied[20:44, 22:36, 26:34] = occupied[20:26, 22:36, 34:50] = True
    voxels = voxels_of(occupied)
    count = len(voxels)
    material, properties = np.zeros(count, np.uint8), np.ones((count, 3), np.float32)
    field = MaterialField(occupied, voxels, material, properties)
    bent = voxels.copy()
    bent[:, 2] += ((bent[:, 0] - 20) ** 2 // 25).astype(np.uint8)
    bent = np.append(bent, np.zeros((1, 3), np.uint8), axis=0)  # far from every annotated voxel
    return field, StructuredLatents(bent, np.zeros((len(bent), 8), np.float32))


@cache
def _process_a_bent_shape() -> None:
    """Align, sample and judge the bent shape, once per process."""
    field, latents = _bent_shape()
    alignment = align(field, latents, AlignParameters(model="deformable"))
    annotation = sample(field, map_of(alignment).places(latents.coords), SampleParameters())
    judge(field, latents, alignment, annotation, SampleParameters())


def _compile_others() -> None:
    """Deform and sample without a search, whose kernels take as long to compile as all others."""
    field, latents = _bent_shape()
    sides, parameters = surfaces_of(field, latents), AlignParameters(model="deformable")
    deform_if_earned(*sides, Similarity(np.eye(3), np.zeros(3), 1.0), Model.SIMILARITY, parameters)
    sample(field, voxel_centres(latents.coords), SampleParameters())
