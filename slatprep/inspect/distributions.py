"""The statistics of a store's voxels as records, and as the rows of a table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slatprep.records import Place

QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
QUANTILE_NAMES = tuple(f"{100 * quantile:g}%" for quantile in QUANTILES)

Weight = Literal["voxel", "asset"]
"""What has a weight of 1: each voxel, or all voxels of one side of an asset together."""


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
    """One property in its SI unit, and its log10 where the store normalises it so."""

    unit: str
    si: Distribution
    log10: Distribution | None


@dataclass(frozen=True)
class SideStatistics:
    """Some voxels of one side: the PixieVerse fields, or the SLATs.

    Attributes
    ----------
    assets, voxels : int
        Number of these voxels (of fields: the occupied ones), and of assets that have any.
    share : float
        Their share of the weight of all voxels on this side.
    unannotated : float
        Share of their weight without an annotation: voxels of fields without a
        class, voxels of SLATs that are not valid.
    classes : dict of str to float
        Share of each class among the annotated voxels.
    properties : dict of str to PropertyStatistics
        By name, over the annotated voxels.
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

    ``field`` is before the lookup, ``slat`` after it. ``verdicts`` counts the assets by verdict; it
    is empty for a class, because the voxels of an asset can have several.
    """

    by: Literal["all", "class", "category"]
    name: str
    verdicts: dict[str, int]
    field: SideStatistics
    slat: SideStatistics


@dataclass(frozen=True, eq=False)
class Histogram:
    """Weights of one property by class (C, bins); `edges` (bins + 1,) are of log10 if `log10`."""

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
        Number of assets in the store, and of those that pass the filters.
    weight : str
        What has a weight of 1, ``voxel`` or ``asset``.
    quantile_error : dict of str to float
        Largest error of a quantile of each property: the width of a bin, in log10 where the
        property is normalised so, else in its SI unit. A quantile is the mean of the values
        in its bin, so it is exact where they are all equal. All other numbers are exact up to
        rounding.
    total : GroupStatistics
        All chosen assets.
    classes, categories : tuple of GroupStatistics
        By class, in the store's order, and by category, in alphabetical order.
    histograms : tuple of Histogram
        One for each property, over its range.
    joint : JointHistogram or None
        Of the first two properties; None if the store has only one.
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


COLUMNS = ("by", "name", "side", "assets", "voxels", "share", "unannotated", "property", "scale",
           "unit", "mean", "std", "least", *QUANTILE_NAMES, "most")  # fmt: skip
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
