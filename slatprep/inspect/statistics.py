"""Statistics of a store's voxels: classes and properties, before and after the lookup."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import require_one_of, row_of_category
from slatprep.inspect.tallies import DRAWN_BINS, SIDES, Tally, no_tally, pooled, tally
from slatprep.pipeline.rows import SourceStore
from slatprep.records import Place, Verdict
from slatprep.store import Store, open_store
from slatprep.workers import Progress
from slatprep.workers.local import run_in_order

BINS = 4096
"""Number of bins over a property's range from which quantiles are computed."""

_TASK_ASSETS = 32

QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
QUANTILE_NAMES = tuple(f"{100 * quantile:g}%" for quantile in QUANTILES)

Weight = Literal["voxel", "asset"]
"""Unit that has a weight of 1: each voxel, or all voxels of one side of an asset together."""


@dataclass(frozen=True)
class Distribution:
    """Mean, standard deviation (of the population), extremes, and quantiles by name (``50%``)."""

    mean: float
    std: float
    least: float
    most: float
    quantiles: dict[str, float]


@dataclass(frozen=True)
class PropertyStatistics:
    """One property in its SI unit, and its log10 if the store normalises it by log10."""

    unit: str
    si: Distribution
    log10: Distribution | None


@dataclass(frozen=True)
class SideStatistics:
    """Statistics of some voxels of one side: the PixieVerse fields, or the SLATs.

    Attributes
    ----------
    assets, voxels : int
        Number of assets that have any of these voxels, and of the voxels; only occupied voxels
        of a field count.
    share : float
        Share of these voxels in the weight of all voxels on this side.
    unannotated : float
        Share of their weight without an annotation: voxels of fields without a
        class, voxels of SLATs that are not valid.
    classes : dict of str to float
        Share of each class among the annotated voxels.
    properties : dict of str to PropertyStatistics
        Statistics of each property over the annotated voxels, by name.
    """

    assets: int
    voxels: int
    share: float
    unannotated: float
    classes: dict[str, float]
    properties: dict[str, PropertyStatistics]


@dataclass(frozen=True)
class GroupStatistics:
    """Statistics of all voxels, of a class, or of the assets of a category.

    ``field`` is before the lookup, ``slat`` after it. ``verdicts`` counts the assets by verdict; it
    is empty for a class, because an asset can have voxels of several classes.
    """

    by: Literal["all", "class", "category"]
    name: str
    verdicts: dict[str, int]
    field: SideStatistics
    slat: SideStatistics


@dataclass(frozen=True, eq=False)
class Histogram:
    """Weights of one property by class (C, bins); `edges` (bins + 1,) are log10 if `log10`."""

    name: str
    unit: str
    log10: bool
    edges: NDArray[np.float64]
    field: NDArray[np.float64]
    slat: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class JointHistogram:
    """Joint weights (bins, bins) of two properties; edges as in `Histogram`."""

    names: tuple[str, str]
    edges: tuple[NDArray[np.float64], NDArray[np.float64]]
    field: NDArray[np.float64]
    slat: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StoreStatistics:
    """Statistics of a store's voxels.

    Attributes
    ----------
    store : Place
        The store.
    assets, assets_chosen : int
        Number of assets in the store, and of assets that pass the filters.
    weight : str
        Unit that has a weight of 1, ``voxel`` or ``asset``.
    quantile_error : dict of str to float
        Largest error of a quantile of each property: the width of a bin, in log10 if the
        property is normalised by log10, else in its SI unit. A quantile is the mean of the
        values in its bin, so it is exact if they are all equal. All other numbers are exact up
        to rounding.
    total : GroupStatistics
        Statistics of all chosen assets.
    classes, categories : tuple of GroupStatistics
        Statistics by class, in the store's order, and by category, in alphabetical order.
    histograms : tuple of Histogram
        Histogram of each property, over its range.
    joint : JointHistogram or None
        Joint histogram of the first two properties; None if the store has only one.
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


def store_statistics(
    store: Store | str | Place,
    verdicts: Collection[str] = (),
    categories: Collection[str] = (),
    *,
    weight: Weight = "voxel",
    jobs: int = 1,
    progress: Progress | None = None,
) -> StoreStatistics:
    """Return the statistics of a store's voxels by class, category and property.

    Each chosen asset is read once, with its grid. Memory does not grow with the number of
    assets; with the number of categories only the result grows.

    Parameters
    ----------
    store : Store, str or Place
        An open store, or its path or URL.
    verdicts, categories : str or collection of str
        Verdicts and categories of the assets to take; empty takes all.
    weight : str
        ``voxel``: each voxel has weight 1. ``asset``: the occupied voxels of a
        field have weight 1 together, and so have the voxels of a SLAT.
    jobs : int
        Worker processes. The result does not depend on it.
    progress : callable, optional
        Called with the number of assets done and the number of all assets.

    Returns
    -------
    StoreStatistics
        Statistics; NaN for a group without voxels. A quantile q is the smallest value that at
        least the share q of the weight does not exceed (numpy's ``inverted_cdf``), up to
        `StoreStatistics.quantile_error`.

    Raises
    ------
    ConfigError
        If `weight` or a verdict does not exist, or no asset has one of the categories.
    StoreError
        If the store cannot be read.
    """
    require_one_of("weight", weight, get_args(Weight))
    store = open_store(store)
    rows = np.flatnonzero(store.having(verdicts, categories)).tolist()
    column = [str(category) for category in store.column("category")]
    verdict_of = [str(verdict) for verdict in store.column("verdict")]
    # Sort by category, so that only one category's tally is in memory at a time.
    rows.sort(key=lambda row: (column[row], row))
    portions = [
        own[start : start + _TASK_ASSETS]
        for own in (list(some) for _, some in groupby(rows, column.__getitem__))
        for start in range(0, len(own), _TASK_ASSETS)
    ]
    source = SourceStore(store)
    tasks = ((source, some, weight == "asset") for some in portions)
    tallied = zip(portions, run_in_order(_tally_some, tasks, jobs), strict=True)
    ranges, labels = store.normalization.ranges, store.contents.labels
    total = nothing = no_tally(store, BINS)
    done, groups = 0, []
    for category, parts in groupby(tallied, lambda part: column[part[0][0]]):
        here, verdicts_here = nothing, Counter[str]()
        for some, counts in parts:
            here += counts
            verdicts_here.update(verdict_of[row] for row in some)
            done += len(some)
            if progress:
                progress(done, len(rows))
        total += here
        name = row_of_category(category)
        groups.append(_group(store, "category", name, here, verdicts_here))
    everything = _group(store, "all", "all", total, Counter(verdict_of[row] for row in rows))
    classes = [_group(store, "class", name, total, None, k) for k, name in enumerate(labels)]
    whole = everything.field.share, everything.slat.share
    histograms = tuple(_histogram(store, total, index) for index in range(len(ranges)))
    joint = None
    if len(histograms) > 1:
        one, other = histograms[:2]
        joint = JointHistogram((one.name, other.name), (one.edges, other.edges), *total.joint)
    return StoreStatistics(
        store=store.path,
        assets=len(store),
        assets_chosen=len(rows),
        weight=weight,
        quantile_error={one.name: (one.hi - one.lo) / BINS for one in ranges},
        total=_of_whole(everything, *whole),
        classes=tuple(_of_whole(group, *whole) for group in classes),
        categories=tuple(_of_whole(group, *whole) for group in groups),
        histograms=histograms,
        joint=joint,
    )


def _tally_some(store: SourceStore, rows: Sequence[int], by_asset: bool) -> Tally:
    """Tally some assets of a store, in a worker."""
    names = "material", "properties"
    total = no_tally(store, BINS)
    for row in rows:
        # `store.asset` would read all columns of asset/*, which takes long in a large store.
        field = (store.read_rows(f"grid/{name}", row, row + 1)[0] for name in names)
        slat = store.read(row, names).values()
        total += tally(store, field, slat, BINS, by_asset)
    return total


def _group(
    store: Store,
    by: Literal["all", "class", "category"],
    name: str,
    counts: Tally,
    verdicts: Counter[str] | None = None,
    index: int | None = None,
) -> GroupStatistics:
    """Summarise all classes of a tally, or one class by its index.

    Shares are weights until `_of_whole` divides them.
    """
    named = {str(v): verdicts[str(v)] for v in Verdict} if verdicts is not None else {}
    assets = sum(named.values()) if index is None else None
    sides = (_side(store, counts, side, index, assets) for side in range(len(SIDES)))
    return GroupStatistics(by, name, named, *sides)


def _side(
    store: Store, counts: Tally, side: int, index: int | None, assets: int | None
) -> SideStatistics:
    """Summarise one side; the last entry of a tally counts voxels without an annotation."""
    chosen = slice(None) if index is None else slice(index, index + 1)
    annotated = slice(counts.weights.shape[-1] - 1) if index is None else chosen
    own = counts.weights[side, annotated]
    whole, part = float(counts.weights[side, chosen].sum()), float(own.sum())
    names = store.contents.labels[annotated]
    return SideStatistics(
        assets=int(counts.assets[side, index or 0]) if assets is None else assets,
        voxels=int(counts.voxels[side, chosen].sum()),
        share=whole,
        unannotated=_ratio(whole - part, whole),
        classes={n: _ratio(float(w), part) for n, w in zip(names, own, strict=False)},
        properties={
            span.name: _property(store, counts, (side, number, annotated))
            for number, span in enumerate(store.normalization.ranges)
        },
    )


def _property(store: Store, counts: Tally, of: tuple[int, int, slice]) -> PropertyStatistics:
    """Summarise a property on a side, over some classes."""
    side, number, chosen = of
    span, weights = store.normalization.ranges[number], counts.weights[side, chosen]
    unit = store.contents.properties[number].unit
    own = counts.mean[side, :, number, chosen], counts.squares[side, :, number, chosen]
    mean, squares = pooled(weights[None], *own, axis=1)
    total = float(weights.sum())
    if not total:
        nothing = Distribution(*(np.nan,) * 4, dict.fromkeys(QUANTILE_NAMES, np.nan))
        return PropertyStatistics(unit, nothing, nothing if span.log10 else None)
    std = np.sqrt(squares / total)
    least, most = counts.least[of].min(), counts.most[of].max()
    inside = counts.histogram[of].sum(axis=0)
    upto = np.cumsum(inside)
    places = np.searchsorted(upto, np.multiply(QUANTILES, upto[-1]))
    found = counts.sums[of].sum(axis=0)[places] / inside[places]
    normalised = np.array([mean[0], least, most, *np.clip(found, least, most)])
    half = 0.5 * (span.hi - span.lo)
    mapped = (normalised + 1.0) * half + span.lo
    if not span.log10:
        return PropertyStatistics(unit, _distribution(mean[1], std[1], mapped), None)
    log10 = _distribution(mapped[0], std[0] * half, mapped)
    return PropertyStatistics(unit, _distribution(mean[1], std[1], 10.0**mapped), log10)


def _histogram(store: Store, counts: Tally, number: int) -> Histogram:
    """Return a property's histogram by class, in `DRAWN_BINS` bins."""
    span, whole = store.normalization.ranges[number], counts.histogram[:, number]
    sides = whole.reshape(*whole.shape[:-1], DRAWN_BINS, -1).sum(axis=-1)
    edges = np.linspace(span.lo, span.hi, DRAWN_BINS + 1)
    unit = store.contents.properties[number].unit
    return Histogram(span.name, unit, span.log10, edges, *sides)


def _distribution(mean: np.floating, std: np.floating, values: NDArray[np.float64]) -> Distribution:
    """Return a distribution; `values` are the mean, the extremes and the quantiles."""
    least, most, *quantiles = values[1:].tolist()
    named = dict(zip(QUANTILE_NAMES, quantiles, strict=True))
    return Distribution(float(mean), float(std), least, most, named)


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")


def _of_whole(group: GroupStatistics, field: float, slat: float) -> GroupStatistics:
    """Return a group whose weights are divided by the total weight of each side."""
    return replace(
        group,
        field=replace(group.field, share=_ratio(group.field.share, field)),
        slat=replace(group.slat, share=_ratio(group.slat.share, slat)),
    )


COLUMNS = ("by", "name", "side", "assets", "voxels", "share", "unannotated", "property", "scale",
           "unit", "mean", "std", "least", *QUANTILE_NAMES, "most")  # fmt: skip
"""Columns of `table_of`."""


def table_of(statistics: StoreStatistics) -> Iterator[tuple[str | int | float, ...]]:
    """Yield a row of `COLUMNS` for each group, side, property and scale."""
    groups = statistics.total, *statistics.classes, *statistics.categories
    for group, side in product(groups, SIDES):
        own: SideStatistics = getattr(group, side)
        which = (group.by, group.name, side, own.assets, own.voxels, own.share, own.unannotated)
        for name, found in own.properties.items():
            for scale, values in (("linear", found.si), ("log10", found.log10)):
                if values is not None:
                    yield (*which, name, scale, found.unit, values.mean, values.std, values.least,
                           *values.quantiles.values(), values.most)  # fmt: skip
