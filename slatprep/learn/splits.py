"""Which objects are trained on, validated on and tested on."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import ConfigError
from slatprep.records import Verdict
from slatprep.store import Store

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")


@dataclass(frozen=True)
class Shares:
    """Shares of the objects, in expectation; they add up to 1.

    Raises
    ------
    ConfigError
        If they do not, or one is negative.
    """

    train: float = 0.8
    val: float = 0.1
    test: float = 0.1

    def __post_init__(self) -> None:
        values = (self.train, self.val, self.test)
        if min(values) < 0 or abs(sum(values) - 1) > 1e-9:
            raise ConfigError(
                f"shares of train, val and test are {values}; "
                "expected three numbers from 0 to 1 that add up to 1, such as 0.8, 0.1, 0.1"
            )


def position_of(object_id: str) -> float:
    """Return where an object lies in [0, 1): the first 8 bytes of its id's SHA-256, over 2^64."""
    digest = hashlib.sha256(object_id.encode("utf-8")).digest()
    # 53 bits are what a float64 holds exactly, so the result never rounds up to 1.
    return (int.from_bytes(digest[:8], "big") >> 11) / 2**53


def split_of(object_id: str, shares: Shares = Shares()) -> Split:
    """Return the split of an object.

    The id alone decides: all views of an object are in one split, and an
    object stays in its split when the dataset grows.

    Parameters
    ----------
    object_id : str
        PixieVerse id, ``asset/object_id`` of the store.
    shares : Shares
        Shares of the splits.
    """
    position = position_of(object_id)
    if position < shares.train:
        return "train"
    return "val" if position < shares.train + shares.val else "test"


def split_objects(object_ids: Iterable[str], shares: Shares = Shares()) -> dict[str, Split]:
    """Return the split of every object of a dataset, none of those asked for empty.

    It is the split of `split_of`, but for datasets so small that one would get
    no object: it then takes the object whose place in [0, 1) is nearest to its
    own, from a split that has others. That needs as many objects as splits.

    Parameters
    ----------
    object_ids : iterable of str
        All objects of the dataset, whatever is filtered later: the choice
        must be the same for whoever trains and for whoever tests.
    shares : Shares
        Shares of the splits; one with share 0 stays empty.
    """
    splits = {object_id: split_of(object_id, shares) for object_id in sorted(set(object_ids))}
    ends = {"train": 0.0, "val": shares.train, "test": shares.train + shares.val}
    for split in SPLITS:
        share, low = getattr(shares, split), ends[split]
        if share == 0 or split in splits.values():
            continue
        counts = Counter(splits.values())
        spare = [object_id for object_id, other in splits.items() if counts[other] > 1]
        if spare:
            middle = low + share / 2
            splits[min(spare, key=lambda object_id: abs(position_of(object_id) - middle))] = split
    return splits


def select_assets(
    store: Store,
    split: Split | None = None,
    *,
    shares: Shares = Shares(),
    verdicts: Collection[str] | None = None,
    max_ambiguity: float | None = None,
) -> NDArray[np.int64]:
    """Return the indices of assets that a split has, in the order of the store.

    Parameters
    ----------
    store : Store
        An open store.
    split : {"train", "val", "test"}, optional
        Which objects, as `split_objects` decides; all if not given.
    shares : Shares
        Shares of the splits.
    verdicts : collection of str, optional
        Verdicts that are good enough, such as ``("good",)``; all if not given.
    max_ambiguity : float, optional
        Largest ``asset/ambiguity`` that is good enough. An asset without that
        number is then left out.

    Returns
    -------
    ndarray of int64
        Indices for `Store.read`. Assets without one valid voxel are left out:
        they have nothing to learn from and nothing to measure.

    Raises
    ------
    ConfigError
        If a split or a verdict has no such name.
    StoreError
        If the store cannot be read.
    """
    if split is not None and split not in SPLITS:
        raise ConfigError(f"there is no split {split!r}; expected one of {', '.join(SPLITS)}")
    chosen = store.column("valid_share") > 0
    if verdicts is not None:
        unknown = sorted(set(verdicts) - set(Verdict))
        if unknown:
            raise ConfigError(f"verdict is {unknown[0]!r}; expected one of {', '.join(Verdict)}")
        chosen &= np.isin(store.column("verdict").astype(str), sorted(verdicts))
    if max_ambiguity is not None:
        chosen &= store.column("ambiguity") <= max_ambiguity
    if split is not None:
        objects = [str(object_id) for object_id in store.column("object_id")]
        usable = zip(objects, store.column("valid_share") > 0, strict=True)
        splits = split_objects((name for name, is_usable in usable if is_usable), shares)
        chosen &= np.array([splits.get(object_id) == split for object_id in objects])
    return np.flatnonzero(chosen)
