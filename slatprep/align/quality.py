"""How good an alignment is: figures at a tight radius, and a verdict in one word."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.geometry import (
    apply_transform,
    invert_transform,
    occupancy_of,
    outer_boundary,
    split_transform,
    voxel_centres,
)
from slatprep.records import Ambiguity, MaterialField, Quality, StructuredLatents, Verdict


@dataclass(frozen=True)
class Thresholds:
    """Where the verdicts part; docs/quality.md says how the numbers were chosen.

    Attributes
    ----------
    good_fitness, failed_fitness : float
        The lower one of the two fitnesses: at least the first is good, below
        the second is failed.
    good_valid_share : float
        Share of SLAT voxels with an annotation; below it the asset is doubtful.
    good_ambiguity : float
        Share of SLAT voxels whose class depends on the choice among placements
        that fit equally well; above it the asset is doubtful.
    """

    good_fitness: float = 0.8
    failed_fitness: float = 0.65
    good_valid_share: float = 0.9
    good_ambiguity: float = 0.05


THRESHOLDS = Thresholds()
"""The thresholds of `judge`."""


def measure_quality(
    field: MaterialField, latents: StructuredLatents, transform: ArrayLike, radius: float
) -> Quality:
    """Measure how well the outer surfaces of the two sides lie on each other.

    Parameters
    ----------
    field, latents : MaterialField, StructuredLatents
        The two sides; only their geometry is used.
    transform : array_like, shape (4, 4)
        PixieVerse frame to SLAT frame.
    radius : float
        Voxels of the SLAT frame; partners farther apart are no inliers.

    Returns
    -------
    Quality
        See `compare`.
    """
    return compare(
        outer_boundary(field.occupancy),
        outer_boundary(occupancy_of(latents.coords)),
        transform,
        radius,
    )


def compare(
    pixieverse: NDArray[np.uint8], slat: NDArray[np.uint8], transform: ArrayLike, radius: float
) -> Quality:
    """Compare two boundaries under a transform.

    Both are boundaries of filled sets: a SLAT has voxels inside the object
    wherever its parts meet, which a solid's boundary cannot have.

    Parameters
    ----------
    pixieverse, slat : ndarray of uint8, shapes (K, 3) and (N, 3)
        Boundary voxels, each in its own frame.
    transform : array_like, shape (4, 4)
        PixieVerse frame to SLAT frame.
    radius : float
        Voxels of the SLAT frame; partners farther apart are no inliers.

    Returns
    -------
    Quality
        Fitness and inlier rmse both ways; overlap is the share of both
        boundaries' voxels together that have a partner.
    """
    from slatprep.lattice import nearest_voxel

    # Both ways the points are carried to the other side's lattice, where the
    # nearest voxel is found without a tree; the scale turns distances in the
    # PixieVerse frame into voxels of the SLAT frame.
    _, _, scale = split_transform(transform)
    carried = apply_transform(transform, voxel_centres(pixieverse))
    forward, _ = nearest_voxel(carried, slat, limit=radius)
    carried = apply_transform(invert_transform(transform), voxel_centres(slat))
    backward, _ = nearest_voxel(carried, pixieverse, limit=radius / scale)
    near, near_back = np.isfinite(forward), np.isfinite(backward)
    return Quality(
        fitness=float(near.mean()),
        inlier_rmse=_rms(forward[near]),
        fitness_backward=float(near_back.mean()),
        inlier_rmse_backward=_rms(backward[near_back] * scale),
        overlap=float((near.sum() + near_back.sum()) / (len(near) + len(near_back))),
        radius=radius,
    )


def judge(
    quality: Quality, valid_share: float, ambiguity: Ambiguity | None
) -> tuple[Verdict, tuple[str, ...]]:
    """Say what an alignment is worth, and why.

    Parameters
    ----------
    quality : Quality
        How well the two surfaces lie on each other.
    valid_share : float
        Share of SLAT voxels that got an annotation, 0..1.
    ambiguity : Ambiguity or None
        What tied placements would change; None where it was not measured.

    Returns
    -------
    verdict : Verdict
        ``good``, ``doubtful`` or ``failed``.
    reasons : tuple of str
        What kept it from being good; empty where it is.
    """
    limits = THRESHOLDS
    reasons = []
    failed = False
    sides = (
        ("PixieVerse boundary", quality.fitness),
        ("SLAT boundary", quality.fitness_backward),
    )
    for name, fitness in sides:
        if fitness < limits.good_fitness:
            reasons.append(
                f"only {fitness:.1%} of the {name} lies within {quality.radius:g} voxel of the "
                f"other side (good: {limits.good_fitness:.0%})"
            )
            failed = failed or fitness < limits.failed_fitness
    if valid_share < limits.good_valid_share:
        reasons.append(
            f"only {valid_share:.1%} of the SLAT voxels found an annotation "
            f"(good: {limits.good_valid_share:.0%})"
        )
    if ambiguity is not None and ambiguity.material_share > limits.good_ambiguity:
        # A store holds the ambiguity without the placements it comes from.
        count = f"{len(ambiguity.placements)} other" if ambiguity.placements else "other"
        reasons.append(
            f"{count} placements fit about as well and would change the "
            f"class of {ambiguity.material_share:.1%} of the voxels "
            f"(good: {limits.good_ambiguity:.0%})"
        )
    if failed:
        return Verdict.FAILED, tuple(reasons)
    return (Verdict.DOUBTFUL if reasons else Verdict.GOOD), tuple(reasons)


def _rms(distance: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(distance**2))) if len(distance) else 0.0
