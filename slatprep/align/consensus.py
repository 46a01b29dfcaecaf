"""Settle ambiguous assets by the orientation that the rest of the dataset shares.

Both pipelines have a habitual frame, so most assets of a dataset have the same rotation. If an
asset's geometry leaves placements tied, the tied placement nearest to the rotation of the clear
winners is taken. An asset without a tie but with another rotation is also fitted in the common
rotation. The score of that fit is weighed against how rare other rotations are. The old placement
stays among the placements, so the choice can be undone.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.align.settle import take
from slatprep.align.starts import distinct_starts
from slatprep.geometry.frames import split_transform
from slatprep.parameters import AlignParameters
from slatprep.records import (
    Alignment,
    Consensus,
    Engine,
    MaterialField,
    Placement,
    StructuredLatents,
)

LEAST_WINNERS = 5
LEAST_SHARE = 0.5
"""Smallest number, and smallest share, of the clear winners that have a common rotation."""

TEMPERATURE = 0.02
"""Rise of the score, after deformation, that makes a placement e times as likely."""

SURE = 0.95
"""Smallest probability at which an asset without a tie takes the common rotation."""

NEAR_DEGREES = 30.0
"""Largest angle, in degrees, between two rotations that count as the same quarter turn."""


def find_consensus(transforms: ArrayLike) -> Consensus | None:
    """Find the rotation that clear winners have in common, from their transforms (A, 4, 4).

    It is the mean of the rotations near the most frequent quarter turn. Return None if
    fewer than `LEAST_WINNERS` assets, or less than `LEAST_SHARE` of them, agree.
    """
    linear = np.asarray(transforms, np.float64).reshape(-1, 4, 4)[:, :3, :3]
    rotations = linear / np.cbrt(np.linalg.det(linear))[:, None, None]
    if not len(rotations):
        return None
    quarters = [start.rotation for start in distinct_starts()]
    angles = np.stack([degrees_between(rotations, quarter) for quarter in quarters], axis=1)
    nearest = np.where(angles.min(axis=1) <= NEAR_DEGREES, angles.argmin(axis=1), len(quarters))
    # The lowest index wins a draw, so that the order of assets does not matter.
    common = np.bincount(nearest, minlength=len(quarters))[: len(quarters)].argmax()
    members = rotations[nearest == common]
    if len(members) < LEAST_WINNERS or len(members) < LEAST_SHARE * len(rotations):
        return None
    return Consensus(
        rotation=_mean_rotation(members), winners=len(rotations), agreeing=len(members)
    )


def settle(alignment: Alignment, latents: StructuredLatents, consensus: Consensus) -> Alignment:
    """Choose, among tied placements, the one nearest to the common rotation.

    Return the same object if nothing is tied or no tied placement has the common rotation.
    """
    if not alignment.placements:
        return alignment
    ties = [Placement(alignment.transform, alignment.score, 0.0), *alignment.placements]
    angles = [degrees_between(split_transform(t.transform)[0], consensus.rotation) for t in ties]
    chosen = int(np.argmin(angles))
    if angles[chosen] > NEAR_DEGREES:
        return alignment
    prior, rare = _shares_of(consensus)
    odds = [prior if angle <= NEAR_DEGREES else rare for angle in angles]
    scores = np.array([tie.score for tie in ties])
    # The score is NaN for an engine that ranks by fitness alone.
    likely = odds * np.exp(np.nan_to_num(scores - scores[chosen]) / TEMPERATURE)
    by = replace(consensus, probability=float(odds[chosen] / likely.sum()))
    if chosen == 0:
        return replace(alignment, settled_by=by)
    return take(alignment, chosen - 1, latents, by)


def turn_if_likelier(
    alignment: Alignment,
    field: MaterialField,
    latents: StructuredLatents,
    consensus: Consensus,
    parameters: AlignParameters,
) -> Alignment:
    """Choose the common rotation for an asset with another rotation, if that is likelier.

    The odds are a product of two factors. One is how much better the asset fits in the common
    rotation once deformed (`TEMPERATURE`). The other is how frequent the common rotation and any
    other quarter turn are in the dataset. A placement changes only from probability `SURE` on.

    Return the same object if the placement stays.
    """
    if alignment.engine is not Engine.FIELD or is_common(alignment.transform, consensus):
        return alignment
    from slatprep.align.field import fitted_near

    placement, gain = fitted_near(alignment, consensus.rotation, field, latents, parameters)
    if not is_common(placement.transform, consensus):
        return alignment
    probability = probability_of_common(consensus, gain)
    if probability < SURE:
        return alignment
    left = replace(alignment, placements=(placement, *alignment.placements))
    return take(left, 0, latents, replace(consensus, probability=probability))


def is_common(transform: ArrayLike, consensus: Consensus) -> bool:
    """Return whether a transform (4, 4) has the common rotation."""
    return bool(degrees_between(split_transform(transform)[0], consensus.rotation) <= NEAR_DEGREES)


def probability_of_common(consensus: Consensus, gain: float) -> float:
    """Return the probability of the common rotation against one other quarter turn.

    `gain` is the rise of the asset's score in the common rotation, after deformation.
    """
    common, other = _shares_of(consensus)
    return 1.0 / (1.0 + other / common * math.exp(min(-gain / TEMPERATURE, 700.0)))


def _shares_of(consensus: Consensus) -> tuple[float, float]:
    """Return the frequency in the dataset of the common and of each other quarter turn."""
    # One more asset is counted as disagreeing, so that no rotation has probability 0.
    common = consensus.agreeing / (consensus.winners + 1)
    return common, (1.0 - common) / (len(distinct_starts()) - 1)


def degrees_between(rotation: ArrayLike, other: ArrayLike) -> Any:
    """Return the angle, in degrees, between one rotation (3, 3) or several and another."""
    trace = np.sum(np.asarray(rotation) * np.asarray(other), axis=(-2, -1))
    return np.degrees(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))


def _mean_rotation(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the chordal mean: the rotation nearest to the mean matrix."""
    # Summed in sorted order: the mean must not depend on the order of assets.
    ordered = sorted(rotations, key=lambda rotation: rotation.tobytes())
    u, _, v = np.linalg.svd(np.mean(ordered, axis=0))
    sign = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ v)))])
    rotation: NDArray[np.float64] = u @ sign @ v
    return rotation
