"""The passes over a whole dataset: the consensus and the witness settle ties, and judge labels.

They read what the first pass left in the spool and change nothing there: a
changed asset is written again under a key of its own. Its record keeps the
result of the first pass, so the next build does not align it again, with these
passes or without.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from slatprep.align.consensus import find_consensus, is_common, settle, turn_if_likelier
from slatprep.align.settle import refit, take
from slatprep.errors import amount
from slatprep.judge import contradicted, witness
from slatprep.parameters import BuildParameters
from slatprep.pipeline.annotate import look_up
from slatprep.pipeline.plan import BuildContext, Crew
from slatprep.pipeline.rows import Row
from slatprep.pipeline.spool import Spool
from slatprep.records import Alignment, Consensus, LatentChoice, Verdict
from slatprep.store.record import FirstPass
from slatprep.store.record_json import to_json
from slatprep.workers.local import run_in_order, run_unordered


def apply_passes(rows: list[Row], context: BuildContext, crew: Crew, labels: int) -> list[Row]:
    """Settle ties by the consensus, then by the latents, if the parameters ask for it.

    `labels` is the number of classes that a voxel may have.
    """
    if context.parameters.consensus.settle:
        rows = apply_consensus(rows, context, crew)
    if context.parameters.witness.settle:
        rows = apply_witness(rows, context, crew, labels)
    return rows


class Reopened:
    """A finished asset, read back from the spool."""

    def __init__(self, asset: Row, spool: Spool) -> None:
        self._asset, self._spool = asset, spool
        self.record, self.field, self.latents, self.annotation = spool.asset(asset.key)
        self.alignment, self.judgement = self.record.alignment, self.record.judgement

    def place(self, alignment: Alignment, parameters: BuildParameters) -> None:
        """Look the field up and judge with another alignment; refit it if its transform is new."""
        if alignment.transform is not self.alignment.transform:
            alignment = refit(alignment, self.field, self.latents, parameters.align)
        looked_up = look_up(self.field, self.latents, alignment, parameters.sample)
        self.alignment, (self.annotation, self.judgement) = alignment, looked_up

    def put(self) -> Row:
        """Write the asset in its current state under a new key; return its row."""
        first = self.record
        record = replace(
            first,
            alignment=self.alignment,
            judgement=self.judgement,
            first_pass=first.first_pass or FirstPass(first.key, first.alignment, first.judgement),
            counts=replace(first.counts, valid=int(self.annotation.valid.sum())),
        )
        key = hashlib.sha256(to_json(record)).hexdigest()
        put = self._spool.put(replace(record, key=key), self.field, self.latents, self.annotation)
        was = self._asset
        return replace(put, damaged=was.damaged, seen=was.seen, aligned=was.aligned)


def apply_consensus(assets: list[Row], context: BuildContext, crew: Crew) -> list[Row]:
    """Give ambiguous assets the placement nearest to the dataset's common rotation.

    The order stays. A row whose placement stays is returned as the same object: if it has no tie
    and shares the rotation, or if the consensus changes neither its tie nor its heading.
    """
    tied = [asset for asset in assets if asset.columns["n_placements"]]
    others = [asset for asset in assets if not asset.columns["n_placements"]]
    voting = [one.columns for one in others if one.columns["verdict"] != Verdict.FAILED]
    transforms = [one["transform"] for one in voting]
    consensus = find_consensus(transforms, [one["object_id"] for one in voting])
    if consensus is None:
        crew.tell(f"consensus: too few objects share a rotation; {len(tied):,} tied ones stay")
        return assets
    turned = [one for one in others if not is_common(one.columns["transform"], consensus)]
    tasks = ((asset, context.spool, consensus, context.parameters) for asset in (*tied, *turned))
    settled = run_unordered(settle_asset, tasks, crew.of(len(assets)))
    changed = {asset.asset_id: asset for asset in settled}

    def moved(some: list[Row]) -> int:
        both = ((one.columns, changed[one.asset_id].columns) for one in some)
        return sum(not np.array_equal(old["transform"], new["transform"]) for old, new in both)

    crew.tell(
        f"consensus: {consensus.agreeing:,} of {consensus.winners:,} objects without a tie share a "
        f"rotation; it gave another placement to {moved(tied):,} of {amount(len(tied), 'tie')}, "
        f"and to {moved(turned):,} of {amount(len(turned), 'asset')} turned otherwise without a tie"
    )
    return [changed.get(asset.asset_id, asset) for asset in assets]


def settle_asset(
    asset: Row, spool: Spool, consensus: Consensus, parameters: BuildParameters
) -> Row:
    """Settle one asset's tie, or weigh its heading; return the same row if nothing changes."""
    first = Reopened(asset, spool)
    own, field, latents = first.alignment, first.field, first.latents
    alignment = settle(own, latents, consensus)
    if alignment is own:
        alignment = turn_if_likelier(own, field, latents, consensus, parameters.align)
    if alignment is own:
        return asset
    first.place(alignment, parameters)
    return first.put()


def apply_witness(assets: list[Row], context: BuildContext, crew: Crew, labels: int) -> list[Row]:
    """Settle ties by the latents and mark labels that they contradict.

    Assets whose verdict is good show how latents are distributed in each class, and how reliable
    they are; `labels` is the number of classes. The order stays; a row that the latents do not
    change is returned as the same object. An asset without a tie is never placed anew.
    """
    spool, parameters, jobs = context.spool, context.parameters, crew.of(len(assets))
    objects = [str(asset.columns["object_id"]) for asset in assets]
    good = [k for k, asset in enumerate(assets) if asset.columns["verdict"] == Verdict.GOOD]
    moments = run_in_order(read_moments, ((assets[k], spool, labels) for k in good), jobs)
    models = witness.fit_models((objects[k], found) for k, found in zip(good, moments, strict=True))
    if models is None:
        crew.tell(f"witness: {len(good):,} good assets have too few classes; latents are not used")
        return assets
    model_of = [models[witness.fold_of(object_id)] for object_id in objects]
    both = zip(assets, model_of, strict=True)
    tasks = ((asset, model, spool, parameters) for asset, model in both)
    evidence = list(run_in_order(weigh_asset, tasks, jobs))
    reliability = witness.reliability_of((objects[k], evidence[k]) for k in good)
    choices = [witness.choice_of(found, reliability) for found in evidence]
    doubted = [
        (asset, spool, choices[k], reliability, model_of[k], parameters)
        for k, asset in enumerate(assets)
        if choices[k] or evidence[k].gain < reliability.least_gain
    ]
    changed = {asset.asset_id: asset for asset in run_unordered(apply_latents, doubted, jobs)}
    contradictions = sum(bool(asset.columns["contradicted"]) for asset in changed.values())
    crew.tell(_told(reliability, choices, contradictions))
    return [changed.get(asset.asset_id, asset) for asset in assets]


def read_moments(asset: Row, spool: Spool, labels: int) -> witness.Moments:
    """Return the moments of an asset's latents."""
    arrays = spool.voxels(asset.key)
    return witness.moments_of(arrays["feats"], arrays["material"], labels)


def weigh_asset(
    asset: Row, model: witness.LatentModel, spool: Spool, parameters: BuildParameters
) -> witness.LatentEvidence:
    """Return the evidence of an asset's latents on its labels."""
    first = Reopened(asset, spool)
    field, latents, material = first.field, first.latents, first.annotation.material
    return witness.weigh(field, latents, first.alignment, material, model, parameters.sample)


def apply_latents(
    asset: Row,
    spool: Spool,
    choice: tuple[int, LatentChoice] | None,
    reliability: witness.Reliability,
    model: witness.LatentModel,
    parameters: BuildParameters,
) -> Row:
    """Place one asset anew by the choice of its latents, or mark its labels as contradicted."""
    first = Reopened(asset, spool)
    if choice is not None:
        number, by = choice
        # Placement 0 is the asset's own: it stays, and is settled now.
        chosen = replace(first.alignment, settled_by=by)
        if number:
            chosen = take(first.alignment, number - 1, first.latents, by)
        first.place(chosen, parameters)
    if model.gain(first.latents.feats, first.annotation.material) < reliability.least_gain:
        first.judgement = contradicted(first.judgement)
    return first.put()


def _told(
    reliability: witness.Reliability,
    choices: Iterable[tuple[int, LatentChoice] | None],
    contradicted: int,
) -> str:
    """Say how reliable latents are, and what they decided."""
    agreeing, good = reliability.agreeing, reliability.witnesses
    fit = (
        f"{agreeing:,} of {good:,} good objects to compare have latents that fit their labels best"
    )
    if not reliability.factor:
        return f"witness: {fit}; too few, so latents are not used"
    decided = [choice[0] for choice in choices if choice]
    moved = sum(number > 0 for number in decided)
    return (
        f"witness: {fit}; latents decide {amount(len(decided), 'tie')}, of which "
        f"{moved:,} took another placement; they contradict the labels of "
        f"{amount(contradicted, 'asset')}"
    )
