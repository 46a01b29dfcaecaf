"""Bin continuous Young's moduli and Poisson's ratios into a few materials."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_FINEST = 1e-6
"""Relative width of the finest bins of E; values that differ by less are float32's rounding."""

_RATIO = 0.25
"""Width of a bin of nu for one of E of relative width 1: 0.25 spans the usual range."""


class Binned(NamedTuple):
    """M materials: class, E [Pa] and nu of each, the material of each row (N,), largest errors."""

    material: NDArray[np.uint8]
    modulus: NDArray[np.float64]
    ratio: NDArray[np.float64]
    rows: NDArray[np.intp]
    modulus_error: float
    ratio_error: float


def bin_materials(material: NDArray[np.uint8], solid: NDArray[np.float64], most: int) -> Binned:
    """Bin rows of a class, E, density, nu (N, 3) into at most `most` materials.

    Bins are as fine as `most` allows, and no bin has rows of two classes. E and nu of a bin
    lie in the middle of its members (E in its logarithm), so that the largest error is least.
    """
    logarithm = np.log10(solid[:, 0])
    width = _FINEST
    while True:
        by_modulus = _cover(logarithm, np.log10(1 + width), most)
        by_ratio = _cover(solid[:, 2], _RATIO * width, most)
        if by_modulus is not None and by_ratio is not None:
            keys = np.stack([material, by_modulus, by_ratio], axis=1)
            bins, rows = np.unique(keys, axis=0, return_inverse=True)
            if len(bins) <= most:
                break
        width *= 1.25
    rows = rows.reshape(-1)
    middle = [_middles(values, rows, len(bins)) for values in (logarithm, solid[:, 2])]
    modulus, ratio = 10 ** middle[0], middle[1]
    return Binned(
        bins[:, 0].astype(np.uint8),
        modulus,
        ratio,
        rows,
        float(np.abs(modulus[rows] / solid[:, 0] - 1).max(initial=0.0)),
        float(np.abs(ratio[rows] - solid[:, 2]).max(initial=0.0)),
    )


def _cover(values: NDArray[np.float64], width: float, most: int) -> NDArray[np.intp] | None:
    """Return the bin of each value (N,), the fewest of a width; None if they are over `most`."""
    ordered = np.unique(values)
    starts: list[int] = []
    next_start = 0
    while next_start < len(ordered):
        if len(starts) == most:
            return None
        starts.append(next_start)
        next_start = int(np.searchsorted(ordered, ordered[next_start] + width, side="right"))
    return np.searchsorted(ordered[starts], values, side="right") - 1


def _middles(
    values: NDArray[np.float64], rows: NDArray[np.intp], count: int
) -> NDArray[np.float64]:
    """Return the middle between least and largest value of each bin (count,)."""
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, rows, values)
    np.maximum.at(high, rows, values)
    middle: NDArray[np.float64] = (low + high) / 2
    return middle
