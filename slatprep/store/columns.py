"""The ``asset/*`` arrays that repeat what a record says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slatprep.store.record import AssetRecord

Column = str | float | tuple[float, ...] | NDArray[np.generic]


def columns_of(record: AssetRecord) -> dict[str, Column]:
    """Return an asset's row of each ``asset/*`` array that its record tells, by its last name.

    A new array is named here and in `slatprep.store.layout.ARRAYS`.
    ``property_ambiguity`` is in mapped units: ranges come from the dataset.
    """
    alignment, judgement, counts = record.alignment, record.judgement, record.counts
    quality, moments = alignment.quality, record.latents
    return {
        "object_id": record.object_id,
        "view": record.view,
        "category": record.category,
        "transform": alignment.transform,
        "engine": alignment.engine,
        "model": alignment.model,
        "search": alignment.search,
        "fitness": quality.fitness,
        "inlier_rmse": quality.inlier_rmse,
        "fitness_backward": quality.fitness_backward,
        "inlier_rmse_backward": quality.inlier_rmse_backward,
        "overlap": quality.overlap,
        "margin": alignment.margin,
        "ambiguity": judgement.ambiguity.material_share,
        "property_ambiguity": judgement.ambiguity.property_change,
        "valid_share": counts.valid / counts.slat_voxels,
        "unphysical": counts.unphysical,
        "verdict": judgement.verdict,
        "confidence": judgement.confidence,
        "same_object": judgement.same_object,
        "right_placement": judgement.right_placement,
        "expected_accuracy": judgement.expected_accuracy,
        "contradicted": judgement.contradicted,
        "merged": bool(record.merged),
        "key": np.frombuffer(bytes.fromhex(record.of_first_pass().key), np.uint8),
        "latent_mean": np.nan if moments is None else moments.mean,
        "latent_std": np.nan if moments is None else moments.std,
    }
