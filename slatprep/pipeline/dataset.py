"""Build a store: normalise and pack every asset of a dataset.

`slatprep.pipeline.asset` processes one asset; `build_store` runs it over the
new and changed assets of a dataset, and replaces the store in one step. Its
steps are: discover, look back, plan, finish, settle, pack, publish.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from slatprep.errors import ConfigError, SlatprepError
from slatprep.parameters import BuildParameters
from slatprep.parameters.files import checked
from slatprep.pipeline.before import SHARE, Before, look_back
from slatprep.pipeline.decoys import DECOYS, measure_build
from slatprep.pipeline.destination import Destination, require_free
from slatprep.pipeline.measured import writable_file
from slatprep.pipeline.notices import dataset_notices, moved_ranges, much_clipped
from slatprep.pipeline.pack import pack_store
from slatprep.pipeline.plan import (
    Action,
    BuildContext,
    BuildPlan,
    Crew,
    Note,
    PlannedAsset,
    plan_assets,
    why_taken_out,
)
from slatprep.pipeline.publish import BuildSummary, counts_of, publish_build, summarise
from slatprep.pipeline.recipe import Wanted, recipe_of
from slatprep.pipeline.rows import NextStore, Row
from slatprep.pipeline.settle import check_objects, kept_rows, settle_rows
from slatprep.pipeline.spool import Spool
from slatprep.pipeline.work import spool_of, work_beside
from slatprep.readers import discover
from slatprep.readers.published import fetch_members
from slatprep.records import AssetPair, Normalization, Place
from slatprep.storage.atomic import staged, telling_if_stopped, writing
from slatprep.storage.place import storage_of
from slatprep.storage.work import require_work_folder
from slatprep.store.reader import require_outside
from slatprep.store.record import FailedRecord
from slatprep.store.record_json import build_id_of, digest_of, to_json
from slatprep.store.records import ASSETS
from slatprep.workers import Progress, counted
from slatprep.workers.local import Jobs, require_shared, run_unordered, start_early

__all__ = ["BuildPlan", "BuildSummary", "Progress", "align_pairs", "build_store", "plan_build"]


_BROUGHT_ABOUT = (OSError, ArithmeticError, ValueError, MemoryError, RuntimeError, SlatprepError)
"""Errors that data and machines cause, unlike faults of slatprep itself."""


def build_store(
    parameters: BuildParameters,
    out: str | Place,
    *,
    manifests: str | Place | None = None,
    jobs: Jobs = 1,
    strict: bool = False,
    fresh: bool = False,
    keep_work: bool = False,
    rehash: float = SHARE,
    rehash_seed: int | None = None,
    compact: bool = False,
    decoys: int = DECOYS,
    assets_per_job: int = 1,
    progress: Progress | None = None,
    note: Note | None = None,
) -> BuildSummary:
    """Build a store of all assets of a dataset, or bring it up to date, with its records.

    Parameters
    ----------
    parameters : BuildParameters
        Sources and methods.
    out : str or Place
        The store, a path or URL. An existing store is replaced, in one step, when the new
        store is finished; assets that did not change are not aligned again.
    manifests : str or Path, optional
        Directory of ``assets.jsonl`` and ``build.json``; by default beside the
        store, see `slatprep.store.records.manifests_of`.
    jobs : int or Workers
        Worker processes, or a `slatprep.workers.dask.Cluster`. The store's bytes do
        not depend on it.
    strict : bool
        Raise at the first asset that cannot be used instead of going on.
    fresh : bool
        Do everything anew, even if it was done before.
    keep_work : bool
        Keep each asset's arrays beside the store, about a megabyte an asset, so that
        the next build can pack all of them anew without reading their sources.
    rehash : float
        Share of the sources to hash, drawn at random from those whose files look unchanged;
        True, or 1, for all. If one of them has changed, all are hashed.
    rehash_seed : int, optional
        Seed of that draw; by default the clock. The summary has it.
    compact : bool
        Order rows by id, as in a first build, even if updates have added rows at the end.
    decoys : int
        Largest number of decoys for measuring errors, see `slatprep.pipeline.decoys`; 0 for none.
        The result lies beside the store, whose bytes do not depend on it.
    assets_per_job : int
        Least number of assets for each process that is started.
    progress : callable, optional
        See `Progress`.
    note : callable, optional
        Called with lines for the user, such as on long work before the first asset.

    Returns
    -------
    BuildSummary
        Summary of the assets that went in, and of those that did not.

    Raises
    ------
    ConfigError
        If `out` is something other than a store, or a parameter is invalid.
    StoreError
        If another build is writing the store, no asset can be used, or the store cannot be
        written.
    InputError
        With `strict`, for the first asset that cannot be used.
    """
    begin = time.perf_counter()
    parameters = checked(BuildParameters, parameters)
    crew = Crew(jobs, assets_per_job, progress, note)
    place, wanted = Destination(out, manifests), Wanted.of(parameters, compact)
    if decoys:
        writable_file(place.store)
    private_disks = not isinstance(jobs, int)
    folder = work_beside(
        place.store, fresh=fresh, keep=keep_work, look=place.look, private_disks=private_disks
    )
    with telling_if_stopped(place.if_stopped), folder as work:
        pairs = _discover(parameters, jobs, work.shared(), note=note)
        before = look_back(place, pairs, wanted, crew, fresh, rehash, rehash_seed)
        if before.suffices and not keep_work:
            return _publish(before, begin)
        before = before.checked(crew.of(len(pairs)))
        context = BuildContext(parameters, wanted.recipe, work.spool, before.previous, strict)
        plan = plan_assets(pairs, context, crew, before.known)
        assets = _finish_all(pairs, plan, context, crew, before, keep_work=keep_work)
        new, failed = settle_rows(assets, before, context, crew)
        spooled = [row for row in new.rows if row.spooled]
        changed = not before.holds(new)
        taken = pack_store(work, place, new, crew.of(len(spooled))) if changed else None
        summary = _publish(before, begin, new, taken, failed)
        if keep_work:
            work.keep_only({row.key for row in spooled})
        made = sum(plan[one].action is not Action.REUSE for one in new.ids)
        return _measured(summary, before, made, decoys, crew) if changed else summary


def _finish_all(
    pairs: Sequence[AssetPair],
    plan: Mapping[str, PlannedAsset],
    context: BuildContext,
    crew: Crew,
    before: Before,
    *,
    keep_work: bool,
) -> list[Row | FailedRecord]:
    """Return all assets; unchanged ones stay rows of the existing store if that is possible.

    With `keep_work`, all are brought into the spool.
    """
    reused = [pair for pair in pairs if plan[pair.asset_id].action is Action.REUSE]
    others = [pair for pair in pairs if plan[pair.asset_id].action is not Action.REUSE]
    made = finish(others, plan, context, crew)
    kept = None if keep_work else kept_rows(made, reused, plan, before)
    return made + (finish(reused, plan, context, crew) if kept is None else kept)


def finish(
    pairs: Sequence[AssetPair], plan: Mapping[str, PlannedAsset], context: BuildContext, crew: Crew
) -> list[Row | FailedRecord]:
    """Bring assets into the spool; return the row or failure of each, in no order.

    `plan` has the planned action of each asset by id.
    """
    if not pairs:
        return []
    # Imported late: a run without changes needs neither numba nor scipy.
    from slatprep.pipeline.asset import compile_kernels, fail_asset, finish_asset

    jobs = crew.of(len(pairs))
    read = [pair for pair in pairs if plan[pair.asset_id].action is Action.ALIGN]
    if isinstance(jobs, int) and read:
        start_early(finish_asset, jobs)
        fetch_members(read, crew.note)
        compile_kernels(crew.note)  # Otherwise each worker of this machine compiles all of them.
    tasks = ((pair, plan[pair.asset_id], context) for pair in pairs)
    if crew.progress:
        crew.progress(0, len(pairs))
    made = run_unordered(finish_asset, tasks, jobs, fail_asset)
    return list(counted(made, len(pairs), crew.progress))


def plan_build(
    parameters: BuildParameters,
    out: str | Place,
    *,
    manifests: str | Place | None = None,
    jobs: Jobs = 1,
    fresh: bool = False,
    rehash: bool = False,
    decoys: int = DECOYS,
    progress: Progress | None = None,
    note: Note | None = None,
) -> BuildPlan:
    """Return what `build_store` would do with each asset, and why; write nothing.

    Another's files where the store, its work folder and its records go are refused as by the build.
    """
    parameters = checked(BuildParameters, parameters)
    place, wanted = Destination(out, manifests), Wanted.of(parameters)
    if decoys:
        writable_file(place.store)
    require_work_folder(place.store)
    place.look()
    crew = Crew(jobs, progress=progress)
    spool = spool_of(place.store, private_disks=not isinstance(jobs, int))
    if fresh:
        spool = Spool(storage_of(place.store).work_folder() / "nothing")
    pairs = _discover(parameters, jobs, note=note)
    before = look_back(place, pairs, wanted, crew, fresh, float(rehash)).checked(jobs)
    context = BuildContext(parameters, wanted.recipe, spool, before.previous, strict=False)
    plan = plan_assets(pairs, context, crew, before.known, ahead=True)
    absent = {one.asset_id for one in plan.values() if one.action in (Action.REFUSE, Action.SKIP)}
    gone, ranges = place.lost({pair.asset_id for pair in pairs} - absent, "is")
    moved = moved_ranges(wanted.ranges, ranges) if isinstance(wanted.ranges, Normalization) else ()
    taken_out = why_taken_out(gone, absent)
    return BuildPlan(place.out, tuple(plan.values()), before.damaged, taken_out, tuple(moved))


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

    `out` is a JSON Lines file in the form of a build's ``assets.jsonl``, sorted by asset id; it
    includes assets that cannot be used. Other parameters are as for `build_store`. InputError with
    `strict`, for the first asset that cannot be used. ConfigError if `out` lies in a store, or is
    a file without records.
    """
    begin = time.perf_counter()
    parameters = checked(BuildParameters, parameters)
    out, crew = Path(out), Crew(jobs, assets_per_job, progress, note)
    require_outside(out)
    require_free(out, mark=ASSETS, kind=ConfigError)
    with work_beside(out.absolute(), arrays=False) as work:
        context = BuildContext(parameters, recipe_of(parameters), work.spool, None, strict)
        pairs = _discover(parameters, jobs, work.scratch, note=note)
        plan = plan_assets(pairs, context, crew)
        assets = sorted(finish(pairs, plan, context, crew), key=lambda asset: asset.asset_id)
        digests = []
        with writing(str(out), out.parent), staged(out) as partial, partial.open("wb") as file:
            for one in assets:
                text = work.spool.record_text(one.key) if isinstance(one, Row) else to_json(one)
                file.write(text + b"\n")
                digests.append((one.asset_id, digest_of(text)))
    failed = [asset for asset in assets if isinstance(asset, FailedRecord)]
    rows = [asset for asset in assets if isinstance(asset, Row)]
    counts = counts_of(
        [row.asset_id for row in rows],
        np.array([row.n_voxels for row in rows], np.int64),
        lambda name: np.array([row.columns[name] for row in rows]),
    )
    build_id = build_id_of(parameters.name, digests)
    return summarise(counts, failed, begin, records=out, build_id=build_id, aligned=len(rows))


def _discover(
    parameters: BuildParameters, jobs: Jobs, *shared: Place, note: Note | None = None
) -> list[AssetPair]:
    """Return the pairs; check that the workers see the first pair's files, and `shared`."""
    pairs = discover(parameters, note)
    check_objects(pairs, parameters.normalize)
    sources = next(([pair.grid, pair.slat] for pair in pairs if pair.grid and pair.slat), [])
    require_shared(jobs, [*shared, *sources])
    return pairs


def _publish(
    before: Before,
    begin: float,
    new: NextStore | None = None,
    taken: frozenset[int] | None = None,
    failed: Sequence[FailedRecord] = (),
) -> BuildSummary:
    """Publish the new or unchanged store with its manifests; note the states of sources.

    `taken` has the shards of records that were taken over; it is None if no store was written.
    """
    place, previous = before.place, before.previous
    store = place.in_place() if previous is None or taken is not None else previous
    parameters = before.wanted.parameters
    rows, warnings = new.rows if new else (), list[str]()
    if before.unnoticed:
        warnings.append(
            f"the sources of {', '.join(before.unnoticed[:3])} changed, though their files look as "
            "they did; all sources were hashed"
        )
    if new and taken is not None:
        warnings += [*dataset_notices(new, parameters, failed), *much_clipped(store)]
    damaged = [f"{row.asset_id}: {row.damaged}" for row in rows if row.damaged]
    summary = publish_build(
        place,
        store,
        parameters,
        begin,
        failed,
        before.standing_files(len(store), taken),
        aligned=sum(row.aligned for row in rows),
        warnings=warnings,
        damaged=(*before.damaged, *damaged),
        rehash_seed=before.seed,
    )
    if new:
        before.note(store, rows)
    return summary


def _measured(
    summary: BuildSummary, before: Before, made: int, decoys: int, crew: Crew
) -> BuildSummary:
    """Measure the errors of the store that was written; if that fails, the summary has a warning.

    `made` is the number of its assets that the plan did not find in the existing store.
    """
    try:
        measure_build(before.place.in_place(), made, decoys, crew, before.previous)
    except _BROUGHT_ABOUT as error:
        # The store is published already, and stays.
        told = f"errors were not measured ({error}); run `slatprep measure-errors`"
        return replace(summary, warnings=(*summary.warnings, told))
    return summary
