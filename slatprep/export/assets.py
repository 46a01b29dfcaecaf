"""Choose the assets of an export, and describe each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from slatprep.errors import ConfigError
from slatprep.records import Verdict
from slatprep.store import Store, StoredAsset
from slatprep.store.layout import MERGED_COLUMNS

COLUMNS = (
    "object_id",
    "view",
    "category",
    "verdict",
    "fitness",
    "fitness_backward",
    "inlier_rmse",
    "ambiguity",
    "valid_share",
)
"""The columns of ``asset/*`` in every export."""

TARGETS = ("properties", "material", "valid")
"""The arrays that a decoder is trained to predict."""


class Exported(NamedTuple):
    """An asset that was written, its file's name, its number of points, figures for the index."""

    asset: StoredAsset
    file: str
    points: int
    figures: Mapping[str, float] = MappingProxyType({})


def with_merged(store: Store, *names: str) -> tuple[str, ...]:
    """Return names of an asset's arrays, and those of merged labels where the store has them."""
    return (*names, *MERGED_COLUMNS) if store.merges else names


def choose_ids(store: Store, assets: Sequence[str | int], verdicts: Sequence[str]) -> list[str]:
    """Return the sorted ids of `assets` with one of `verdicts`; an empty sequence takes all.

    Raises ConfigError if an id or a verdict is unknown, or no asset is left.
    """
    unknown = sorted(set(verdicts) - set(Verdict))
    if unknown:
        raise ConfigError(f"verdict is {unknown[0]!r}; expected one of {', '.join(Verdict)}")
    rows = sorted({store.match(name) for name in assets}) or range(len(store))
    verdict = store.column("verdict")
    ids = (store.ids[row] for row in rows if not verdicts or verdict[row] in verdicts)
    chosen = sorted(ids)
    if not chosen:
        there = Counter(str(verdict[row]) for row in rows)
        counts = ", ".join(f"{count} {name}" for name, count in sorted(there.items()))
        raise ConfigError(
            f"{store.path}: no asset has the verdict {' or '.join(verdicts)}; those asked for "
            f"are {counts}"
        )
    return chosen


def describe_columns(asset: StoredAsset) -> dict[str, Any]:
    """Return an asset's id and its `COLUMNS`, as Python objects."""
    columns = {name: np.asarray(asset.columns[name]).tolist() for name in COLUMNS}
    return {"asset_id": asset.asset_id, **columns}
