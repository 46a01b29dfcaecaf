"""Summarise a store's contents and quality for one screen, and list its assets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import row_of_category
from slatprep.judge import THRESHOLDS
from slatprep.records import Normalization, Place, Verdict
from slatprep.storage.place import storage_of
from slatprep.store import Store
from slatprep.store.reader import open_again
from slatprep.store.records import StoredRecords

_MEDIANS = ("confidence", "expected_accuracy", "fitness", "inlier_rmse", "fitness_backward",
            "overlap")  # fmt: skip


@dataclass(frozen=True)
class GroupOverview:
    """Figures over some assets of a store.

    ``verdicts`` counts the assets by verdict. Confidence, expected accuracy, fitness, rmse [voxel]
    and overlap are medians over the assets; ``valid_share`` is over all their voxels. ``ambiguous``
    counts assets above the threshold of ambiguity, and ``settled`` the good ones among them.
    ``unphysical`` counts PixieVerse voxels without an annotation because no material has their
    properties.
    """

    name: str
    assets: int
    voxels: int
    verdicts: dict[str, int]
    confidence: float
    expected_accuracy: float
    fitness: float
    inlier_rmse: float
    fitness_backward: float
    overlap: float
    valid_share: float
    ambiguous: int
    settled: int
    unphysical: int


@dataclass(frozen=True)
class StoreOverview:
    """The contents of a store.

    ``total`` is over all assets; ``categories`` has an entry for each category, in alphabetical
    order. ``files`` is the number of the store's files, ``size`` their total size in bytes.
    """

    store: Place
    format_version: int
    build_id: str
    files: int
    size: int
    engines: dict[str, int]
    models: dict[str, int]
    normalization: Normalization
    total: GroupOverview
    categories: tuple[GroupOverview, ...]


def overview_of(store: Store) -> StoreOverview:
    """Return the contents of a store, overall and by category; read only ``asset/*`` arrays."""
    names = ("category", "verdict", *_MEDIANS, "valid_share", "ambiguity", "engine", "model",
             "unphysical")  # fmt: skip
    columns = {name: store.column(name) for name in names}
    columns["voxels"] = np.diff(store.offsets)
    rows: dict[str, list[int]] = {}
    for row, category in enumerate(columns["category"]):
        rows.setdefault(str(category), []).append(row)
    sizes = storage_of(store.path).files()
    open_again(store.path, store.identity)  # Else these may be files of another store.
    return StoreOverview(
        store=store.path,
        format_version=store.format_version,
        build_id=store.about.manifest,
        files=len(sizes),
        size=sum(sizes.values()),
        engines=_counts(columns["engine"]),
        models=_counts(columns["model"]),
        normalization=store.normalization,
        total=_group("all", columns, list(range(len(store)))),
        categories=tuple(
            _group(row_of_category(name), columns, own) for name, own in sorted(rows.items())
        ),
    )


def _group(name: str, columns: dict[str, NDArray[Any]], chosen: list[int]) -> GroupOverview:
    own = {column: values[chosen] for column, values in columns.items()}
    voxels, verdicts = int(own["voxels"].sum()), _counts(own["verdict"])
    tied = own["ambiguity"] > THRESHOLDS.good_ambiguity
    return GroupOverview(
        name=name,
        assets=len(chosen),
        voxels=voxels,
        verdicts={str(verdict): verdicts.get(str(verdict), 0) for verdict in Verdict},
        **{median: float(np.median(own[median])) for median in _MEDIANS},
        valid_share=float(own["valid_share"] @ own["voxels"] / voxels),
        ambiguous=int(tied.sum()),
        settled=int((tied & (own["verdict"] == Verdict.GOOD)).sum()),
        unphysical=int(own["unphysical"].sum()),
    )


def _counts(values: Sequence[Any] | NDArray[Any]) -> dict[str, int]:
    return dict(sorted(Counter(map(str, values)).items()))


@dataclass(frozen=True)
class ListedAsset:
    """One asset of the list; ``reasons`` say why the verdict is not ``good``."""

    asset_id: str
    category: str
    verdict: str
    confidence: float
    fitness: float
    voxels: int
    reasons: tuple[str, ...]


def list_assets(
    store: Store,
    verdicts: Collection[str] = (),
    categories: Collection[str] = (),
    max_confidence: float | None = None,
) -> Iterator[ListedAsset]:
    """Yield the assets of a store, sorted by id.

    If given, `verdicts`, `categories` and `max_confidence` choose the assets. Raises StoreError if
    the store, or the record of an asset that is not good, cannot be read.
    """
    table, records, ids = store.table(), StoredRecords(store), store.ids
    rows = np.flatnonzero(store.having(verdicts, categories)).tolist()
    for row in sorted(rows, key=ids.__getitem__):
        verdict, confidence = str(table["verdict"][row]), float(table["confidence"][row])
        if max_confidence is not None and not confidence <= max_confidence:
            continue
        good = verdict == Verdict.GOOD  # Needs no record, which takes a millisecond to read.
        yield ListedAsset(
            ids[row],
            str(table["category"][row]),
            verdict,
            confidence,
            float(table["fitness"][row]),
            int(table["voxels"][row]),
            () if good else records.read(row).judgement.reasons,
        )
