"""Build a store: every asset of a dataset, brought to one scale and packed.

`slatprep.pipeline.asset` is the way of one asset; `build_store` runs it over a
dataset, for what is new or changed, and replaces the store in one step.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from slatprep.errors import StoreError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.assemble import assemble
from slatprep.pipeline.asset import fail_asset, finish_asset, process_asset
from slatprep.pipeline.carry import Carried, KeptAsset, Row, in_order, kept_assets
from slatprep.pipeline.consensus import apply_consensus
from slatprep.pipeline.context import BuildContext
from slatprep.pipeline.kernels import compile_kernels
from slatprep.pipeline.pack import latent_warnings, settled_contents
from slatprep.pipeline.plan import Action, BuildPlan, PlannedAsset, plan_assets
from slatprep.pipeline.previous import previous_build, store_there
from slatprep.pipeline.publish import Destination, publish_manifests
from slatprep.pipeline.ranges import check_objects, given_ranges, source_of
from slatprep.pipeline.recipe import recipe_of
from slatprep.pipeline.seen import Found
from slatprep.pipeline.spool import FailedAsset, Spool, SpooledAsset
from slatprep.pipeline.summary import (
    BuildSummary,
    counts_in,
    counts_of,
    nothing_usable,
    summarise_build,
)
from slatprep.pipeline.update import (
    Looked,
    Wanted,
    found_before,
    is_current,
    is_untouched,
    repeat_summary,
)
from slatprep.pipeline.witness import apply_witness
from slatprep.pipeline.work import work_beside, work_directory
from slatprep.provenance.record_json import write_records
from slatprep.readers import contents_of, discover
from slatprep.records import AssetPair, Place
from slatprep.storage.atomic import staged, writing
from slatprep.store import open_store
from slatprep.workers.local import Jobs, at_most, require_shared, run_unordered

__all__ = [
    "BuildPlan",
    "BuildSummary",
    "Progress",
    "align_pairs",
    "build_store",
    "plan_build",
    "process_asset",
]

Progress = Callable[[int, int], None]
"""Called with the assets done and the assets in all; at the beginning with none done."""

Note = Callable[[str], None]
"""Called with a line for the user."""


def build_store(
    parameters: BuildParameters,
    out: str | Place,
    *,
    manifests: str | Place | None = None,
    jobs: Jobs = 1,
    strict: bool = False,
    fresh: bool = False,
    keep_work: bool = False,
    rehash: bool = False,
    compact: bool = False,
    assets_per_job: int = 1,
    progress: Progress | None = None,
    note: Note | None = None,
) -> BuildSummary:
    """Build a store of all assets of a dataset, or bring it up to date, with the records of how.

    Parameters
    ----------
    parameters : BuildParameters
        Sources and methods.
    out : str or Place
        The store, a path or URL. One that is there is replaced, in one step, when the new
        one is finished; assets that did not change are not aligned again.
    manifests : str or Path, optional
        Directory of ``assets.jsonl`` and ``build.json``; by default beside the
        store, see `slatprep.provenance.places.manifests_of`.
    jobs : int or Workers
        Worker processes, or a `slatprep.workers.dask.Cluster`. The store's bytes do
        not depend on it.
    strict : bool
        Raise at the first asset that cannot be used instead of going on.
    fresh : bool
        Do everything, whatever was done before.
    keep_work : bool
        Keep each asset's arrays beside the store, about a megabyte an asset, so that
        the next build can pack all of them anew without reading their sources.
    rehash : bool
        Hash all sources, also those whose size, times and inode are as they were.
    compact : bool
        Order rows by id, as in a first build, where updates have added some behind.
    assets_per_job : int
        Start no more processes than there are so many assets for.
    progress : callable, optional
        See `Progress`.
    note : callable, optional
        Gets lines for the user, such as what takes long before the first asset.

    Returns
    -------
    BuildSummary
        What went in and what did not.

    Raises
    ------
    StoreError
        If `out` is something other than a store, another build is writing it,
        no asset can be used, or the disk does not take what is written.
    InputError
        With `strict`, for the first asset that cannot be used.
    """
    begin = time.perf_counter()
    place = Destination(out, manifests)
    declared = contents_of(parameters)
    given = given_ranges(parameters.normalize, declared.properties)
    wanted = Wanted(given or source_of(parameters.normalize), compact, declared)
    with work_beside(place.store, fresh=fresh, keep=keep_work) as work:
        place.look()
        pairs = _discover(parameters, jobs, work.scratch)
        check_objects(pairs, parameters.normalize)
        jobs = at_most(len(pairs) // assets_per_job, jobs)
        there = None if fresh else store_there(place.store)
        context = BuildContext(parameters, recipe_of(parameters), work.spool, there, strict)
        looked = Looked.at(pairs, context, place, rehash)
        if is_untouched(looked, pairs, context, place.records(), wanted):
            clipped = looked.seen.rows["clipped"].sum(axis=0)
            seconds = time.perf_counter() - begin
            return repeat_summary([], context, place, seconds, clipped, untouched=True)
        previous, damaged = (None, ()) if fresh else previous_build(place.store, jobs)
        context = replace(context, previous=previous)
        known = {} if damaged else looked.known
        few = at_most((len(pairs) - len(known)) // assets_per_job, jobs)
        plan = _plan(pairs, context, few, progress, known)
        new, unchanged = _split(pairs, plan)
        _compile(plan, few, note)
        assets = _finish(new, plan, context, few, progress)
        keys = {pair.asset_id: plan[pair.asset_id].key for pair in unchanged}
        unmade = not any(isinstance(asset, SpooledAsset) for asset in assets)
        intact = previous is not None and not damaged and unmade
        found = found_before(keys, previous, looked.seen) if previous and intact else {}
        if intact and is_current(plan, assets, context, wanted, found):
            clipped = np.sum([one.clipped for one in found.values()], axis=0)
            seconds = time.perf_counter() - begin
            summary = repeat_summary(assets, context, place, seconds, clipped, untouched=False)
            looked.note(summary, place, found)
            return summary
        kept = None
        if not damaged and not keep_work:
            made = [asset for asset in assets if isinstance(asset, SpooledAsset)]
            kept = kept_assets(unchanged, plan, made, context, looked.seen, given, declared)
        if kept is None:
            assets += _finish(unchanged, plan, context, jobs, progress)
        else:
            jobs = few
        usable, failed = _usable_and_failed(assets, kept or [], parameters, pairs)
        keys = {asset.asset_id: asset.key for asset in usable}
        if kept is None:
            made = [asset for asset in usable if isinstance(asset, SpooledAsset)]
            made = apply_consensus(made, work.spool, parameters, jobs, note)
            usable = list(apply_witness(made, work.spool, parameters, jobs, note))
        contents = settled_contents(usable, declared, parameters.slat.standardised)
        usable = in_order(usable, previous, compact)
        carried = Carried(previous, usable) if kept and previous else None
        with writing(str(place.out), work_directory(place.store).parent):
            packed = assemble(usable, failed, given, work, parameters, jobs, contents, carried)
            counts = counts_in(open_store(packed.store))
            place.replace(packed.store)
        told = (asset for asset in usable if isinstance(asset, SpooledAsset) and asset.damaged)
        summary = summarise_build(
            counts,
            failed,
            store=place.out,
            records=place.records(),
            build_id=packed.build_id,
            seconds=time.perf_counter() - begin,
            normalization=packed.normalization,
            clipped=packed.clipped.sum(axis=0),
            warnings=latent_warnings(usable, contents.latents, parameters.slat.standardised),
            damaged=(*damaged, *(f"{asset.asset_id}: {asset.damaged}" for asset in told)),
        )
        publish_manifests(packed.records, summary, parameters)
        place.publish()
        clips = zip(usable, packed.clipped, strict=True)
        found = {a.asset_id: Found(keys[a.asset_id], a.extent, c, a.latents) for a, c in clips}
        looked.note(summary, place, found)
        if keep_work:
            work.spool.keep_only({asset.key for asset in usable})
    return summary


def plan_build(
    parameters: BuildParameters,
    out: str | Place,
    *,
    jobs: Jobs = 1,
    fresh: bool = False,
    rehash: bool = False,
    progress: Progress | None = None,
) -> BuildPlan:
    """Say what `build_store` would do with each asset, and why; nothing is written.

    Parameters
    ----------
    parameters, out, jobs, fresh, rehash, progress
        As for `build_store`.

    Returns
    -------
    BuildPlan
        An entry an asset.
    """
    place = Destination(out)
    spool = Spool(work_directory(place.store) / ("nothing" if fresh else "spool"))
    pairs = _discover(parameters, jobs)
    previous, damaged = (None, ()) if fresh else previous_build(place.store, jobs)
    context = BuildContext(parameters, recipe_of(parameters), spool, previous, strict=False)
    known = {} if damaged else Looked.at(pairs, context, place, rehash).known
    plan = plan_assets(pairs, context, jobs, progress, known)
    return BuildPlan(place.out, tuple(plan), damaged)


def align_pairs(
    parameters: BuildParameters,
    out: str | Path,
    *,
    jobs: Jobs = 1,
    strict: bool = False,
    assets_per_job: int = 1,
    progress: Progress | None = None,
    note: Note | None = None,
) -> BuildSummary:
    """Align all assets of a dataset and write their records, without a store.

    Parameters
    ----------
    parameters : BuildParameters
        Sources and methods.
    out : str or Path
        JSON Lines file of asset records, sorted by asset id, in the form of a
        build's ``assets.jsonl``; ``normalization`` is null.
    jobs, strict, assets_per_job, progress, note
        As for `build_store`.

    Returns
    -------
    BuildSummary
        What went in and what did not.

    Raises
    ------
    InputError
        With `strict`, for the first asset that cannot be used.
    """
    begin = time.perf_counter()
    out = Path(out)
    with work_beside(out.absolute(), arrays=False) as work:
        context = BuildContext(parameters, recipe_of(parameters), work.spool, None, strict)
        pairs = _discover(parameters, jobs, work.scratch)
        jobs = at_most(len(pairs) // assets_per_job, jobs)
        plan = _plan(pairs, context, jobs, progress)
        _compile(plan, jobs, note)
        assets = _finish(pairs, plan, context, jobs, progress)
        assets.sort(key=lambda asset: asset.asset_id)
        with writing(str(out), out.parent), staged(out) as file:
            build_id = write_records(file, (work.spool.record(asset.key) for asset in assets))
    seconds = time.perf_counter() - begin
    failed = [asset for asset in assets if isinstance(asset, FailedAsset)]
    counts = counts_of(asset for asset in assets if isinstance(asset, SpooledAsset))
    return summarise_build(counts, failed, records=out, build_id=build_id, seconds=seconds)


def _discover(parameters: BuildParameters, jobs: Jobs, *shared: Path) -> list[AssetPair]:
    """Return the pairs; see that the workers find the first one's files, and `shared`."""
    pairs = discover(parameters)
    sources = next(([pair.grid, pair.slat] for pair in pairs if pair.grid and pair.slat), [])
    require_shared(jobs, [*shared, *sources])
    return pairs


def _plan(
    pairs: Sequence[AssetPair],
    context: BuildContext,
    jobs: Jobs,
    progress: Progress | None,
    known: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, PlannedAsset]:
    """Return what is to be done by asset id; nothing where nothing was done before."""
    if context.previous is None and not context.spool.holds_any():
        return {}
    plan = plan_assets(pairs, context, jobs, progress, known)
    return {asset.asset_id: asset for asset in plan}


def _compile(plan: Mapping[str, PlannedAsset], jobs: Jobs, note: Note | None) -> None:
    """Compile before workers of this machine start, unless nothing will be aligned."""
    aligns = any(asset.action is Action.ALIGN for asset in plan.values())
    if isinstance(jobs, int) and (aligns or not plan):
        compile_kernels(note)


def _split(
    pairs: Iterable[AssetPair], plan: Mapping[str, PlannedAsset]
) -> tuple[list[AssetPair], list[AssetPair]]:
    """Return the pairs that are new or changed, and those whose alignment is in the store."""
    split: tuple[list[AssetPair], list[AssetPair]] = ([], [])
    for pair in pairs:
        planned = plan.get(pair.asset_id)
        split[planned is not None and planned.action is Action.REUSE].append(pair)
    return split


def _finish(
    pairs: Sequence[AssetPair],
    plan: Mapping[str, PlannedAsset],
    context: BuildContext,
    jobs: Jobs,
    progress: Progress | None,
) -> list[SpooledAsset | FailedAsset]:
    """Bring assets into the spool; return what is kept of each, in no order."""
    tasks = ((pair, plan.get(pair.asset_id), context) for pair in pairs)
    assets: list[SpooledAsset | FailedAsset] = []
    if progress and pairs:
        progress(0, len(pairs))
    for asset in run_unordered(finish_asset, tasks, jobs, fail_asset):
        assets.append(asset)
        if progress:
            progress(len(assets), len(pairs))
    return assets


def _usable_and_failed(
    assets: Iterable[SpooledAsset | FailedAsset],
    kept: Sequence[KeptAsset],
    parameters: BuildParameters,
    pairs: Sequence[AssetPair],
) -> tuple[list[Row], list[FailedAsset]]:
    """Return the assets that go into the store and those that do not, each by id."""
    by_id = sorted((*assets, *kept), key=lambda asset: asset.asset_id)
    usable: list[Row] = [asset for asset in by_id if not isinstance(asset, FailedAsset)]
    failed = [asset for asset in by_id if isinstance(asset, FailedAsset)]
    if not usable:
        raise StoreError(nothing_usable(failed, parameters, pairs))
    return usable, failed
