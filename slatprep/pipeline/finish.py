"""Bring assets into the spool, each by one worker; progress is reported."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from slatprep.pipeline.plan import Action, BuildContext, PlannedAsset
from slatprep.pipeline.rows import Row
from slatprep.readers.published import fetch_members
from slatprep.records import AssetPair
from slatprep.store.record import FailedRecord
from slatprep.workers.local import Jobs, at_most, run_unordered, start_early

Progress = Callable[[int, int], None]
"""Called with the assets done and the assets in all; at the beginning with none done."""

Note = Callable[[str], None]
"""Called with a line for the user."""


@dataclass(frozen=True)
class Crew:
    """Who works on a build, and who is told of it.

    Attributes
    ----------
    jobs : int or Workers
        Worker processes, or a cluster's.
    assets_per_job : int
        No more processes are started than there are so many assets for.
    progress : callable or None
        See `Progress`.
    note : callable or None
        See `Note`.
    seen : dict of str to bytes
        States of the sources of assets as they were read, by id.
    """

    jobs: Jobs
    assets_per_job: int = 1
    progress: Progress | None = None
    note: Note | None = None
    seen: dict[str, bytes] = field(default_factory=dict)

    def of(self, assets: int) -> Jobs:
        """Return who works on so many assets."""
        return at_most(assets // self.assets_per_job, self.jobs)

    def tell(self, line: str) -> None:
        """Give a line for the user to whoever listens."""
        if self.note:
            self.note(line)


def finish(
    pairs: Sequence[AssetPair],
    plan: Mapping[str, PlannedAsset],
    context: BuildContext,
    crew: Crew,
) -> list[Row | FailedRecord]:
    """Bring assets into the spool; return what is kept of each, in no order.

    `plan` says what is to be done by id; of those that it does not have, everything.
    """
    if not pairs:
        return []
    # Late: a run that finds nothing changed needs neither numba nor scipy.
    from slatprep.pipeline.asset import compile_kernels, fail_asset, finish_asset

    jobs = crew.of(len(pairs))
    actions = {planned.action if (planned := plan.get(p.asset_id)) else Action.ALIGN for p in pairs}
    if isinstance(jobs, int) and Action.ALIGN in actions:
        start_early(finish_asset, jobs)
        fetch_members((pair for pair in pairs if _is_new(pair, plan)), crew.note)
        compile_kernels(crew.note)  # Before workers of this machine work, each to compile all.
    tasks = ((pair, plan.get(pair.asset_id), context) for pair in pairs)
    assets: list[Row | FailedRecord] = []
    if crew.progress:
        crew.progress(0, len(pairs))
    for asset in run_unordered(finish_asset, tasks, jobs, fail_asset):
        assets.append(asset)
        if isinstance(asset, Row) and asset.seen:
            crew.seen[asset.asset_id] = asset.seen
        if crew.progress:
            crew.progress(len(assets), len(pairs))
    return assets


def _is_new(pair: AssetPair, plan: Mapping[str, PlannedAsset]) -> bool:
    """Whether the sources of an asset will be read."""
    planned = plan.get(pair.asset_id)
    return planned is None or planned.action is Action.ALIGN
