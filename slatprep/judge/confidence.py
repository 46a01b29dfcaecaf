"""The calibrated probability that a voxel's class is right, and the causes of an asset's doubt."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from slatprep.judge.calibration import SAME_OBJECT, VOXEL
from slatprep.judge.evidence import MEANING, Surroundings
from slatprep.judge.model import FLOOR


def causes_of_doubt(evidence: NDArray[np.float64]) -> dict[str, float]:
    """Return how much ``shape`` and ``roughness`` speak against the same object, largest first.

    Each is the sum by which its figures lower the logarithm of the odds, compared with
    a usual right placement.
    """
    taken = {"shape": 0.0, "roughness": 0.0}
    added = SAME_OBJECT.contributions(evidence).tolist()
    for figure, own in zip(MEANING.values(), added, strict=True):
        if figure.shows in taken:
            taken[figure.shows] -= min(own, 0.0)
    return dict(sorted(taken.items(), key=lambda item: -item[1]))


def voxel_figures(around: Surroundings, confidence: float) -> NDArray[np.float32]:
    """Return the `VOXEL_FIGURES` (N, F) of voxels from their surroundings.

    Near a border of classes, the error of a position matters. So the shares of other
    classes also count times the asset's doubt, and times its roughness.
    """
    unsure = np.float32(-logit(np.clip(confidence, FLOOR, 1.0 - FLOOR)))
    rough = np.float32(around.depth.std())
    count = len(around.distance)
    distance = np.minimum(around.distance, np.float32(5.0))
    whole = (unsure, rough, distance.mean(), around.moved.mean())
    # Columns are contiguous in memory, as the model reads them.
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
    """Return the probability (N,) that the class of each voxel is right, 0 if it is not valid.

    `confidence` is the asset's: the probability of its object times that of its placement. Tied
    placements are equally likely, so the model's probability is multiplied by the share of them
    that have the same class.
    """
    likely = np.zeros(len(valid), dtype=np.float32)
    if valid.any():
        # Voxels without a counterpart are far from everything and would distort the means.
        seen = around.where(valid)
        likely[valid] = VOXEL.probability(voxel_figures(seen, confidence)) * (1.0 - seen.tied)
    return likely
