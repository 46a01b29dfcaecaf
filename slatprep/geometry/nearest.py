"""Find the nearest voxel of a set, exactly and fast, for points close to it.

A kd-tree spends most of its time on being built. Voxels lie on a lattice, so a search of the cells
around a point, nearest first, finds the same voxel after a few reads. If no voxel is that near,
whole columns are searched, but only in slabs that can hold a nearer voxel. This is fast even if all
points are far away.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.distance import NOTHING, padded, spread
from slatprep.geometry.kernel import kernel
from slatprep.records import RESOLUTION

_REACH = 3  # voxels; reach of the search by cells, which precedes that by columns
_SURE = _REACH + 0.5  # voxels; smallest distance of a voxel beyond these cells
_BEYOND = 1.5  # voxels; smallest distance of a voxel outside the 27 cells around a point
_BLOCK = 4  # cells along an edge of a block, which is skipped as a whole
_ROUNDING = 1e-6  # voxels; slack of a bound, so that rounding skips no voxel


class VoxelIndex:
    """A set of voxels (K, 3), K >= 1, with the row of the voxel in each cell of the grid."""

    def __init__(self, voxels: NDArray[np.uint8]) -> None:
        if len(voxels) == 0:
            raise ValueError("the nearest voxel of an empty set does not exist")
        self._row = np.full((RESOLUTION,) * 3, -1, dtype=np.int32)
        self._blocks = np.zeros((RESOLUTION // _BLOCK,) * 3, dtype=bool)
        _number(voxels, self._row, self._blocks)
        self._voxels = voxels
        self._alike: tuple[NDArray[np.uint8], NDArray[np.bool_]] | None = None
        self._near: dict[float, NDArray[np.bool_]] = {}

    def nearest(
        self, points: NDArray[np.float64], limit: float = np.inf
    ) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
        """Return distance (N,) [voxel] and row (N,) of the nearest voxel of points (N, 3).

        Points may lie outside the cube. The first of several equally near voxels counts. If the
        distance exceeds `limit` (voxels), it is infinite and the row is -1.
        """
        # In index units, where voxel i is centred at i.
        position = np.ascontiguousarray((np.asarray(points, np.float64) + 0.5) * RESOLUTION - 0.5)
        near = self._blocks_near(min(limit, _SURE))
        distance, nearest = _search(position, self._row, near, *_cells(), float(limit) ** 2)
        if limit >= _SURE:
            # In a usual asset few points are too far away for the search by cells.
            far = np.flatnonzero(~(distance < _SURE))
            if len(far):
                below, above, apart = _columns(self._row)
                distance[far], nearest[far] = _search_columns(
                    position[far], self._row, below, above, apart, float(limit) ** 2
                )
        return distance, nearest

    def _blocks_near(self, reach: float) -> NDArray[np.bool_]:
        """Return the blocks of cells that may have a voxel within `reach`; others are skipped.

        If a set that fills the grid is looked up in a smaller one, most points are skipped.
        """
        if reach not in self._near:
            near = self._near[reach] = self._blocks.copy()
            for axis in range(3):
                own = np.moveaxis(near, axis, 0)
                before = own.copy()
                for step in range(1, math.ceil((reach + 0.5) / _BLOCK) + 1):
                    own[step:] |= before[:-step]
                    own[:-step] |= before[step:]
        return self._near[reach]

    def voted(
        self,
        points: NDArray[np.float64],
        labels: NDArray[np.uint8],
        width: float,
        most: float,
        limit: float = np.inf,
    ) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.bool_]]:
        """Return distance and row as `nearest`, but of a voxel chosen by vote, and `near` (N,).

        A point is near if its nearest voxel is at most `most` voxels away. The voxels in the 27
        cells around it vote for their label (K,) with the weight exp(-d^2 / 2 width^2), where d is
        their distance in voxels. The lower label wins a draw. The nearest voxel of the winning
        label is chosen.
        """
        distance, nearest = self.nearest(points, limit)
        near = distance <= most
        if self._alike is None or self._alike[0] is not labels:
            self._alike = labels, _alike_around(self._voxels, labels)
        parties, steepness = int(labels.max()) + 1, 0.5 / width**2
        alike = self._alike[1]
        _vote(points, near, self._row, labels, alike, parties, steepness, distance, nearest)
        return distance, nearest, near


@lru_cache(maxsize=1)
def _cells() -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return cell offsets and the smallest squared distance of a voxel in each, in that order."""
    axis = np.arange(-_REACH, _REACH + 1)
    offsets = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    floors = (np.maximum(np.abs(offsets) - 0.5, 0.0) ** 2).sum(axis=1)
    order = np.argsort(floors, kind="stable")
    # Voxels beyond the reach may lie at `_SURE` already, so farther cells prove nothing.
    sure = floors[order] <= _SURE**2
    return offsets[order][sure].astype(np.int64), floors[order][sure]


@kernel()
def _number(voxels, row, blocks):  # type: ignore[no-untyped-def]
    """Write the row of each voxel to its cell, and mark the blocks that have voxels."""
    for m in range(len(voxels)):
        a, b, c = voxels[m, 0], voxels[m, 1], voxels[m, 2]
        row[a, b, c] = m
        blocks[a // _BLOCK, b // _BLOCK, c // _BLOCK] = True


@kernel()
def _search(position, row, near, offsets, floors, limit):  # type: ignore[no-untyped-def]
    count = position.shape[0]
    size = row.shape[0]
    distance = np.full(count, np.inf)
    nearest = np.full(count, -1, dtype=np.intp)
    for m in range(count):
        x, y, z = position[m, 0], position[m, 1], position[m, 2]
        a, b, c = int(np.rint(x)), int(np.rint(y)), int(np.rint(z))
        inside = min(max(a, 0), size - 1), min(max(b, 0), size - 1), min(max(c, 0), size - 1)
        if not near[inside[0] // _BLOCK, inside[1] // _BLOCK, inside[2] // _BLOCK]:
            continue
        aside = max(abs(x - a), abs(y - b), abs(z - c))
        if aside < 0.5 - _ROUNDING and inside == (a, b, c) and row[a, b, c] >= 0:
            # If the point lies in a voxel of the set, this voxel is the nearest.
            square = (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2
            if square <= limit:
                distance[m], nearest[m] = np.sqrt(square), row[a, b, c]
            continue
        best, found = np.inf, -1
        for n in range(offsets.shape[0]):
            # Equality does not end the search: an equally near voxel may have a lower row.
            if floors[n] > best or floors[n] > limit:
                break
            i, j, k = a + offsets[n, 0], b + offsets[n, 1], c + offsets[n, 2]
            if i < 0 or j < 0 or k < 0 or i >= size or j >= size or k >= size:
                continue
            candidate = row[i, j, k]
            if candidate < 0:
                continue
            square = (x - i) ** 2 + (y - j) ** 2 + (z - k) ** 2
            if square < best or (square == best and candidate < found):
                best, found = square, candidate
        if best <= limit:
            distance[m], nearest[m] = np.sqrt(best), found
    return distance, nearest


@kernel()
def _columns(row):  # type: ignore[no-untyped-def]
    """Return for each cell the next voxels of its column (along the last axis) and of its slab.

    The first two arrays have the column index of the last voxel at or before the cell, and of the
    first at or after it; -1 for none. The third has the squared distance to the nearest voxel with
    the same first index. It is at least the square of `NOTHING` if there is none.
    """
    below, above = np.full(row.shape, -1, np.int8), np.full(row.shape, -1, np.int8)
    size = row.shape[0]
    apart, lines = np.empty(row.shape, np.int16), padded(size, size)
    slab = lines.reshape(3, size, size)[1]
    for i in range(size):
        for j in range(size):
            slab[j, :] = NOTHING * NOTHING
            if row[i, j].max() < 0:  # true for most lines
                continue
            last, after = -1, -1
            for k in range(size):
                last = k if row[i, j, k] >= 0 else last
                below[i, j, k] = last
            for k in range(size - 1, -1, -1):
                after = k if row[i, j, k] >= 0 else after
                above[i, j, k] = after
                least = after - k if after >= 0 else NOTHING
                if below[i, j, k] >= 0:
                    least = min(least, k - below[i, j, k])
                slab[j, k] = least * least
        spread(lines, apart[i].reshape(-1), size)
    return below, above, apart


@kernel()
def _search_columns(position, row, below, above, apart, limit):  # type: ignore[no-untyped-def]
    """Search slab after slab, column after column, outwards from the point's own."""
    count, end = position.shape[0], row.shape[0] - 1
    distance = np.full(count, np.inf)
    nearest = np.full(count, -1, dtype=np.intp)
    for m in range(count):
        x, y, z = position[m, 0], position[m, 1], position[m, 2]
        v, w = min(max(y, 0.0), end), min(max(z, 0.0), end)
        a, b, c = int(np.rint(min(max(x, 0.0), end))), int(np.rint(v)), int(np.rint(w))
        # If the point is halfway between two cells, either may hold the nearest voxel.
        low, high = int(np.floor(w)), int(np.ceil(w))
        # The squared distance to the grid, and the distance to the cell whose `apart` is read.
        outside = (y - v) ** 2 + (z - w) ** 2
        aside = math.sqrt((v - b) ** 2 + (w - c) ** 2) + _ROUNDING
        best, found = limit, -1
        for slabs in range(2 * end + 1):
            step = (slabs + 1) // 2
            if step and (step - 0.5) ** 2 > best:
                break
            i = a + step if slabs % 2 else a - step
            across = (x - i) ** 2
            if i < 0 or i > end or across > best or apart[i, b, c] >= NOTHING**2:
                continue
            if across + outside + max(math.sqrt(apart[i, b, c]) - aside, 0.0) ** 2 > best:
                continue
            for columns in range(2 * end + 1):
                step = (columns + 1) // 2
                if step and across + (step - 0.5) ** 2 > best:
                    break
                j = b + step if columns % 2 else b - step
                if j < 0 or j > end or across + (y - j) ** 2 > best:
                    continue
                for k in (below[i, j, low], above[i, j, high]):
                    if k < 0:
                        continue
                    candidate = row[i, j, k]
                    square = (x - i) ** 2 + (y - j) ** 2 + (z - k) ** 2
                    if square < best or (square == best and not 0 <= found <= candidate):
                        best, found = square, candidate
        if found >= 0:
            distance[m], nearest[m] = np.sqrt(best), found
    return distance, nearest


@kernel()
def _alike_around(voxels, labels):  # type: ignore[no-untyped-def]
    """Return for each cell, with a margin of two, whether all voxels in 27 cells around agree.

    The value has no meaning if none of the cells is in the set.
    """
    side = RESOLUTION + 4
    low, high = np.full(side**3, 255, np.uint8), np.zeros(side**3, np.uint8)
    for m in range(len(voxels)):
        a, b, c = voxels[m, 0] + 2, voxels[m, 1] + 2, voxels[m, 2] + 2
        low[(a * side + b) * side + c] = high[(a * side + b) * side + c] = labels[m]
    # In a flattened grid a neighbour lies at a fixed offset. Offsets that leave a line or a plane
    # lead from margin to margin and do no harm. Each cell takes the values of itself and of the
    # next two, so the result for a cell lies `margin` places before it.
    for step in (1, side, side * side):
        for k in range(side**3 - 2 * step):
            low[k] = min(low[k], low[k + step], low[k + 2 * step])
            high[k] = max(high[k], high[k + step], high[k + 2 * step])
    alike = np.zeros(side**3, np.bool_)
    margin = 1 + side + side * side
    for k in range(side**3 - 2 * margin):
        alike[k + margin] = low[k] == high[k]
    return alike.reshape((side, side, side))


@kernel()
def _vote(  # type: ignore[no-untyped-def]
    points, near, row, labels, alike, n_labels, steepness, distance, index
):
    """Write distance and row of the chosen voxel for each near point."""
    size = row.shape[0]
    nearest, nearest_square = np.zeros(n_labels, dtype=np.intp), np.zeros(n_labels)
    voter_label, voter_square = np.zeros(27, dtype=np.intp), np.zeros(27)
    votes = np.zeros(n_labels)
    for m in range(len(points)):
        if not near[m]:
            continue
        x = (points[m, 0] + 0.5) * size - 0.5
        y = (points[m, 1] + 0.5) * size - 0.5
        z = (points[m, 2] + 0.5) * size - 0.5
        a, b, c = int(np.rint(x)), int(np.rint(y)), int(np.rint(z))
        if distance[m] < _BEYOND and alike[a + 2, b + 2, c + 2]:
            continue  # Away from borders all voters agree.
        voters, parties = 0, 0
        nearest_square[:] = np.inf
        for i in range(max(a - 1, 0), min(a + 2, size)):
            for j in range(max(b - 1, 0), min(b + 2, size)):
                for k in range(max(c - 1, 0), min(c + 2, size)):
                    voxel = row[i, j, k]
                    if voxel < 0:
                        continue
                    label, square = labels[voxel], (x - i) ** 2 + (y - j) ** 2 + (z - k) ** 2
                    voter_label[voters], voter_square[voters] = label, square
                    voters += 1
                    best = nearest_square[label]
                    parties += best == np.inf
                    if square < best or (square == best and voxel < nearest[label]):
                        nearest_square[label], nearest[label] = square, voxel
        if parties == 0:
            continue
        chosen = nearest[voter_label[0]]
        if parties > 1:
            votes[:] = 0.0
            for voter in range(voters):
                votes[voter_label[voter]] += math.exp(-voter_square[voter] * steepness)
            chosen = nearest[np.argmax(votes)]
        if chosen != index[m]:
            distance[m], index[m] = math.sqrt(nearest_square[labels[chosen]]), chosen
