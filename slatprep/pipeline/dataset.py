"""Build a store: every asset of a dataset, brought to one scale and packed.

`slatprep.pipeline.asset` is the way of one asset; `build_store` runs it over a
dataset, for what is new or changed, and replaces the store in one step.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.asset import fail_asset, finish_asset, process_asset
from slatprep.pipeline.consensus import apply_consensus
from slatprep.pipeline.context import BuildContext
from slatprep.pipeline.kernels import compile_kernels
from slatprep.pipeline.pack import latent_warnings, pack_store, settled_contents
from slatprep.pipeline.plan import Action, BuildPlan, PlannedAsset, plan_assets
from slatprep.pipeline.previous import previous_build
from slatprep.pipeline.publish import Destination, publish_manifests, write_all_records
from slatprep.pipeline.ranges import check_objects, dataset_ranges, given_ranges, source_of
from slatprep.pipeline.recipe import recipe_of
from slatprep.pipeline.spool import FailedAsset, Spool, SpooledAsset
from slatprep.pipeline.summary import BuildSummary, nothing_usable, summarise_build
from slatprep.pipeline.update import is_current, repeat_summary
from slatprep.pipeline.witness import apply_witness
from slatprep.pipeline.work import Work, work_beside, work_directory
from slatprep.provenance.make import complete_record, origin
from slatprep.provenance.record import AssetRecord, Clipped, Record
from slatprep.provenance.record_json import write_records
from slatprep.readers import contents_of, discover
from slatprep.records import AssetPair, Contents, Normalization, Place
from slatprep.storage.atomic import staged, writing
from slatprep.store.writer import finish_store
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
        Keep each asset's arrays beside the store, about a megabyte an asset,
        so that the next build does not even read unchanged assets twice.
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
    source = given.source if given else source_of(parameters.normalize)
    with work_beside(place.store, fresh=fresh, keep=keep_work) as work:
        place.look()
        pairs = _discover(parameters, jobs, work.scratch)
        check_objects(pairs, parameters.normalize)
        jobs = at_most(len(pairs) // assets_per_job, jobs)
        previous, damaged = (None, ()) if fresh else previous_build(place.store, jobs)
        context = BuildContext(parameters, recipe_of(parameters), work.spool, previous, strict)
        plan = _plan(pairs, context, jobs, progress)
        new, unchanged = _split(pairs, plan)
        _compile(plan, jobs, note)
        assets = _finish(new, plan, context, jobs, progress)
        if not damaged and is_current(plan, assets, context, given or source, declared):
            return repeat_summary(assets, context, place, time.perf_counter() - begin)
        assets += _finish(unchanged, plan, context, jobs, progress)
        usable, failed = _usable_and_failed(assets, parameters, pairs)
        usable = apply_consensus(usable, work.spool, parameters, jobs, note)
        usable = apply_witness(usable, work.spool, parameters, jobs, note)
        with writing(str(place.out), work_directory(place.store).parent):
            contents = settled_contents(usable, declared, parameters.slat.standardised)
            packed = _pack(usable, failed, given, work, parameters, jobs, contents)
            place.replace(packed.store)
        summary = summarise_build(
            [*usable, *failed],
            store=place.out,
            records=place.records(),
            build_id=packed.build_id,
            seconds=time.perf_counter() - begin,
            normalization=packed.normalization,
            clipped=packed.clipped,
            damaged=damaged,
            warnings=latent_warnings(usable, contents.latents, parameters.slat.standardised),
        )
        publish_manifests(packed.records, summary, parameters)
        place.publish()
        if keep_work:
            work.spool.keep_only({asset.key for asset in usable})
    return summary


def plan_build(
    parameters: BuildParameters,
    out: str | Place,
    *,
    jobs: Jobs = 1,
    fresh: bool = False,
    progress: Progress | None = None,
) -> BuildPlan:
    """Say what `build_store` would do with each asset, and why; nothing is written.

    Parameters
    ----------
    parameters, out, jobs, fresh, progress
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
    return BuildPlan(place.out, tuple(plan_assets(pairs, context, jobs, progress)), damaged)


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
    return summarise_build(assets, records=out, build_id=build_id, seconds=seconds)


def _discover(parameters: BuildParameters, jobs: Jobs, *shared: Path) -> list[AssetPair]:
    """Return the pairs; see that the workers find the first one's files, and `shared`."""
    pairs = discover(parameters)
    sources = next(([pair.grid, pair.slat] for pair in pairs if pair.grid and pair.slat), [])
    require_shared(jobs, [*shared, *sources])
    return pairs


def _plan(
    pairs: Sequence[AssetPair], context: BuildContext, jobs: Jobs, progress: Progress | None
) -> dict[str, PlannedAsset]:
    """Return what is to be done by asset id; nothing where nothing was done before."""
    if context.previous is None and not context.spool.holds_any():
        return {}
    return {asset.asset_id: asset for asset in plan_assets(pairs, context, jobs, progress)}


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


@dataclass(frozen=True)
class _Packed:
    """A new store that is not in place yet, and what goes into the summary of it."""

    store: Path
    records: Path
    build_id: str
    normalization: Normalization
    clipped: Sequence[Clipped]


def _usable_and_failed(
    assets: Iterable[SpooledAsset | FailedAsset],
    parameters: BuildParameters,
    pairs: Sequence[AssetPair],
) -> tuple[list[SpooledAsset], list[FailedAsset]]:
    """Return the assets that go into the store and those that do not, each by id."""
    by_id = sorted(assets, key=lambda asset: asset.asset_id)
    usable = [asset for asset in by_id if isinstance(asset, SpooledAsset)]
    failed = [asset for asset in by_id if isinstance(asset, FailedAsset)]
    if not usable:
        raise StoreError(nothing_usable(failed, parameters, pairs))
    return usable, failed


def _pack(
    usable: Sequence[SpooledAsset],
    failed: Sequence[FailedAsset],
    given: Normalization | None,
    work: Work,
    parameters: BuildParameters,
    jobs: Jobs,
    contents: Contents,
) -> _Packed:
    """Normalise and pack the rows of a store, then its records and its root attributes."""
    normalization = given or dataset_ranges(
        usable, work.spool, parameters.normalize, jobs, contents.properties
    )
    store, records = work.scratch / "store.zarr", work.scratch / "assets.jsonl"
    clipped = pack_store(store, work.spool, usable, normalization, parameters.store, jobs, contents)
    completed = _completed_records(work.spool, usable, failed, normalization, clipped)
    build_id = write_all_records(store, records, completed)
    finish_store(store, normalization, build_id, origin(parameters), contents)
    return _Packed(store, records, build_id, normalization, clipped)


def _completed_records(
    spool: Spool,
    usable: Sequence[SpooledAsset],
    failed: Sequence[FailedAsset],
    normalization: Normalization,
    clipped: Sequence[Clipped],
) -> Iterator[Record]:
    """Yield the records of a build by asset id, with the ranges and what they clip."""
    clips = dict(zip((asset.asset_id for asset in usable), clipped, strict=True))
    everything: list[SpooledAsset | FailedAsset] = [*usable, *failed]
    for asset in sorted(everything, key=lambda asset: asset.asset_id):
        record = spool.record(asset.key)
        if isinstance(record, AssetRecord):
            record = complete_record(record, normalization, clips[asset.asset_id])
        yield record
