"""Two surfaces and the steps of the search for the placement of one on the other.

Poses are refined, polished, ranked by trial deformations and finished; the engine,
`slatprep.align.field`, says in which order, and when it is enough.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slatprep.align.deform import Deformed, deform_if_earned, try_out
from slatprep.align.pose import Pose
from slatprep.align.starts import so3_starts
from slatprep.align.surface import Surface
from slatprep.align.warp import Warp, from_nearest, places_of
from slatprep.parameters import AlignParameters
from slatprep.records import Model

COARSE_SAMPLES, POLISH_SAMPLES, FINE_SAMPLES = 100, 400, 2_000
"""Samples a side used from the starts, on the survivors, and at the end."""

COARSE_TAUS = (8.0, 8.0, 6.0, 5.0, 4.0, 3.0, 2.0, 2.0)
POLISH_TAUS = (2.0,) * 4 + (1.0,) * 4
FINE_TAUS = (1.0,) * 10
"""Width of the robust kernel at each step, in voxels."""

SURVIVORS, MOST_SURVIVORS = 4, 24
"""Distinct placements that are polished: at least, whatever they score, and at most."""

TIE = 0.03
"""Placements that score less than this below the best one fit about as well."""

DISTINCT = 1.5
"""Voxels, rms over the SLAT's surface, from which on two placements are two."""

SO3_STARTS, SO3_HALFWAY, SO3_KEPT = 240, 4, 80
"""Starts over all orientations, and how many of them are refined further after so many steps.

Of 180 assets the best placement was among the first 30 then, but for three with ties in plenty.
"""

SAME_SIZE = 0.05
"""Sizes whose ratio is this near to one need no second set of starts, at scale one."""

RANK_WITHIN, MOST_RANKED, RANK_SAMPLES = 0.12, 6, 250
"""Where the best fit is poor, so many placements within so much of it are ranked anew, by what
they score after a trial deformation on so many samples."""

SCALE_PRIOR = 0.04
"""By so much a scale off by 28 % (a quarter, as a logarithm) lowers the rank, squared beyond."""

STRETCH_MANY = 40, (5.0, 4.0, 3.0), 24
STRETCH_FEW = 160, (3.0, 2.0, 2.0, 1.5), MOST_RANKED
"""Where the best fit is poor, all poses halfway through the search of all orientations are
stretched, and the best of them once more: samples a side, widths of the kernel, how many are left.

Of 140 pairs of generated shapes the right placement of 12 did not fit best as a similarity:
halfway it was the 6th to the 94th.
"""

RANK_STANDING = 0.01
"""By so much another placement must rank above the one that fits best as a similarity."""

MOST_CONTESTED = 4
"""Where the best placement is deformed, so many, of those within twice `TIE`, are deformed too."""

RIGID_IF_SCALE_WITHIN = 0.04
RIGID_LOSS = 0.004
"""A scale this near to one is kept only if it raises the score by more than this."""


def _scale_penalty(pose: Pose) -> float:
    return float(SCALE_PRIOR * (np.log(pose.scale) / 0.25) ** 2)


def _rank(pose: Pose, deformed: Deformed) -> float:
    figures = deformed.figures
    return 0.5 * (figures.score_slat + figures.score_pixieverse) - _scale_penalty(pose)


def _apart_from_all(places: NDArray[np.float64], others: Iterable[NDArray[np.float64]]) -> bool:
    """Whether similarities did not deform into one and the same placement."""
    apart = (np.sqrt(((places - other) ** 2).sum(axis=1).mean()) for other in others)
    return all(distance >= 2.0 * DISTINCT for distance in apart)


def _apart(
    places: NDArray[np.float64], distance: float, most: int | None = None
) -> NDArray[np.intp]:
    """Choose at most so many places, best first, that do not lie near to a better one."""
    left = np.arange(len(places))
    kept: list[np.intp] = []
    while len(left) and len(kept) != most:
        best, left = left[0], left[1:]
        kept.append(best)
        left = left[((places[left] - places[best]) ** 2).sum(axis=1) >= distance**2]
    return np.array(kept, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class Stretched:
    """A pose and the affine map before it, with its score."""

    pose: Pose
    warp: Warp
    score: float = 0.0


def _unstretched(poses: Iterable[Pose]) -> list[Stretched]:
    return [Stretched(pose, Warp(np.eye(3, 4), pose.offset)) for pose in poses]


class Pair:
    """Two surfaces and what the search asks of them."""

    def __init__(self, slat: Surface, pixie: Surface, parameters: AlignParameters) -> None:
        self.slat, self.pixie = slat, pixie
        self.parameters = parameters
        self._cache: dict[int, tuple[Surface, Surface]] = {}
        self.free_scale = parameters.model != "rigid"
        self.may_deform = parameters.model in ("auto", "affine", "deformable")
        points = slat.points
        self._mean: NDArray[np.float64] = points.mean(axis=0)
        covariance = np.cov(points.T, bias=True) if len(points) > 1 else np.zeros((3, 3))
        variances, axes = np.linalg.eigh(covariance)
        self._spread: NDArray[np.float64] = axes * np.sqrt(np.maximum(variances, 0.0))

    @property
    def size_ratio(self) -> float:
        """The scale that lays size on size, within its bounds; 1 where scale is not free."""
        if not self.free_scale or self.pixie.size <= 0:
            return 1.0
        low, high = self.parameters.scale_bounds
        return float(np.clip(self.slat.size / self.pixie.size, low, high))

    def poses(self, rotations: Iterable[NDArray[np.float64]], scale: float) -> list[Pose]:
        """Start poses that lay centroid on centroid."""
        here, there = self.slat.centroid, self.pixie.centroid
        return [Pose(r, here - scale * (r @ there), scale) for r in rotations]

    def refine(
        self,
        poses: Sequence[Pose],
        samples: int,
        taus: Sequence[float],
        tolerance: float,
        free_scale: bool | None = None,
        size_by_slat: bool = False,
    ) -> list[Pose]:
        """Refine each pose on an even subset of the samples; see `slatprep.align.solver.solve`."""
        from slatprep.align.solver import solve

        slat, pixie = self._subsets(samples)
        low, high = self.parameters.scale_bounds
        rotations = np.array([pose.rotation for pose in poses])
        shifts = np.array([pose.shift for pose in poses])
        scales = np.array([pose.scale for pose in poses])
        offsets = np.array([pose.offset for pose in poses])
        fits = solve(
            slat.points, slat.values, slat.distance, slat.origin,
            pixie.points, pixie.values, pixie.distance, pixie.origin,
            rotations, shifts, scales, offsets,
            np.array(taus, dtype=np.float64), self.free_scale if free_scale is None else free_scale,
            size_by_slat, low, high, tolerance,
        )  # fmt: skip
        return [
            Pose(rotation, shift, float(scale), float(offset), 0.5 * (here + back), within, rmse,
                 pose.bonus, pose.standing)
            for pose, rotation, shift, scale, offset, (here, back, within, rmse) in zip(
                poses, rotations, shifts, scales, offsets, fits.tolist(), strict=True
            )
        ]  # fmt: skip

    def search_all(self) -> tuple[list[Pose], list[Pose]]:
        """Refine starts in all orientations, those that look hopeless halfway not to the end.

        Returns
        -------
        refined, halfway : list of Pose
            Those that were refined to the end, and those of the first set halfway.
        """
        scales = [self.size_ratio]
        if abs(scales[0] - 1.0) > SAME_SIZE:
            # Floaters, ground and missing parts falsify sizes; one is the likeliest scale.
            scales.append(1.0)
        sets: list[list[Pose]] = []
        for scale in scales:
            # The second set is a supplement, and half as dense for the sake of time.
            starts = self.poses(so3_starts(SO3_STARTS)[:: 2 if sets else 1], scale)
            taus = COARSE_TAUS[:SO3_HALFWAY]
            free = self.free_scale and not sets
            halfway = self.refine(starts, COARSE_SAMPLES, taus, 0.02, free_scale=free)
            sets.append(sorted(halfway, key=lambda pose: -pose.score))
        kept = [pose for some in sets for pose in some[: SO3_KEPT // len(sets)]]
        refined = self.refine(kept, COARSE_SAMPLES, COARSE_TAUS[SO3_HALFWAY:], 0.02)
        return refined, sets[0]

    def stretched(self, near: Sequence[Pose], halfway: Sequence[Pose]) -> list[Pose]:
        """Return the placements that fit best if they may be stretched.

        Squashed by a quarter, an apple fits best as a similarity if it lies on its side,
        and a search for similarities may not come to the right placement at all. So
        `halfway`, poses of all orientations, are stretched, and the best of them once more, beside
        `near`, which fit well as they are.
        """
        first = self._stretch(_unstretched(halfway), *STRETCH_MANY)
        found = self._stretch([*_unstretched(near), *first], *STRETCH_FEW)
        likely = [s for s in found if s.score > found[0].score - RANK_WITHIN]
        points = self._subsets(POLISH_SAMPLES)[0].points
        bounds = self.parameters.scale_bounds
        similar = [
            Pose(**vars(from_nearest(s.pose.similarity, s.warp, points, bounds)[0]))
            for s in likely
            if s.pose not in near
        ]
        if similar:
            similar = self.refine(similar, POLISH_SAMPLES, POLISH_TAUS, 0.01)
        return self.distinct([*(s.pose for s in likely if s.pose in near), *similar])

    def _stretch(
        self, poses: Sequence[Stretched], samples: int, taus: Sequence[float], most: int
    ) -> list[Stretched]:
        """Stretch poses further; return so many distinct ones at most, best first."""
        from slatprep.align.stretch import stretch

        slat, pixie = self._subsets(samples)
        affines = np.array([s.warp.affine for s in poses])
        offsets = np.array([s.warp.offset for s in poses])
        scores = stretch(
            slat.points, slat.values, slat.distance, slat.origin,
            pixie.points, pixie.values, pixie.distance, pixie.origin,
            np.array([s.pose.rotation for s in poses]), np.array([s.pose.shift for s in poses]),
            np.array([s.pose.scale for s in poses]), affines, offsets, np.array(taus),
        )  # fmt: skip
        order = np.argsort(-scores, kind="stable")
        places = self._places([poses[k].pose for k in order], affines[order])
        return [
            Stretched(poses[k].pose, Warp(affines[k], float(offsets[k])), float(scores[k]))
            for k in order[_apart(places, 2.0 * DISTINCT, most)]
        ]

    def ranked(self, poses: Sequence[Pose], halfway: Sequence[Pose]) -> list[Pose]:
        """Order the best poses by how well they fit once deformed.

        Where shapes differ, the score of a similarity says little about which
        placement is right. What a trial deformation leaves says more.
        """
        near = [p for p in poses if p.score > poses[0].score - RANK_WITHIN][:MOST_RANKED]
        likely = self.stretched(near, halfway)
        if poses[0] not in likely:
            likely.append(poses[0])
        points = self.slat.subset(RANK_SAMPLES).points
        ranked = []
        for pose in likely:
            trial = try_out(self.slat, self.pixie, pose.similarity, RANK_SAMPLES)
            bonus = float(trial.whole) - _scale_penalty(pose) - pose.score
            standing = RANK_STANDING if pose is poses[0] else 0.0
            places = places_of(pose.similarity, trial.bent, points)
            ranked.append((replace(pose, bonus=bonus, standing=standing), places))
        ranked.sort(key=lambda entry: -entry[0].rank)
        kept: list[tuple[Pose, NDArray[np.float64]]] = []
        for pose, places in ranked:
            if _apart_from_all(places, (p for _, p in kept)):
                kept.append((pose, places))
        return self.distinct([*(pose for pose, _ in kept), *poses[len(near) :]])

    def _subsets(self, samples: int) -> tuple[Surface, Surface]:
        if samples not in self._cache:
            self._cache[samples] = self.slat.subset(samples), self.pixie.subset(samples)
        return self._cache[samples]

    def polish(self, poses: Sequence[Pose]) -> list[Pose]:
        """Refine the best distinct poses further; best first."""
        survivors = self.distinct(poses)
        likely = [p for p in survivors if p.score > survivors[0].score - 2 * TIE]
        survivors = survivors[: min(max(SURVIVORS, len(likely)), MOST_SURVIVORS)]
        return self.distinct(self.refine(survivors, POLISH_SAMPLES, POLISH_TAUS, 0.01))

    def finish(self, poses: Sequence[Pose], rough: bool) -> tuple[list[Pose], Deformed]:
        """Refine poses on all samples, best first, and deform the best one if that is earned.

        Then those that fit about as well are deformed too: the order is by what that leaves.
        """
        fine = self.refine(poses, FINE_SAMPLES, FINE_TAUS, 0.002, size_by_slat=rough)
        first, *others = self.distinct(fine)
        best, deformed = self._deformed(first, rough)
        if deformed.deformation is None:
            return [best, *others], deformed
        few, rest = others[: MOST_CONTESTED - 1], others[MOST_CONTESTED - 1 :]
        contested = [(best, deformed), *(self._deformed(pose, rough) for pose in few)]
        ranks = np.array([_rank(*entry) for entry in contested])
        standing = RANK_STANDING * (np.arange(len(ranks)) == 0)
        order = np.argsort(-(ranks + standing), kind="stable")
        highest = max(pose.merit for pose, _ in contested)
        points = self.slat.subset(RANK_SAMPLES).points
        kept: list[tuple[Pose, Deformed, NDArray[np.float64]]] = []
        for k in order:
            pose, bent = contested[k]
            places = pose.similarity.inverse(bent.moved(points))
            if _apart_from_all(places, (there for _, _, there in kept)):
                below = max(float(ranks[order[0]] - ranks[k]), 0.0)
                bonus = highest - below - pose.score
                kept.append((replace(pose, bonus=bonus, standing=0.0), bent, places))
        return [*(pose for pose, _, _ in kept), *rest], kept[0][1]

    def _deformed(self, pose: Pose, rough: bool) -> tuple[Pose, Deformed]:
        best, model = self._simplest(pose, rough)
        found = deform_if_earned(self.slat, self.pixie, best.similarity, model, self.parameters)
        return replace(best, **vars(found.pose)), found

    def _simplest(self, pose: Pose, rough: bool) -> tuple[Pose, Model]:
        """Return the pose with its scale set to one where that fits as well, and the model."""
        model = self.parameters.model
        if model in ("rigid", "similarity"):
            return pose, Model(model)
        if abs(pose.scale - 1.0) < RIGID_IF_SCALE_WITHIN:
            start = replace(pose, shift=self._rescaled_shift(pose), scale=1.0)
            (rigid,) = self.refine(
                [start], FINE_SAMPLES, FINE_TAUS, 0.002, free_scale=False, size_by_slat=rough
            )
            if rigid.score >= pose.score - RIGID_LOSS:
                return rigid, Model.RIGID
        return pose, Model.SIMILARITY

    def _rescaled_shift(self, pose: Pose) -> NDArray[np.float64]:
        centre = self._mean
        return centre + (pose.shift - centre) / pose.scale

    def apart(self, poses: Sequence[Pose], other: Pose) -> NDArray[np.float64]:
        """Rms distance, in voxels, between where poses and another look the SLAT's surface up."""
        places = self._places([*poses, other])
        distance: NDArray[np.float64] = np.linalg.norm(places[:-1] - places[-1], axis=1)
        return distance

    def others(self, best: Pose, poses: Sequence[Pose]) -> list[Pose]:
        """Return the distinct ones of poses that do not repeat `best`, whatever their scores."""
        apart = self.apart(poses, best) >= DISTINCT
        far = [pose for pose, ok in zip(poses, apart, strict=True) if ok]
        return self.distinct(far) if far else []

    def _places(
        self, poses: Sequence[Pose], affines: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return poses as points in 12 dimensions whose distances are those of `apart`.

        Over samples of mean m and covariance L L^T, the mean square of A x + b is
        the sum of squares of A L and of A m + b. The `affines` (n, 3, 4) come before the poses.
        """
        inverse = np.array([pose.rotation for pose in poses]).transpose(0, 2, 1)
        inverse = inverse / np.array([pose.scale for pose in poses])[:, None, None]
        moved = -np.array([pose.shift for pose in poses])
        matrices = inverse
        if affines is not None:
            matrices, moved = inverse @ affines[:, :, :3], moved + affines[:, :, 3]
        centre = matrices @ self._mean + np.einsum("nij,nj->ni", inverse, moved)
        return np.concatenate([(matrices @ self._spread).reshape(-1, 9), centre], axis=1)

    def distinct(self, poses: Sequence[Pose]) -> list[Pose]:
        """Return the poses best first, without those that repeat a better one."""
        rest = sorted(poses, key=lambda pose: -pose.rank)
        return [rest[k] for k in _apart(self._places(rest), DISTINCT)]
