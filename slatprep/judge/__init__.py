"""What an alignment is worth: what ties would change, how sure it is, and a verdict in one word."""

from __future__ import annotations

from slatprep.judge.ambiguity import measure_ambiguity
from slatprep.judge.verdict import (
    THRESHOLDS,
    contradicted,
    judge,
    merged,
    verdict_of,
    voxel_confidence,
)

__all__ = [
    "THRESHOLDS",
    "contradicted",
    "judge",
    "measure_ambiguity",
    "merged",
    "verdict_of",
    "voxel_confidence",
]
