"""The assets of a store in a split."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import require_one_of
from slatprep.readers.splits import HASH, SPLITS, Assignment, Split, assign_splits
from slatprep.readers.splits import Shares as Shares
from slatprep.readers.splits import split_of as split_of
from slatprep.records import Place
from slatprep.store import Store


def assign_store(
    store: Store,
    by: str | Place = HASH,
    shares: Shares = Shares(),  # noqa: B008 (immutable)
) -> Assignment:
    """Return the split of every object of a store that has a valid voxel.

    Rule, shares and errors are those of `slatprep.readers.splits.assign_splits`.
    """
    columns = (store.ids, store.column("object_id"), store.column("category"))
    rows = np.flatnonzero(store.column("valid_share") > 0).tolist()
    named = [tuple(str(column[row]) for column in columns) for row in rows]
    objects = {object_id: category for _, object_id, category in named}
    return assign_splits(by, objects, shares, {asset: name for asset, name, _ in named})


def select_assets(
    store: Store,
    split: Split | None = None,
    *,
    shares: Shares = Shares(),  # noqa: B008 (immutable)
    verdicts: Collection[str] = (),
    max_ambiguity: float | None = None,
    splits: Mapping[str, Split] | None = None,
) -> NDArray[np.int64]:
    """Return the rows (K,) of the assets in a split, in the order of the store.

    Assets must have one of `verdicts`, if given, and an ambiguity of at most `max_ambiguity`, not
    NaN. Assets without a valid voxel have no labels, and are left out. `splits` gives the split of
    each object by id, by default the split by hash. ConfigError if split or verdict is unknown.
    """
    if split is not None:
        require_one_of("split", split, SPLITS)
    chosen = store.having(verdicts) & (store.column("valid_share") > 0)
    if max_ambiguity is not None:
        chosen &= store.column("ambiguity") <= max_ambiguity
    if split is not None:
        objects = [str(object_id) for object_id in store.column("object_id")]
        if splits is None:
            splits = assign_store(store, shares=shares).splits
        chosen &= np.array([splits.get(object_id) == split for object_id in objects])
    return np.flatnonzero(chosen)
