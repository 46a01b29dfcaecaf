"""Settle the rows of the next store: which assets, in which order, aligned or taken over."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from slatprep.errors import StoreError
from slatprep.pipeline.carry import Carried, Row, in_order, kept_assets
from slatprep.pipeline.consensus import apply_consensus
from slatprep.pipeline.finish import Crew, finish
from slatprep.pipeline.pack import resolved_contents
from slatprep.pipeline.plan import PlannedAsset
from slatprep.pipeline.spool import FailedAsset, SpooledAsset
from slatprep.pipeline.summary import nothing_usable
from slatprep.pipeline.update import Update
from slatprep.records import AssetPair, Contents


@dataclass(frozen=True, eq=False)
class Rows:
    """What goes into the next store, and what does not.

    Attributes
    ----------
    usable : list of SpooledAsset or KeptAsset
        The assets of the store, by row.
    failed : list of FailedAsset
        Those that have a record and no row, by id.
    contents : Contents
        What the store holds.
    carried : Carried or None
        What is taken from the existing store.
    keys : dict of str to str
        What each asset was made from and how, by id, before passes over the whole dataset.
    """

    usable: list[Row]
    failed: list[FailedAsset]
    contents: Contents
    carried: Carried | None
    keys: dict[str, str]

    @property
    def made(self) -> list[SpooledAsset]:
        """The assets that lie in the spool."""
        return _made(self.usable)


def settle_rows(
    update: Update,
    new: Sequence[SpooledAsset | FailedAsset],
    unchanged: Sequence[AssetPair],
    plan: Mapping[str, PlannedAsset],
    crew: Crew,
    keep_work: bool = False,
) -> Rows:
    """Settle the rows: unchanged ones are taken over, or finished too where that cannot be.

    Parameters
    ----------
    update : Update
        The build.
    new : sequence of SpooledAsset or FailedAsset
        The assets that are new or changed, finished.
    unchanged : sequence of AssetPair
        Those whose alignment is in the existing store.
    plan : mapping of str to PlannedAsset
        What is to be done by id.
    crew : Crew
        Who works.
    keep_work : bool
        Have all assets in the spool.

    Raises
    ------
    StoreError
        If no asset can be used.
    """
    context, wanted = update.context, update.wanted
    parameters, spool = context.parameters, context.spool
    assets: list[Row | FailedAsset] = [*new]
    kept = None
    if not update.damaged and not keep_work:
        seen, declared = update.looked.seen, wanted.declared
        kept = kept_assets(unchanged, plan, _made(new), context, seen, wanted.given, declared)
    assets += finish(unchanged, plan, context, crew) if kept is None else kept
    assets.sort(key=lambda asset: asset.asset_id)
    usable: list[Row] = [asset for asset in assets if not isinstance(asset, FailedAsset)]
    failed = [asset for asset in assets if isinstance(asset, FailedAsset)]
    if not usable:
        raise StoreError(nothing_usable(failed, parameters, update.pairs))
    keys = {asset.asset_id: asset.key for asset in usable}
    if kept is None:
        from slatprep.pipeline.witness import apply_witness  # It needs scipy.

        jobs = crew.of(len(usable))
        made = apply_consensus(_made(usable), spool, parameters, jobs, crew.note)
        labels = wanted.declared.n_labels
        usable = list(apply_witness(made, spool, parameters, jobs, crew.note, labels))
    contents = resolved_contents(usable, wanted.declared, parameters.slat.standardised)
    usable = in_order(usable, context.previous, wanted.compact)
    carried = None
    if kept and context.previous:
        carried = Carried(context.previous, usable, parameters.store)
    return Rows(usable, failed, contents, carried, keys)


def _made(assets: Iterable[Row | FailedAsset]) -> list[SpooledAsset]:
    return [asset for asset in assets if isinstance(asset, SpooledAsset)]
