"""The pass in which latents are heard: they settle ties, and contradict labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from slatprep.align.settle import take
from slatprep.judge import contradicted
from slatprep.judge.witness import (
    Hearing,
    LatentModel,
    Moments,
    Trial,
    fit_models,
    fold_of,
    hear,
    moments_of,
    ruling_of,
    try_witnesses,
)
from slatprep.parameters import BuildParameters
from slatprep.pipeline.settle import Reopened
from slatprep.pipeline.spool import Spool, SpooledAsset
from slatprep.records import Ruling, Verdict
from slatprep.workers.local import Jobs, run_unordered


def apply_witness(
    assets: Sequence[SpooledAsset], spool: Spool, parameters: BuildParameters, jobs: Jobs
) -> list[SpooledAsset]:
    """Let latents settle ties and contradict labels, if asked to.

    Parameters
    ----------
    assets : sequence of SpooledAsset
        The assets of the build, by id. Those whose verdict is good say what
        latents are like in each class, and whether they can be trusted.
    spool : Spool
        Where they lie.
    parameters : BuildParameters
        Whether to do it, and how to align and to look up.
    jobs : int or Workers
        Worker processes, or a cluster's.

    Returns
    -------
    list of SpooledAsset
        In the same order; those of which latents say nothing are the same
        objects. An asset without a tie is never placed anew.
    """
    if not parameters.witness.settle:
        return list(assets)
    sure = [asset for asset in assets if asset.columns["verdict"] == Verdict.GOOD]
    moments = dict(run_unordered(read_moments, ((asset, spool) for asset in sure), jobs))
    models = fit_models((_object_of(asset), moments[asset.asset_id]) for asset in sure)
    if models is None:
        return list(assets)
    model_of = {asset.asset_id: models[fold_of(_object_of(asset))] for asset in assets}
    tasks = ((asset, spool, model_of[asset.asset_id], parameters) for asset in assets)
    heard = dict(run_unordered(hear_asset, tasks, jobs))
    trial = try_witnesses([heard[asset.asset_id] for asset in sure])
    rulings = {asset.asset_id: ruling_of(heard[asset.asset_id], trial) for asset in assets}
    tasks_of_changed = (
        (asset, spool, rulings[asset.asset_id], trial, model_of[asset.asset_id], parameters)
        for asset in assets
        if rulings[asset.asset_id] or heard[asset.asset_id].gain < trial.least_gain
    )
    changed = {asset.asset_id: asset for asset in run_unordered(rule, tasks_of_changed, jobs)}
    return [changed.get(asset.asset_id, asset) for asset in assets]


def read_moments(asset: SpooledAsset, spool: Spool) -> tuple[str, Moments]:
    """Return an asset's id and the moments of its latents."""
    arrays = spool.voxels(asset.key)
    return asset.asset_id, moments_of(arrays["feats"], arrays["material"])


def hear_asset(
    asset: SpooledAsset, spool: Spool, model: LatentModel, parameters: BuildParameters
) -> tuple[str, Hearing]:
    """Return an asset's id and what its latents say."""
    first = Reopened(asset, spool)
    return asset.asset_id, hear(
        first.field,
        first.latents,
        first.record.alignment,
        first.annotation.material,
        model,
        parameters.sample,
    )


def rule(
    asset: SpooledAsset,
    spool: Spool,
    ruling: tuple[int, Ruling] | None,
    trial: Trial,
    model: LatentModel,
    parameters: BuildParameters,
) -> SpooledAsset:
    """Do with one asset what its latents said; see `slatprep.judge.witness.ruling_of`."""
    first = Reopened(asset, spool)
    alignment, annotation = first.record.alignment, first.annotation
    judgement = first.record.judgement
    if ruling is not None:
        number, by = ruling
        # Placement 0 is the one that the asset has: it stands, and is settled now.
        chosen = (
            take(alignment, number - 1, first.latents, by)
            if number
            else replace(alignment, settled_by=by)
        )
        alignment, annotation, judgement = first.placed(chosen, parameters)
    if model.gain(first.latents.feats, annotation.material) < trial.least_gain:
        judgement = contradicted(judgement)
    return first.put(alignment, annotation, judgement)


def _object_of(asset: SpooledAsset) -> str:
    return str(asset.columns["object_id"])
