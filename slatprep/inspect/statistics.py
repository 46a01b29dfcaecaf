"""What the voxels of a store are: classes and properties, before and after the lookup."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.inspect.listing import rows_chosen
from slatprep.inspect.tallies import JOINT_BINS, SideTally, Tally, no_tally, pooled, tally
from slatprep.records import (
    BACKGROUND,
    Normalization,
    Place,
    Verdict,
)
from slatprep.store import Store, open_store
from slatprep.workers import Progress
from slatprep.workers.local import run_in_order

BINS = 4096
"""Bins that quantiles are read from, over a property's range."""

DRAWN_BINS = 64
"""Bins of the histograms that are handed out."""

QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
_QUANTILE_NAMES = tuple(f"{100 * quantile:g}%" for quantile in QUANTILES)

Weight = Literal["voxel", "asset"]
"""What weighs one: every voxel, or all voxels of an asset's side together."""

_TASK_ASSETS = 32


@dataclass(frozen=True)
class Distribution:
    """Mean, standard deviation (of the population), ends, and quantiles by name (``50%``)."""

    mean: float
    std: float
    least: float
    most: float
    quantiles: dict[str, float]


@dataclass(frozen=True)
class PropertyStatistics:
    """One property: in its SI unit, and of log10 of that where it is normalised so."""

    unit: str
    si: Distribution
    log10: Distribution | None


@dataclass(frozen=True)
class SideStatistics:
    """Some voxels of the PixieVerse fields, or of the SLATs.

    Attributes
    ----------
    assets, voxels : int
        Assets that have such a voxel, and those voxels; of a field those that are occupied.
    share : float
        What they weigh, of all voxels of that side.
    unannotated : float
        Of that the share without an annotation: a field's voxels without a
        class, a SLAT's voxels that are not valid.
    classes : dict of str to float
        Of the annotated ones the share of each class.
    properties : dict of str to PropertyStatistics
        Of the annotated ones.
    """

    assets: int
    voxels: int
    share: float
    unannotated: float
    classes: dict[str, float]
    properties: dict[str, PropertyStatistics]


@dataclass(frozen=True)
class GroupStatistics:
    """All voxels, those of a class, or those of the assets of a category.

    ``field`` is before the lookup, ``slat`` after it; ``verdicts`` counts the
    assets by verdict, and is empty for a class, which no asset belongs to.
    """

    by: Literal["all", "class", "category"]
    name: str
    verdicts: dict[str, int]
    field: SideStatistics
    slat: SideStatistics


@dataclass(frozen=True, eq=False)
class Histogram:
    """Weights by class (7, bins) of one property; `edges` (bins + 1,) in log10 where that is so."""

    name: str
    unit: str
    log10: bool
    edges: NDArray[np.float64]
    field: NDArray[np.float64]
    slat: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class JointHistogram:
    """Weights (bins, bins) of two properties together, with their edges as in `Histogram`."""

    names: tuple[str, str]
    edges: tuple[NDArray[np.float64], NDArray[np.float64]]
    field: NDArray[np.float64]
    slat: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StoreStatistics:
    """What the voxels of a store are.

    Attributes
    ----------
    store : Place
        The store.
    assets, assets_chosen : int
        Assets of the store, and those that the filters left.
    weight : str
        What weighs one, ``voxel`` or ``asset``.
    quantile_error : dict of str to float
        How far a quantile of each property may be off, in log10 where it is
        normalised so, in its SI unit otherwise: the width of the bin that it is
        read from, whose mean it is, so that values which recur come back as
        they are. All else is exact but for rounding.
    total : GroupStatistics
        All chosen assets.
    classes, categories : tuple of GroupStatistics
        The same by class, in the store's order, and by category, in alphabetical order.
    histograms : tuple of Histogram
        Of each property, over its range.
    joint : JointHistogram or None
        Of the first two properties; None where there is only one.
    """

    store: Place
    assets: int
    assets_chosen: int
    weight: Weight
    quantile_error: dict[str, float]
    total: GroupStatistics
    classes: tuple[GroupStatistics, ...]
    categories: tuple[GroupStatistics, ...]
    histograms: tuple[Histogram, ...]
    joint: JointHistogram | None

    @property
    def groups(self) -> tuple[GroupStatistics, ...]:
        """All groups: the total, the classes, the categories."""
        return (self.total, *self.classes, *self.categories)


def store_statistics(
    store: Store,
    *,
    verdicts: Collection[str] = (),
    categories: Collection[str] = (),
    weight: Weight = "voxel",
    jobs: int = 1,
    progress: Progress | None = None,
) -> StoreStatistics:
    """Return what the voxels of a store are, by class, category and property.

    Each chosen asset is read once, its grid included. Memory does not grow with
    assets, and with categories only by what is returned of each.

    Parameters
    ----------
    store : Store
        From `slatprep.open_store`.
    verdicts, categories : collection of str
        Only assets with one of these; empty takes all.
    weight : str
        ``voxel``: every voxel weighs one. ``asset``: the occupied voxels of a
        field, and the voxels of a SLAT, weigh one together.
    jobs : int
        Worker processes. The result does not depend on it.
    progress : callable, optional
        Called with the assets done and the assets in all.

    Returns
    -------
    StoreStatistics
        Numbers of nothing are NaN. Quantiles are the smallest value that at
        least such a share of the weight does not exceed ("inverted_cdf" of
        numpy), to within `StoreStatistics.quantile_error`.

    Raises
    ------
    StoreError
        If the store cannot be read.
    """
    rows = rows_chosen(store, verdicts, categories)
    column = [str(category) for category in store.column("category")]
    verdict_of = [str(verdict) for verdict in store.column("verdict")]
    # Category after category, so that one tally is held at a time, however many there are.
    rows.sort(key=lambda row: (column[row], row))
    of_category = [list(own) for _, own in groupby(rows, column.__getitem__)]
    tasks = [
        (store.path, some[start : start + _TASK_ASSETS], weight == "asset")
        for some in of_category
        for start in range(0, len(some), _TASK_ASSETS)
    ]
    tallies = run_in_order(_tally_some, tasks, jobs)
    ranges = store.normalization.ranges
    make = _Summariser(
        store.normalization,
        tuple(one.unit for one in store.contents.properties),
        store.contents.classes[:BACKGROUND] or ("annotated",),
    )
    total = nothing = no_tally(len(ranges), BINS)
    done, groups = 0, []
    for own in of_category:
        here = nothing
        for start in range(0, len(own), _TASK_ASSETS):
            here += next(tallies)
            done += len(own[start : start + _TASK_ASSETS])
            if progress:
                progress(done, len(rows))
        total += here
        name = column[own[0]] or "(unknown)"
        groups.append(make.group("category", name, here, Counter(verdict_of[r] for r in own)))
    all_of_it = make.group("all", "all", total, Counter(verdict_of[row] for row in rows))
    classes = [
        make.group("class", name, total, None, index) for index, name in enumerate(make.classes)
    ]
    whole = all_of_it.field.share, all_of_it.slat.share
    return StoreStatistics(
        store=store.path,
        assets=len(store),
        assets_chosen=len(rows),
        weight=weight,
        quantile_error={one.name: (one.hi - one.lo) / BINS for one in ranges},
        total=_of_whole(all_of_it, *whole),
        classes=tuple(_of_whole(group, *whole) for group in classes),
        categories=tuple(_of_whole(group, *whole) for group in groups),
        histograms=tuple(make.histogram(total, index) for index in range(len(ranges))),
        joint=make.joint(total),
    )


COLUMNS = ("by", "name", "side", "assets", "voxels", "share", "unannotated", "property", "scale",
           "unit", "mean", "std", "least", *_QUANTILE_NAMES, "most")  # fmt: skip
"""Columns of `table_of`."""


def table_of(statistics: StoreStatistics) -> Iterator[tuple[str | int | float, ...]]:
    """Yield a row of `COLUMNS` for each group, side, property and scale."""
    for group in statistics.groups:
        for side, own in (("field", group.field), ("slat", group.slat)):
            which = (group.by, group.name, side, own.assets, own.voxels, own.share, own.unannotated)
            for name, found in own.properties.items():
                for scale, values in (("linear", found.si), ("log10", found.log10)):
                    if values is not None:
                        quantiles = values.quantiles.values()
                        ends = (*quantiles, values.most)
                        yield (*which, name, scale, found.unit, values.mean, values.std,
                               values.least, *ends)  # fmt: skip


def _tally_some(path: Place, rows: Sequence[int], by_asset: bool) -> Tally:
    """Tally some assets of a store, in a worker."""
    store = open_store(path)
    ranges = store.normalization
    total = no_tally(len(ranges.ranges), BINS)
    for row in rows:
        # No column of asset/* is needed, and those of a large store take long to read.
        material, properties = (
            store.read_rows(f"grid/{name}", row, row + 1)[0] for name in ("material", "properties")
        )
        slat = store.read(row, ("material", "properties"))
        total += tally(
            (material, properties),
            (slat["material"], slat["properties"]),
            ranges,
            BINS,
            by_asset=by_asset,
        )
    return total


@dataclass(frozen=True, eq=False)
class _Summariser:
    """Makes of tallies what is handed out; shares are weights until `_of_whole`."""

    ranges: Normalization
    units: tuple[str, ...]
    classes: tuple[str, ...]

    def group(
        self,
        by: Literal["all", "class", "category"],
        name: str,
        counts: Tally,
        verdicts: Counter[str] | None = None,
        index: int | None = None,
    ) -> GroupStatistics:
        """Summarise all classes of a tally, or the one with this index."""
        named = {str(v): verdicts[str(v)] for v in Verdict} if verdicts is not None else {}
        chosen = np.arange(BACKGROUND + 1) if index is None else np.array([index])
        sides = (
            self._side(side, chosen, sum(named.values()) if index is None else None)
            for side in (counts.field, counts.slat)
        )
        return GroupStatistics(by, name, named, *sides)

    def _side(
        self, counts: SideTally, chosen: NDArray[np.int64], assets: int | None
    ) -> SideStatistics:
        weights = counts.weights[chosen]
        annotated = chosen[chosen < BACKGROUND]
        own = counts.weights[annotated]
        whole, part = float(weights.sum()), float(own.sum())
        return SideStatistics(
            assets=int(counts.assets[chosen[0]]) if assets is None else assets,
            voxels=int(counts.voxels[chosen].sum()),
            share=whole,
            unannotated=_ratio(whole - part, whole),
            classes={
                self.classes[k]: _ratio(float(counts.weights[k]), part)
                for k in annotated
                if k < len(self.classes)
            },
            properties={
                span.name: self._property(counts, number, annotated)
                for number, span in enumerate(self.ranges.ranges)
            },
        )

    def _property(
        self, counts: SideTally, number: int, chosen: NDArray[np.int64]
    ) -> PropertyStatistics:
        span, weights = self.ranges.ranges[number], counts.weights[chosen]
        mean, squares = pooled(
            weights[None], counts.mean[:, number, chosen], counts.squares[:, number, chosen], axis=1
        )
        total = float(weights.sum())
        if not total:
            nothing = Distribution(*(np.nan,) * 4, dict.fromkeys(_QUANTILE_NAMES, np.nan))
            return PropertyStatistics(self.units[number], nothing, nothing if span.log10 else None)
        std = np.sqrt(squares / total)
        least, most = counts.ends[0, number, chosen].min(), counts.ends[1, number, chosen].max()
        inside = counts.histogram[number, chosen].sum(axis=0)
        upto = np.cumsum(inside)
        places = np.searchsorted(upto, np.multiply(QUANTILES, upto[-1]))
        found = counts.sums[number, chosen].sum(axis=0)[places] / inside[places]
        normalised = np.array([mean[0], least, most, *np.clip(found, least, most)])
        mapped = (normalised + 1.0) * 0.5 * (span.hi - span.lo) + span.lo
        si = 10.0**mapped if span.log10 else mapped
        spread = float(std[0]) * 0.5 * (span.hi - span.lo)
        return PropertyStatistics(
            self.units[number],
            _distribution(float(mean[1]), float(std[1]), si),
            _distribution(float(mapped[0]), spread, mapped) if span.log10 else None,
        )

    def histogram(self, counts: Tally, number: int) -> Histogram:
        """Return a property's histogram by class, in wider bins."""
        span = self.ranges.ranges[number]
        sides = (
            side.histogram[number].reshape(BACKGROUND, DRAWN_BINS, -1).sum(axis=-1)
            for side in (counts.field, counts.slat)
        )
        edges = np.linspace(span.lo, span.hi, DRAWN_BINS + 1)
        return Histogram(span.name, self.units[number], span.log10, edges, *sides)

    def joint(self, counts: Tally) -> JointHistogram | None:
        """Return the joint histogram of the first two properties."""
        if len(self.ranges.ranges) < 2:
            return None
        first, second = self.ranges.ranges[:2]
        edges = [np.linspace(span.lo, span.hi, JOINT_BINS + 1) for span in (first, second)]
        return JointHistogram(
            (first.name, second.name), (edges[0], edges[1]), counts.field.joint, counts.slat.joint
        )


def _distribution(mean: float, std: float, values: NDArray[np.float64]) -> Distribution:
    """Return a distribution; after the mean `values` has the ends and the quantiles."""
    least, most, *quantiles = values[1:].tolist()
    return Distribution(mean, std, least, most, dict(zip(_QUANTILE_NAMES, quantiles, strict=True)))


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")


def _of_whole(group: GroupStatistics, field: float, slat: float) -> GroupStatistics:
    """Return a group with shares of these weights in place of weights."""
    return replace(
        group,
        field=replace(group.field, share=_ratio(group.field.share, field)),
        slat=replace(group.slat, share=_ratio(group.slat.share, slat)),
    )
