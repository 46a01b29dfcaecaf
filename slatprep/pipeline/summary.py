"""What a build did, small enough to print."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from slatprep.parameters import BuildParameters
from slatprep.pipeline.spool import FailedAsset, SpooledAsset
from slatprep.provenance.record import Clipped
from slatprep.readers.pairing import explain_unmatched
from slatprep.records import AssetPair, Normalization, Place, Status

PROBLEMS_LISTED = 100
"""How many problems a summary lists; the records hold all."""


@dataclass(frozen=True)
class BuildSummary:
    """What a build did.

    Attributes
    ----------
    records : Place
        The JSON Lines file of asset records.
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
        What of the store that was there was not as it was written, and was made anew.
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


def summarise_build(
    assets: Sequence[SpooledAsset | FailedAsset],
    *,
    records: Place,
    build_id: str,
    seconds: float,
    store: Place | None = None,
    normalization: Normalization | None = None,
    clipped: Iterable[Clipped] = (),
    damaged: Sequence[str] = (),
    warnings: Iterable[str] = (),
) -> BuildSummary:
    """Count what became of the assets."""
    usable = [asset for asset in assets if isinstance(asset, SpooledAsset)]
    failed = [asset for asset in assets if isinstance(asset, FailedAsset)]
    statuses = Counter(str(asset.status) for asset in failed) + Counter(ok=len(usable))
    verdicts = Counter(str(asset.columns["verdict"]) for asset in usable)
    return BuildSummary(
        records=records,
        build_id=build_id,
        seconds=seconds,
        statuses={str(status): statuses[str(status)] for status in Status},
        verdicts=dict(sorted(verdicts.items())),
        n_voxels=sum(asset.n_voxels for asset in usable),
        n_valid=sum(asset.n_valid for asset in usable),
        n_unphysical=int(np.sum([asset.columns["unphysical"] for asset in usable])),
        problems=tuple((asset.asset_id, asset.reason) for asset in failed[:PROBLEMS_LISTED]),
        contradicted=tuple(
            islice((a.asset_id for a in usable if a.columns["contradicted"]), PROBLEMS_LISTED)
        ),
        store=store,
        normalization=normalization,
        clipped=_clipped_by_property(clipped),
        warnings=tuple(warnings),
        damaged=(*damaged, *(f"{a.asset_id}: {a.damaged}" for a in usable if a.damaged)),
    )


def _clipped_by_property(clipped: Iterable[Clipped]) -> dict[str, int]:
    """Return the clipped values of ``voxel/properties`` of all assets, by property."""
    counts: Counter[str] = Counter()
    for asset in clipped:
        counts.update(asset.voxel)  # Zeros are kept, and the order of the columns.
    return dict(counts)


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
