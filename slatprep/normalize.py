"""Physical properties to [-1, 1] and back.

Young's modulus and density are mapped to log10 of their SI value, Poisson's
ratio is taken as it is; the mapped value v of a range lo..hi becomes
``2 (v - lo) / (hi - lo) - 1`` (SLAT-Phys; Pixie uses the same form).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.records import PROPERTY_COLUMNS, MaterialField, Normalization, PropertyRange

LOG10 = (True, True, False)
"""Which of ``PROPERTY_COLUMNS`` are normalised on a log10 scale."""

PIXIE_RANGES = Normalization(
    ranges=(
        PropertyRange("youngs_modulus", True, 3.0183002948760986, 10.881680488586426),
        PropertyRange("density", True, 1.7031893730163574, 3.871432304382324),
        PropertyRange("poissons_ratio", False, 0.21027633547782898, 0.4492689371109009),
    ),
    source="pixie",
)
"""Pixie's published ranges, the 1st and 99th percentile of its dataset."""

# A property with one value in the whole dataset has no range of its own; this
# much on either side of it makes the mapping defined and sends it to 0.
_HALF_WIDTH_OF_A_POINT = 0.5


def to_mapped(properties: ArrayLike) -> NDArray[np.float64]:
    """Map SI properties (N, 3) to log10 E, log10 density and Poisson's ratio."""
    mapped = np.array(properties, dtype=np.float64)
    mapped[..., :2] = np.log10(mapped[..., :2])
    return mapped


def property_extent(field: MaterialField) -> NDArray[np.float64]:
    """Return the smallest and largest mapped property of a field.

    Parameters
    ----------
    field : MaterialField
        The field; all its annotated voxels count.

    Returns
    -------
    ndarray of float64, shape (3, 2)
        Per property of ``PROPERTY_COLUMNS`` the minimum and maximum, log10 for
        Young's modulus and density.
    """
    # log10 is monotonic, so it is taken of six numbers and not of the whole field.
    # By column: numpy takes ten times as long along the first axis of a narrow array.
    columns = [field.properties[:, k] for k in range(len(PROPERTY_COLUMNS))]
    return to_mapped([[c.min() for c in columns], [c.max() for c in columns]]).T


def ranges_from_extents(extents: ArrayLike) -> Normalization:
    """Return the ranges that span a whole dataset.

    Parameters
    ----------
    extents : array_like of float64, shape (A, 3, 2)
        What `property_extent` gave for each asset.

    Returns
    -------
    Normalization
        Dataset minimum and maximum of each property, as SLAT-Phys uses them.

    Raises
    ------
    ValueError
        If there is no asset, or an extent is not finite.
    """
    table = np.asarray(extents, dtype=np.float64).reshape(-1, 3, 2)
    if len(table) == 0 or not np.isfinite(table).all():
        raise ValueError(f"ranges need finite extents of at least one asset, got {table.tolist()}")
    lo, hi = table[:, :, 0].min(axis=0), table[:, :, 1].max(axis=0)
    single = hi <= lo
    lo, hi = lo - single * _HALF_WIDTH_OF_A_POINT, hi + single * _HALF_WIDTH_OF_A_POINT
    first, second, third = (
        PropertyRange(name, log10, float(low), float(high))
        for name, log10, low, high in zip(PROPERTY_COLUMNS, LOG10, lo, hi, strict=True)
    )
    return Normalization((first, second, third), source="dataset")


def normalize(
    properties: ArrayLike, normalization: Normalization
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Bring SI properties to [-1, 1].

    Parameters
    ----------
    properties : array_like of float32, shape (N, 3)
        Young's modulus [Pa], density [kg/m^3], Poisson's ratio; NaN passes through.
    normalization : Normalization
        The ranges.

    Returns
    -------
    values : ndarray of float32, shape (N, 3)
        Normalised properties, clipped to [-1, 1].
    clipped : ndarray of int64, shape (3,)
        How many values of each property lay outside its range.

    Examples
    --------
    >>> values, clipped = normalize([[1e7, 1000.0, 0.3]], PIXIE_RANGES)
    >>> [round(float(v), 4) for v in values[0]], clipped.tolist()
    ([0.0127, 0.1962, -0.2492], [0, 0, 0])
    """
    given = np.asarray(properties)
    values = np.empty(given.shape, dtype=np.float32)
    clipped = np.zeros(len(PROPERTY_COLUMNS), dtype=np.int64)
    for column, span in enumerate(normalization.ranges):
        mapped = given[..., column].astype(np.float64)
        if span.log10:
            np.log10(mapped, out=mapped)
        # Counted after rounding: a range's own end point must not count as clipped.
        value = (2.0 * (mapped - span.lo) / (span.hi - span.lo) - 1.0).astype(np.float32)
        clipped[column] = np.count_nonzero(np.abs(value) > 1.0)
        values[..., column] = np.clip(value, -1.0, 1.0)
    return values, clipped


def denormalize(values: ArrayLike, normalization: Normalization) -> NDArray[np.float32]:
    """Bring normalised properties back to SI, the inverse of `normalize`.

    Parameters
    ----------
    values : array_like, shape (N, 3)
        Normalised Young's modulus, density and Poisson's ratio.
    normalization : Normalization
        The ranges they were normalised with.

    Returns
    -------
    ndarray of float32, shape (N, 3)
        Young's modulus [Pa], density [kg/m^3], Poisson's ratio.
    """
    given = np.asarray(values)
    properties = np.empty(given.shape, dtype=np.float32)
    for column, span in enumerate(normalization.ranges):
        mapped = (given[..., column].astype(np.float64) + 1.0) * 0.5 * (span.hi - span.lo) + span.lo
        properties[..., column] = 10.0**mapped if span.log10 else mapped
    return properties


def normalize_change(change: ArrayLike, normalization: Normalization) -> NDArray[np.float64]:
    """Scale differences of mapped properties to differences of normalised ones."""
    lo, hi = _limits(normalization)
    return np.asarray(change, dtype=np.float64) * 2.0 / (hi - lo)


def _limits(normalization: Normalization) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    ranges = normalization.ranges
    return np.array([r.lo for r in ranges]), np.array([r.hi for r in ranges])
