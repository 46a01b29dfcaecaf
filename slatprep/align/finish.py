"""Refine the placements that a search leaves, deform them if earned, and compare them again.

Steps 4 and 6 of docs/design/alignment.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slatprep.align.agreement import blocks_of
from slatprep.align.deform import Deformed, deform_if_earned
from slatprep.align.pair import (
    FINE,
    RANK_SAMPLES,
    RANK_STANDING,
    TIE,
    Pair,
    far_apart,
    scale_penalty,
)
from slatprep.align.pose import Pose, Similarity
from slatprep.align.residuals import Residuals
from slatprep.align.warp import Warp, places_of
from slatprep.geometry.frames import Array
from slatprep.records import FitFigures, Model

MOST_CONTESTED = 4
"""Largest number of placements that are deformed and compared, if the best one is deformed or the
sides are rough. The others score within twice `TIE` of the best."""

LEAST_SPREAD = 1e-4
"""Least standard error of a mean kernel; below it is rounding, as of a cube and its turns."""

CONTEST_SAMPLES, SHARP = 2_000, 0.5
"""Samples per side on which placements are compared, and the kernel's width [voxel]. It is narrower
than in a fit, as a front may differ from a back in fine details only."""

RIGID_IF_SCALE_WITHIN = 0.04
RIGID_LOSS = 0.004
"""A scale whose distance from one is below the first number must raise the score by more than the
second, or it is set to one."""


def finish(pair: Pair, poses: Sequence[Pose], rough: bool) -> tuple[list[Pose], Deformed]:
    """Refine poses by `FINE` steps, and deform the best one if that is earned.

    If it is deformed or the sides are rough, deform the next ones too, and order all by their
    scores after that. Return the poses, best first, and the fit of the best one.
    """
    fine = pair.refine(poses, FINE._replace(size_by_slat=rough))
    first, *others = pair.distinct(fine)
    best, deformed = _deformed(pair, first, rough)
    if deformed.deformation is None and not (rough and pair.may_deform):
        near = [pose for pose in others if pose.merit > best.merit - TIE]
        fits = [
            replace(deformed, pose=pose.similarity, warp=Warp.unbent(pose.similarity))
            for pose in near
        ]
        far = [pose for pose in others if pose not in near]
        return [best, *_told_apart(pair, deformed, near, fits), *far], deformed
    few, rest = others[: MOST_CONTESTED - 1], others[MOST_CONTESTED - 1 :]
    contested = [(best, deformed), *(_deformed(pair, pose, rough) for pose in few)]
    alike = as_free(pair, [bent for _, bent in contested])
    ranks = np.array([rank_of(fit.pose, fit.figures) for fit in alike])
    standing = RANK_STANDING * (np.arange(len(ranks)) == 0)
    order = np.argsort(-(ranks + standing), kind="stable")
    highest = max(pose.merit for pose, _ in contested)
    points = pair.slat.subset(RANK_SAMPLES).points
    fitted = [contested[k] for k in order]
    kept = far_apart([places_of(pose.similarity, bent.warp, points) for pose, bent in fitted])
    merits = highest - np.maximum(ranks[order[0]] - ranks[order], 0.0)
    best, *near = [
        replace(fitted[k][0], bonus=float(merits[k]) - fitted[k][0].score, standing=0.0)
        for k in kept
    ]
    (free, *fits), deformed = [alike[order[k]] for k in kept], fitted[0][1]
    return [best, *_told_apart(pair, free, near, fits), *rest], deformed


def as_free(pair: Pair, fits: Sequence[Deformed]) -> list[Deformed]:
    """Return the fits, each refitted with the freest model among them.

    A freer model fits better at any placement, so placements are compared with equal models.
    """
    models = {fit.model for fit in fits}
    if not models & {Model.AFFINE, Model.DEFORMABLE}:
        return list(fits)
    bends = Model.DEFORMABLE in models
    freest = Model.DEFORMABLE if bends else Model.AFFINE
    free = replace(pair.parameters, model="deformable" if bends else "affine")
    return [
        fit
        if fit.model is freest
        else deform_if_earned(pair.slat, pair.pixie, fit.pose, fit.model, free)
        for fit in fits
    ]


def _told_apart(
    pair: Pair, best: Deformed, poses: Sequence[Pose], fits: Sequence[Deformed]
) -> list[Pose]:
    """Return poses with `behind` set: by how many standard errors the best one fits better.

    All fits are measured on the same samples, so the differences of the two sides cancel out.
    Errors within a block of space are correlated, so blocks are counted, not samples.
    """
    if not poses:
        return []
    kernels, places = _kernels(pair, best)
    blocks = blocks_of(places)
    found = []
    for pose, fit in zip(poses, fits, strict=True):
        gains = np.bincount(blocks, kernels - _kernels(pair, fit)[0])
        spread = max(float(np.sqrt((gains**2).sum())), LEAST_SPREAD)
        found.append(replace(pose, behind=float(gains.sum()) / spread))
    return found


def _kernels(pair: Pair, fit: Deformed) -> tuple[Array, Array]:
    """Return each sample's kernel, with equal sums of weights by side, and its SLAT position."""
    residuals = Residuals(pair.slat, pair.pixie, fit.pose, CONTEST_SAMPLES)
    sides = residuals.at(fit.warp)
    kernels = [0.5 / len(side) / (1.0 + (side / SHARP) ** 2) for side in sides]
    return np.concatenate(kernels), residuals.places.copy()


def rank_of(similarity: Similarity, figures: FitFigures) -> float:
    """Return a deformed placement's rank: the score of unseen samples less the scale penalty."""
    return 0.5 * (figures.score_slat + figures.score_pixieverse) - scale_penalty(similarity)


def _deformed(pair: Pair, pose: Pose, rough: bool) -> tuple[Pose, Deformed]:
    best, model = _simplest(pair, pose, rough)
    found = deform_if_earned(pair.slat, pair.pixie, best.similarity, model, pair.parameters)
    return replace(best, similarity=found.pose), found


def _simplest(pair: Pair, pose: Pose, rough: bool) -> tuple[Pose, Model]:
    """Return the pose, with scale one if that fits about as well, and its model."""
    model = pair.parameters.model
    if model in ("rigid", "similarity"):
        return pose, Model(model)
    if abs(pose.similarity.scale - 1.0) < RIGID_IF_SCALE_WITHIN:
        start = replace(pose, similarity=pair.at_scale_one(pose.similarity))
        (rigid,) = pair.refine([start], FINE._replace(free_scale=False, size_by_slat=rough))
        if rigid.score >= pose.score - RIGID_LOSS:
            return rigid, Model.RIGID
    return pose, Model.SIMILARITY
