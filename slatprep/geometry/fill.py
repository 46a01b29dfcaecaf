"""Find the space outside a voxel set, 64 voxels at a time.

A line of the grid along its last axis is one 64-bit word. So a flood runs along a
line in six steps, and from line to line in one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.kernel import kernel

WORD = 64
"""Longest line, in voxels, that fits into a word."""


def outside_of(occupancy: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the empty voxels that a path over faces connects to the outside of a grid (a, b, c).

    Raise ValueError if c is above 64, as a line is a word.
    """
    a, b, c = occupancy.shape
    if c > WORD:
        raise ValueError(f"the last axis is at most {WORD} long, got shape {occupancy.shape}")
    # The bits of a word beyond its line are occupied, so that no flood enters them.
    lines = np.ones((a, b, WORD), dtype=bool)
    lines[..., :c] = occupancy
    # The grid is flattened, as numpy packs one line far faster than many.
    free = ~np.packbits(lines.reshape(-1), bitorder="little").view("<u8").astype(np.uint64)
    flooded = _flood(free.reshape(a, b), np.uint64(1 | 1 << (c - 1))).astype("<u8")
    bits = np.unpackbits(flooded.view(np.uint8).reshape(-1), bitorder="little")
    return bits.view(np.bool_).reshape(a, b, WORD)[..., :c]


@kernel()
def _flood(free, ends):  # type: ignore[no-untyped-def]
    """Flood `free` from the grid's faces, by forward and backward sweeps until nothing changes."""
    rows, columns = free.shape
    flooded = np.zeros_like(free)
    changed, forward = True, True
    while changed:
        changed = False
        for step in range(rows * columns):
            line = step if forward else rows * columns - 1 - step
            i, j = line // columns, line % columns
            if flooded[i, j] == free[i, j]:
                continue
            seeds = flooded[i, j]
            if i == 0 or j == 0 or i == rows - 1 or j == columns - 1:
                seeds = free[i, j]
            else:
                seeds |= flooded[i - 1, j] | flooded[i + 1, j]
                seeds |= flooded[i, j - 1] | flooded[i, j + 1] | ends
            reached = _along_line(seeds & free[i, j], free[i, j])
            if reached != flooded[i, j]:
                flooded[i, j] = reached
                changed = True
        forward = not forward
    return flooded


@kernel(inline="always")
def _along_line(seeds, free):  # type: ignore[no-untyped-def]
    """Spread set bits over adjacent free bits both ways, in doubling steps (Kogge and Stone)."""
    up, down = seeds, seeds
    way_up, way_down = free, free
    for exponent in range(6):
        step = np.uint64(1 << exponent)
        up |= way_up & (up << step)
        way_up &= way_up << step
        down |= way_down & (down >> step)
        way_down &= way_down >> step
    return up | down
