"""How good an alignment is: figures at a tight radius, and a verdict in one word."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from slatprep.geometry import (
    VOXEL_SIZE,
    apply_transform,
    boundary,
    voxel_centres,
    voxels_of,
)
from slatprep.records import (
    Ambiguity,
    MaterialField,
    Quality,
    StructuredLatents,
    Verdict,
)


def measure_quality(
    field: MaterialField, latents: StructuredLatents, transform: ArrayLike, radius: float
) -> Quality:
    """Measure how well two voxel surfaces lie on each other.

    Parameters
    ----------
    field, latents : MaterialField, StructuredLatents
        The two sides; only their geometry is used.
    transform : array_like, shape (4, 4)
        PixieVerse frame to SLAT frame.
    radius : float
        Voxels; partners farther apart do not count as inliers.

    Returns
    -------
    Quality
        Fitness and inlier rmse both ways, and the overlap of the two surfaces:
        intersection over union of the SLAT voxels and the voxels that the
        carried boundary falls into, one voxel of slack on either side.
    """
    from scipy.spatial import cKDTree

    carried = apply_transform(transform, voxel_centres(voxels_of(boundary(field.occupancy))))
    slat = voxel_centres(latents.coords)
    forward = cKDTree(slat).query(carried, distance_upper_bound=4.0 * VOXEL_SIZE)[0] / VOXEL_SIZE
    backward = cKDTree(carried).query(slat, distance_upper_bound=4.0 * VOXEL_SIZE)[0] / VOXEL_SIZE
    fitness, rmse = _inliers(forward, radius)
    fitness_backward, rmse_backward = _inliers(backward, radius)
    matched = (forward <= radius).sum() + (backward <= radius).sum()
    return Quality(
        fitness=fitness,
        inlier_rmse=rmse,
        fitness_backward=fitness_backward,
        inlier_rmse_backward=rmse_backward,
        overlap=float(matched / (len(forward) + len(backward))),
        radius=radius,
    )


def judge(
    quality: Quality, valid_share: float, ambiguity: Ambiguity | None
) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict on an alignment and the reasons for it."""
    reasons = []
    if quality.fitness_backward < 0.5:
        reasons.append(f"only {quality.fitness_backward:.0%} of the SLAT voxels have a partner")
        return Verdict.FAILED, tuple(reasons)
    return Verdict.GOOD, ()


def _inliers(distance: np.ndarray, radius: float) -> tuple[float, float]:
    near = distance[distance <= radius]
    if len(near) == 0:
        return 0.0, 0.0
    return float(len(near) / len(distance)), float(np.sqrt(np.mean(near**2)))
