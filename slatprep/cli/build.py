"""`slatprep make-demo`, `build-store`, `align`, `subset` and `concat`: make data and stores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any

import click

from slatprep.cli import options
from slatprep.cli.info import show_quality, show_sentences
from slatprep.cli.output import DONE, Output, say
from slatprep.cli.signature import Click, command
from slatprep.errors import amount, first_of
from slatprep.workers import Progress

if TYPE_CHECKING:
    from slatprep.parameters import BuildParameters
    from slatprep.pipeline.dataset import BuildPlan, BuildSummary


@dataclass(frozen=True, kw_only=True)
class DemoOptions:
    """Options of `slatprep.demo.make_demo`.

    Attributes
    ----------
    assets
        Number of objects; fourteen have every category once.
    seed
        Seed of all random choices; the same seed gives the same bytes.
    levels
        Difficulty, 0 (quarter turns) to 4 (warped), 5 (a generated shape), 6 (a NeRF's field), 7
        (both); may be repeated: assets take the levels in turn. [default: 0 to 4, or 0 if both
        sides share a frame]
    views
        Number of SLATs per object.
    habitual_share
        Share of the objects that have the same quarter turn.
    latents
        Noise with TRELLIS's statistics (placeholder), or latents that depend on the material.
    source
        PixieVerse's grids, predictions of 11 or 4 channels, VoMP's or PhysXNet's voxels, or plain
        voxels with ten properties (in HDF5 without classes).
    encoder
        Latents of TRELLIS, SAM 3D Objects, TRELLIS.2 (-512: on a grid of 32^3), or others with 16
        channels (-128: on a grid of 128^3).
    slat_form
        Files of (N,3) or (N,4) coordinates, HDF5, or one HDF5 for all.
    slat_names
        Name SLATs by object, or by sha256 with a metadata.csv.
    results
        Also write results/: grids predicted with errors, 12 MB each, for `slatprep evaluate
        --grids`.
    samples
        Number of annotations of each object; several have errors in each part, and dataset.toml
        merges them.
    """

    assets: options.Positive = 25
    seed: options.Seed = 0
    levels: Annotated[tuple[int, ...], click.IntRange(0, 7), Click("--level")] = ()
    views: options.Positive = 1
    habitual_share: Annotated[float, options.FiniteRange(0, 1)] = 0.0
    latents: Annotated[Any, options.ChoiceOf("slatprep.demo.latents:LatentKind")] = "placeholder"
    source: Annotated[Any, options.ChoiceOf("slatprep.demo.sources:Source")] = "pixieverse"
    encoder: Annotated[Any, options.ChoiceOf("slatprep.demo.latents:Encoder")] = "trellis"
    slat_form: Annotated[Any, options.ChoiceOf("slatprep.demo.write:SlatForm")] = "npz"
    slat_names: Annotated[Any, options.ChoiceOf("slatprep.demo.write:SlatNames")] = "id"
    results: bool = False
    samples: options.Positive = 1


@command("make-demo")
def make_demo(
    output: Output, directory: options.NewFolder, *, demo: DemoOptions, jobs: options.Jobs = 1
) -> None:
    """Make procedural assets with known truth in DIRECTORY.

    Writes pixieverse/ (or the folder of another source), slat/ and truth/ in the
    layouts that build-store reads, and dataset.toml, their definition for
    build-store --config. DIRECTORY must be new, empty, or hold the same demo.

    Example
    -------
    slatprep make-demo demo --assets 14 --seed 0
    slatprep make-demo hard --assets 6 --seed 1 --level 3 --level 4
    slatprep make-demo doubts --assets 6 --samples 5
    slatprep make-demo shapes --assets 6 --seed 1 --level 5 --level 6 --level 7
    slatprep make-demo other --assets 4 --seed 2 --source pixie-predictions --slat-form hdf5
    slatprep make-demo vomp --assets 4 --source vomp --encoder trellis2
    """
    from slatprep.demo import make_demo as make
    from slatprep.storage.atomic import writing

    chosen = vars(demo) | {"levels": tuple(sorted(set(demo.levels))) or None}
    with writing(str(directory), directory.parent), output.progress("demo") as progress:
        summary = make(directory, **chosen, jobs=jobs, progress=progress)

    def show() -> None:
        title = f"Demo data in {summary.path}"
        output.table(title, ("category", "objects"), sorted(summary.categories.items()))
        store = f"{summary.path}.zarr"
        output.note(f"a store of it: slatprep build-store --config {summary.config} --out {store}")
        output.note(f"its score:     slatprep score {store} {summary.path / 'truth'}")

    output.made(summary, show)


_ASSETS_PER_JOB = 32
"""Number of assets that the default engine aligns in the start-up time of a worker, 1.6 s."""


@command("build-store")
def build_store(
    output: Output,
    *,
    sources: options.SourceOptions,
    out: options.NewStore,
    manifests: options.RecordsFolder | None = None,
    strict: bool = False,
    consensus: bool = False,
    witness: bool = False,
    fresh: bool = False,
    rehash: Annotated[
        float,
        options.FiniteRange(0, 1),
        Click(is_flag=False, flag_value="1", show_default=True),
    ] = 0.01,
    compact: bool = False,
    keep_work: bool = False,
    decoys: options.Count = 200,
    dry_run: bool = False,
    workers: options.WorkersOptions,
) -> None:
    """Build one store of aligned, normalised supervision, or bring it up to date.

    Pairs the assets of both sides by id, aligns them, looks up the material and
    its properties at every SLAT voxel, normalises and writes. An asset that
    cannot be built does not stop the others: it is named on standard error and
    in the records, and the exit code is 1.

    If an asset's sources, parameters and code did not change, its row is reused
    without aligning it again. An interrupted build is resumed.

    Parameters
    ----------
    strict
        Stop at the first asset that cannot be built.
    consensus
        Settle ties by the rotation that most assets share.
    witness
        Settle ties by comparing latents, and name assets whose latents contradict their labels.
    fresh
        Reuse nothing from an earlier build.
    rehash : [SHARE]
        Hash this share, drawn at random, of the sources whose files look unchanged; without a
        number, all of them.
    compact
        Sort rows by id, as a first build does; otherwise an update appends new assets.
    keep_work
        Keep all assets' arrays beside the store, about 1 MB each, so that an update that packs all
        assets again does not read their sources.
    decoys : N
        Measure errors on at most N decoys: grids aligned with SLATs of other objects. Up to 40,
        there is one for every 20 assets that are aligned; from 2,400 assets on, for every 60.
        0: none.
    dry_run
        Print what would be done with each asset, and why; write nothing.

    Example
    -------
    slatprep build-store --pixieverse demo/pixieverse --slat demo/slat --out demo.zarr --jobs 2
    slatprep build-store --config manifests/demo.toml --preset paper --out data/demo.zarr
    slatprep build-store --config demo/dataset.toml --ranges p1-p99 --ranges-of train --out d.zarr
    slatprep build-store --config manifests/demo.toml --out data/demo.zarr --dry-run
    slatprep build-store --config manifests/demo.toml --out data/demo.zarr --scheduler tcp://node7:8786
    """
    parameters = sources.parameters(consensus=consensus, witness=witness)
    from slatprep.pipeline import dataset as build

    with workers.started(output) as jobs:
        if dry_run:
            with output.progress("compare") as progress:
                plan = build.plan_build(
                    parameters,
                    out,
                    manifests=manifests,
                    jobs=jobs,
                    fresh=fresh,
                    rehash=rehash == 1,
                    decoys=decoys,
                    progress=progress,
                    note=output.note,
                )
            _show_plan(output, plan)
            return
        with output.progress("build") as progress:
            summary = build.build_store(
                parameters,
                out,
                manifests=manifests,
                jobs=jobs,
                strict=strict,
                fresh=fresh,
                rehash=rehash,
                compact=compact,
                keep_work=keep_work,
                decoys=decoys,
                progress=_counting(output, progress),
                **_by_work(output, parameters),
            )
    report(output, summary)


@command()
def align(
    output: Output,
    *,
    sources: options.SourceOptions,
    out: options.NewFile,
    strict: bool = False,
    workers: options.WorkersOptions,
) -> None:
    """Align without building a store.

    Writes a JSON record for each asset: the transform, its quality, and the
    score of every candidate.

    Parameters
    ----------
    out : FILE.jsonl
        File to write, with a record on each line.
    strict
        Stop at the first asset that cannot be aligned.

    Example
    -------
    slatprep align --pixieverse demo/pixieverse --slat demo/slat --out demo.jsonl --jobs 2
    """
    parameters = sources.parameters()
    from slatprep.pipeline import dataset as build

    if parameters.consensus.settle or parameters.witness.settle:
        output.note("note:    consensus and witness are passes of a build, and are left out here")
    with workers.started(output) as jobs, output.progress("align") as progress:
        summary = build.align_pairs(
            parameters,
            out,
            jobs=jobs,
            strict=strict,
            progress=progress,
            **_by_work(output, parameters),
        )
    report(output, summary)


def _counting(output: Output, progress: Progress) -> Progress:
    """Return `progress` that also updates the message for a stopped build.

    Assets are done from the first update with 0 done on; before, they are only compared.
    """
    begun = False

    def update(done: int, total: int) -> None:
        nonlocal begun
        begun = begun or done == 0
        if begun and done:
            output.if_stopped = (
                f"nothing was replaced; {done:,} of {amount(total, 'asset')} are done and kept; "
                "the same command goes on from there"
            )
        progress(done, total)

    return update


def _by_work(output: Output, parameters: BuildParameters) -> dict[str, Any]:
    """Return options that avoid workers for small builds, and print notes about slow starts."""
    per_job = _ASSETS_PER_JOB if parameters.align.engine == "field" else 1
    return {"assets_per_job": per_job, "note": output.note}


def _show_damaged(output: Output, damaged: Sequence[str]) -> None:
    """Print the faults that were found in the existing store."""
    lines = [f"damaged, made anew: {line}" for line in damaged]
    output.problems(lines, "`slatprep verify` lists them")


def _show_plan(output: Output, plan: BuildPlan) -> None:
    """Print what would be done with each asset, and why; unchanged assets are only counted."""
    _show_damaged(output, plan.damaged)
    for warning in plan.warnings:
        output.problem(warning)
    keys = ("asset_id", "action", "reason")
    assets = [{key: getattr(asset, key) for key in keys} for asset in plan.assets]

    def show() -> None:
        shown = [one for one in assets if one["action"] != "reuse" or output.verbosity > 0]
        if shown:
            rows = (tuple(one.values()) for one in shown)
            output.table("What would be done", ("asset", "action", "why"), rows)
        say(_counts(plan.statuses, plan.actions["align"]))
        say(f"store:   {plan.store} (a dry run: nothing is written)")

    counts = {"actions": plan.actions, "statuses": plan.statuses, "removed": len(plan.taken_out)}
    complete = plan.statuses["ok"] == sum(plan.statuses.values())
    _tell_removed(output, len(plan.taken_out), plan.taken_out, "is")
    output.result(vars(plan) | counts | {"assets": assets}, show, complete)


def _counts(statuses: Mapping[str, int], aligned: int, failed: str = "not built") -> str:
    """Return the line that counts assets by status; `ok` assets are aligned or taken over."""
    # Beside the verdicts, "failed" would read as a verdict, and "ok" as all other verdicts.
    taken_over = statuses["ok"] - aligned
    counts = {"aligned": aligned} | ({"taken over": taken_over} if taken_over else {})
    counts |= {failed: statuses["failed"], "skipped": statuses["skipped"]}
    told = ", ".join(f"{count:,} {word}" for word, count in counts.items())
    return f"assets:  {sum(counts.values()):,} ({told})"


def _tell_removed(output: Output, count: int, taken_out: Mapping[str, str], verb: str) -> None:
    """Tell the number of assets that leave the store, and the first three with reasons."""
    if count:
        named = [f"{name} ({why})" for name, why in taken_out.items()]
        output.problem(
            f"removed: {amount(count, 'asset')} of the store that {verb} there: "
            f"{first_of(named, number=count)}"
        )


def report(output: Output, summary: BuildSummary) -> None:
    """Print the outcome of a build and the assets that failed, and set the exit code."""
    from slatprep.readers.pairing import LOOKED_FOR
    from slatprep.records import Verdict

    output.if_stopped = DONE
    _show_damaged(output, summary.damaged)
    looked = ""
    for asset_id, reason in summary.problems:
        what, _, names = reason.partition(LOOKED_FOR)
        output.problem(f"{asset_id}: {what if names == looked else reason}")
        looked = names or looked  # Repeated names are printed once.
    total, good = sum(summary.statuses.values()), summary.statuses["ok"]
    for asset_id in summary.contradicted:
        output.note(f"{asset_id}: its latents contradict its labels; look at it first")
    unlisted = total - good - len(summary.problems)
    if unlisted:
        output.problem(f"and {unlisted:,} more: see {summary.records}")
    for warning in summary.warnings:
        output.problem(warning)
    if summary.n_unphysical:
        output.problem(
            f"{summary.n_unphysical:,} PixieVerse voxels with properties that no material has are "
            f"not annotated; `warnings` in {summary.records} says in which assets"
        )

    def show() -> None:
        if summary.store is not None:
            from slatprep.inspect.overview import list_assets, overview_of
            from slatprep.pipeline.measured import told_of

            store, built = options.opened(summary.store), output.command == "build-store"
            # Advice on dataset definitions is of no use to `subset` and `concat`.
            show_quality(output, overview_of(store), summary.store, advise=built)
            show_sentences("wrong pairs", told_of(store))
            if output.verbosity > 0:
                names = ("asset_id", "verdict", "confidence", "fitness")
                rows = map(attrgetter(*names), list_assets(store))
                output.table("Assets", ("asset", *names[1:]), rows)
        if output.command in ("subset", "concat"):
            counts = f"assets:  {good:,} copied"
        else:
            failed = "not aligned" if summary.store is None else "not built"
            counts = _counts(summary.statuses, summary.aligned, failed)
        say(f"{counts} in {summary.seconds:,.1f} s")
        if summary.unchanged:
            say("changed: nothing")
        if summary.store is not None:
            say(f"store:   {summary.store}")
        say(f"records: {summary.records}")

    verdicts = {str(verdict): summary.verdicts.get(str(verdict), 0) for verdict in Verdict}
    _tell_removed(output, summary.removed, summary.taken_out, "was")
    output.made(vars(summary) | {"verdicts": verdicts}, show, summary.complete)


@command()
def subset(
    output: Output,
    store: options.FolderOrUrl,
    *,
    out: options.NewStore,
    assets: options.AssetIds = (),
    chosen: options.ChosenOptions,
    manifests: options.RecordsFolder | None = None,
    jobs: options.Jobs = 1,
) -> None:
    """Make a store of some assets of STORE, without aligning them again.

    Rows, records and ranges are copied unchanged. Assets must have one of the verdicts and
    one of the categories; assets named by --asset are always included.

    Example
    -------
    slatprep subset data/demo.zarr --verdict good --out good.zarr
    slatprep subset data/demo.zarr --asset 5f61cc --asset 803c1a --out two.zarr
    """
    if not (assets or chosen.verdicts or chosen.categories):
        raise click.UsageError("say which assets: --asset ID, --verdict or --category")
    from slatprep.pipeline.join import subset_store

    options.note_numbered(output, options.opened(store), assets)
    with output.progress("subset", "shards") as progress:
        summary = subset_store(
            store, out, assets, **vars(chosen), manifests=manifests, jobs=jobs, progress=progress
        )
    report(output, summary)


@command()
def concat(
    output: Output,
    stores: tuple[options.FolderOrUrl, ...],
    *,
    out: options.NewStore,
    manifests: options.RecordsFolder | None = None,
    jobs: options.Jobs = 1,
) -> None:
    """Make one store of the assets of all STORES, without aligning them again.

    The stores must have been built with the same parameters, and no id may be in two
    of them. If each has the ranges of its own dataset, properties are converted to
    ranges over all assets.

    Example
    -------
    slatprep concat first.zarr second.zarr --out both.zarr
    """
    from slatprep.pipeline.join import concat_stores

    with output.progress("concat", "shards") as progress:
        summary = concat_stores(stores, out, manifests=manifests, jobs=jobs, progress=progress)
    report(output, summary)
