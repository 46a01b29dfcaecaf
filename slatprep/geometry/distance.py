"""The exact signed distance to the faces of a voxel solid; a compiled inner loop.

The squared distance to a set separates by axis (Felzenszwalb and Huttenlocher,
"Distance Transforms of Sampled Functions", 2012): the distance along one axis
is a running count, and each further axis takes the least of ``f(i') + (i - i')^2``.
Near a surface the least is found within a few voxels, and several rows are
searched at once in 16-bit integers, which beats the lower envelope of parabolas
of the packages at this size threefold.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.kernel import kernel

LARGEST_SIDE = 72
"""Longest side of a box: three squares of it still fit the integers used."""

NOTHING = 127
"""Stands for "nothing of the other kind in this line".

Its square exceeds every squared distance in a box that the solid touches on all
sides, or within a slab of such a box, and may be added to one.
"""

_VECTOR, _ROWS = 16, 8
"""How many 16-bit integers a processor takes at once, and rows that are searched together."""


def signed_distance(solid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the distance (a, b, c), in voxels, of each voxel's centre to the faces of a solid.

    It is Euclidean, to the nearest voxel centre of the other kind, less half a voxel; negative
    inside. What lies outside the box is not looked at. ValueError if a side is beyond
    `LARGEST_SIDE`.
    """
    if max(solid.shape) > LARGEST_SIDE:
        raise ValueError(f"a side is at most {LARGEST_SIDE} voxels, got shape {solid.shape}")
    solid = np.ascontiguousarray(solid)
    # Lines of whole vectors; what is added to them is as near as can be, and so not searched for.
    length = -(-solid.shape[2] // _VECTOR) * _VECTOR
    inside, outside = np.zeros((2, *solid.shape[:2], length), dtype=np.int16)
    _squares_along_last(solid, inside, outside)
    for squares in (inside, outside):
        _spread_over_others(squares)
    distance = np.empty(solid.shape, dtype=np.float32)
    _signed(solid, inside, outside, distance)
    return distance


@kernel()
def _squares_along_last(solid, inside, outside):  # type: ignore[no-untyped-def]
    """Squared distance within each line to the nearest voxel of the other kind, into zeros."""
    length = solid.shape[2]
    for i in range(solid.shape[0]):
        for j in range(solid.shape[1]):
            line, begin = solid[i, j], 0
            for end in range(1, length + 1):
                if end < length and line[end] == line[end - 1]:
                    continue
                # From `begin` to `end` all are of a kind; the next of the other one lie there.
                before = begin - 1 if begin > 0 else -NOTHING
                after = end if end < length else length + NOTHING
                into = inside[i, j, begin:end] if line[begin] else outside[i, j, begin:end]
                for k in range(len(into)):
                    apart = np.int16(min(begin + k - before, after - begin - k, NOTHING))
                    into[k] = apart * apart
                begin = end


@kernel()
def _spread_over_others(squares):  # type: ignore[no-untyped-def]
    """Take the two axes before the last into account, in place, slab by slab."""
    # Copied by loops, which become vector instructions: an assignment of slices does not.
    a, b, c = squares.shape
    slab, least = padded(a, c), np.empty(a * c, np.int16)
    for j in range(b):
        smallest = largest = squares[0, j, 0]
        for i in range(a):
            to, line = slab[(a + i) * c :], squares[i, j]
            smallest = min(smallest, line[0])
            for k in range(len(line)):
                to[k] = line[k]
                largest = largest if largest > line[k] else line[k]
        if smallest == NOTHING * NOTHING or largest == 0:
            continue  # Nothing of the other kind in any of its lines, or nothing else.
        spread(slab, least, c)
        for i in range(a):
            own, line = least[i * c :], squares[i, j]
            for k in range(len(line)):
                line[k] = own[k]
    slab = padded(b, c)
    to, slabs = slab[b * c :], squares.reshape(a, b * c)
    for i in range(a):
        own, largest = slabs[i], np.int16(0)
        for k in range(len(own)):
            to[k] = own[k]
            largest = largest if largest > own[k] else own[k]
        if largest > 0:
            spread(slab, own, c)


@kernel()
def padded(rows, columns):  # type: ignore[no-untyped-def]
    """Return memory for a flattened slab, with as many rows of nothing before and behind it."""
    return np.full(3 * rows * columns, NOTHING * NOTHING, np.int16)


@kernel()
def spread(slab, least, columns):  # type: ignore[no-untyped-def]
    """Set ``least[i, k]`` to the minimum over i' of ``slab[i', k] + (i - i')^2``.

    Both are flattened, and the slab is `padded`. Comparisons are spelled out and 16 bits wide, and
    slices have no end, so that they become vector instructions, of `_ROWS` rows at a time.
    """
    size = len(least)
    for first in range(0, size, _ROWS * columns):
        into = least[first : first + _ROWS * columns]
        own = slab[size + first :]
        largest = np.int16(0)
        for k in range(len(into)):
            value = own[k]
            into[k] = value
            largest = largest if largest > value else value
        apart = 1
        while apart * columns < size and apart * apart < largest:
            square, step = np.int16(apart * apart), apart * columns
            before, behind = slab[size + first - step :], slab[size + first + step :]
            for k in range(len(into)):
                below, above, known = before[k], behind[k], into[k]
                value = np.int16((below if below < above else above) + square)
                into[k] = value if value < known else known
            if apart % 4 == 0:
                largest = np.int16(0)
                for k in range(len(into)):
                    largest = largest if largest > into[k] else into[k]
            apart += 1


@kernel()
def _signed(solid, inside, outside, distance):  # type: ignore[no-untyped-def]
    for i in range(solid.shape[0]):
        for j in range(solid.shape[1]):
            for k in range(solid.shape[2]):
                # One of the two is 0.
                apart = np.sqrt(np.float32(inside[i, j, k] + outside[i, j, k])) - np.float32(0.5)
                distance[i, j, k] = -apart if solid[i, j, k] else apart


@kernel()
def near_surface(distance, band):  # type: ignore[no-untyped-def]
    """Return the lattice points (M, 3) within `band` voxels of a surface, and their distances (M,).

    In C order; of the points a column lies after the other in memory.
    """
    limit = np.float32(band)
    lines = np.zeros(distance.shape[:2], np.int64)
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            line, found = distance[i, j], 0
            for k in range(len(line)):
                found += abs(line[k]) <= limit
            lines[i, j] = found
    points = np.empty((3, lines.sum()), np.uint8)
    values = np.empty(points.shape[1], np.float32)
    found = 0
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            if lines[i, j] == 0:
                continue
            for k in range(distance.shape[2]):
                value = distance[i, j, k]
                if abs(value) <= limit:
                    points[0, found], points[1, found], points[2, found] = i, j, k
                    values[found] = value
                    found += 1
    return points.T, values
