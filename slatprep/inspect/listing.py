"""The assets of a store in a list, with the reasons of their verdicts."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from slatprep.records import Verdict, words_of
from slatprep.store import Store
from slatprep.store.records import StoredRecords


@dataclass(frozen=True)
class ListedAsset:
    """One line of the list; ``reasons`` say why the verdict is not ``good``."""

    asset_id: str
    category: str
    verdict: str
    confidence: float
    fitness: float
    voxels: int
    reasons: tuple[str, ...]


def rows_chosen(
    store: Store, verdicts: Collection[str] = (), categories: Collection[str] = ()
) -> list[int]:
    """Return the rows of assets with these verdicts and categories; empty takes all."""
    verdicts, categories = words_of(verdicts), words_of(categories)
    named = zip(store.column("verdict"), store.column("category"), strict=True)
    return [
        row
        for row, (verdict, category) in enumerate(named)
        if (not verdicts or verdict in verdicts) and (not categories or category in categories)
    ]


def list_assets(
    store: Store,
    verdicts: Collection[str] = (),
    categories: Collection[str] = (),
    max_confidence: float | None = None,
) -> Iterator[ListedAsset]:
    """Yield the assets of a store, sorted by id.

    They have one of `verdicts` and `categories`, where given, and at most `max_confidence`.
    StoreError if the store, or the record of an asset that is not good, cannot be read.
    """
    table, records, ids = store.table(), StoredRecords(store), store.ids
    for row in sorted(rows_chosen(store, verdicts, categories), key=ids.__getitem__):
        verdict, confidence = str(table["verdict"][row]), float(table["confidence"][row])
        if max_confidence is not None and not confidence <= max_confidence:
            continue
        good = verdict == Verdict.GOOD  # A record takes a millisecond to read, and most are good.
        yield ListedAsset(
            ids[row],
            str(table["category"][row]),
            verdict,
            confidence,
            float(table["fitness"][row]),
            int(table["voxels"][row]),
            () if good else records.read(row).judgement.reasons,
        )
