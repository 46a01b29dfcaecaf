"""A placement while it is searched for: a similarity, and how well it fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slatprep.align.warp import Similarity
from slatprep.geometry.frames import VOXEL_SIZE, make_transform


@dataclass(frozen=True, eq=False)
class Pose:
    """A similarity from the PixieVerse frame to the SLAT frame, and how well it fits.

    ``shift`` and ``offset`` are in voxels, positions relative to the cube's
    centre; ``score`` is the mean robust kernel over the samples of both sides,
    1 for a perfect fit; ``fitness`` the share of samples within one voxel.
    ``bonus`` is what a trial deformation added to the score, where one was made;
    ``standing`` counts in the order of placements, and not in how far they are apart.
    """

    rotation: NDArray[np.float64]
    shift: NDArray[np.float64]
    scale: float
    offset: float = 0.0
    score: float = 0.0
    fitness: float = 0.0
    rmse: float = 0.0
    bonus: float = 0.0
    standing: float = 0.0

    @property
    def merit(self) -> float:
        """How well it fits, once deformed where that was tried."""
        return self.score + self.bonus

    @property
    def rank(self) -> float:
        """What placements are ordered by."""
        return self.merit + self.standing

    @property
    def similarity(self) -> Similarity:
        """The pose without its marks."""
        return Similarity(self.rotation, self.shift, self.scale, self.offset)

    @property
    def transform(self) -> NDArray[np.float64]:
        """The pose as a 4x4 matrix between the unit cubes."""
        u, _, v = np.linalg.svd(self.rotation)
        return make_transform(u @ v, self.shift * VOXEL_SIZE, self.scale)
