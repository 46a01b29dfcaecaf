"""The outcome of each asset of a build, as its records have it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from slatprep.errors import StoreError
from slatprep.records import Place, Status
from slatprep.store.reader import Store
from slatprep.store.record import AssetRecord
from slatprep.store.records import StoredRecords, build_in

MOST_TIES = 8
"""Most tied placements of an asset on the page."""

DIGITS = 5
"""Decimal places of numbers on the page."""

# Not "failed", which is a verdict on an alignment: these were not aligned at all.
_ABSENT = {Status.FAILED: "not built", Status.SKIPPED: "skipped"}

_NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?")


Columns = dict[str, Any]
"""What the table on the page says of one asset, by the names of its columns."""


@dataclass(frozen=True)
class Outcomes:
    """The outcomes of a build: each asset on the page, and how many are not in the store.

    Attributes
    ----------
    created : str
        Day of the build.
    stored : dict of str to Columns
        By id, what records say of the assets of the store that the page lists.
    absent : list of Columns
        Assets that are not in the store, sorted by id.
    states : Counter
        All of those, by state.
    """

    created: str
    stored: dict[str, Columns]
    absent: list[Columns]
    states: Counter[str]


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
    records = (record for record in StoredRecords(store) if record.asset_id in listed)
    failed = sorted(build.failed[:most_absent], key=lambda one: one.asset_id)
    states = {state: build.statuses.get(str(status), 0) for status, state in _ABSENT.items()}
    return Outcomes(
        created=f"{build.created:%Y-%m-%d}",
        stored={record.asset_id: _columns_of(record) for record in records},
        absent=[
            {
                "id": one.asset_id,
                "category": one.category,
                "state": _ABSENT[one.status],
                "reasons": [one.reason],
            }
            for one in failed
        ],
        states=+Counter(states),
    )


def _columns_of(record: AssetRecord) -> Columns:
    placements, merged = record.alignment.placements, record.merged
    return {
        "reasons": list(record.judgement.reasons),
        # Distinct placements that fit about as well as the best, and the first of their transforms.
        "tied": len(placements),
        "ties": [
            [round(number, 6) for number in one.transform[:3].ravel().tolist()]
            for one in placements[:MOST_TIES]
        ],
        "displacement": rounded(max((one.displacement for one in placements), default=None)),
        "annotations": [sum(not one.left_out for one in merged), len(merged)] if merged else None,
    }


def rounded(value: float | None) -> float | None:
    """Return a number with as many digits as the page has; None where it is not finite."""
    return None if value is None or not np.isfinite(value) else round(value, DIGITS)


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
