"""A placement during the search: a similarity, and how well it fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from typing import NamedTuple

import numpy as np

from slatprep.geometry.frames import VOXEL_SIZE, Array, make_transform, split_transform


class Similarity(NamedTuple):
    """A similarity from the PixieVerse frame to the SLAT frame, in voxels from the cube's centre.

    ``offset`` is how far the PixieVerse surface stands inside the SLAT's.
    """

    rotation: Array
    shift: Array
    scale: float
    offset: float = 0.0

    @classmethod
    def of(cls, transform: Array) -> Similarity:
        """Return the similarity of a 4x4 matrix between the unit cubes."""
        rotation, shift, scale = split_transform(transform)
        return cls(rotation, shift / VOXEL_SIZE, scale)

    @property
    def transform(self) -> Array:
        """The 4x4 matrix between the unit cubes."""
        u, _, v = np.linalg.svd(self.rotation)
        return make_transform(u @ v, self.shift * VOXEL_SIZE, self.scale)

    def inverse(self, points: Array) -> Array:
        """Return where points (N, 3) of the SLAT frame lie in the PixieVerse frame, in voxels."""
        return (points - self.shift) @ self.rotation / self.scale


class Poses(NamedTuple):
    """Many similarities as arrays, which kernels read and change in place."""

    rotations: Array  # (n, 3, 3)
    shifts: Array  # (n, 3)
    scales: Array  # (n,)
    offsets: Array  # (n,)

    @classmethod
    def of(cls, similarities: Sequence[Similarity]) -> Poses:
        """Return the similarities, copied into arrays."""
        return cls(*(np.array(each) for each in zip(*similarities, strict=True)))

    def similarities(self) -> list[Similarity]:
        """Return the similarities as a list."""
        numbers = self.scales.tolist(), self.offsets.tolist()
        each = zip(self.rotations, self.shifts, *numbers, strict=True)
        return [Similarity(*one) for one in each]


@dataclass(frozen=True, eq=False)
class Pose:
    """A similarity and how well it fits.

    ``score`` is the mean robust kernel over the samples of both sides, 1 for a perfect fit.
    ``fitness`` is the share of samples within one voxel. ``bonus`` is the rise of the score by a
    deformation, if one was tried. ``standing`` counts in the order of placements, but not in their
    margin. ``behind`` is by how many standard errors the pose fits worse than the best one; NaN if
    not measured.
    """

    similarity: Similarity
    score: float = 0.0
    fitness: float = 0.0
    rmse: float = 0.0
    bonus: float = 0.0
    standing: float = 0.0
    behind: float = nan

    @property
    def merit(self) -> float:
        """The score, after deformation if one was tried."""
        return self.score + self.bonus

    @property
    def rank(self) -> float:
        """The value that orders placements."""
        return self.merit + self.standing
