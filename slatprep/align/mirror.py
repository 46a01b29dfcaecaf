"""Test whether an annotation is a mirror image of its object.

No rotation undoes a mirroring. A mirrored annotation still fits its object as well as the shape
allows, and very well if the object is nearly its own mirror image. So the mirrored SLAT is fitted
to the annotation too. If that fits clearly better, one side is the mirror image of the other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slatprep.align.deform import try_out
from slatprep.align.pair import POLISH, Pair, Steps
from slatprep.align.pose import Pose, Similarity
from slatprep.align.starts import distinct_starts, so3_starts
from slatprep.records import MIRRORED

REFLECTED = Steps(60, (3.0, 2.0, 1.0, 1.0), 0.02)
WIDE, WIDE_STARTS, WIDE_KEPT = Steps(100, (8.0, 5.0, 3.0, 2.0), 0.02), 240, 6
NEXT, NEXT_KEPT = Steps(200, (2.0, 1.0, 1.0, 1.0), 0.01), 2
LAST = POLISH._replace(taus=(1.0, 1.0, 1.0))
"""Steps of the search for a mirrored fit, with numbers of starts and of placements kept."""

FAIR = 0.9
"""Score below which the found placement may itself be wrong, so all orientations are searched."""


def mirror_gain(pair: Pair, found: Similarity, poor: bool) -> float:
    """Return the rise of the score once the SLAT is mirrored.

    Return NaN if the score of `found` is so high that it cannot rise by `MIRRORED`. If the fit is
    `poor`, scores are those after a trial deformation, if the parameters allow one.
    """
    (best,) = pair.refine([Pose(found)], POLISH._replace(taus=()))
    if best.score > 1.0 - MIRRORED:
        return float("nan")
    mirrored = pair.mirrored()
    tried = mirrored.refine(_reflected(pair, best.similarity), REFLECTED)
    if best.score < FAIR:
        # Every second start is enough: several starts lead to a mirrored fit that is better.
        rotations = [s.rotation for s in distinct_starts()] + list(so3_starts(WIDE_STARTS)[::2])
        wide = mirrored.refine(mirrored.starts(rotations, pair.size_ratio), WIDE)
        tried = mirrored.refine(_best(tried, NEXT_KEPT) + _best(wide, WIDE_KEPT), NEXT)
    kept = _best(tried, 1)
    if poor and pair.may_deform:
        there = try_out(mirrored.slat, pair.pixie, kept[0].similarity)
        here = try_out(pair.slat, pair.pixie, best.similarity)
        return there.whole - here.whole
    (other,) = mirrored.refine(kept, LAST)
    return other.score - best.score


def _best(poses: Sequence[Pose], most: int) -> list[Pose]:
    return sorted(poses, key=lambda pose: -pose.score)[:most]


def _reflected(pair: Pair, found: Similarity) -> list[Pose]:
    """Return placements on the mirrored SLAT: the found one, reflected in six planes.

    The planes are the SLAT's principal planes and those of the grid. A plane of symmetry is a
    principal plane, but principal planes are arbitrary if two variances are equal.
    """
    flip, centre = np.diag([-1.0, 1.0, 1.0]), pair.slat.centroid
    poses = []
    for normal in (*pair.principal[0].T, *np.eye(3)):
        reflect = np.eye(3) - 2.0 * np.outer(normal, normal)
        shift = flip @ (reflect @ (found.shift - centre) + centre)
        poses.append(Pose(found._replace(rotation=flip @ reflect @ found.rotation, shift=shift)))
    return poses
