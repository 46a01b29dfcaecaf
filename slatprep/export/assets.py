"""Choose assets of a store, and what all exports say of each."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np

from slatprep.errors import ConfigError, StoreError
from slatprep.records import Verdict
from slatprep.store import Store, StoredAsset

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
"""The columns of ``asset/*`` that travel with an exported asset."""

TARGETS = ("properties", "material", "valid")
"""What a decoder is trained on, beside coordinates and latents."""

_LONGEST_NAME = 180


class Exported(NamedTuple):
    """What was written of an asset: the name of its file, and its number of points."""

    asset: StoredAsset
    file: str
    points: int


def choose_ids(store: Store, assets: Sequence[str], verdicts: Sequence[str]) -> list[str]:
    """Return the ids that were asked for, sorted.

    Parameters
    ----------
    store : Store
        The store.
    assets : sequence of str
        Ids; empty means all.
    verdicts : sequence of str
        Verdicts that may go out; empty means all.

    Raises
    ------
    ConfigError
        If an id or a verdict is unknown, or nothing is left.
    """
    unknown = sorted(set(verdicts) - set(Verdict))
    if unknown:
        raise ConfigError(f"verdict is {unknown[0]!r}; expected one of {', '.join(Verdict)}")
    try:
        rows = sorted({store.find(asset_id) for asset_id in assets}) or range(len(store))
    except StoreError as error:
        # An unknown name is the caller's mistake; nothing is wrong with the store.
        raise ConfigError(str(error)) from None
    verdict = store.column("verdict")
    chosen = [store.ids[row] for row in rows if not verdicts or verdict[row] in verdicts]
    if not chosen:
        there = Counter(str(verdict[row]) for row in rows)
        counts = ", ".join(f"{count} {name}" for name, count in sorted(there.items()))
        raise ConfigError(
            f"{store.path}: no asset has the verdict {' or '.join(verdicts)}; those asked for "
            f"are {counts}"
        )
    return chosen


def describe_columns(asset: StoredAsset) -> dict[str, Any]:
    """Return an asset's id and its `COLUMNS`, as Python's own numbers and words."""
    columns = {name: np.asarray(asset.columns[name]).tolist() for name in COLUMNS}
    return {"asset_id": asset.asset_id, **columns}


def file_name(asset_id: str, *, dots: bool = True) -> str:
    """Return a file name for an asset, without suffix.

    Plain ids stay as they are. Whatever could mean something to a shell, an
    archive or a file system is percent-encoded, as is a leading sign; a name
    that would be too long ends in a hash instead.

    Parameters
    ----------
    asset_id : str
        Any text.
    dots : bool
        Whether dots may stay.

    Examples
    --------
    >>> file_name("0a1b2c.front"), file_name("0a1b2c.front", dots=False)
    ('0a1b2c.front', '0a1b2c%2Efront')
    >>> file_name("../a b"), file_name("-rf")
    ('%2E.%2Fa%20b', '%2Drf')
    """
    name = quote(asset_id, safe="")
    if not dots:
        name = name.replace(".", "%2E")
    if name.startswith((".", "_", "-", "~")):
        name = f"%{ord(name[0]):02X}{name[1:]}"
    if len(name) > _LONGEST_NAME:
        digest = hashlib.sha256(asset_id.encode()).hexdigest()[:32]
        name = f"{name[:_LONGEST_NAME]}~{digest}"
    return name
