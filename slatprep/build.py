"""Build a store: the way from source files to rows, for one asset and for all.

`process_asset` is the method for one asset, stage by stage; `build_store` runs
it over a dataset, brings all to one scale and packs the result.
"""

from __future__ import annotations

import shutil
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep import provenance
from slatprep.align import align
from slatprep.align.ambiguity import measure_ambiguity
from slatprep.align.quality import judge
from slatprep.errors import MissingPartnerError, SlatprepError, StoreError
from slatprep.normalize import PIXIE_RANGES, ranges_from_extents, read_ranges
from slatprep.parallel import run_unordered
from slatprep.parameters import BuildParameters, NormalizeParameters, StoreParameters
from slatprep.readers import discover, read_field, read_latents
from slatprep.records import PROPERTY_COLUMNS, AssetPair, AssetResult, Normalization, Status
from slatprep.sample import sample
from slatprep.store.reader import is_store
from slatprep.store.replace import replace_directory
from slatprep.store.spool import Spool, SpooledAsset
from slatprep.store.writer import create_store, finish_store, shards, write_assets, write_shard
from slatprep.summary import BuildSummary, problems_of, summarise

__all__ = [
    "BuildSummary",
    "Progress",
    "align_pairs",
    "build_store",
    "default_manifests",
    "process_asset",
]

Progress = Callable[[int, int], None]
"""Called with the assets done and the assets in all."""


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
    field = read_field(pair)
    latents = read_latents(pair)
    alignment = align(field, latents, parameters.align)
    annotation = sample(field, latents.coords, alignment.transform, parameters.sample)
    ambiguity = measure_ambiguity(field, latents, alignment, parameters.sample)
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


def build_store(
    parameters: BuildParameters,
    out: Path,
    *,
    manifests: Path | None = None,
    jobs: int = 1,
    strict: bool = False,
    progress: Progress | None = None,
) -> BuildSummary:
    """Build a store of all assets of a dataset, and the records of how.

    Parameters
    ----------
    parameters : BuildParameters
        Sources and methods.
    out : Path
        The store; an older one is replaced, in one step, when the new one is
        finished.
    manifests : Path, optional
        Directory of ``assets.jsonl`` and ``build.json``; by default beside the
        store, see `default_manifests`.
    jobs : int
        Worker processes. The store's bytes do not depend on it.
    strict : bool
        Raise at the first asset that cannot be used instead of going on.
    progress : callable, optional
        See `Progress`.

    Returns
    -------
    BuildSummary
        What went in and what did not.

    Raises
    ------
    StoreError
        If `out` is something other than a store, or no asset can be used.
    InputError
        With `strict`, for the first asset that cannot be used.
    """
    begin = time.perf_counter()
    out = Path(out)
    _refuse_other_targets(out)
    target = out.resolve()  # What a link points to is replaced, not the link.
    manifests = default_manifests(out) if manifests is None else Path(manifests)
    given = _given_ranges(parameters.normalize)
    with _work_directory(target) as work:
        spool = Spool(work / "spool")
        assets = _process_all(parameters, spool, jobs, strict, progress)
        usable = [asset for asset in assets if asset.status is Status.OK]
        if not usable:
            raise StoreError(_nothing_usable(assets, parameters))
        normalization = given or _dataset_ranges(usable)
        new = work / "store.zarr"
        clipped = _pack(new, spool, usable, normalization, parameters.store, jobs)
        with (
            provenance.staged(manifests / "assets.jsonl") as records_file,
            provenance.staged(manifests / "build.json") as build_file,
        ):
            records = _completed_records(spool, assets, normalization, clipped)
            manifest = provenance.write_records(records_file, records)
            finish_store(new, normalization, manifest, provenance.origin(parameters))
            summary = summarise(
                assets,
                store=out,
                records=manifests / "assets.jsonl",
                manifest=manifest,
                normalization=normalization,
                clipped=dict(
                    zip(PROPERTY_COLUMNS, clipped["voxel"].sum(axis=0).tolist(), strict=True)
                ),
                seconds=time.perf_counter() - begin,
            )
            provenance.write_build_record(build_file, summary, parameters)
            replace_directory(new, target)
    return summary


def align_pairs(
    parameters: BuildParameters,
    out: Path,
    *,
    jobs: int = 1,
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
    with _work_directory(out) as work:
        spool = Spool(work, arrays=False)
        assets = _process_all(parameters, spool, jobs, strict, progress)
        with provenance.staged(out) as file:
            records = (spool.record(asset.asset_id) for asset in assets)
            manifest = provenance.write_records(file, records)
    seconds = time.perf_counter() - begin
    return summarise(assets, records=out, manifest=manifest, seconds=seconds)


def default_manifests(store: Path) -> Path:
    """Return the directory of a store's records: ``demo.manifests`` beside ``demo.zarr``."""
    return store.with_name(f"{store.name.removesuffix('.zarr')}.manifests")


def _process_all(
    parameters: BuildParameters,
    spool: Spool,
    jobs: int,
    strict: bool,
    progress: Progress | None,
) -> list[SpooledAsset]:
    """Process every asset of the dataset into the spool; return what is kept, sorted by id."""
    # Listing names twice is cheap; holding a list of all pairs is not.
    total = sum(1 for _ in discover(parameters)) if progress else 0
    tasks = ((pair, parameters, spool, strict) for pair in discover(parameters))
    assets = []
    for asset in run_unordered(_spool_asset, tasks, jobs):
        assets.append(asset)
        if progress:
            progress(len(assets), max(total, len(assets)))
    return sorted(assets, key=lambda asset: asset.asset_id)


def _spool_asset(
    pair: AssetPair, parameters: BuildParameters, spool: Spool, strict: bool
) -> SpooledAsset:
    """Process one asset in a worker; its faults become a status unless `strict`."""
    begin = time.perf_counter()
    trace = ""
    try:
        result = process_asset(pair, parameters)
    except SlatprepError as error:
        if strict:
            raise
        missing = isinstance(error, MissingPartnerError)
        result = AssetResult(pair, Status.SKIPPED if missing else Status.FAILED, _line(error))
    except Exception as error:
        # A fault of slatprep's own in one asset must not cost the others.
        if strict:
            raise
        trace = traceback.format_exc()
        reason = f"internal error, please report: {type(error).__name__}: {_line(error)}"
        result = AssetResult(pair, Status.FAILED, reason)
    record = provenance.asset_record(result, parameters, time.perf_counter() - begin, trace)
    return spool.put(replace(result, record=record))


def _given_ranges(parameters: NormalizeParameters) -> Normalization | None:
    """Return ranges that do not depend on the dataset, or None; read first, to fail early."""
    if parameters.ranges == "dataset":
        return None
    return PIXIE_RANGES if parameters.ranges == "pixie" else read_ranges(Path(parameters.ranges))


def _dataset_ranges(usable: Sequence[SpooledAsset]) -> Normalization:
    return ranges_from_extents([asset.extent for asset in usable if asset.extent is not None])


def _pack(
    path: Path,
    spool: Spool,
    assets: Sequence[SpooledAsset],
    normalization: Normalization,
    parameters: StoreParameters,
    jobs: int,
) -> dict[str, NDArray[np.int64]]:
    """Write the store's arrays, a task a shard; return the values clipped, by group and asset."""
    ids = [asset.asset_id for asset in assets]
    offsets = [0, *accumulate(asset.n_voxels for asset in assets)]
    create_store(path, len(ids), offsets[-1], parameters)
    write_assets(path, assets, offsets, normalization)
    clipped = {group: np.zeros((len(ids), 3), dtype=np.int64) for group in ("voxel", "grid")}
    tasks = ((path, spool, shard, normalization) for shard in shards(ids, offsets, parameters))
    for shard, counts in run_unordered(write_shard, tasks, jobs):
        clipped[shard.group][shard.first : shard.first + len(shard.ids)] += counts
    return clipped


def _by_property(clipped: NDArray[np.int64]) -> dict[str, int]:
    return dict(zip(PROPERTY_COLUMNS, clipped.sum(axis=0).tolist(), strict=True))


def _completed_records(
    spool: Spool,
    assets: Sequence[SpooledAsset],
    normalization: Normalization,
    clipped: dict[str, NDArray[np.int64]],
) -> Iterator[dict[str, Any]]:
    counts = zip(clipped["voxel"], clipped["grid"], strict=True)
    for asset in assets:
        record = spool.record(asset.asset_id)
        if asset.status is Status.OK:
            record = provenance.complete_record(record, normalization, *next(counts))
        yield record


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def _nothing_usable(assets: Sequence[SpooledAsset], parameters: BuildParameters) -> str:
    problems = problems_of(assets)
    if not problems:
        return (
            f"no asset found in {parameters.pixieverse.root} and {parameters.slat.root}; "
            "expected files that match the patterns of the dataset definition"
        )
    listed = "".join(f"\n  {asset_id}: {reason}" for asset_id, reason in problems[:5])
    more = f"\n  and {len(problems) - 5} more" if len(problems) > 5 else ""
    return f"none of {len(problems)} assets can be used, so there is no store:{listed}{more}"


def _refuse_other_targets(out: Path) -> None:
    if out.exists() and not is_store(out) and not (out.is_dir() and not any(out.iterdir())):
        raise StoreError(
            f"{out} exists and is not a slatprep store; expected a store to replace, or a new path"
        )


@contextmanager
def _work_directory(out: Path) -> Iterator[Path]:
    """Make a directory beside `out`, on its file system, and remove it afterwards."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        # A name of its own for each build: what a killed one left is never taken for this one's.
        work = Path(tempfile.mkdtemp(prefix=f".{out.name}.work-", dir=out.parent))
    except OSError as error:
        raise StoreError(
            f"{out.parent}: cannot write there ({error.strerror}); "
            "expected a folder for the result and for temporary files"
        ) from error
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
