"""How good an alignment is: figures at a tight radius, and a verdict in one word."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.geometry import (
    apply_transform,
    boundary,
    invert_transform,
    split_transform,
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
    from slatprep.lattice import nearest_voxel

    # Both ways the points are carried to the other side's lattice, where the
    # nearest voxel is found without a tree; a scale turns the way back's
    # distances into voxels of the SLAT frame.
    _, _, scale = split_transform(transform)
    surface = voxels_of(boundary(field.occupancy))
    forward, _ = nearest_voxel(
        apply_transform(transform, voxel_centres(surface)), latents.coords, limit=radius
    )
    backward, _ = nearest_voxel(
        apply_transform(invert_transform(transform), voxel_centres(latents.coords)),
        surface,
        limit=radius / scale,
    )
    backward = backward * scale
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


def _inliers(distance: NDArray[np.float64], radius: float) -> tuple[float, float]:
    near = distance[distance <= radius]
    if len(near) == 0:
        return 0.0, 0.0
    return float(len(near) / len(distance)), float(np.sqrt(np.mean(near**2)))
