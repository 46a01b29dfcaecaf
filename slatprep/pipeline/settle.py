"""Settle the next store: which rows it has, in which order, and the ranges of its properties."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError, StoreError
from slatprep.normalize import ranges_from_bounds, ranges_from_extents, to_mapped
from slatprep.parameters import NormalizeParameters, percentiles_of
from slatprep.pipeline.before import Before
from slatprep.pipeline.notices import nothing_usable
from slatprep.pipeline.plan import BuildContext, Crew, PlannedAsset
from slatprep.pipeline.recipe import Wanted
from slatprep.pipeline.rows import NextStore, Row, SourceStore, column, in_order, moments_of
from slatprep.pipeline.spool import Spool
from slatprep.readers.contents import resolve_latents
from slatprep.readers.splits import Shares, assign_splits
from slatprep.records import AssetPair, Contents, LatentSpace, Normalization, Property
from slatprep.store.reader import is_store
from slatprep.store.record import FailedRecord
from slatprep.workers.local import Jobs, run_unordered

_SIGN = np.uint32(1 << 31)

_TOLD = 5
"""Number of assets that are named where no record names them."""

_HALF = 16
"""Number of bits of a value that are counted at a time."""


def settle_rows(
    assets: Sequence[Row | FailedRecord], before: Before, context: BuildContext, crew: Crew
) -> tuple[NextStore, list[FailedRecord]]:
    """Return the next store of `assets`, and the assets that cannot go in, by id.

    Rows that lie in the existing store stay there. StoreError if no asset can be used.
    """
    wanted, parameters = before.wanted, context.parameters
    declared = wanted.declared
    assets = sorted(assets, key=lambda asset: asset.asset_id)
    rows = [asset for asset in assets if isinstance(asset, Row)]
    failed = [asset for asset in assets if isinstance(asset, FailedRecord)]
    if not rows:
        raise StoreError(
            nothing_usable(failed, parameters, before.pairs, is_store(before.place.store))
        )
    stores: tuple[SourceStore, ...] = ()
    if before.previous is not None and not all(row.spooled for row in rows):
        stores = (before.previous,)
        ranges = before.previous.normalization
    else:
        if wanted.passes:
            from slatprep.pipeline.passes import apply_passes  # They need scipy.

            rows = apply_passes(rows, context, crew, declared.n_labels)
        ranges = dataset_ranges(rows, context.spool, wanted, crew.of(len(rows)))
    rows = in_order(rows, before.previous, wanted.compact)
    known = before.previous.contents.latents if before.previous is not None else None
    try:
        contents = resolved_contents(rows, stores, declared, parameters.slat.standardised, known)
    except ConfigError:
        for asset in failed[:_TOLD]:  # No store and no record will tell of them.
            crew.tell(f"{asset.asset_id}: {asset.reason}")
        raise
    build, replaces = wanted.build, bool(stores)
    return NextStore(rows, stores, ranges, contents, build, parameters.store, replaces), failed


def kept_rows(
    made: Sequence[Row | FailedRecord],
    unchanged: Sequence[AssetPair],
    plan: Mapping[str, PlannedAsset],
    before: Before,
) -> list[Row] | None:
    """Return the rows of unchanged assets in the existing store; None if they may not stay there.

    `made` are the other assets. Rows stay if the parameters that decide a store's bytes do, and
    so do the ranges with the other assets' rows.
    """
    previous, wanted = before.previous, before.wanted
    if previous is None or before.damaged or not unchanged:
        return None
    tables = [(one.properties, one.classes) for one in (previous.contents, wanted.declared)]
    builds = [{**one.build, "name": ""} for one in (previous, wanted)]
    if tables[0] != tables[1] or builds[0] != builds[1]:
        return None
    sizes, rows = np.diff(previous.offsets).tolist(), []
    for one in (plan[pair.asset_id] for pair in unchanged):
        row = previous.find(one.asset_id)
        rows.append(Row(one.asset_id, sizes[row], store=0, row=row, names=one.names, seen=one.seen))
    added = [asset for asset in made if isinstance(asset, Row)]
    return rows if _may_stay(rows, added, previous, before) else None


def _may_stay(
    rows: Sequence[Row], added: Sequence[Row], previous: SourceStore, before: Before
) -> bool:
    """Return whether `rows` of the existing store stay as they are beside the `added` ones."""
    wanted, ranges = before.wanted, before.wanted.ranges
    # Passes, percentiles, and ranges of the objects to train on look at the voxels of all assets.
    by_rows = not wanted.passes and (isinstance(ranges, Normalization) or ranges == "dataset")
    if not added and len(rows) == len(previous) and not any(row.names for row in rows):
        # A build of these assets would make the same rows. Subsets and joined stores have ranges
        # and placements of other assets, unless the rows alone show that these are the same.
        return (before.built or by_rows) and wanted.has_ranges(previous)
    if by_rows and ranges == "dataset":
        extents = column("extent", [*rows, *added], (previous,))
        ranges = ranges_from_extents(extents, "dataset", wanted.declared.properties)
    return by_rows and ranges == previous.normalization


def resolved_contents(
    rows: Sequence[Row],
    stores: Sequence[SourceStore],
    declared: Contents,
    standardised: str,
    known: LatentSpace | None = None,
) -> Contents:
    """Return the contents of a store, with the latent space that `resolve_latents` finds."""
    # Sums of the same numbers in another order differ in their last digits.
    rows = sorted(rows, key=lambda row: row.asset_id)
    # Annotations of one object share its SLAT, which counts once.
    counts = (row.n_voxels for row in rows)
    moments = list(dict.fromkeys(zip(counts, moments_of(rows, stores), strict=True)))
    latents = resolve_latents(declared.latents, standardised, moments, known)
    return replace(declared, latents=latents)


def check_objects(pairs: Sequence[AssetPair], parameters: NormalizeParameters) -> None:
    """Raise, before hours of work, what `dataset_ranges` raises if a split cannot be made."""
    if parameters.objects == "train":
        objects = {pair.object_id: pair.category for pair in pairs}
        _trained(objects, parameters, {pair.asset_id: pair.object_id for pair in pairs})


def dataset_ranges(
    usable: Sequence[Row], spool: Spool, wanted: Wanted, jobs: Jobs
) -> Normalization:
    """Return the given ranges, or the ranges of the usable assets' fields.

    The fields' ranges are their extent, or percentiles over the annotated voxels of all fields
    together. Voxels have equal weights, and each field counts once. Percentiles are interpolated in
    mapped units, as in numpy and Pixie (``inspect_ranges.py``, which draws 2,000,000 voxels). For
    percentiles only the first of merged annotations counts. ConfigError if no object is trained on
    or a split cannot be made, InputError if a file of ids cannot be used.
    """
    source, parameters = wanted.ranges, wanted.parameters.normalize
    if isinstance(source, Normalization):
        return source
    chosen, table = _chosen(usable, parameters), wanted.declared.properties
    if (percentiles := percentiles_of(parameters.ranges)) is None:
        return ranges_from_extents([asset.columns["extent"] for asset in chosen], source, table)
    keys = list({_field_of(asset): asset.key for asset in reversed(chosen)}.values())
    lo, hi = _at_percentiles(percentiles, spool, keys, jobs, table)
    return ranges_from_bounds(lo, hi, source, table)


def _chosen(usable: Sequence[Row], parameters: NormalizeParameters) -> Sequence[Row]:
    """Return the assets of the objects from which ranges are taken."""
    if parameters.objects != "train":
        return usable
    valid = [asset for asset in usable if asset.columns["n_valid"]]
    trained = _trained(
        {str(asset.columns["object_id"]): str(asset.columns["category"]) for asset in valid},
        parameters,
        {asset.asset_id: str(asset.columns["object_id"]) for asset in valid},
    )
    return [asset for asset in usable if str(asset.columns["object_id"]) in trained]


def _field_of(asset: Row) -> tuple[str, str]:
    """Return a value that identifies an asset's field, which views of an object share."""
    object_id, view = str(asset.columns["object_id"]), str(asset.columns["view"])
    return object_id, asset.asset_id.removeprefix(object_id).removeprefix(f".{view}")


def _trained(
    objects: Mapping[str, str], parameters: NormalizeParameters, assets: Mapping[str, str]
) -> set[str]:
    shares = Shares(*parameters.shares)
    splits = assign_splits(parameters.split_by, objects, shares, assets).splits
    trained = {object_id for object_id, split in splits.items() if split == "train"}
    if not trained:
        raise ConfigError(
            "normalize.objects: no object is trained on, of which ranges could be taken; "
            "expected a share or a list of train"
        )
    return trained


def _at_percentiles(
    at: Sequence[float], spool: Spool, keys: Sequence[str], jobs: Jobs, table: Sequence[Property]
) -> NDArray[np.float64]:
    """Return the properties of all fields' voxels at two percentiles, (2, P), in mapped units.

    Two passes find the value of any rank, in memory that does not grow with the number of values.
    The first counts values by the upper half of their bits, which sort like the values. The second
    counts those that share the upper half of a wanted rank, by their lower half.
    """
    counts = _counted(spool, keys, jobs, len(table))
    place = (counts[0].sum() - 1) * np.array(at) / 100
    upper, ranks = _at(counts, np.concatenate([np.floor(place), np.ceil(place)]).astype(int))
    lower, _ = _at(_counted(spool, keys, jobs, len(table), upper), ranks)
    below, above = np.split(to_mapped(_of_ranks(upper << _HALF | lower).T, table), 2)
    return np.asarray(below + (place % 1)[:, None] * (above - below), np.float64)


def _counted(
    spool: Spool,
    keys: Sequence[str],
    jobs: Jobs,
    columns: int,
    upper: NDArray[np.uint32] | None = None,
) -> NDArray[np.int64]:
    """Return the sum of `count_halves` over all fields, (P, R, 65536)."""
    shape = (columns, 1) if upper is None else upper.shape
    totals = np.zeros((*shape, 1 << _HALF), np.int64)
    for counted in run_unordered(count_halves, ((spool, key, upper) for key in keys), jobs):
        for total, (halves, numbers) in zip(totals.reshape(-1, 1 << _HALF), counted, strict=True):
            total[halves] += numbers
    return totals


def count_halves(
    spool: Spool, key: str, upper: NDArray[np.uint32] | None
) -> list[tuple[NDArray[np.uint32], NDArray[np.int64]]]:
    """Count a field's values by one half of their bits, see `_at_percentiles`.

    Without `upper`, count each property's values by their upper 16 bits. Otherwise, for each upper
    half in `upper` (P, R), count the property's values that have it by their lower 16 bits.
    """
    bits = _in_order(spool.field(key).properties).T
    if upper is None:
        return [np.unique(own >> _HALF, return_counts=True) for own in bits]
    return [
        np.unique(own[own >> _HALF == half] % (1 << _HALF), return_counts=True)
        for own, halves in zip(bits, upper, strict=True)
        for half in halves
    ]


def _in_order(values: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Return the bits of floats, changed so that they sort like the floats."""
    # Adding zero turns minus zero into zero.
    bits = np.ascontiguousarray(values + np.float32(0)).view(np.uint32)
    return np.where(bits >> 31, ~bits, bits | _SIGN)


def _of_ranks(ordered: NDArray[Any]) -> NDArray[np.float32]:
    """Return the floats of bits that `_in_order` made."""
    return np.where(ordered >> 31, ordered ^ _SIGN, ~ordered).view(np.float32)


def _at(
    counts: NDArray[np.int64], ranks: NDArray[np.int64]
) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Return the value at each rank, (P, R), and its rank among equal values.

    `counts`, (P, 1, V) or (P, R, V), has the number of times that each value occurs.
    """
    ends = counts.cumsum(axis=-1)
    values = (ends <= ranks[..., None]).sum(axis=-1)
    smaller = np.take_along_axis(ends - counts, values[..., None], axis=-1)[..., 0]
    return values.astype(np.uint32), ranks - smaller
