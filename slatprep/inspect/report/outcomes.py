"""The outcome of each asset of a build, as its records have it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.records import Place, Status
from slatprep.store.reader import Store
from slatprep.store.record import AssetRecord
from slatprep.store.records import StoredRecords, build_in

MOST_TIES = 8
"""Most tied placements of an asset on the page."""

_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Outcome:
    """The outcome of one asset.

    Attributes
    ----------
    asset_id, category : str
        From its record.
    status : Status
        ``ok`` if it is in the store.
    reasons : tuple of str
        Why it is not in the store, or why its verdict is not ``good``.
    tied : int
        Distinct placements that fit about as well as the best.
    displacement : float or None
        Largest distance [voxel] between the best placement and a tied one; None without ties.
    ties : tuple of tuple of float
        Transforms of the first `MOST_TIES` tied placements, each as three rows of four numbers.
    annotations : tuple of int
        Number of annotations that were merged and of all; empty for a single annotation.
    """

    asset_id: str
    category: str
    status: Status
    reasons: tuple[str, ...]
    tied: int
    displacement: float | None
    ties: tuple[tuple[float, ...], ...] = ()
    annotations: tuple[int, ...] = ()


@dataclass(frozen=True)
class Outcomes:
    """The outcomes of a build: sums over all assets, and each asset on the page.

    Attributes
    ----------
    known : dict of str to Outcome
        By id, assets that the page lists, whether in the store or not.
    clipped : ndarray of int64, shape (P,)
        Values outside the range, by property, of all assets.
    absent : Counter
        Assets that are not in the store, by status.
    """

    known: dict[str, Outcome]
    clipped: NDArray[np.int64]
    absent: Counter[Status]


def gather_outcomes(
    manifests: Place, store: Store, listed: Collection[str], most_absent: int
) -> Outcomes:
    """Gather the outcomes of a build from its records.

    It keeps the assets `listed` and at most `most_absent` that are not in the store. StoreError if
    the records cannot be read, belong to another build, or lack an asset of the store.
    """
    build = build_in(manifests)
    if build.id != store.about.manifest:
        raise StoreError(
            f"{manifests} holds the records of build {build.id[:12]!r}, the store was written by "
            f"{store.about.manifest[:12]!r}; name the folder of its own records with --manifests"
        )
    known = {
        one.asset_id: Outcome(one.asset_id, one.category, one.status, (one.reason,), 0, None)
        for one in build.failed[:most_absent]
    }
    for record in StoredRecords(store):
        if record.asset_id in listed:
            known[record.asset_id] = _outcome(record)
    absent = Counter({status: build.statuses.get(str(status), 0) for status in Status})
    del absent[Status.OK]
    clipped = store.column("clipped").sum(axis=0)
    return Outcomes(dict(sorted(known.items())), clipped, +absent)


def kind_of(reason: str) -> str:
    """Return a reason without the file and the numbers of the asset.

    >>> kind_of("only 76.1% of the SLAT boundary lies within 1 voxel of the other side")
    'only N% of the SLAT boundary lies within N voxel of the other side'
    >>> kind_of("a/b.npz: holds 3 voxels twice; expected distinct coordinates")
    'holds N voxels twice'
    """
    return _NUMBER.sub("N", _fault_of(reason))


def kinds_of(reasons: Iterable[str]) -> dict[str, str]:
    """Return the kind of each reason, with the numbers that all reasons of one kind share."""
    all_reasons = list(reasons)
    common: dict[str, list[str]] = {}
    for reason in all_reasons:
        kind, numbers = kind_of(reason), _NUMBER.findall(_fault_of(reason))
        known = common.setdefault(kind, numbers)
        common[kind] = [a if a == b else "N" for a, b in zip(known, numbers, strict=True)]
    kinds = {}
    for reason in all_reasons:
        texts = _NUMBER.split(_fault_of(reason))
        between = [*common[kind_of(reason)], ""]
        kinds[reason] = "".join(a + b for a, b in zip(texts, between, strict=True))
    return kinds


def _fault_of(reason: str) -> str:
    return re.sub(r"^\S*[/\\.]\S*: ", "", reason.partition("; expected")[0])


def _outcome(record: AssetRecord) -> Outcome:
    placements, merged = record.alignment.placements, record.merged
    return Outcome(
        record.asset_id,
        record.category,
        record.status,
        reasons=record.judgement.reasons,
        tied=len(placements),
        displacement=max((placement.displacement for placement in placements), default=None),
        ties=tuple(
            tuple(placement.transform[:3].ravel().tolist()) for placement in placements[:MOST_TIES]
        ),
        annotations=(sum(not one.left_out for one in merged), len(merged)) if merged else (),
    )
