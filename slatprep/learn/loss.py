"""SLAT-Phys's loss."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional

from slatprep.learn.dataset import IGNORED, SparseBatch
from slatprep.learn.decoder import Prediction

PROPERTY_WEIGHT = 1.0
CLASS_WEIGHT = 0.5
"""Weights of SLAT-Phys for the MSE of each property and the cross-entropy of the classes."""


def loss_of(prediction: Prediction, batch: SparseBatch, weigh: bool = False) -> Tensor:
    """Return SLAT-Phys's loss over the valid voxels of a batch, a scalar.

    It is the sum of the properties' mean squared errors and half the cross-entropy. With `weigh`,
    confidence weights the means over voxels.
    """
    if not bool(batch.valid.any()):
        return prediction.properties.sum() * 0.0 + prediction.logits.sum() * 0.0
    squared = (prediction.properties - batch.properties)[batch.valid].square()
    if weigh:
        weights = batch.confidence[batch.valid]
        weights = weights / weights.sum()
        entropies = functional.cross_entropy(
            prediction.logits[batch.valid], batch.material[batch.valid], reduction="none"
        )
        return PROPERTY_WEIGHT * (weights @ squared).sum() + CLASS_WEIGHT * weights @ entropies
    entropy = functional.cross_entropy(prediction.logits, batch.material, ignore_index=IGNORED)
    return PROPERTY_WEIGHT * squared.mean(dim=0).sum() + CLASS_WEIGHT * entropy
