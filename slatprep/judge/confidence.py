"""Calibrated probabilities: that a placement is right, and that a voxel's class is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from slatprep.judge.calibration import PLACEMENT, SAME_OBJECT, VOXEL
from slatprep.judge.evidence import FIGURES, Surroundings
from slatprep.judge.model import FLOOR

_CAUSES = {
    "shape": ("moved", "moved_most", "bending", "stretch", "scale", "within_2", "within_3",
              "score_similarity", "ground", "directions_worst", "blocks_far"),
    "roughness": ("score_slat", "score_pixieverse", "within_1", "offset", "distance", "depth",
                  "fitness", "fitness_backward", "valid_share", "directions_near",
                  "directions_middle", "blocks_near", "blocks_middle", "slat_within_half",
                  "slat_within_1", "slat_within_15", "pixieverse_within_half",
                  "pixieverse_within_1", "pixieverse_within_15"),
}  # fmt: skip
"""Which figures speak for another object by its shape, and which by a rough fit."""


def same_object(evidence: NDArray[np.float64]) -> float:
    """Return the probability that both sides show the same object, by the `FIGURES` (F,)."""
    return float(SAME_OBJECT.probability(evidence))


def right_placement(evidence: NDArray[np.float64]) -> float:
    """Return the probability that the placement is right if the object is the same."""
    return float(PLACEMENT.probability(evidence))


def same_objects(evidence: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what `same_object` says of many alignments (A, F)."""
    return SAME_OBJECT.probability(evidence)


def right_placements(evidence: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what `right_placement` says of many alignments (A, F)."""
    return PLACEMENT.probability(evidence)


def causes_of_doubt(evidence: NDArray[np.float64]) -> dict[str, float]:
    """Return what speaks against the same object, compared with a usual right placement.

    For ``shape`` and ``roughness`` the sum of what their figures take from the
    logarithm of the odds; largest first.
    """
    added = dict(zip(FIGURES, SAME_OBJECT.contributions(evidence), strict=True))
    taken = {
        cause: float(-sum(min(added.get(name, 0.0), 0.0) for name in names))
        for cause, names in _CAUSES.items()
    }
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

    `confidence` is the asset's: `same_object` times `right_placement`. Placements that fit equally
    well are taken as equally likely: the model's probability counts for those with the same class.
    """
    likely = np.zeros(len(valid), dtype=np.float32)
    if valid.any():
        # What has no counterpart says nothing of the others, though it is far from everything.
        seen = around.where(valid)
        likely[valid] = VOXEL.probability(voxel_figures(seen, confidence)) * (1.0 - seen.tied)
    return likely
