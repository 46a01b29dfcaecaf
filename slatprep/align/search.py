"""Search all orientations, and rank placements of shapes that differ.

Steps 3 and 5 of docs/design/alignment.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slatprep.align.deform import TRIAL_SAMPLES, try_out
from slatprep.align.pair import (
    COARSE,
    DISTINCT,
    POLISH,
    RANK_SAMPLES,
    RANK_STANDING,
    Pair,
    Steps,
    far_apart,
    first_of_each,
    scale_penalty,
)
from slatprep.align.pose import Pose, Poses, Similarity
from slatprep.align.residuals import Residuals
from slatprep.align.starts import so3_starts
from slatprep.align.stretch import stretch
from slatprep.align.warp import Warp, from_nearest, places_of
from slatprep.geometry.frames import Array

SO3_STARTS, SO3_HALFWAY, SO3_KEPT = 240, 4, 80
"""Number of starts over all orientations, of steps before a selection, and of starts kept then.

The best placement was among the first 30 then for 177 of 180 assets; the others have many ties.
"""

TURN, SLIDE, MOST_SLID, REACH = 12, 3.0, 20.0, 0.4
"""Steps of the moves of `repeated`, in degrees and voxels; the farthest slides, in voxels and as a
share of the extent."""

REPEATED, REPEATED_KEPT = Steps(40, (3.0, 2.0), 0.02), 24
"""First steps of such poses, and the number of poses that are refined further."""

TRADED, TRADED_WITHIN = -0.015, 0.15
"""A part may lack if a scale's logarithm times the offset [voxel] is below the first number. A
placement of scale one may score less by the second number then and still tie."""

FITS, MISSES, MOST_FIT = 0.6, 3.0, 0.85
"""In that tie, over a share `MOST_FIT` of the samples that are off by less than `MISSES` voxels are
off by less than `FITS`: all but the missing part fits."""

SAME_SIZE = 0.05
"""Largest difference of the size ratio from one without a second set of starts at scale one."""

RANK_WITHIN, MOST_RANKED = 0.12, 6
"""If the best fit is poor, at most `MOST_RANKED` placements whose score is within `RANK_WITHIN` of
it are ranked by their score after a trial deformation."""

STRETCH_MANY = Steps(40, (5.0, 4.0, 3.0), 0.0), 24
STRETCH_FEW = Steps(160, (3.0, 2.0, 2.0, 1.5), 0.0), MOST_RANKED
"""Steps of affine maps, none of which is spared, and number of poses kept.

If the best fit is poor, all poses halfway through the search of all orientations are stretched. The
best of them are stretched once more. In 12 of 140 pairs of generated shapes the right placement did
not fit best as a similarity: halfway it ranked 6th to 94th.
"""


@dataclass(frozen=True, eq=False)
class Stretched:
    """A pose, the affine map that is applied before it, and their score."""

    pose: Pose
    warp: Warp
    score: float = 0.0


def _unstretched(poses: Iterable[Pose]) -> list[Stretched]:
    return [Stretched(pose, Warp.unbent(pose.similarity)) for pose in poses]


def search_all(pair: Pair) -> tuple[list[Pose], list[Pose]]:
    """Refine starts in all orientations, and drop the worst ones halfway.

    Return the poses refined to the end, and all poses of the first set as they were halfway.
    """
    scales = [pair.size_ratio]
    if abs(scales[0] - 1.0) > SAME_SIZE:
        # Floaters, ground and missing parts falsify sizes, and the likeliest scale is one.
        scales.append(1.0)
    sets: list[list[Pose]] = []
    begin, end = COARSE.taus[:SO3_HALFWAY], COARSE.taus[SO3_HALFWAY:]
    for scale in scales:
        # The second set is half as dense, to save time.
        starts = pair.starts(so3_starts(SO3_STARTS)[:: 2 if sets else 1], scale)
        halfway = pair.refine(starts, COARSE._replace(taus=begin, free_scale=not sets))
        sets.append(sorted(halfway, key=lambda pose: -pose.score))
    kept = [pose for some in sets for pose in some[: SO3_KEPT // len(sets)]]
    return pair.refine(kept, COARSE._replace(taus=end)), sets[0]


def repeated(pair: Pair, best: Pose) -> list[Pose]:
    """Refine a pose turned about, and slid along, the principal axes of the SLAT's surface.

    What repeats itself, such as stairs, a comb or a gear, fits after such a move nearly as well.
    Starts that lay the centroids on each other may then miss the right placement.
    """
    from scipy.spatial.transform import Rotation

    axes, centre = pair.principal[0].T, pair.slat.centroid
    half = 2.0 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    angles = np.radians(np.arange(0, 360, TURN))
    vectors = (axes[:, None, :] * angles[:, None]).reshape(-1, 3)
    about = Rotation.from_rotvec(vectors).as_matrix().reshape(3, -1, 3, 3)
    across = about @ np.roll(half, -1, axis=0)[:, None]
    turns = np.concatenate([about[:, 1:], across], axis=1).reshape(-1, 3, 3)
    slides = _slides(pair)
    turned = np.concatenate([turns, np.repeat([np.eye(3), *half], len(slides), axis=0)])
    moved = np.concatenate([np.zeros((len(turns), 3)), *[slides] * 4])
    own = best.similarity
    shifts = turned @ (own.shift - centre) + centre + moved
    scales, offsets = (np.full(len(turned), each) for each in (own.scale, own.offset))
    starts = Poses(turned @ own.rotation, shifts, scales, offsets)
    fits = pair.solve(starts, REPEATED)
    order = np.argsort(-fits[:, :2].sum(axis=1), kind="stable")[:REPEATED_KEPT]
    kept = Poses(*(each[order] for each in starts)).similarities()
    return pair.polish(pair.refine([*map(Pose, kept)], COARSE._replace(taus=(2.0, 1.0))))


def _slides(pair: Pair) -> Array:
    """Return shifts (n, 3) [voxel] to and fro along the principal axes of the SLAT's surface."""
    axes = pair.principal[0].T
    by = np.outer([1.0, -1.0], np.arange(SLIDE, MOST_SLID, SLIDE)).reshape(-1, 1)
    far = REACH * np.ptp(axes @ pair.slat.points.T, axis=1)
    return np.asarray((by[:, :, None] * axes)[np.abs(by) < far])


def of_scale_one(pair: Pair, best: Pose) -> list[Pose]:
    """Return the distinct placements of scale one that a pose's scale and offset may stand for.

    A tapered bar that lacks an end is a smaller bar with a thicker surface.
    """
    own = best.similarity
    if not pair.free_scale or np.log(own.scale) * own.offset > TRADED:
        return []
    start = pair.at_scale_one(own)._replace(offset=0.0)
    shifts = start.shift + np.concatenate([np.zeros((1, 3)), _slides(pair)])
    starts = [Pose(start._replace(shift=shift)) for shift in shifts]
    others = pair.others(best, pair.refine(starts, POLISH._replace(free_scale=False)))
    near = [pose for pose in others if pose.score > best.score - TRADED_WITHIN]
    return [pose for pose in near if _fits_but_for_a_part(pair, pose.similarity)]


def _fits_but_for_a_part(pair: Pair, similarity: Similarity) -> bool:
    residuals = Residuals(pair.slat, pair.pixie, similarity, TRIAL_SAMPLES)
    off = np.abs(np.concatenate(residuals.at(Warp.unbent(similarity))))
    return bool((off[off < MISSES] < FITS).mean() > MOST_FIT)


def ranked(pair: Pair, poses: Sequence[Pose], halfway: Sequence[Pose]) -> list[Pose]:
    """Order the best poses by how well they fit once deformed.

    If shapes differ, the score of a similarity says little about which placement is right. The
    score after a trial deformation says more.
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
    """Return the placements that fit best after an affine map.

    An apple squashed by a quarter fits best as a similarity if it lies on its side, so a search for
    similarities may miss the right placement. Therefore `halfway`, poses of all orientations, are
    stretched. The best of them are stretched once more, with `near`, the poses that already fit
    well.
    """
    first = _stretch(pair, _unstretched(halfway), *STRETCH_MANY)
    found = _stretch(pair, [*_unstretched(near), *first], *STRETCH_FEW)
    likely = [s for s in found if s.score > found[0].score - RANK_WITHIN]
    points = pair.slat.subset(POLISH.samples).points
    similar = [
        Pose(from_nearest(s.pose.similarity, s.warp, points, pair.parameters.scale_bounds)[0])
        for s in likely
        if s.pose not in near
    ]
    if similar:
        similar = pair.refine(similar, POLISH)
    return pair.distinct([*(s.pose for s in likely if s.pose in near), *similar])


def _stretch(pair: Pair, poses: Sequence[Stretched], steps: Steps, most: int) -> list[Stretched]:
    """Stretch poses further; return at most `most` distinct ones, best first."""
    slat, pixie = pair.subsets(steps.samples)
    affines = np.array([s.warp.affine for s in poses])
    stretched = Poses.of([s.pose.similarity._replace(offset=s.warp.offset) for s in poses])
    scores = stretch(slat.samples, pixie.samples, stretched, affines, np.array(steps.taus))
    order = np.argsort(-scores, kind="stable")
    places = pair.places([poses[k].pose for k in order], affines[order])
    return [
        Stretched(poses[k].pose, Warp(affines[k], float(stretched.offsets[k])), float(scores[k]))
        for k in order[first_of_each(places, 2.0 * DISTINCT, most)]
    ]
