"""The pass that compares labels with latents: it settles ties, and names contradicted labels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from slatprep.align.settle import take
from slatprep.judge import contradicted
from slatprep.judge.witness import (
    LatentEvidence,
    LatentModel,
    Moments,
    Reliability,
    choice_of,
    fit_models,
    fold_of,
    moments_of,
    reliability_of,
    weigh,
)
from slatprep.parameters import BuildParameters
from slatprep.pipeline.settle import Reopened
from slatprep.pipeline.spool import Spool, SpooledAsset
from slatprep.records import BACKGROUND, LatentChoice, Verdict
from slatprep.workers.local import Jobs, run_unordered


def apply_witness(
    assets: Sequence[SpooledAsset],
    spool: Spool,
    parameters: BuildParameters,
    jobs: Jobs,
    note: Callable[[str], None] | None = None,
    labels: int = BACKGROUND,
) -> list[SpooledAsset]:
    """Settle ties by the latents and mark labels that they contradict, if asked to.

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
    note : callable, optional
        Gets a line that says what came of it.
    labels : int
        How many classes voxels may have.

    Returns
    -------
    list of SpooledAsset
        In the same order; those of which latents say nothing are the same
        objects. An asset without a tie is never placed anew.
    """
    if not parameters.witness.settle:
        return list(assets)
    sure = [asset for asset in assets if asset.columns["verdict"] == Verdict.GOOD]
    moments = dict(run_unordered(read_moments, ((asset, spool, labels) for asset in sure), jobs))
    models = fit_models((_object_of(asset), moments[asset.asset_id]) for asset in sure)
    tell = note or (lambda line: None)
    if models is None:
        tell(f"witness: {len(sure):,} good assets have too few classes; latents are not used")
        return list(assets)
    model_of = {asset.asset_id: models[fold_of(_object_of(asset))] for asset in assets}
    tasks = ((asset, spool, model_of[asset.asset_id], parameters) for asset in assets)
    evidence = dict(run_unordered(weigh_asset, tasks, jobs))
    reliability = reliability_of([evidence[asset.asset_id] for asset in sure])
    choices = {asset.asset_id: choice_of(evidence[asset.asset_id], reliability) for asset in assets}
    tasks_of_changed = (
        (asset, spool, choices[asset.asset_id], reliability, model_of[asset.asset_id], parameters)
        for asset in assets
        if choices[asset.asset_id] or evidence[asset.asset_id].gain < reliability.least_gain
    )
    changed = {
        asset.asset_id: asset for asset in run_unordered(apply_latents, tasks_of_changed, jobs)
    }
    contradictions = sum(bool(asset.columns["contradicted"]) for asset in changed.values())
    tell(_told(reliability, choices.values(), contradictions))
    return [changed.get(asset.asset_id, asset) for asset in assets]


def read_moments(asset: SpooledAsset, spool: Spool, labels: int) -> tuple[str, Moments]:
    """Return an asset's id and the moments of its latents."""
    arrays = spool.voxels(asset.key)
    return asset.asset_id, moments_of(arrays["feats"], arrays["material"], labels)


def weigh_asset(
    asset: SpooledAsset, spool: Spool, model: LatentModel, parameters: BuildParameters
) -> tuple[str, LatentEvidence]:
    """Return an asset's id and what its latents say of its labels."""
    first = Reopened(asset, spool)
    return asset.asset_id, weigh(
        first.field,
        first.latents,
        first.record.alignment,
        first.annotation.material,
        model,
        parameters.sample,
    )


def apply_latents(
    asset: SpooledAsset,
    spool: Spool,
    choice: tuple[int, LatentChoice] | None,
    reliability: Reliability,
    model: LatentModel,
    parameters: BuildParameters,
) -> SpooledAsset:
    """Place one asset anew as its latents ask, or mark its labels as contradicted."""
    first = Reopened(asset, spool)
    alignment, annotation = first.record.alignment, first.annotation
    judgement = first.record.judgement
    if choice is not None:
        number, by = choice
        # Placement 0 is the one that the asset has: it stands, and is settled now.
        chosen = (
            take(alignment, number - 1, first.latents, by)
            if number
            else replace(alignment, settled_by=by)
        )
        alignment, annotation, judgement = first.placed(chosen, parameters)
    if model.gain(first.latents.feats, annotation.material) < reliability.least_gain:
        judgement = contradicted(judgement)
    return first.put(alignment, annotation, judgement)


def _told(
    reliability: Reliability, choices: Iterable[tuple[int, LatentChoice] | None], contradicted: int
) -> str:
    """Say how reliable latents are, and what they decided."""
    agreeing, good = reliability.agreeing, reliability.witnesses
    fit = f"the latents of {agreeing:,} of {good:,} good assets fit their own labels best"
    if not reliability.factor:
        return f"witness: {fit}; too few, so latents are not used"
    decided = [choice[0] for choice in choices if choice]
    moved = sum(number > 0 for number in decided)
    return (
        f"witness: {fit}; of {len(decided):,} ties that latents decide {moved:,} were given "
        f"another placement; they contradict the labels of {contradicted:,} assets"
    )


def _object_of(asset: SpooledAsset) -> str:
    return str(asset.columns["object_id"])
