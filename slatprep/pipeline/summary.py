"""What a build did, small enough to print."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from slatprep.pipeline.spool import SpooledAsset
from slatprep.records import Normalization, Place, Status

PROBLEMS_LISTED = 100
"""How many problems a summary lists; the records hold all."""


@dataclass(frozen=True)
class BuildSummary:
    """What a build did.

    Attributes
    ----------
    records : Place
        The JSON Lines file of asset records.
    manifest : str
        Id of the build, a hash of the records' content.
    seconds : float
        Wall clock time.
    statuses : dict
        Assets by status: ``ok``, ``failed``, ``skipped``.
    verdicts : dict
        Assets with status ``ok`` by verdict: ``good``, ``doubtful``, ``failed``.
    n_voxels, n_valid : int
        SLAT voxels of those assets, and how many found an annotation.
    problems : tuple of (str, str)
        Asset id and reason of the first `PROBLEMS_LISTED` that are not ``ok``.
    store : Place or None
        The store; None where only alignments were written.
    normalization : Normalization or None
        Ranges of the properties.
    clipped : dict
        By property, values of ``voxel/properties`` that lay outside its range.
    """

    records: Place
    manifest: str
    seconds: float
    statuses: dict[str, int]
    verdicts: dict[str, int]
    n_voxels: int
    n_valid: int
    problems: tuple[tuple[str, str], ...]
    store: Place | None = None
    normalization: Normalization | None = None
    clipped: Mapping[str, int] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether every asset went in."""
        return all(count == 0 for status, count in self.statuses.items() if status != Status.OK)


def summarise(
    assets: Sequence[SpooledAsset],
    *,
    records: Place,
    manifest: str,
    seconds: float,
    store: Place | None = None,
    normalization: Normalization | None = None,
    clipped: Mapping[str, int] | None = None,
) -> BuildSummary:
    """Count what became of the assets."""
    statuses = Counter(str(asset.status) for asset in assets)
    verdicts = Counter(asset.columns["verdict"] for asset in assets if asset.columns)
    return BuildSummary(
        records=records,
        manifest=manifest,
        seconds=seconds,
        statuses={str(status): statuses[str(status)] for status in Status},
        verdicts=dict(sorted(verdicts.items())),
        n_voxels=sum(asset.n_voxels for asset in assets),
        n_valid=sum(asset.n_valid for asset in assets),
        problems=tuple(problems_of(assets))[:PROBLEMS_LISTED],
        store=store,
        normalization=normalization,
        clipped=dict(clipped or {}),
    )


def problems_of(assets: Iterable[SpooledAsset]) -> list[tuple[str, str]]:
    """Return id and reason of each asset that is not ``ok``."""
    return [(asset.asset_id, asset.reason) for asset in assets if asset.status is not Status.OK]
