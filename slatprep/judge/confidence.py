"""Calibrated probabilities: that a placement is right, and that a voxel's class is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from slatprep.judge.calibration import SAME_OBJECT, VOXEL
from slatprep.judge.evidence import FIGURES, Surroundings
from slatprep.judge.model import FLOOR

_OF_SHAPE = {"moved", "moved_most", "bending", "stretch", "scale", "within_2", "within_3",
             "score_similarity", "ground", "directions_worst", "blocks_far"}  # fmt: skip
"""Which figures speak for another object by its shape; the others do by a rough fit."""


def causes_of_doubt(evidence: NDArray[np.float64]) -> dict[str, float]:
    """Return what speaks against the same object, compared with a usual right placement.

    For ``shape`` and ``roughness`` the sum of what their figures take from the
    logarithm of the odds; largest first.
    """
    taken = {"shape": 0.0, "roughness": 0.0}
    for name, added in zip(FIGURES, SAME_OBJECT.contributions(evidence).tolist(), strict=True):
        taken["shape" if name in _OF_SHAPE else "roughness"] -= min(added, 0.0)
    return dict(sorted(taken.items(), key=lambda item: -item[1]))


def voxel_figures(around: Surroundings, confidence: float) -> NDArray[np.float32]:
    """Return the `VOXEL_FIGURES` (N, F) of voxels by what lies around them.

    Near a border of classes it matters how far off a place may be: the shares
    of other classes count also times the asset's doubt and its roughness.
    """
    unsure = np.float32(-logit(np.clip(confidence, FLOOR, 1.0 - FLOOR)))
    rough = np.float32(around.depth.std())
    count = len(around.distance)
    distance = np.minimum(around.distance, np.float32(5.0))
    whole = (unsure, rough, distance.mean(), around.moved.mean())
    # A column after the other in memory, as the model looks at them.
    return np.concatenate(
        [
            around.others.T,
            around.others.T * rough,
            around.others.T * unsure,
            np.stack([distance, np.abs(around.depth), around.moved]),
            np.broadcast_to(np.array(whole, dtype=np.float32)[:, None], (len(whole), count)),
        ]
    ).T


def class_confidence(
    around: Surroundings, confidence: float, valid: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return how likely the class of each voxel (N,) is right, 0 where not valid.

    `confidence` is the asset's: that of its object times that of its placement. Placements that fit
    equally well are taken as equally likely: the model's probability counts for those with the same
    class.
    """
    likely = np.zeros(len(valid), dtype=np.float32)
    if valid.any():
        # What has no counterpart says nothing of the others, though it is far from everything.
        seen = around.where(valid)
        likely[valid] = VOXEL.probability(voxel_figures(seen, confidence)) * (1.0 - seen.tied)
    return likely
