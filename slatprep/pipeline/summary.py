"""What a build did, small enough to print."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np

from slatprep.parameters import BuildParameters
from slatprep.pipeline.rows import FailedAsset, Row
from slatprep.readers.unmatched import explain_unmatched
from slatprep.records import AssetPair, Normalization, Place, Status
from slatprep.store import Store
from slatprep.store.manifests import SEVERAL, file_names

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


def counts_of(assets: Iterable[Row]) -> Counts:
    """Count what became of finished assets."""
    usable = list(assets)
    return Counts(
        verdicts=dict(sorted(Counter(str(asset.columns["verdict"]) for asset in usable).items())),
        n_voxels=sum(asset.n_voxels for asset in usable),
        n_valid=sum(asset.columns["n_valid"] for asset in usable),
        n_unphysical=int(np.sum([asset.columns["unphysical"] for asset in usable])),
        contradicted=tuple(
            islice((a.asset_id for a in usable if a.columns["contradicted"]), PROBLEMS_LISTED)
        ),
    )


def counts_in(store: Store) -> Counts:
    """Count what became of the assets of a store."""
    sizes = np.diff(store.offsets)
    rows = np.flatnonzero(store.column("contradicted"))
    contradicted = sorted(store.ids[row] for row in rows)
    return Counts(
        verdicts=dict(sorted(Counter(map(str, store.column("verdict"))).items())),
        n_voxels=int(sizes.sum()),
        n_valid=int(np.rint(store.column("valid_share") * sizes).sum()),
        n_unphysical=int(store.column("unphysical").sum()),
        contradicted=tuple(contradicted[:PROBLEMS_LISTED]),
    )


def summarise(
    counts: Counts, failed: Sequence[FailedAsset], records: Place, build_id: str, seconds: float
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
    failed: Sequence[FailedAsset],
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


def nothing_usable(
    failed: Sequence[FailedAsset], parameters: BuildParameters, pairs: Collection[AssetPair] = ()
) -> str:
    """Say why there is no store."""
    if unmatched := explain_unmatched(pairs, parameters):
        return f"{unmatched}. There is no store"
    problems = [f"\n  {asset.asset_id}: {asset.reason}" for asset in failed]
    if not problems:
        return (
            f"no asset found in {parameters.pixieverse.root} and {parameters.slat.root}; "
            "expected files that match the patterns of the dataset definition"
        )
    more = f"\n  and {len(problems) - 5} more" if len(problems) > 5 else ""
    return (
        f"none of {len(problems)} assets can be used, so there is no store:"
        f"{''.join(problems[:5])}{more}"
    )
