"""Settle the next store: which rows it has, in which order, and the ranges of its properties."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError, StoreError
from slatprep.normalize import ranges_from_bounds, ranges_from_extents, to_mapped
from slatprep.parameters import BuildParameters, NormalizeParameters, is_split_file, percentiles_of
from slatprep.pipeline.before import Before
from slatprep.pipeline.notices import nothing_usable
from slatprep.pipeline.plan import BuildContext, Crew, PlannedAsset
from slatprep.pipeline.recipe import build_of
from slatprep.pipeline.rows import NextStore, Row, SourceStore, column, in_order, moments_of
from slatprep.pipeline.spool import Spool
from slatprep.readers import contents_of
from slatprep.readers.contents import resolve_latents
from slatprep.readers.ranges import pixie_ranges, read_ranges
from slatprep.readers.splits import Shares, assign_splits, read_id_file
from slatprep.records import PROPERTIES, AssetPair, Contents, Normalization, Property
from slatprep.storage.place import place_of
from slatprep.store import Store
from slatprep.store.record import FailedRecord
from slatprep.workers.local import Jobs, run_unordered

_SIGN = np.uint32(1 << 31)

_HALF = 16
"""Bits that the first pass over the fields counts by."""


@dataclass(frozen=True)
class Wanted:
    """What a build is asked for.

    Attributes
    ----------
    build : mapping
        Parameters and versions, as the store's attribute ``build`` says them.
    ranges : Normalization or str
        Ranges that do not depend on the dataset, or where those of the dataset come from.
    compact : bool
        Rows by id, whatever the order of the existing store.
    declared : Contents
        What the sources hold.
    """

    build: Mapping[str, object]
    ranges: Normalization | str
    compact: bool
    declared: Contents

    @classmethod
    def of(cls, parameters: BuildParameters, compact: bool = False) -> Wanted:
        """Return what parameters ask for; raise `SlatprepError` if their files cannot be used."""
        declared = contents_of(parameters)
        given = given_ranges(parameters.normalize, declared.properties)
        return cls(
            build_of(parameters), given or source_of(parameters.normalize), compact, declared
        )

    @property
    def given(self) -> Normalization | None:
        """Ranges that do not depend on the dataset."""
        return self.ranges if isinstance(self.ranges, Normalization) else None

    def allows(self, store: Store) -> bool:
        """Whether a store of the right assets is the one that is asked for."""
        return (
            store.attributes["build"] == self.build
            and self.ranges in (store.normalization, store.normalization.source)
            and not (self.compact and len(store.attributes["segments"]) > 1)
        )


def settle_rows(
    finished: Sequence[Row | FailedRecord],
    kept: Sequence[Row],
    before: Before,
    context: BuildContext,
    wanted: Wanted,
    crew: Crew,
) -> tuple[NextStore, list[FailedRecord]]:
    """Return the next store of `finished` assets, and those that cannot go in, by id.

    Rows that are `kept` are taken over from the existing store. StoreError if no asset can be used.
    """
    parameters, spool, previous = context.parameters, context.spool, before.previous
    rows = sorted((a for a in finished if isinstance(a, Row)), key=lambda row: row.asset_id)
    failed = [asset for asset in finished if isinstance(asset, FailedRecord)]
    failed.sort(key=lambda asset: asset.asset_id)
    if not (rows or kept):
        raise StoreError(nothing_usable(failed, parameters, before.pairs))
    if kept and previous:
        rows, normalization = [*rows, *kept], previous.normalization
    else:
        jobs = crew.of(len(rows))
        if parameters.consensus.settle or parameters.witness.settle:
            from slatprep.pipeline.passes import apply_passes  # They need scipy.

            rows = apply_passes(rows, context, crew, wanted.declared.n_labels)
        normalization = wanted.given or dataset_ranges(
            rows, spool, parameters.normalize, jobs, wanted.declared.properties
        )
    stores = (previous,) if kept and previous else ()
    rows = in_order(rows, previous, wanted.compact)
    contents = resolved_contents(rows, stores, wanted.declared, parameters.slat.standardised)
    how = (wanted.build, parameters.store, bool(stores))
    return NextStore(rows, stores, normalization, contents, *how), failed


def kept_rows(
    finished: Sequence[Row | FailedRecord],
    unchanged: Sequence[AssetPair],
    plan: Mapping[str, PlannedAsset],
    before: Before,
    parameters: BuildParameters,
    wanted: Wanted,
) -> list[Row]:
    """Return the rows of unchanged assets, if they can be taken over; else none.

    They can where the ranges stay as they are, no pass over the whole dataset may
    change them, and the rest of what decides a store's bytes is the same.
    """
    previous, normalize = before.previous, parameters.normalize
    if previous is None or before.damaged:
        return []
    made = [asset for asset in finished if isinstance(asset, Row)]
    store, declared = previous.store, wanted.declared
    tables = [(one.properties, one.classes) for one in (store.contents, declared)]
    if tables[0] != tables[1] or {**previous.build, "name": ""} != {**wanted.build, "name": ""}:
        return []
    sizes, rows = np.diff(store.offsets).tolist(), []
    for pair in unchanged:
        row = store.find(pair.asset_id)
        names = plan[pair.asset_id].names
        rows.append(Row(pair.asset_id, sizes[row], store=0, row=row, names=names))
    everything, alone = [*rows, *made], not made and len(rows) == len(store)
    if alone and not any(row.names for row in rows):
        # Whatever made ranges and placements of these assets would make the same again.
        return rows if wanted.ranges in (store.normalization, store.normalization.source) else []
    if parameters.consensus.settle or parameters.witness.settle or not rows:
        return []
    ranges = wanted.given
    if ranges is None:
        if normalize.objects != "all" or percentiles_of(normalize.ranges):
            return []  # Such ranges are of the values of all fields.
        extents = column("extent", everything, (previous,))
        ranges = ranges_from_extents(extents, normalize.ranges, declared.properties)
    return rows if ranges == store.normalization else []


def resolved_contents(
    rows: Sequence[Row], stores: Sequence[SourceStore], declared: Contents, standardised: str
) -> Contents:
    """Return what a store holds, its latents as `resolve_latents` finds them to be."""
    means, stds = (column(name, rows, stores) for name in ("latent_mean", "latent_std"))
    moments = [
        (row.n_voxels, moments_of(mean, std))
        for row, mean, std in zip(rows, means, stds, strict=True)
    ]
    return replace(declared, latents=resolve_latents(declared.latents, standardised, moments))


def given_ranges(
    parameters: NormalizeParameters, table: Sequence[Property] = PROPERTIES
) -> Normalization | None:
    """Return ranges that do not depend on the dataset, or None; read first, to fail early."""
    if parameters.ranges == "dataset" or percentiles_of(parameters.ranges):
        return None
    if parameters.ranges == "pixie":
        return pixie_ranges(table)
    return read_ranges(place_of(parameters.ranges), table)


def source_of(parameters: NormalizeParameters) -> str:
    """Return where ranges of the dataset come from, in a word that changes when they would.

    InputError if a file of ids cannot be used.
    """
    if parameters.objects == "all":
        return parameters.ranges
    by = parameters.split_by
    if is_split_file(by):
        digest = hashlib.sha256(read_id_file(place_of(by))).hexdigest()
        by = f"{place_of(by).name}, sha256 {digest[:12]}"
    return f"{parameters.ranges} of train by {by}"


def check_objects(pairs: Sequence[AssetPair], parameters: NormalizeParameters) -> None:
    """Raise what `dataset_ranges` would of a split that cannot be made, before hours of work."""
    if parameters.objects == "train":
        objects = {pair.object_id: pair.category for pair in pairs}
        _trained(objects, parameters, {pair.asset_id: pair.object_id for pair in pairs})


def dataset_ranges(
    usable: Sequence[Row],
    spool: Spool,
    parameters: NormalizeParameters,
    jobs: Jobs,
    table: Sequence[Property] = PROPERTIES,
) -> Normalization:
    """Return the ranges of the usable assets' fields: their extent, or percentiles.

    Percentiles are over the annotated voxels of all fields together, each alike and each field
    once, and interpolated in mapped units, as numpy and Pixie (``inspect_ranges.py``, which draws
    2,000,000 of them) do; of annotations that are merged, the first counts. ConfigError if no
    object is trained on or a split cannot be made, InputError if a file of ids cannot be used.
    """
    chosen, source = _chosen(usable, parameters), source_of(parameters)
    percentiles = percentiles_of(parameters.ranges)
    if percentiles is None:
        return ranges_from_extents([asset.columns["extent"] for asset in chosen], source, table)
    keys = list({_field_of(asset): asset.key for asset in reversed(chosen)}.values())
    coarse = _counted(spool, keys, jobs, len(table))
    place = (sum(coarse[0].values()) - 1) * np.array(percentiles) / 100
    ranks = np.concatenate([np.floor(place), np.ceil(place)]).astype(int).tolist()
    halves = [[_at(counts, rank) for rank in ranks] for counts in coarse]
    fine = _counted(spool, keys, jobs, len(table), [{h for h, _ in own} for own in halves])
    bits = [
        [
            _at({value: n for value, n in counts.items() if value >> _HALF == half}, rank)[0]
            for half, rank in own
        ]
        for counts, own in zip(fine, halves, strict=True)
    ]
    below, above = np.split(to_mapped(_of_ranks(np.array(bits, dtype=np.uint32)).T, table), 2)
    lo, hi = below + (place % 1)[:, None] * (above - below)
    return ranges_from_bounds(lo, hi, source, table)


def _chosen(usable: Sequence[Row], parameters: NormalizeParameters) -> Sequence[Row]:
    """Return the assets of the objects that count."""
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
    """Return what tells an asset's field from others: views of an object have it in common."""
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


def _counted(
    spool: Spool,
    keys: Sequence[str],
    jobs: Jobs,
    columns: int,
    halves: Sequence[set[int]] | None = None,
) -> list[Counter[int]]:
    totals: list[Counter[int]] = [Counter() for _ in range(columns)]
    for counts in run_unordered(count_bits, ((spool, key, halves) for key in keys), jobs):
        for total, (bits, numbers) in zip(totals, counts, strict=True):
            total.update(dict(zip(bits.tolist(), numbers.tolist(), strict=True)))
    return totals


def count_bits(
    spool: Spool, key: str, halves: Sequence[set[int]] | None = None
) -> list[tuple[NDArray[np.uint32], NDArray[np.int64]]]:
    """Count a field's values by their bits, brought to an order that is that of the values.

    Returns of each property the bits, sorted, and how often they occur: the upper 16 bits of all
    values, or, with `halves`, all 32 bits of the values whose upper 16 are among a property's. So
    two passes find any value by its rank in a memory that does not grow with their number.
    """
    bits = _in_order(spool.field(key).properties)
    if halves is None:
        return [np.unique(column >> _HALF, return_counts=True) for column in bits.T]
    return [
        np.unique(column[np.isin(column >> _HALF, list(own))], return_counts=True)
        for column, own in zip(bits.T, halves, strict=True)
    ]


def _in_order(values: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Return the bits of floats so changed that they have the floats' order."""
    # Minus zero is no less than zero.
    bits = np.ascontiguousarray(values + np.float32(0)).view(np.uint32)
    ordered: NDArray[np.uint32] = np.where(bits >> 31, ~bits, bits | _SIGN)
    return ordered


def _of_ranks(ordered: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Return the floats of bits that `_in_order` made."""
    return np.where(ordered >> 31, ordered ^ _SIGN, ~ordered).view(np.float32)


def _at(counts: Mapping[int, int], rank: int) -> tuple[int, int]:
    """Return the value of a rank, and its rank among equal ones."""
    for value in sorted(counts):
        if rank < counts[value]:
            return value, rank
        rank -= counts[value]
    raise IndexError(rank)
