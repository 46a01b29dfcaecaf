"""Two surfaces, and the operations on poses that all steps of the search use.

`slatprep.align.field` decides which steps run in which order. `slatprep.align.search` searches all
orientations, and `slatprep.align.finish` refines, deforms and compares the remaining poses.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from slatprep.align.pose import Pose, Poses, Similarity
from slatprep.align.solver import solve
from slatprep.align.surface import Surface
from slatprep.geometry.frames import Array
from slatprep.geometry.kernel import kernel
from slatprep.parameters import AlignParameters


class Steps(NamedTuple):
    """How poses are refined: samples per side, and the robust kernel's width at each step.

    Steps end once one moves the object's rim by less than the tolerance. Lengths are in voxels. The
    scale is refined too unless `free_scale` is false or the parameters fix it. See
    `slatprep.align.solver.solve` for `size_by_slat`.
    """

    samples: int
    taus: tuple[float, ...]
    tolerance: float
    free_scale: bool = True
    size_by_slat: bool = False


COARSE = Steps(100, (8.0, 8.0, 6.0, 5.0, 4.0, 3.0, 2.0, 2.0), 0.02)
POLISH = Steps(400, (2.0,) * 4 + (1.0,) * 4, 0.01)
FINE = Steps(2_000, (1.0,) * 10, 0.002)
"""Steps of the starts, of the survivors, and of the last refinement."""

SURVIVORS, MOST_SURVIVORS = 4, 24
"""Smallest number, whatever they score, and largest number of placements that are polished."""

TIE = 0.03
"""Difference to the best score below which a placement fits about as well."""

DISTINCT = 1.5
"""Smallest distance of two distinct placements: rms over the SLAT's surface, in voxels."""

SCALE_PRIOR = 0.04
"""Loss of rank by a scale off by 28 % (logarithm 0.25); it grows as the logarithm squared."""

RANK_STANDING = 0.01
"""Lead in rank that a placement needs over the one that fits best as a similarity."""

RANK_SAMPLES = 250
"""Samples at which deformed placements are compared."""


def scale_penalty(similarity: Similarity) -> float:
    """Return by how much the scale of a deformed placement lowers its rank."""
    return float(SCALE_PRIOR * (np.log(similarity.scale) / 0.25) ** 2)


@kernel()
def first_of_each(places, distance, most):  # type: ignore[no-untyped-def]
    """Choose at most `most` of places (n, 12), given best first, none near a better one."""
    kept = np.empty(min(most, len(places)), np.intp)
    found = 0
    for k in range(len(places)):
        if found == most:
            break
        apart = ((places[kept[:found]] - places[k]) ** 2).sum(axis=1)
        if (apart >= distance**2).all():
            kept[found] = k
            found += 1
    return kept[:found]


def far_apart(places: Sequence[Array]) -> list[int]:
    """Choose placements, given best first by deformed places (N, 3), none near a better one."""
    kept: list[int] = []
    for k, own in enumerate(places):
        apart = (np.sqrt(((own - places[other]) ** 2).sum(axis=1).mean()) for other in kept)
        if all(distance >= 2.0 * DISTINCT for distance in apart):
            kept.append(k)
    return kept


class Pair:
    """The SLAT's and the PixieVerse surface, with the operations of the search."""

    def __init__(self, slat: Surface, pixie: Surface, parameters: AlignParameters) -> None:
        self.slat, self.pixie = slat, pixie
        self.parameters = parameters
        self.free_scale = parameters.model != "rigid"
        self.may_deform = parameters.model in ("auto", "affine", "deformable")

    @cached_property
    def principal(self) -> tuple[Array, Array]:
        """Principal axes of the SLAT's samples, columns (3, 3): unit vectors; times the spread."""
        points = self.slat.points
        covariance = np.cov(points.T, bias=True) if len(points) > 1 else np.zeros((3, 3))
        variances, axes = np.linalg.eigh(covariance)
        return axes, axes * np.sqrt(np.maximum(variances, 0.0))

    def mirrored(self) -> Pair:
        """Return the same pair with the SLAT mirrored in its first axis."""
        return Pair(self.slat.mirrored(), self.pixie, self.parameters)

    @property
    def size_ratio(self) -> float:
        """SLAT size over PixieVerse size, within the scale's bounds; 1 if the scale is fixed."""
        if not self.free_scale or self.pixie.size <= 0:
            return 1.0
        low, high = self.parameters.scale_bounds
        return float(np.clip(self.slat.size / self.pixie.size, low, high))

    def subsets(self, samples: int) -> tuple[Surface, Surface]:
        """Return the SLAT's and the PixieVerse surface with at most `samples` samples."""
        return self.slat.subset(samples), self.pixie.subset(samples)

    def starts(self, rotations: Iterable[Array], scale: float) -> list[Pose]:
        """Return a pose for each of the rotations, with the centroids on each other."""
        turns = np.array([*rotations])
        shifts = self.slat.centroid - scale * (turns @ self.pixie.centroid)
        return [Pose(Similarity(*pose, scale)) for pose in zip(turns, shifts, strict=True)]

    def refine(self, poses: Sequence[Pose], steps: Steps) -> list[Pose]:
        """Refine each pose on an even subset of the samples; see `slatprep.align.solver.solve`."""
        refined = Poses.of([pose.similarity for pose in poses])
        fits = self.solve(refined, steps)
        return [
            Pose(similarity, 0.5 * (here + back), within, rmse, pose.bonus, pose.standing)
            for pose, similarity, (here, back, within, rmse) in zip(
                poses, refined.similarities(), fits.tolist(), strict=True
            )
        ]

    def solve(self, poses: Poses, steps: Steps) -> Array:
        """Refine poses in place, and return their fits (n, 4), as `solver.solve` does."""
        slat, pixie = self.subsets(steps.samples)
        low, high = self.parameters.scale_bounds
        fits: Array = solve(
            slat.samples, pixie.samples, poses, np.array(steps.taus, dtype=np.float64),
            self.free_scale and steps.free_scale, steps.size_by_slat,
            (float(low), float(high)), steps.tolerance,
        )  # fmt: skip
        return fits

    def polish(self, poses: Sequence[Pose]) -> list[Pose]:
        """Refine the best distinct poses further and return them best first."""
        survivors = self.distinct(poses)
        likely = [p for p in survivors if p.score > survivors[0].score - 2 * TIE]
        survivors = survivors[: min(max(SURVIVORS, len(likely)), MOST_SURVIVORS)]
        return self.distinct(self.refine(survivors, POLISH))

    def apart(self, poses: Sequence[Pose], other: Pose) -> Array:
        """Return the rms distance [voxel] of each pose from `other`, over the SLAT's surface.

        It is measured in the PixieVerse frame.
        """
        places = self.places([*poses, other])
        return np.asarray(np.linalg.norm(places[:-1] - places[-1], axis=1))

    def others(self, best: Pose, poses: Sequence[Pose]) -> list[Pose]:
        """Return the distinct poses that do not repeat `best`, whatever their scores."""
        apart = self.apart(poses, best) >= DISTINCT
        far = [pose for pose, ok in zip(poses, apart, strict=True) if ok]
        return self.distinct(far) if far else []

    def places(self, poses: Sequence[Pose], affines: Array | None = None) -> Array:
        """Return poses as points in 12 dimensions whose distances are those of `apart`.

        For samples of mean m and covariance L L^T, the mean square of A x + b is the sum of
        squares of A L and A m + b. The `affines` (n, 3, 4) are applied before the poses.
        """
        all_poses = Poses.of([pose.similarity for pose in poses])
        inverse = all_poses.rotations.transpose(0, 2, 1) / all_poses.scales[:, None, None]
        moved = -all_poses.shifts
        matrices = inverse
        if affines is not None:
            matrices, moved = inverse @ affines[:, :, :3], moved + affines[:, :, 3]
        centre = matrices @ self.slat.centroid + np.einsum("nij,nj->ni", inverse, moved)
        return np.concatenate([(matrices @ self.principal[1]).reshape(-1, 9), centre], axis=1)

    def distinct(self, poses: Sequence[Pose]) -> list[Pose]:
        """Return the poses best first, without those that repeat a better one."""
        rest = sorted(poses, key=lambda pose: -pose.rank)
        return [rest[k] for k in first_of_each(self.places(rest), DISTINCT, len(rest))]

    def at_scale_one(self, similarity: Similarity) -> Similarity:
        """Return the similarity of scale one that maps the SLAT's centroid to the same point."""
        centre = self.slat.centroid
        shift = centre + (similarity.shift - centre) / similarity.scale
        return similarity._replace(shift=shift, scale=1.0)
