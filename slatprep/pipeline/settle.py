"""Settle the next store: which rows it has, in which order, and the ranges of its properties."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slatprep.errors import StoreError
from slatprep.normalize import ranges_from_extents
from slatprep.parameters import BuildParameters, percentiles_of
from slatprep.pipeline.before import Before
from slatprep.pipeline.finish import Crew, finish
from slatprep.pipeline.plan import BuildContext, PlannedAsset
from slatprep.pipeline.previous import SourceStore
from slatprep.pipeline.ranges import dataset_ranges, given_ranges, source_of
from slatprep.pipeline.recipe import build_of
from slatprep.pipeline.rows import NextStore, Row, column, in_order, moments_of
from slatprep.pipeline.summary import nothing_usable
from slatprep.readers import contents_of
from slatprep.readers.encoders import resolve_latents
from slatprep.records import AssetPair, Contents, Normalization
from slatprep.store import Store
from slatprep.store.record import FailedRecord


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
    unchanged: Sequence[AssetPair],
    plan: Mapping[str, PlannedAsset],
    before: Before,
    context: BuildContext,
    wanted: Wanted,
    crew: Crew,
    keep_work: bool = False,
) -> tuple[NextStore, list[FailedRecord]]:
    """Return the next store, and the assets that cannot go in by id.

    `finished` are the assets that are new or changed. Rows of the `unchanged` are taken over from
    the existing store, or finished too where that cannot be, or with `keep_work`. StoreError if no
    asset can be used.
    """
    parameters, spool, previous = context.parameters, context.spool, before.previous
    kept: list[Row] = []
    if not (before.damaged or keep_work):
        made = [asset for asset in finished if isinstance(asset, Row)]
        kept = _kept_rows(made, unchanged, plan, before, parameters, wanted)
    if not kept:
        finished = [*finished, *finish(unchanged, plan, context, crew)]
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


def _kept_rows(
    made: Sequence[Row],
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
    if previous is None:
        return []
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
