"""The second pass: ties settled by the rotation that the dataset has in common.

It works on what the first pass left in the spool and changes nothing there: an
asset whose placement changes is written again under a key of its own. Its
record keeps what the first pass found, so the next build does not align it
again, with this pass or without.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from slatprep.align.consensus import find_consensus, settle
from slatprep.align.quality import measure_quality
from slatprep.parameters import BuildParameters
from slatprep.pipeline.asset import annotate_asset
from slatprep.pipeline.spool import Spool, SpooledAsset
from slatprep.provenance import record as provenance
from slatprep.provenance.record import alignment_of
from slatprep.records import (
    BACKGROUND,
    AssetPair,
    Consensus,
    MaterialField,
    Status,
    StructuredLatents,
    Verdict,
)
from slatprep.workers.local import Jobs, run_unordered


def settle_ties(
    assets: Sequence[SpooledAsset], spool: Spool, parameters: BuildParameters, jobs: Jobs
) -> list[SpooledAsset]:
    """Give ambiguous assets the placement nearest to the dataset's common rotation.

    Parameters
    ----------
    assets : sequence of SpooledAsset
        All assets of the build.
    spool : Spool
        Where they lie.
    parameters : BuildParameters
        How annotations are looked up, and the radius of the quality figures.
    jobs : int or Workers
        Worker processes, or a cluster's.

    Returns
    -------
    list of SpooledAsset
        In the same order; those without a tie are the same objects.
    """
    consensus = find_consensus(
        _row(asset)["transform"]
        for asset in assets
        if asset.status is Status.OK
        and not asset.n_placements
        and _row(asset)["verdict"] != Verdict.FAILED
    )
    if consensus is None:
        return list(assets)
    tied = ((asset, spool, consensus, parameters) for asset in assets if asset.n_placements)
    settled = {asset.asset_id: asset for asset in run_unordered(settle_asset, tied, jobs)}
    return [settled.get(asset.asset_id, asset) for asset in assets]


def settle_asset(
    asset: SpooledAsset, spool: Spool, consensus: Consensus, parameters: BuildParameters
) -> SpooledAsset:
    """Settle one asset's tie; return it as it was where the choice stands."""
    record = spool.record(asset.key)
    arrays = spool.voxels(asset.key)
    latents = StructuredLatents(arrays["coords"], arrays["feats"])
    before = alignment_of(record["alignment"])
    after = settle(before, latents, consensus)
    if after is before:
        return asset
    grid, voxels, properties = spool.grid(asset.key)
    field = MaterialField(grid != BACKGROUND, voxels, grid[tuple(voxels.T)], properties)
    quality = measure_quality(field, latents, after.transform, parameters.align.radius)
    after = replace(after, quality=quality)
    result = annotate_asset(_pair_of(record), field, latents, after, parameters)
    key = hashlib.sha256(f"{asset.key} {consensus.rotation.tobytes().hex()}".encode()).hexdigest()
    entries = {
        "key": key,
        "alignment": provenance.alignment_entry(result),
        "counts": provenance.counts_entry(result),
        "before_settling": {"key": asset.key, "alignment": record["alignment"]},
    }
    return spool.put(replace(result, record=record | entries), key)


def _row(asset: SpooledAsset) -> dict[str, Any]:
    if asset.columns is None:
        raise ValueError(f"{asset.asset_id}: status is ok, but its row is missing")
    return asset.columns


def _pair_of(record: Mapping[str, Any]) -> AssetPair:
    """Return the pair that a record is of, as far as names go."""
    nowhere = Path()
    return AssetPair(
        asset_id=record["asset_id"],
        object_id=record["object_id"],
        view=record["view"],
        category=record["category"],
        pixieverse_root=nowhere,
        slat_root=nowhere,
        grid=None,
        mask=None,
        bounds=None,
        slat=None,
    )
