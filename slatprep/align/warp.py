"""A similarity and its deformation while they are fitted; lengths are in voxels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slatprep.align.pose import Similarity
from slatprep.geometry.bspline import displacements, refined
from slatprep.geometry.deformation import make_deformation
from slatprep.geometry.frames import VOXEL_SIZE, Array, nearest_similarity, split_transform
from slatprep.records import Deformation

NO_SPACING = 1e6
"""Spacing of a warp without a lattice."""


class Warp(NamedTuple):
    """A deformation while it is fitted; lengths in voxels, positions from the cube's centre."""

    affine: Array
    offset: float
    origin: Array = np.zeros(3)
    spacing: float = NO_SPACING
    coefficients: Array = np.zeros((4, 4, 4, 3))

    @classmethod
    def unbent(cls, pose: Similarity) -> Warp:
        """Return the warp that leaves a similarity as it is."""
        return cls(np.eye(3, 4), pose.offset)

    def moved(self, points: Array) -> Array:
        """Return points (N, 3) of the SLAT frame as the warp moves them."""
        moved: Array = points @ self.affine[:, :3].T + self.affine[:, 3]
        if self.spacing < NO_SPACING:
            added = np.empty_like(moved)
            displacements(points, self.origin, self.spacing, self.coefficients, added)
            moved += added
        return moved

    def record(self, points: Array, max_displacement: float) -> Deformation | None:
        """Return the warp as a bounded, rounded record without folds, or None if there is none.

        `points` (N, 3) are the SLAT's; `max_displacement` is in voxels.
        """
        affine = self.affine.copy()
        affine[:, 3] *= VOXEL_SIZE
        lattice: tuple[Array, float, Array] = np.zeros(3), 1.0, np.zeros((0, 0, 0, 3))
        if self.coefficients.any():
            origin, spacing, coefficients = self.origin, self.spacing, self.coefficients
            lattice = origin * VOXEL_SIZE, spacing * VOXEL_SIZE, coefficients * VOXEL_SIZE
        return make_deformation(affine, *lattice, points * VOXEL_SIZE, max_displacement)

    def as_recorded(self, kept: Deformation) -> Warp:
        """Return the warp with the numbers of the deformation that `record` made of it."""
        affine = kept.affine.copy()
        affine[:, 3] /= VOXEL_SIZE
        if not kept.coefficients.size:
            return self._replace(affine=affine)
        return self._replace(affine=affine, coefficients=kept.coefficients / VOXEL_SIZE)


def halved(warp: Warp) -> Warp:
    """Return the same warp on a lattice of half the spacing."""
    return warp._replace(spacing=0.5 * warp.spacing, coefficients=refined(warp.coefficients))


def places_of(pose: Similarity, warp: Warp, points: Array) -> Array:
    """Return where points (N, 3) of the SLAT frame lie in the PixieVerse frame, all in voxels."""
    return pose.inverse(warp.moved(points))


def from_nearest(
    pose: Similarity, warp: Warp, points: Array, scale_bounds: tuple[float, float]
) -> tuple[Similarity, Warp]:
    """Return the same map as the similarity nearest to it, and a warp of that.

    If shapes differ much, the search may find a similarity of another size or heading, which a
    deformation should not correct. Nearest means least squares over `points` (N, 3) of the SLAT.
    The new similarity's scale stays within the bounds.
    """
    moved = warp.moved(points)
    turn, _, grown = split_transform(nearest_similarity(points, moved))
    low, high = scale_bounds
    grown = pose.scale / float(np.clip(pose.scale / grown, low, high))
    centre, there = points.mean(axis=0), moved.mean(axis=0)
    back = turn.T / grown
    affine = np.column_stack(
        [back @ warp.affine[:, :3], centre + back @ (warp.affine[:, 3] - there)]
    )
    nearest = Similarity(
        turn.T @ pose.rotation,
        centre + back @ (pose.shift - there),
        pose.scale / grown,
        pose.offset,
    )
    return nearest, warp._replace(affine=affine, coefficients=warp.coefficients @ back.T)
