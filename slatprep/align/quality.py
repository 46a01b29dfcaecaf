"""Measure the quality of an alignment at a tight radius."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.geometry.frames import (
    apply_transform,
    invert_transform,
    split_transform,
    voxel_centres,
)
from slatprep.geometry.voxels import above, occupancy_of, outer_boundary
from slatprep.records import Ground, MaterialField, Quality, StructuredLatents


def measure_quality(
    field: MaterialField,
    latents: StructuredLatents,
    transform: ArrayLike,
    radius: float,
    ground: Ground | None = None,
) -> Quality:
    """Measure how well the outer surfaces of the two sides lie on each other; see `compare`.

    The transform (4, 4) maps to the SLAT frame. Voxels of the ground are left out.
    """
    return compare(
        outer_boundary(above(field.occupancy, ground)),
        outer_boundary(occupancy_of(latents.coords, latents.resolution)),
        transform,
        radius,
    )


def compare(
    pixieverse: NDArray[np.uint8], slat: NDArray[np.uint8], transform: ArrayLike, radius: float
) -> Quality:
    """Compare boundary voxels (K, 3) and (N, 3), each in its own frame, under a transform (4, 4).

    Both must be boundaries of filled sets. A SLAT also has voxels inside the object where its parts
    meet, and the boundary of a solid has none there. A partner farther away than `radius` (voxels
    of the SLAT frame) is no inlier.
    """
    from slatprep.geometry.nearest import VoxelIndex

    # Both ways the points are carried to the other side's lattice, where the nearest voxel is found
    # without a tree. The scale converts distances in the PixieVerse frame to voxels of the SLAT
    # frame.
    _, _, scale = split_transform(transform)
    carried = apply_transform(transform, voxel_centres(pixieverse))
    forward, _ = VoxelIndex(slat).nearest(carried, limit=radius)
    carried = apply_transform(invert_transform(transform), voxel_centres(slat))
    backward, _ = VoxelIndex(pixieverse).nearest(carried, limit=radius / scale)
    near, near_back = np.isfinite(forward), np.isfinite(backward)
    return Quality(
        fitness=float(near.mean()),
        inlier_rmse=_rms(forward[near]),
        fitness_backward=float(near_back.mean()),
        inlier_rmse_backward=_rms(backward[near_back] * scale),
        overlap=float((near.sum() + near_back.sum()) / (len(near) + len(near_back))),
        radius=radius,
    )


def _rms(distance: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(distance**2))) if len(distance) else 0.0
