"""What a build will do with each asset, and why, before it does it.

Sources are compared by content. Their sizes and times are not trusted: a
copied or restored file keeps them, and hashing takes a small part of what
aligning takes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from slatprep.errors import SlatprepError
from slatprep.parameters import BuildParameters
from slatprep.pipeline.recipe import Recipe
from slatprep.pipeline.spool import Spool
from slatprep.provenance.jsonable import jsonable
from slatprep.readers import discover
from slatprep.readers.identity import hash_sources
from slatprep.records import AssetPair, Place, SourceFile
from slatprep.store.records import StoredRecords, stored_records
from slatprep.workers.local import Jobs, run_unordered


class Action(StrEnum):
    """What a build does with an asset."""

    ALIGN = "align"
    REUSE = "reuse"
    RESUME = "resume"
    REFUSE = "refuse"
    REMOVE = "remove"


@dataclass(frozen=True, slots=True)
class PlannedAsset:
    """What will be done with one asset.

    Attributes
    ----------
    asset_id : str
        Id of the row.
    action : Action
        ``align``: from its sources to the spool. ``reuse``: its alignment is
        in the store that is there. ``resume``: an interrupted build finished
        it. ``refuse``: it cannot go in. ``remove``: it is in the store but no
        longer in the dataset.
    reason : str
        Why, in one line.
    key : str
        See `slatprep.pipeline.recipe`; empty where the sources cannot be read.
    names : dict
        Entries of the record that differ from what is known of the asset,
        though its content does not: its category, paths of its files.
    """

    asset_id: str
    action: Action
    reason: str
    key: str = ""
    names: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class BuildPlan:
    """What a build will do.

    Attributes
    ----------
    store : Place
        The store to make or replace.
    assets : tuple of PlannedAsset
        Sorted by id.
    """

    store: Place
    assets: tuple[PlannedAsset, ...]

    @property
    def actions(self) -> dict[str, int]:
        """Assets by action."""
        counts = Counter(asset.action for asset in self.assets)
        return {str(action): counts[action] for action in Action}


def plan_assets(
    parameters: BuildParameters,
    recipe: Recipe,
    spool: Spool | None,
    previous: tuple[Place, str] | None,
    jobs: Jobs,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[PlannedAsset]:
    """Yield what will be done with each asset, in no order, those to be removed last.

    Parameters
    ----------
    parameters : BuildParameters
        Where the sources lie.
    recipe : Recipe
        What the build's parameters and code come to.
    spool : Spool or None
        What an interrupted build left.
    previous : (Place, str) or None
        The store that is there, and its build's id.
    jobs : int or Workers
        Worker processes, or a cluster's.
    progress : callable, optional
        Called with the assets done and the assets in all.
    """
    # Listing names twice is cheap; holding a list of all pairs is not.
    total = sum(1 for _ in discover(parameters)) if progress else 0
    tasks = ((pair, recipe, spool, previous) for pair in discover(parameters))
    seen = set()
    for planned in run_unordered(plan_asset, tasks, jobs):
        seen.add(planned.asset_id)
        if progress:
            progress(len(seen), total)
        yield planned
    records = _records(previous)
    for asset_id in records.ids if records else ():
        if asset_id not in seen:
            yield PlannedAsset(asset_id, Action.REMOVE, "no longer among the sources")


def plan_asset(
    pair: AssetPair, recipe: Recipe, spool: Spool | None, previous: tuple[Place, str] | None
) -> PlannedAsset:
    """Say what will be done with one asset, and why."""
    try:
        sources, digests = hash_sources(pair)
    except SlatprepError as error:
        return PlannedAsset(pair.asset_id, Action.REFUSE, " ".join(str(error).split()))
    key = recipe.key(pair.asset_id, digests)
    if spool is not None and spool.find(key) is not None:
        reason = "finished by an earlier build"
        names = _new_names(spool.record(key), pair, sources)
        return PlannedAsset(pair.asset_id, Action.RESUME, reason, key, names)
    record = previous_record(previous, pair.asset_id)
    if record is None:
        return PlannedAsset(pair.asset_id, Action.ALIGN, "not in the store", key)
    if record["key"] == key:
        names = _new_names(record, pair, sources)
        reason = f"unchanged, but for {', '.join(names)}" if names else "unchanged"
        return PlannedAsset(pair.asset_id, Action.REUSE, reason, key, names)
    return PlannedAsset(pair.asset_id, Action.ALIGN, recipe.difference(record, sources), key)


def _new_names(
    record: dict[str, Any], pair: AssetPair, sources: tuple[SourceFile, ...]
) -> dict[str, Any]:
    names = {
        "object_id": pair.object_id,
        "view": pair.view,
        "category": pair.category,
        "sources": jsonable(sources),
    }
    return {name: value for name, value in names.items() if record[name] != value}


def previous_record(previous: tuple[Place, str] | None, asset_id: str) -> dict[str, Any] | None:
    """Return what is recorded of an asset of the store that is there, as the first pass left it."""
    records = _records(previous)
    record = records.find(asset_id) if records else None
    return record and {**record, **(record["before_settling"] or {})}


def _records(previous: tuple[Place, str] | None) -> StoredRecords | None:
    return stored_records(*previous) if previous else None
