"""What a build did, small enough to print."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.records import Normalization, Place, Status
from slatprep.store import Store
from slatprep.store.record import FailedRecord
from slatprep.store.records import SEVERAL, file_names

PROBLEMS_LISTED = 100
"""How many problems a summary lists; the records hold all."""


@dataclass(frozen=True)
class BuildSummary:
    """What a build did.

    Attributes
    ----------
    records : Place
        The JSON Lines file of asset records; of more than 1,024 assets, what their files are
        called, with a ``*``.
    build_id : str
        Id of the build, a hash of the records' content.
    seconds : float
        Wall clock time.
    statuses : dict
        Assets by status: ``ok``, ``failed``, ``skipped``.
    verdicts : dict
        Assets with status ``ok`` by verdict: ``good``, ``doubtful``, ``failed``.
    n_voxels, n_valid : int
        SLAT voxels of those assets, and how many found an annotation.
    n_unphysical : int
        PixieVerse voxels of those assets that no annotation was taken from, as no
        material has their properties.
    problems : tuple of (str, str)
        Asset id and reason of the first `PROBLEMS_LISTED` that are not ``ok``.
    contradicted : tuple of str
        Ids of the first `PROBLEMS_LISTED` whose latents contradict their labels.
    store : Place or None
        The store; None where only alignments were written.
    normalization : Normalization or None
        Ranges of the properties.
    clipped : dict
        By property, values of ``voxel/properties`` that lay outside its range.
    warnings : tuple of str
        What a person should know about the dataset as a whole.
    damaged : tuple of str
        What of the existing store was not as it was written, and was made anew.
    rehash_seed : int or None
        What the share of unchanged sources was drawn with that was hashed; None if none was.
    """

    records: Place
    build_id: str
    seconds: float
    statuses: dict[str, int]
    verdicts: dict[str, int]
    n_voxels: int
    n_valid: int
    n_unphysical: int
    problems: tuple[tuple[str, str], ...]
    contradicted: tuple[str, ...] = ()
    store: Place | None = None
    normalization: Normalization | None = None
    clipped: Mapping[str, int] = field(default_factory=dict)
    damaged: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    rehash_seed: int | None = None

    @property
    def complete(self) -> bool:
        """Whether every asset went in."""
        return all(count == 0 for status, count in self.statuses.items() if status != Status.OK)


@dataclass(frozen=True)
class Counts:
    """What of a `BuildSummary` the assets with status ``ok`` tell."""

    verdicts: dict[str, int]
    n_voxels: int
    n_valid: int
    n_unphysical: int
    contradicted: tuple[str, ...]


def counts_in(store: Store) -> Counts:
    """Count what became of the assets of a store."""
    return count(store.ids, np.diff(store.offsets), store.column)


def count(
    ids: Sequence[str], sizes: NDArray[np.int64], column: Callable[[str], NDArray[Any]]
) -> Counts:
    """Count what became of assets: their ids, numbers of voxels (N,), and columns by name."""
    contradicted = sorted(ids[row] for row in np.flatnonzero(column("contradicted")).tolist())
    return Counts(
        verdicts=dict(sorted(Counter(map(str, column("verdict"))).items())),
        n_voxels=int(sizes.sum()),
        n_valid=int(np.rint(column("valid_share") * sizes).sum()),
        n_unphysical=int(column("unphysical").sum()),
        contradicted=tuple(contradicted[:PROBLEMS_LISTED]),
    )


def summarise(
    counts: Counts, failed: Sequence[FailedRecord], records: Place, build_id: str, seconds: float
) -> BuildSummary:
    """Say what became of the assets, by counts of those that went in."""
    statuses = Counter(str(asset.status) for asset in failed)
    statuses[str(Status.OK)] = sum(counts.verdicts.values())
    return BuildSummary(
        records=records,
        build_id=build_id,
        seconds=seconds,
        statuses={str(status): statuses[str(status)] for status in Status},
        problems=tuple((asset.asset_id, asset.reason) for asset in failed[:PROBLEMS_LISTED]),
        **vars(counts),
    )


def summarise_store(
    store: Store,
    failed: Sequence[FailedRecord],
    place: Place,
    manifests: Place,
    seconds: float,
    warnings: Iterable[str] = (),
    damaged: Iterable[str] = (),
) -> BuildSummary:
    """Say what a build's store holds, which its user calls `place`, and what did not go in."""
    names = file_names(len(store))
    records = manifests / (names[0] if len(names) == 1 else SEVERAL)
    clipped = zip(store.about.property_columns, store.column("clipped").sum(axis=0), strict=True)
    return replace(
        summarise(counts_in(store), failed, records, store.about.manifest, seconds),
        store=place,
        normalization=store.normalization,
        clipped={name: int(count) for name, count in clipped},
        warnings=tuple(warnings),
        damaged=tuple(damaged),
    )
