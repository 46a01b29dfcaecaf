"""The report on a dataset: a single HTML file that opens in a browser without a network."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.inspect.report.content import BINS, page_content
from slatprep.inspect.report.outcomes import Outcomes, gather_outcomes
from slatprep.inspect.report.page import write_page
from slatprep.inspect.report.thumbnails import PER_SHEET, sheet, thumbnail
from slatprep.inspect.report.voxels import COARSE, FULL, encode_asset
from slatprep.inspect.tallies import Tally, tally
from slatprep.inspect.verify.index import WORDS
from slatprep.records import Place, Verdict
from slatprep.storage.atomic import staged, writing
from slatprep.store import open_store
from slatprep.store.reader import Store, StoredAsset
from slatprep.store.records import StoredRecords, build_in
from slatprep.workers import Progress
from slatprep.workers.local import run_unordered

__all__ = ["ReportSummary", "write_report"]

ASSETS_IN_DETAIL = 5_000
"""Most assets with a thumbnail and a 3D view."""

ASSETS_LISTED = 50_000
"""Most assets in the table; of a larger store it has a sample, those in detail."""

VOXEL_BYTES = 36_000_000
"""Most bytes of voxels at full detail, before base64 makes them a third larger."""

TASK_ASSETS = 16
"""Assets drawn by one task of a worker."""


@dataclass(frozen=True)
class ReportSummary:
    """The size and contents of a page.

    Attributes
    ----------
    path : Path
        The HTML file.
    size : int
        Its bytes.
    assets : int
        Assets of the build, whether in the store or not.
    listed : int
        Assets in the table: all, or a sample of more than `ASSETS_LISTED`.
    in_detail : int
        Assets with a thumbnail and a 3D view.
    side : int
        Voxels per edge of the 3D views: 64, or 32 where 64 would exceed `VOXEL_BYTES`.
    """

    path: Path
    size: int
    assets: int
    listed: int
    in_detail: int
    side: int


@dataclass(frozen=True)
class Drawn:
    """An asset of the store as drawn: thumbnail, and voxels by level of detail.

    For merged labels, ``votes`` is the mean share of votes for a voxel's class. ``spreads`` has the
    mean spread of each normalised property, NaN where a single annotation has it.
    """

    index: int
    thumbnail: NDArray[np.uint8]
    voxels: dict[int, bytes]
    votes: float = np.nan
    spreads: tuple[float, ...] = ()


def write_report(
    store: Store,
    out: Path,
    *,
    manifests: Place | None = None,
    jobs: int = 1,
    progress: Progress | None = None,
) -> ReportSummary:
    """Write the page of a store.

    Parameters
    ----------
    store : Store
        From `slatprep.store.open_store`.
    out : Path
        The HTML file; an existing file is replaced when the new one is complete.
    manifests : Path, optional
        Folder of the build's records. Without them the page cannot say which assets are
        not in the store, and why.
    jobs : int
        Worker processes. The page's bytes do not depend on it.
    progress : callable, optional
        Called with the number of assets done and the number of all assets.

    Returns
    -------
    ReportSummary
        Its size and contents.

    Raises
    ------
    StoreError
        If the store or its records cannot be read, or belong to different builds.
    """
    _refuse_other_words(store)
    chosen = _chosen(store)
    listed = range(len(store)) if len(store) <= ASSETS_LISTED else chosen
    outcomes: Outcomes | None = None
    created = None
    if manifests is not None:
        created = f"{build_in(manifests).created:%Y-%m-%d}"
        names = {store.ids[row] for row in listed}
        outcomes = gather_outcomes(manifests, store, names, ASSETS_LISTED)
    drawn: list[Drawn] = []
    tallies: dict[str, Tally] = {}
    starts = range(0, len(chosen), TASK_ASSETS)
    tasks = ((store.path, chosen[start : start + TASK_ASSETS]) for start in starts)
    for some, counts in run_unordered(_draw, tasks, jobs):
        drawn += some
        _add(tallies, counts)
        if progress:
            progress(len(drawn), len(chosen))
    drawn.sort(key=attrgetter("index"))
    full = sum(len(one.voxels[FULL]) for one in drawn)
    side = FULL if full <= VOXEL_BYTES else COARSE
    agreement = {one.index: (one.votes, one.spreads) for one in drawn if one.spreads}
    content = page_content(store, outcomes, tallies, listed, chosen, side, created, agreement)
    sheets = [drawn[start : start + PER_SHEET] for start in range(0, len(drawn), PER_SHEET)]
    with writing(str(out), Path(out).parent), staged(Path(out)) as temporary:
        with temporary.open("w", encoding="utf-8", newline="\n") as file:
            write_page(
                file,
                str(content["title"]),
                content,
                sheets=(sheet([one.thumbnail for one in own]) for own in sheets),
                packs=([b64encode(one.voxels[side]).decode() for one in own] for own in sheets),
            )
        size = temporary.stat().st_size
    total, in_table = content["all"]["assets"], len(content["assets"]["id"])
    return ReportSummary(Path(out), size, total, in_table, len(chosen), side)


def _refuse_other_words(store: Store) -> None:
    for name, words in WORDS.items():
        other = set(map(str, store.column(name))) - set(words)
        if other:
            raise StoreError(
                f"{store.path}/asset/{name}: {min(other)!r} is none of {', '.join(words)}, and "
                "cannot be drawn; run `slatprep verify`"
            )


def _chosen(store: Store) -> list[int]:
    """Return the rows of the assets shown in detail, at most `ASSETS_IN_DETAIL`."""
    total = len(store)
    if total <= ASSETS_IN_DETAIL:
        return list(range(total))
    # First those that are not good, then others at even steps through the store.
    doubtful = np.flatnonzero(store.column("verdict") != str(Verdict.GOOD))
    doubtful = doubtful[: ASSETS_IN_DETAIL // 2]
    spread = np.linspace(0, total - 1, ASSETS_IN_DETAIL - len(doubtful)).round().astype(int)
    return [int(index) for index in np.union1d(doubtful, spread)]


def _draw(path: Path, indices: Sequence[int]) -> tuple[list[Drawn], dict[str, Tally]]:
    """Draw some assets of a store and tally their voxels by category, in a worker."""
    store = open_store(path)
    records = StoredRecords(store)
    max_distance = store.about.build.parameters.sample.max_distance
    drawn: list[Drawn] = []
    tallies: dict[str, Tally] = {}
    for index in indices:
        asset = store.asset(store.ids[index])
        way = records.place_map(asset)
        voxels = {side: encode_asset(asset, way, max_distance, side) for side in (FULL, COARSE)}
        drawn.append(Drawn(index, thumbnail(asset), voxels, *_agreement(asset)))
        field = asset.grid_material, asset.grid_properties
        slat = asset.material, asset.properties
        counts = tally(field, slat, store.normalization, BINS, contents=store.contents)
        _add(tallies, {str(asset.columns["category"]): counts})
    return drawn, tallies


def _agreement(asset: StoredAsset) -> tuple[float, tuple[float, ...]]:
    """Return votes and spreads of merged labels, as in `Drawn`."""
    if not asset.merged or not asset.valid.any():
        return np.nan, ()
    spread = np.ma.masked_invalid(asset.spread.astype(np.float64)).mean(axis=0)
    votes = asset.votes[asset.valid].mean(dtype=np.float64)
    return float(votes), tuple(spread.filled(np.nan).tolist())


def _add(tallies: dict[str, Tally], more: Mapping[str, Tally]) -> None:
    for category, counts in more.items():
        tallies[category] = tallies[category] + counts if category in tallies else counts
