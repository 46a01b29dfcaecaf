"""The pass by which ties are settled by the consensus, the rotation that most assets share."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from slatprep.align.consensus import find_consensus, settle
from slatprep.parameters import BuildParameters
from slatprep.pipeline.settle import Reopened
from slatprep.pipeline.spool import Spool, SpooledAsset
from slatprep.records import Consensus, Verdict
from slatprep.workers.local import Jobs, run_unordered


def apply_consensus(
    assets: Sequence[SpooledAsset],
    spool: Spool,
    parameters: BuildParameters,
    jobs: Jobs,
    note: Callable[[str], None] | None = None,
) -> list[SpooledAsset]:
    """Give ambiguous assets the placement nearest to the dataset's common rotation, if asked to.

    Parameters
    ----------
    assets : sequence of SpooledAsset
        The assets of the build.
    spool : Spool
        Where they lie.
    parameters : BuildParameters
        Whether to do it, and how to align and to look up.
    jobs : int or Workers
        Worker processes, or a cluster's.
    note : callable, optional
        Gets a line that says what came of it.

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
    tied = [asset for asset in assets if asset.n_placements]
    tell = note or (lambda line: None)
    if consensus is None:
        tell(f"consensus: too few assets share a rotation; all {len(tied):,} ties stay")
        return list(assets)
    tasks = ((asset, spool, consensus, parameters) for asset in tied)
    changed = {asset.asset_id: asset for asset in run_unordered(settle_asset, tasks, jobs)}
    moved = sum(changed[asset.asset_id] is not asset for asset in tied)
    tell(
        f"consensus: {consensus.agreeing:,} of {consensus.winners:,} assets without a tie share a "
        f"rotation; {moved:,} of {len(tied):,} ties were given another placement by it"
    )
    return [changed.get(asset.asset_id, asset) for asset in assets]


def settle_asset(
    asset: SpooledAsset, spool: Spool, consensus: Consensus, parameters: BuildParameters
) -> SpooledAsset:
    """Settle one asset's tie; return it as it was where the choice stands."""
    first = Reopened(asset, spool)
    alignment = settle(first.record.alignment, first.latents, consensus)
    if alignment is first.record.alignment:
        return asset
    return first.put(*first.placed(alignment, parameters))
