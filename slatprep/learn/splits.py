"""Which objects are trained on, validated on and tested on."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
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
        Which objects; all if not given.
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
        objects = store.column("object_id")
        chosen &= np.array([split_of(str(object_id), shares) == split for object_id in objects])
    return np.flatnonzero(chosen)
