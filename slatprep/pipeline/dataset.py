"""Build a store: every asset of a dataset, brought to one scale and packed.

`slatprep.pipeline.asset` tells the way of one asset; `build_store` runs it over a
dataset, for what is new or changed, and replaces the store in one step.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.asset import Bench, finish_asset, process_asset, worker_died
from slatprep.pipeline.consensus import settle_ties
from slatprep.pipeline.pack import (
    by_property,
    dataset_ranges,
    given_ranges,
    pack_store,
)
from slatprep.pipeline.plan import Action, BuildPlan, PlannedAsset, plan_assets
from slatprep.pipeline.publish import publish_manifests, write_all_records
from slatprep.pipeline.recipe import recipe_of
from slatprep.pipeline.spool import Spool, SpooledAsset
from slatprep.pipeline.summary import BuildSummary, summarise
from slatprep.pipeline.update import (
    is_current,
    nothing_usable,
    places_of,
    previous_build,
    repeat_summary,
)
from slatprep.pipeline.work import work_beside, work_directory
from slatprep.provenance import record as provenance
from slatprep.provenance.places import manifests_of
from slatprep.readers import discover
from slatprep.records import AssetPair, Normalization, Place, Status
from slatprep.storage.atomic import replace_directory, staged, writing
from slatprep.storage.place import place_of
from slatprep.storage.remote import RemotePlace
from slatprep.storage.upload import published_state, upload_store
from slatprep.store.writer import finish_store
from slatprep.workers.local import Jobs, require_shared, run_unordered

__all__ = [
    "BuildPlan",
    "BuildSummary",
    "Progress",
    "align_pairs",
    "build_store",
    "default_manifests",
    "plan_build",
    "process_asset",
]

Progress = Callable[[int, int], None]
"""Called with the assets done and the assets in all."""

_OTHERS = tuple(action for action in Action if action is not Action.REUSE)


def build_store(
    parameters: BuildParameters,
    out: str | Place,
    *,
    manifests: str | Place | None = None,
    jobs: Jobs = 1,
    strict: bool = False,
    fresh: bool = False,
    keep_work: bool = False,
    progress: Progress | None = None,
) -> BuildSummary:
    """Build a store of all assets of a dataset, or bring it up to date, with the records of how.

    Parameters
    ----------
    parameters : BuildParameters
        Sources and methods.
    out : str or Place
        The store. One that is there is replaced, in one step, when the new
        one is finished; assets that did not change are not aligned again.
    manifests : str or Path, optional
        Directory of ``assets.jsonl`` and ``build.json``; by default beside the
        store, see `default_manifests`.
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
    progress : callable, optional
        See `Progress`.

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
    out = place_of(out)
    target, manifests = places_of(out, manifests)
    given = given_ranges(parameters.normalize)
    with work_beside(target, keep=keep_work) as work:
        if fresh:
            work.spool.keep_only(set())
        require_shared(jobs, [work.scratch, *_some_sources(parameters)])
        base = published_state(target) if isinstance(target, RemotePlace) else None
        previous = None if fresh else previous_build(target)
        bench = Bench(parameters, recipe_of(parameters), work.spool, previous, strict)
        plan = _plan_if_any(bench, jobs, progress)
        assets = _finish_all(bench, plan, _OTHERS, jobs, progress)
        usable = any(asset.status is Status.OK for asset in assets)
        if not usable and previous and is_current(plan, assets, bench, given):
            folder = manifests or default_manifests(out if base is None else previous[0])
            return repeat_summary(
                assets, bench, store=out, manifests=folder, seconds=time.perf_counter() - begin
            )
        assets += _finish_all(bench, plan, (Action.REUSE,), jobs, progress)
        assets.sort(key=lambda asset: asset.asset_id)
        if parameters.consensus.settle:
            assets = settle_ties(assets, work.spool, parameters, jobs)
        usable_assets = [asset for asset in assets if asset.status is Status.OK]
        if not usable_assets:
            raise StoreError(nothing_usable(assets, parameters))
        normalization = given or dataset_ranges(usable_assets)
        new, records_file = work.scratch / "store.zarr", work.scratch / "assets.jsonl"
        with writing(str(out), work_directory(target).parent):
            clipped = pack_store(
                new, work.spool, usable_assets, normalization, parameters.store, jobs
            )
            records = _completed_records(work.spool, assets, normalization, clipped)
            manifest = write_all_records(new, records_file, records)
            finish_store(new, normalization, manifest, provenance.origin(parameters))
            if isinstance(target, Path):
                replace_directory(new, target)
        upload = None if base is None else upload_store(new, base)
        folder = manifests or default_manifests(upload.version if upload else out)
        summary = summarise(
            assets,
            store=out,
            records=folder / "assets.jsonl",
            manifest=manifest,
            normalization=normalization,
            clipped=by_property(clipped["voxel"]),
            seconds=time.perf_counter() - begin,
        )
        publish_manifests(records_file, summary, parameters)
        if upload is not None:
            upload.publish()
        if keep_work:
            work.spool.keep_only({asset.key for asset in usable_assets})
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
    out = place_of(out)
    target, _ = places_of(out, None)
    directory = work_directory(target) / "spool"
    spool = Spool(directory) if directory.is_dir() and not fresh else None
    require_shared(jobs, _some_sources(parameters))
    previous = None if fresh else previous_build(target)
    assets = plan_assets(parameters, recipe_of(parameters), spool, previous, jobs, progress)
    return BuildPlan(out, tuple(sorted(assets, key=lambda asset: asset.asset_id)))


def align_pairs(
    parameters: BuildParameters,
    out: Path,
    *,
    jobs: Jobs = 1,
    strict: bool = False,
    progress: Progress | None = None,
) -> BuildSummary:
    """Align all assets of a dataset and write their records, without a store.

    Parameters
    ----------
    parameters : BuildParameters
        Sources and methods.
    out : Path
        JSON Lines file of asset records, sorted by asset id, in the form of a
        build's ``assets.jsonl``; ``normalization`` is null.
    jobs, strict, progress
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
        require_shared(jobs, [work.scratch, *_some_sources(parameters)])
        bench = Bench(parameters, recipe_of(parameters), work.spool, None, strict)
        plan = _plan_if_any(bench, jobs, progress)
        assets = _finish_all(bench, plan, tuple(Action), jobs, progress)
        assets.sort(key=lambda asset: asset.asset_id)
        with writing(str(out), out.parent), staged(out) as file:
            records = (work.spool.record(asset.key) for asset in assets)
            manifest = provenance.write_records(file, records)
    seconds = time.perf_counter() - begin
    return summarise(assets, records=out, manifest=manifest, seconds=seconds)


def default_manifests(store: Place) -> Place:
    """Return the directory of a store's records: ``demo.manifests`` beside ``demo.zarr``."""
    return manifests_of(store)


def _plan_if_any(
    bench: Bench, jobs: Jobs, progress: Progress | None
) -> dict[str, PlannedAsset] | None:
    """Return what is to be done by asset id, or None where nothing was done before."""
    if bench.previous is None and not bench.spool.holds_any():
        return None
    spool = bench.spool if bench.spool.holds_any() else None
    assets = plan_assets(bench.parameters, bench.recipe, spool, bench.previous, jobs, progress)
    return {asset.asset_id: asset for asset in assets}


def _some_sources(parameters: BuildParameters) -> Iterator[Place]:
    """Yield the files of a pair, by which to see that a worker has the sources."""
    for pair in discover(parameters):
        if pair.grid and pair.slat:
            yield from (pair.grid, pair.slat)
            return


def _finish_all(
    bench: Bench,
    plan: dict[str, PlannedAsset] | None,
    actions: tuple[Action, ...],
    jobs: Jobs,
    progress: Progress | None,
) -> list[SpooledAsset]:
    """Bring every asset with one of these actions into the spool; return what is kept of each."""

    def chosen() -> Iterator[tuple[AssetPair, PlannedAsset | None]]:
        for pair in discover(bench.parameters):
            planned = plan.get(pair.asset_id) if plan else None
            if planned is None or planned.action in actions:
                yield pair, planned

    if plan is None and Action.ALIGN not in actions:
        return []
    # Listing names twice is cheap; holding a list of all pairs is not.
    total = sum(1 for _ in chosen()) if progress else 0
    tasks = ((pair, planned, bench) for pair, planned in chosen())
    assets = []
    for asset in run_unordered(finish_asset, tasks, jobs, worker_died):
        assets.append(asset)
        if progress:
            progress(len(assets), max(total, len(assets)))
    return assets


def _completed_records(
    spool: Spool,
    assets: Sequence[SpooledAsset],
    normalization: Normalization,
    clipped: dict[str, NDArray[np.int64]],
) -> Iterator[dict[str, Any]]:
    counts = zip(clipped["voxel"], clipped["grid"], strict=True)
    for asset in assets:
        record = spool.record(asset.key)
        if asset.status is Status.OK:
            record = provenance.complete_record(record, normalization, *next(counts))
        yield record
