"""The search of all orientations, and of shapes that differ.

Steps 3 and 5 of docs/design/alignment.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slatprep.align.deform import try_out
from slatprep.align.pair import (
    COARSE_SAMPLES,
    COARSE_TAUS,
    DISTINCT,
    POLISH_SAMPLES,
    POLISH_TAUS,
    RANK_SAMPLES,
    RANK_STANDING,
    Pair,
    far_apart,
    first_of_each,
    scale_penalty,
)
from slatprep.align.pose import Pose, Poses
from slatprep.align.starts import so3_starts
from slatprep.align.stretch import stretch
from slatprep.align.warp import Warp, from_nearest, places_of

SO3_STARTS, SO3_HALFWAY, SO3_KEPT = 240, 4, 80
"""Starts over all orientations, and how many of them are refined further after so many steps.

Of 180 assets the best placement was among the first 30 then, but for three with ties in plenty.
"""

SAME_SIZE = 0.05
"""Sizes whose ratio is this near to one need no second set of starts, at scale one."""

RANK_WITHIN, MOST_RANKED = 0.12, 6
"""Where the best fit is poor, so many placements within so much of it are ranked anew, by what
they score after a trial deformation."""

STRETCH_MANY = 40, (5.0, 4.0, 3.0), 24
STRETCH_FEW = 160, (3.0, 2.0, 2.0, 1.5), MOST_RANKED
"""Where the best fit is poor, all poses halfway through the search of all orientations are
stretched, and the best of them once more: samples a side, widths of the kernel, how many are left.

Of 140 pairs of generated shapes the right placement of 12 did not fit best as a similarity:
halfway it was the 6th to the 94th.
"""


@dataclass(frozen=True, eq=False)
class Stretched:
    """A pose and the affine map before it, with its score."""

    pose: Pose
    warp: Warp
    score: float = 0.0


def _unstretched(poses: Iterable[Pose]) -> list[Stretched]:
    return [Stretched(pose, Warp.unbent(pose.similarity)) for pose in poses]


def search_all(pair: Pair) -> tuple[list[Pose], list[Pose]]:
    """Refine starts in all orientations, those that look hopeless halfway not to the end.

    Returns those that were refined to the end, and those of the first set halfway.
    """
    scales = [pair.size_ratio]
    if abs(scales[0] - 1.0) > SAME_SIZE:
        # Floaters, ground and missing parts falsify sizes; one is the likeliest scale.
        scales.append(1.0)
    sets: list[list[Pose]] = []
    for scale in scales:
        # The second set is a supplement, and half as dense for the sake of time.
        starts = pair.starts(so3_starts(SO3_STARTS)[:: 2 if sets else 1], scale)
        taus = COARSE_TAUS[:SO3_HALFWAY]
        free = pair.free_scale and not sets
        halfway = pair.refine(starts, COARSE_SAMPLES, taus, 0.02, free_scale=free)
        sets.append(sorted(halfway, key=lambda pose: -pose.score))
    kept = [pose for some in sets for pose in some[: SO3_KEPT // len(sets)]]
    refined = pair.refine(kept, COARSE_SAMPLES, COARSE_TAUS[SO3_HALFWAY:], 0.02)
    return refined, sets[0]


def ranked(pair: Pair, poses: Sequence[Pose], halfway: Sequence[Pose]) -> list[Pose]:
    """Order the best poses by how well they fit once deformed.

    Where shapes differ, the score of a similarity says little about which
    placement is right. What a trial deformation leaves says more.
    """
    near = [p for p in poses if p.score > poses[0].score - RANK_WITHIN][:MOST_RANKED]
    likely = stretched(pair, near, halfway)
    if poses[0] not in likely:
        likely.append(poses[0])
    points = pair.slat.subset(RANK_SAMPLES).points
    ranked = []
    for pose in likely:
        trial = try_out(pair.slat, pair.pixie, pose.similarity, RANK_SAMPLES)
        bonus = float(trial.whole) - scale_penalty(pose.similarity) - pose.score
        standing = RANK_STANDING if pose is poses[0] else 0.0
        places = places_of(pose.similarity, trial.bent, points)
        ranked.append((replace(pose, bonus=bonus, standing=standing), places))
    ranked.sort(key=lambda entry: -entry[0].rank)
    kept = [ranked[k][0] for k in far_apart([places for _, places in ranked])]
    return pair.distinct([*kept, *poses[len(near) :]])


def stretched(pair: Pair, near: Sequence[Pose], halfway: Sequence[Pose]) -> list[Pose]:
    """Return the placements that fit best if they may be stretched.

    Squashed by a quarter, an apple fits best as a similarity if it lies on its side,
    and a search for similarities may not come to the right placement at all. So
    `halfway`, poses of all orientations, are stretched, and the best of them once more, beside
    `near`, which fit well as they are.
    """
    first = _stretch(pair, _unstretched(halfway), *STRETCH_MANY)
    found = _stretch(pair, [*_unstretched(near), *first], *STRETCH_FEW)
    likely = [s for s in found if s.score > found[0].score - RANK_WITHIN]
    points = pair.subsets(POLISH_SAMPLES)[0].points
    bounds = pair.parameters.scale_bounds
    similar = [
        Pose(from_nearest(s.pose.similarity, s.warp, points, bounds)[0])
        for s in likely
        if s.pose not in near
    ]
    if similar:
        similar = pair.refine(similar, POLISH_SAMPLES, POLISH_TAUS, 0.01)
    return pair.distinct([*(s.pose for s in likely if s.pose in near), *similar])


def _stretch(
    pair: Pair, poses: Sequence[Stretched], samples: int, taus: Sequence[float], most: int
) -> list[Stretched]:
    """Stretch poses further; return so many distinct ones at most, best first."""
    slat, pixie = pair.subsets(samples)
    affines = np.array([s.warp.affine for s in poses])
    stretched = Poses.of([s.pose.similarity._replace(offset=s.warp.offset) for s in poses])
    scores = stretch(slat.samples, pixie.samples, stretched, affines, np.array(taus))
    order = np.argsort(-scores, kind="stable")
    places = pair.places([poses[k].pose for k in order], affines[order])
    return [
        Stretched(poses[k].pose, Warp(affines[k], float(stretched.offsets[k])), float(scores[k]))
        for k in order[first_of_each(places, 2.0 * DISTINCT, most)]
    ]
