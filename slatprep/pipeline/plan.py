"""Plan what a build will do with each asset, and why.

Sources are compared by content, unless their state is the one that the last build saw
(`slatprep.pipeline.seen`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from types import MappingProxyType

from slatprep.errors import ConfigError, MissingPartnerError, SlatprepError, StoreError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.recipe import Recipe
from slatprep.pipeline.rows import Names, SourceStore
from slatprep.pipeline.seen import as_read
from slatprep.pipeline.spool import Spool
from slatprep.readers import hash_sources
from slatprep.records import AssetPair, Place, SourceFile, Status
from slatprep.storage.faults import reached
from slatprep.storage.states import noting
from slatprep.store.record import AssetRecord
from slatprep.store.record_json import RecordError
from slatprep.workers import Progress
from slatprep.workers.local import Jobs, at_most, run_unordered

Note = Callable[[str], None]
"""Callback that gets a line for the user."""


@dataclass(frozen=True)
class Crew:
    """The workers of a build, and the callbacks that report on it.

    `jobs` are worker processes, or a cluster's workers; there are at least `assets_per_job` assets
    for each process that is started. `progress` is called with the number of assets done and of
    all assets, at the beginning with 0 done. `note` is called with lines for the user.
    """

    jobs: Jobs
    assets_per_job: int = 1
    progress: Progress | None = None
    note: Note | None = None

    def __post_init__(self) -> None:
        if self.assets_per_job < 1:
            raise ConfigError(f"assets_per_job is {self.assets_per_job}; expected at least 1")

    def of(self, assets: int) -> Jobs:
        """Return the workers for a number of assets."""
        return at_most(assets // self.assets_per_job, self.jobs)

    def tell(self, line: str) -> None:
        """Give a line for the user to `note`, if there is one."""
        if self.note:
            self.note(line)


@dataclass(frozen=True)
class BuildContext:
    """The facts about a build that its tasks need.

    `recipe` follows from parameters and code. Finished assets go to `spool`; `previous` is the
    existing store. With `strict`, an asset's fault is raised instead of recorded.
    """

    parameters: BuildParameters
    recipe: Recipe
    spool: Spool
    previous: SourceStore | None
    strict: bool


class Action(StrEnum):
    """Action of a build on an asset.

    ``align``: from its sources to the spool. ``reuse``: its alignment is in the existing store.
    ``resume``: an interrupted build finished it. ``refuse``: it cannot go in. ``skip``: its partner
    is missing. ``remove``: it is in the store but no longer in the dataset.
    """

    ALIGN = "align"
    REUSE = "reuse"
    RESUME = "resume"
    REFUSE = "refuse"
    SKIP = "skip"
    REMOVE = "remove"


@dataclass(frozen=True, slots=True)
class PlannedAsset:
    """The planned action for one asset.

    Attributes
    ----------
    asset_id : str
        Id of the row.
    action : Action
        The action.
    reason : str
        Reason for it, in one line.
    key : str
        See `slatprep.pipeline.recipe`; empty if the sources were not, or cannot be, read.
    names : mapping of str to object, or None
        Names that differ from its record, such as its category or the paths of its files.
    seen : bytes
        State of its sources; empty if they were not looked at.
    """

    asset_id: str
    action: Action
    reason: str
    key: str = ""
    names: Names | None = None
    seen: bytes = b""


@dataclass(frozen=True)
class BuildPlan:
    """The planned actions for `assets`, sorted by id, to make or replace a `store`.

    `damaged` are damaged parts of the existing store, in words, which will be made anew.
    `taken_out` says by id why assets will leave the store, and `warnings` are as of a build.
    """

    store: Place
    assets: tuple[PlannedAsset, ...]
    damaged: tuple[str, ...] = ()
    taken_out: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def statuses(self) -> dict[str, int]:
        """Number of assets by status, as far as it is known before the build."""
        counts = self.actions
        failed, skipped = counts[Action.REFUSE], counts[Action.SKIP]
        going_in = sum(counts.values()) - failed - skipped - counts[Action.REMOVE]
        return {Status.OK: going_in, Status.FAILED: failed, Status.SKIPPED: skipped}

    @property
    def actions(self) -> dict[str, int]:
        """Number of assets by action."""
        counts = Counter(asset.action for asset in self.assets)
        return {str(action): counts[action] for action in Action}


def plan_assets(
    pairs: Sequence[AssetPair],
    context: BuildContext,
    crew: Crew,
    known: Mapping[str, tuple[bytes, str]] = MappingProxyType({}),
    *,
    ahead: bool = False,
) -> dict[str, PlannedAsset]:
    """Return the planned action of each asset, by id, including assets to be removed.

    `known` has state and key of assets whose sources need not be hashed again. If there is no
    earlier work, no sources are hashed, unless the plan must say `ahead` which cannot be read.
    """
    resumable = context.spool.holds_any()
    if not (ahead or resumable or context.previous is not None):
        return {pair.asset_id: PlannedAsset(pair.asset_id, Action.ALIGN, "new") for pair in pairs}
    plan = {}
    other = []
    for pair in pairs:
        state, key = known.get(pair.asset_id, (b"", ""))
        if not key or (resumable and context.spool.find(key)):
            other.append(pair)
        else:
            reuse = PlannedAsset(pair.asset_id, Action.REUSE, "unchanged", key, seen=state)
            plan[pair.asset_id] = reuse
    tasks = ((pair, context) for pair in other)
    for planned in run_unordered(plan_asset, tasks, crew.of(len(pairs) - len(known))):
        plan[planned.asset_id] = planned
        if crew.progress:
            crew.progress(len(plan), len(pairs))
    there = () if context.previous is None else context.previous.ids
    gone = set(there) - {pair.asset_id for pair in pairs}
    plan |= {one: PlannedAsset(one, Action.REMOVE, why) for one, why in why_taken_out(gone).items()}
    return dict(sorted(plan.items()))


def why_taken_out(removed: Iterable[str], refused: Collection[str] = ()) -> dict[str, str]:
    """Say by id why assets leave a store; `refused` assets are still in the dataset."""
    why = "no longer in the dataset"
    return {one: "cannot be used now" if one in refused else why for one in removed}


def plan_asset(pair: AssetPair, context: BuildContext) -> PlannedAsset:
    """Return the planned action of one asset, after hashing its sources."""
    reached("asset compared", pair.asset_id)
    with noting() as noted:
        try:
            sources, digests = hash_sources(pair)
        except SlatprepError as error:
            action = Action.SKIP if isinstance(error, MissingPartnerError) else Action.REFUSE
            return PlannedAsset(pair.asset_id, action, " ".join(str(error).split()))
    return replace(_planned(pair, sources, digests, context), seen=as_read(pair, noted))


def _planned(
    pair: AssetPair,
    sources: tuple[SourceFile, ...],
    digests: Mapping[str, str],
    context: BuildContext,
) -> PlannedAsset:
    """Return the planned action of an asset whose sources have been hashed."""
    asset_id, recipe = pair.asset_id, context.recipe
    key = recipe.key(asset_id, digests)
    planned = partial(PlannedAsset, asset_id, key=key)
    if found := context.spool.find(key):
        names = names_of(pair, sources, found[0])
        return planned(Action.RESUME, "finished by an earlier build", names=names)
    try:
        record = None if context.previous is None else context.previous.record(asset_id)
    except StoreError as error:
        fault = error.faults[0] if isinstance(error, RecordError) else error
        return planned(Action.ALIGN, f"its record cannot be read: {fault}")
    if record is None:
        return planned(Action.ALIGN, "not in the store")
    if record.key != key:
        return planned(Action.ALIGN, recipe.difference(record, sources))
    names = names_of(pair, sources, record)
    changed = f", but for {', '.join(names)}" if names else ""
    return planned(Action.REUSE, f"unchanged{changed}", names=names)


def names_of(pair: AssetPair, sources: tuple[SourceFile, ...], record: AssetRecord) -> Names | None:
    """Return the names of an asset and its files that differ from its record; None if none do."""
    names = {name: getattr(pair, name) for name in ("object_id", "view", "category")}
    names["sources"] = sources
    return {name: own for name, own in names.items() if getattr(record, name) != own} or None
