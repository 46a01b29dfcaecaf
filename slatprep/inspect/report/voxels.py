"""An asset's voxels in a few kilobytes, for the 3D view.

An asset is one stream of raw deflate (RFC 1951), which browsers can unpack. It holds, for n
voxels per edge and voxels in C order of the grid::

    n^3 / 8 bytes   occupancy of the SLAT, most significant bit first
    n^3 / 8 bytes   occupancy of the PixieVerse boundary, in its own frame
    N bytes each    class, E, density, Poisson's ratio, distance of the SLAT voxels
    K bytes         class of the boundary voxels

and for a deformed asset also::

    4 bytes         a step in edges of the cube, float32, little-endian
    3 K bytes       displacement of the centre of each boundary voxel along x, y and z of its
                    own frame before the transform, int8, in steps

Properties are quantised to `LEVELS` over [-1, 1] and distances over 0 to the
largest distance allowed; 255 means not valid, for a class as well.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.deformation import PlaceMap
from slatprep.geometry.frames import apply_transform, invert_transform, voxel_centres
from slatprep.geometry.voxels import boundary, filled
from slatprep.records import RESOLUTION, UNANNOTATED
from slatprep.store import StoredAsset

LEVELS = 64
"""Steps of a quantised property or distance, finer than a colour scale can show."""

NOT_VALID = 255

FULL, COARSE = RESOLUTION, RESOLUTION // 2
"""Voxels per edge of the two levels of detail."""


def encode_asset(asset: StoredAsset, way: PlaceMap, max_distance: float, side: int) -> bytes:
    """Return an asset's voxels for the 3D view, in the form that this module describes.

    `way` maps between its frames. Distances [voxel] are scaled up to `max_distance`. `side` is
    `FULL`, or `COARSE` for voxels of 2 x 2 x 2.
    """
    cells, row = asset.cells
    first, occupied = _cells(cells, side)
    first = row[first]
    grid, material = _boundary_of(asset.grid_material, asset.store.contents.background)
    chosen, grid_occupied = _cells(grid, side)
    scalars = np.column_stack(
        [(asset.properties[first] + 1.0) / 2.0, asset.distance[first] / max_distance]
    )
    scalars[~asset.valid[first], :3] = np.nan
    parts = [
        occupied,
        grid_occupied,
        asset.material[first].tobytes(),
        *(_quantised(column).tobytes() for column in scalars.T),
        material[chosen].tobytes(),
    ]
    if way.deformation is not None:
        centres = voxel_centres(grid[chosen])
        moved = apply_transform(invert_transform(way.transform), way.to_slat(centres)) - centres
        step = np.float32(max(np.abs(moved).max(), 1e-6) / 127)
        parts += [step.tobytes(), np.rint(moved / step).astype(np.int8).tobytes()]
    deflate = zlib.compressobj(6, zlib.DEFLATED, -zlib.MAX_WBITS)
    return deflate.compress(b"".join(parts)) + deflate.flush()


def _boundary_of(
    grid_material: NDArray[np.uint8], background: int
) -> tuple[NDArray[np.intp], NDArray[np.uint8]]:
    """Return the outer surface (K, 3) of a field and the class (K,) of its voxels."""
    occupancy = grid_material != background
    surface = boundary(filled(occupancy)) & occupancy
    material = grid_material[surface]
    return np.argwhere(surface), np.where(material == UNANNOTATED, NOT_VALID, material)


def _cells(voxels: NDArray[np.integer], side: int) -> tuple[NDArray[np.intp], bytes]:
    """Return the first voxel of each occupied cell, and the bits of all cells, in C order."""
    cells = voxels.astype(np.intp) // (RESOLUTION // side)
    flat, first = np.unique(np.ravel_multi_index(tuple(cells.T), (side,) * 3), return_index=True)
    occupancy = np.zeros(side**3, dtype=bool)
    occupancy[flat] = True
    return first, np.packbits(occupancy).tobytes()


def _quantised(share: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return shares 0..1 in `LEVELS` steps; NaN as `NOT_VALID`."""
    known = np.isfinite(share)
    steps = np.round(np.clip(np.where(known, share, 0.0), 0.0, 1.0) * (LEVELS - 1))
    return np.where(known, steps, NOT_VALID).astype(np.uint8)
