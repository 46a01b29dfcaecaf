"""Normalise physical properties to [-1, 1] and back.

A property is mapped to log10 of its SI value (Young's modulus, density) or stays as it is
(Poisson's ratio), as its table says. The mapped value v of a range lo..hi becomes ``2 (v - lo) /
(hi - lo) - 1`` (SLAT-Phys; Pixie uses the same form).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.records import PROPERTIES, MaterialField, Normalization, Property, PropertyRange

PIXIE_RANGES = Normalization(
    ranges=(
        PropertyRange("youngs_modulus", True, 3.0183002948760986, 10.881680488586426),
        PropertyRange("density", True, 1.7031893730163574, 3.871432304382324),
        PropertyRange("poissons_ratio", False, 0.21027633547782898, 0.4492689371109009),
    ),
    source="pixie",
)
"""Pixie's published ranges, the 1st and 99th percentile of its dataset."""

_Table = Sequence[Property | PropertyRange]

# A property with one value in the whole dataset has no range. This width on either
# side of the value makes the mapping defined and maps the value to 0.
_HALF_WIDTH_OF_A_POINT = 0.5


def to_mapped(properties: ArrayLike, table: _Table = PROPERTIES) -> NDArray[np.float64]:
    """Map SI properties (N, P) to their log10 if the table says so; the others stay."""
    mapped = np.array(properties, dtype=np.float64)
    for column, one in enumerate(table):
        if one.log10:
            np.log10(mapped[..., column], out=mapped[..., column])
    return mapped


def from_mapped(mapped: ArrayLike, table: _Table = PROPERTIES) -> NDArray[np.float32]:
    """Bring mapped properties (N, P) back to SI units, the inverse of `to_mapped`."""
    properties = np.array(mapped, dtype=np.float64)
    columns = [column for column, one in enumerate(table) if one.log10]
    properties[..., columns] = 10.0 ** properties[..., columns]
    return properties.astype(np.float32)


def property_extent(
    field: MaterialField, table: Sequence[Property] | None = None
) -> NDArray[np.float64]:
    """Return minimum and maximum (P, 2) of each mapped property over a field's annotated voxels.

    The properties are those of `table`, by default the field's; NaN if the field lacks one.
    """
    table = field.table if table is None else table
    own = {one.name: column for one, column in zip(field.table, field.properties.T, strict=True)}
    # log10 is monotonic, so it is taken of minima and maxima only. Columns are reduced one
    # by one, as numpy takes ten times as long along the first axis of a narrow array.
    missing = np.array([np.nan], dtype=np.float32)
    columns = [own.get(one.name, missing) for one in table]
    ends = [[c.min() for c in columns], [c.max() for c in columns]]
    return to_mapped(ends, table).T


def ranges_from_extents(
    extents: ArrayLike, source: str = "dataset", table: Sequence[Property] = PROPERTIES
) -> Normalization:
    """Return the ranges that span a dataset with extents (A, P, 2) from `property_extent`.

    The ranges record their `source`. Raise ValueError without assets, or if an extent is not
    finite.
    """
    ends = np.asarray(extents, dtype=np.float64).reshape(-1, len(table), 2)
    if len(ends) == 0 or not np.isfinite(ends).all():
        raise ValueError(f"ranges need finite extents of at least one asset, got {ends.tolist()}")
    return ranges_from_bounds(ends[:, :, 0].min(axis=0), ends[:, :, 1].max(axis=0), source, table)


def ranges_from_bounds(
    lo: NDArray[np.float64],
    hi: NDArray[np.float64],
    source: str,
    table: Sequence[Property] = PROPERTIES,
) -> Normalization:
    """Return the ranges between bounds (P,) of the mapped properties; equal bounds are spread."""
    single = hi <= lo
    lo, hi = lo - single * _HALF_WIDTH_OF_A_POINT, hi + single * _HALF_WIDTH_OF_A_POINT
    return normalization_of(np.stack([lo, hi], axis=1), source, table)


def normalization_of(
    ranges: NDArray[np.float64], source: str, table: Sequence[Property] = PROPERTIES
) -> Normalization:
    """Return ranges, given as rows lo, hi (P, 2) of the mapped properties, as a `Normalization`."""
    spans = zip(table, ranges.tolist(), strict=True)
    return Normalization(tuple(PropertyRange(p.name, p.log10, *span) for p, span in spans), source)


def normalize_properties(
    properties: ArrayLike, normalization: Normalization = PIXIE_RANGES
) -> NDArray[np.float32]:
    """Bring properties to [-1, 1].

    Parameters
    ----------
    properties : array_like, shape (N, P)
        In SI units, a column for each range (Young's modulus [Pa], density
        [kg/m^3] and Poisson's ratio by default). NaN passes through, and a
        negative value without a logarithm becomes NaN.
    normalization : Normalization
        The ranges; Pixie's published ranges by default. Those of a store are
        ``store.normalization``.

    Returns
    -------
    ndarray of float32, shape (N, P)
        Clipped to [-1, 1].

    Examples
    --------
    >>> values = normalize_properties([[1e7, 1000.0, 0.3]])
    >>> values.round(3).tolist() == np.float32([[0.013, 0.196, -0.249]]).tolist()
    True
    >>> denormalize_properties(values).round(3).tolist()
    [[10000000.0, 1000.0, 0.30000001192092896]]
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return normalize_and_count(properties, normalization)[0]


def normalize_and_count(
    properties: ArrayLike, normalization: Normalization
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Normalise as `normalize_properties`, and count the clipped values per property (P,)."""
    # Columns are made contiguous, as numpy takes twice the time along such narrow rows.
    given = np.asfortranarray(_in_columns(properties, normalization))
    mapped = to_mapped(given, normalization.ranges)
    # Values are counted after rounding, so that a range's own end does not count as clipped.
    values = normalize_mapped(mapped, normalization).astype(np.float32)
    clipped = (np.abs(values) > 1.0).sum(axis=tuple(range(values.ndim - 1)))
    return np.clip(values, -1.0, 1.0), clipped


def denormalize_properties(
    values: ArrayLike, normalization: Normalization = PIXIE_RANGES
) -> NDArray[np.float32]:
    """Bring normalised properties back to SI units, the inverse of `normalize_properties`.

    Parameters
    ----------
    values : array_like, shape (N, P)
        Normalised properties, a column for each range.
    normalization : Normalization
        The ranges that normalised them.

    Returns
    -------
    ndarray of float32, shape (N, P)
        In SI units. Clipped values come back as the end of their range.
    """
    return from_mapped(
        _undone(_in_columns(values, normalization), normalization), normalization.ranges
    )


def _in_columns(values: ArrayLike, normalization: Normalization) -> NDArray[Any]:
    given, names = np.asarray(values), [span.name for span in normalization.ranges]
    if given.shape[-1:] != (len(names),):
        raise ValueError(
            f"properties have shape {given.shape}; expected (N, {len(names)}), a column each of "
            f"{', '.join(names)}"
        )
    return given


def change_ranges(values: ArrayLike, old: Normalization, new: Normalization) -> NDArray[np.float64]:
    """Convert values (N, P), normalised by `old` ranges, to `new` ones; nothing is clipped."""
    return normalize_mapped(_undone(values, old), new)


def normalize_mapped(mapped: ArrayLike, normalization: Normalization) -> NDArray[np.float64]:
    """Normalise mapped properties (N, P); nothing is clipped."""
    lo, hi = _ends(normalization)
    normalized: NDArray[np.float64] = 2.0 * (np.asarray(mapped) - lo) / (hi - lo) - 1.0
    return normalized


def _undone(values: ArrayLike, normalization: Normalization) -> NDArray[np.float64]:
    """Bring normalised properties (N, P) back to mapped ones."""
    lo, hi = _ends(normalization)
    mapped: NDArray[np.float64] = (np.asarray(values, np.float64) + 1.0) * 0.5 * (hi - lo) + lo
    return mapped


def normalize_change(change: ArrayLike, normalization: Normalization) -> NDArray[np.float64]:
    """Scale differences (N, P) of mapped properties to differences of normalised ones."""
    lo, hi = _ends(normalization)
    scaled: NDArray[np.float64] = np.asarray(change, dtype=np.float64) * 2.0 / (hi - lo)
    return scaled


def _ends(normalization: Normalization) -> NDArray[np.float64]:
    return normalization.spans.T
