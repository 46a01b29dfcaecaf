"""The second pass: ties settled by the consensus, the rotation that most assets share.

It works on what the first pass left in the spool and changes nothing there: an
asset whose placement changes is written again under a key of its own. Its
record keeps what the first pass found, so the next build does not align it
again, with this pass or without.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

from slatprep.align.consensus import find_consensus, settle
from slatprep.align.deformation import map_of
from slatprep.align.quality import measure_quality
from slatprep.judge import judge_with_voxels
from slatprep.parameters import BuildParameters
from slatprep.pipeline.spool import Spool, SpooledAsset
from slatprep.provenance.record import FailedRecord, FirstPass
from slatprep.records import Consensus, StructuredLatents, Verdict
from slatprep.sample import sample
from slatprep.workers.local import Jobs, run_unordered


def apply_consensus(
    assets: Sequence[SpooledAsset], spool: Spool, parameters: BuildParameters, jobs: Jobs
) -> list[SpooledAsset]:
    """Give ambiguous assets the placement nearest to the dataset's common rotation, if asked to.

    Parameters
    ----------
    assets : sequence of SpooledAsset
        The assets of the build.
    spool : Spool
        Where they lie.
    parameters : BuildParameters
        Whether to do it, how annotations are looked up, and the radius of the quality figures.
    jobs : int or Workers
        Worker processes, or a cluster's.

    Returns
    -------
    list of SpooledAsset
        In the same order; those without a tie are the same objects.
    """
    if not parameters.consensus.settle:
        return list(assets)
    consensus = find_consensus(
        asset.columns["transform"]
        for asset in assets
        if not asset.n_placements and asset.columns["verdict"] != Verdict.FAILED
    )
    if consensus is None:
        return list(assets)
    tied = ((asset, spool, consensus, parameters) for asset in assets if asset.n_placements)
    changed = {asset.asset_id: asset for asset in run_unordered(settle_asset, tied, jobs)}
    return [changed.get(asset.asset_id, asset) for asset in assets]


def settle_asset(
    asset: SpooledAsset, spool: Spool, consensus: Consensus, parameters: BuildParameters
) -> SpooledAsset:
    """Settle one asset's tie; return it as it was where the choice stands."""
    first = spool.record(asset.key)
    if isinstance(first, FailedRecord):
        raise TypeError(f"{first.asset_id}: a failed asset has no tie")
    arrays = spool.voxels(asset.key)
    latents = StructuredLatents(arrays["coords"], arrays["feats"])
    alignment = settle(first.alignment, latents, consensus)
    if alignment is first.alignment:
        return asset
    field = spool.field(asset.key)
    quality = measure_quality(field, latents, alignment.transform, parameters.align.radius)
    alignment = replace(alignment, quality=quality)
    annotation = sample(field, map_of(alignment).places(latents.coords), parameters.sample)
    judgement, likely = judge_with_voxels(field, latents, alignment, annotation, parameters.sample)
    annotation = replace(annotation, confidence=likely)
    key = hashlib.sha256(f"{asset.key} {consensus.rotation.tobytes().hex()}".encode()).hexdigest()
    record = replace(
        first,
        key=key,
        alignment=alignment,
        judgement=judgement,
        before_consensus=FirstPass(first.key, first.alignment, first.judgement),
        counts=replace(first.counts, valid=int(annotation.valid.sum())),
    )
    return spool.put(record, field, latents, annotation)
