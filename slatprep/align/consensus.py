"""Settle ambiguous assets by the orientation that the rest of the dataset shares.

Both pipelines have a habitual frame, so most assets of a dataset are turned the
same way. Where an asset's geometry cannot tell placements apart, the clear
winners of its dataset can: among its tied placements the one nearest to their
common rotation is taken. An asset that is turned otherwise without a tie is fitted
in the common rotation as well, and what the shapes say is weighed against how rare
other rotations are. The placement that was left is kept among the placements, so
that the choice can be undone.
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
"""A rotation is common if so many clear winners, and this share of them, have it."""

TEMPERATURE = 0.02
"""A placement that scores so much higher, once deformed, is e times as likely the right one."""

SURE = 0.95
"""From this probability on an asset without a tie is turned as the dataset is."""

NEAR_DEGREES = 30.0
"""Rotations this near to a quarter turn count as that quarter turn."""


def find_consensus(transforms: ArrayLike) -> Consensus | None:
    """Find the rotation that clear winners have in common, from their transforms (A, 4, 4).

    It is the mean of the rotations near the most frequent quarter turn. None where fewer than
    `LEAST_WINNERS` assets or less than `LEAST_SHARE` of them agree.
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

    Returns the same object where nothing is tied, or none of them is turned as the dataset is.
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
    # An engine that ranks by fitness alone has no scores: NaN.
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
    """Choose the common rotation for an asset that is turned otherwise, if that is likelier.

    The odds are those of the shapes, by how much better the asset fits once deformed
    (`TEMPERATURE`), times those of the dataset: how frequent the common rotation is, and any
    other quarter turn. It takes `SURE` to change a placement.

    Returns the same object where the choice stands.
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
    """Whether a transform (4, 4) turns as the dataset does."""
    return bool(degrees_between(split_transform(transform)[0], consensus.rotation) <= NEAR_DEGREES)


def probability_of_common(consensus: Consensus, gain: float) -> float:
    """Return how likely the common rotation is for an asset, of it and one other quarter turn.

    `gain` is how much higher the asset scores in the common rotation, once deformed.
    """
    common, other = _shares_of(consensus)
    return 1.0 / (1.0 + other / common * math.exp(min(-gain / TEMPERATURE, 700.0)))


def _shares_of(consensus: Consensus) -> tuple[float, float]:
    """Return how frequent the common rotation is in the dataset, and any other quarter turn."""
    # One more that disagrees, so that no other rotation is impossible.
    common = consensus.agreeing / (consensus.winners + 1)
    return common, (1.0 - common) / (len(distinct_starts()) - 1)


def degrees_between(rotation: ArrayLike, other: ArrayLike) -> Any:
    """Return the angle, in degrees, of the turn from one rotation (3, 3) or several to another."""
    trace = np.sum(np.asarray(rotation) * np.asarray(other), axis=(-2, -1))
    return np.degrees(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))


def _mean_rotation(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Chordal mean: the rotation nearest to the mean matrix."""
    # Summed in sorted order: the mean must not depend on the order of assets.
    ordered = sorted(rotations, key=lambda rotation: rotation.tobytes())
    u, _, v = np.linalg.svd(np.mean(ordered, axis=0))
    sign = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ v)))])
    rotation: NDArray[np.float64] = u @ sign @ v
    return rotation
