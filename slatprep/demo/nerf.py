"""Degrade an object on PixieVerse's grid, as the density of a NeRF does.

`damage` changes a few places of a grid. `nerf_field` replaces all of it by a field that is rough
and thicker than the object, with hollows and floating blobs. Some thin parts are missing, and some
fields include a piece of the ground.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from slatprep.demo.model import Rng
from slatprep.geometry.frames import VOXEL_SIZE, voxel_centres
from slatprep.geometry.voxels import boundary
from slatprep.records import RESOLUTION

EMPTY, UNLABELLED = -1, -2
"""Stuff of an empty voxel, and of an occupied voxel without a label."""

THICKENING = 0.5
"""Mean distance [voxel] of the field's surface outside the surface of the exact grid.

The exact grid is itself thicker than the object, because all voxels on the surface are filled.
"""

ROUGHNESS = 0.6
"""Standard deviation [voxel] of the surface's distance, clipped at `_MOST_ROUGH` deviations."""

GROUND_SHARE = 1.0 / 3.0
"""Share of the assets with a slab of ground."""

_MOST_ROUGH = 2.0
_THIN = 1.5  # Half the thickness [voxel] below which a part may be removed.
_MOST_LOST = 0.15  # Largest share of an object that is removed with its thin parts.


def damage(
    rng: Rng,
    stuff: NDArray[np.int16],
    distance: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    stuffs: int,
) -> NDArray[np.int16]:
    """Remove pieces of a grid (64, 64, 64) of stuff indices, and add two to four floaters.

    `distance` is the solid's distance bound in the grid's frame. The first floater is `UNLABELLED`;
    each of the others gets one of `stuffs` stuffs.
    """
    damaged = stuff.copy()
    skin = np.argwhere(boundary(stuff >= 0))
    for _ in range(rng.integers(1, 4)):
        centre = skin[rng.integers(len(skin))]
        damaged[_ball(centre, np.full(3, rng.uniform(2.5, 5.0)))] = EMPTY
    wanted = int(rng.integers(2, 5))
    places = rng.integers(3, RESOLUTION - 3, (200, 3))
    free = places[distance(voxel_centres(places)) > 4.5 * VOXEL_SIZE][:wanted]
    for k, centre in enumerate(free):
        _add_blob(rng, damaged, _ball(centre, rng.uniform(1.0, 2.5, 3)), stuffs, k > 0)
    return damaged


def nerf_field(
    rng: Rng, stuff: NDArray[np.int16], up: NDArray[np.float64], stuffs: int
) -> NDArray[np.int16]:
    """Degrade an exact grid (64, 64, 64) of stuff indices as a NeRF's density would.

    The unit vector `up` (3,) points up from the ground. The first blob is `UNLABELLED`; each other
    blob and the ground get one of `stuffs` stuffs.
    """
    kept = _without_thin_parts(rng, stuff >= 0)
    away, nearest = ndimage.distance_transform_edt(~kept, return_indices=True)
    depth = ndimage.distance_transform_edt(kept)
    signed = np.where(kept, 0.5 - depth, away - 0.5)
    rough = ROUGHNESS * np.clip(_smooth_noise(rng, 1.5), -_MOST_ROUGH, _MOST_ROUGH)
    field = np.where(signed <= THICKENING + rough, stuff[tuple(nearest)], np.int16(EMPTY))
    _hollow(rng, field, depth)
    if rng.uniform() < GROUND_SHARE:
        _add_ground(rng, field, kept, up, int(rng.integers(stuffs)))
    _add_blobs(rng, field, away, stuffs)
    return field.astype(np.int16)


def _smooth_noise(rng: Rng, sigma: float) -> NDArray[np.float64]:
    """Return noise (64, 64, 64), smoothed over `sigma` voxels, of mean 0 and deviation 1."""
    noise = ndimage.gaussian_filter(rng.normal(size=(RESOLUTION,) * 3), sigma)
    return np.asarray((noise - noise.mean()) / noise.std())


def _without_thin_parts(rng: Rng, occupied: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Remove some of the pieces into which a ball of radius `_THIN` does not fit."""
    core = ndimage.distance_transform_edt(occupied) > _THIN
    opened = ndimage.distance_transform_edt(~core) <= _THIN
    thin = occupied & ~opened & (_smooth_noise(rng, 4.0) > 0.0)
    pieces, count = ndimage.label(thin, np.ones((3, 3, 3)))
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)[1:]
    order = rng.permutation(count)
    # An object with mostly thin parts, such as grass, must not lose most of them.
    lost = order[np.cumsum(sizes[order]) <= _MOST_LOST * occupied.sum()]
    return np.asarray(occupied & ~np.isin(pieces, lost + 1))


def _ball(centre: NDArray[np.integer], radii: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the occupancy (64, 64, 64) of an axis-parallel ellipsoid; arguments are in voxels."""
    x, y, z = (((np.arange(RESOLUTION) - c) / r) ** 2 for c, r in zip(centre, radii, strict=True))
    return np.asarray(x[:, None, None] + y[:, None] + z < 1.0)


def _hollow(rng: Rng, field: NDArray[np.int16], depth: NDArray[np.float64]) -> None:
    """Empty a few places well below the surface."""
    deep = np.argwhere(depth > 3.5)
    for _ in range(rng.integers(1, 4) if len(deep) else 0):
        hollow = _ball(deep[rng.integers(len(deep))], rng.uniform(2.0, 6.0, 3))
        field[hollow & (depth > 2.0)] = EMPTY


def _add_ground(
    rng: Rng,
    field: NDArray[np.int16],
    occupied: NDArray[np.bool_],
    up: NDArray[np.float64],
    stuff: int,
) -> None:
    """Add a round slab of one stuff at the object's foot, cut off by the grid."""
    centres = voxel_centres(np.argwhere(np.ones_like(occupied))) / VOXEL_SIZE
    height = (centres @ up).reshape(occupied.shape)
    foot = float(height[occupied].min())
    middle = centres[occupied.ravel()].mean(axis=0)
    aside = centres - middle
    aside -= np.outer(aside @ up, up)
    distance = np.linalg.norm(aside, axis=1).reshape(occupied.shape)
    radius = rng.uniform(0.9, 1.4) * float(np.quantile(distance[occupied], 0.95))
    top, thickness = foot + rng.uniform(0.0, 1.5), rng.uniform(2.0, 4.0)
    slab = (height <= top) & (height > top - thickness) & (distance < radius)
    field[slab & (field == EMPTY)] = stuff


def _add_blobs(rng: Rng, field: NDArray[np.int16], away: NDArray[np.float64], stuffs: int) -> None:
    """Add blobs in empty space; the first has no label."""
    free = np.argwhere((away > 4.5) & (field == EMPTY))
    for k in range(rng.integers(3, 8) if len(free) else 0):
        blob = _ball(free[rng.integers(len(free))], rng.uniform(1.0, 3.0, 3))
        _add_blob(rng, field, blob, stuffs, k > 0)


def _add_blob(
    rng: Rng, field: NDArray[np.int16], blob: NDArray[np.bool_], stuffs: int, labelled: bool
) -> None:
    field[blob & (field == EMPTY)] = rng.integers(stuffs) if labelled else UNLABELLED
