"""Settle ambiguous assets by the orientation that the rest of the dataset shares.

Both pipelines have a habitual frame, so most assets of a dataset have the same rotation. If an
asset's geometry leaves placements tied, the tied placement nearest to the rotation of the clear
winners is taken. An asset without a tie but with another rotation is also fitted in the common
rotation. The score of that fit is weighed against how rare other rotations are. The old placement
stays among the placements, so the choice can be undone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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

TEMPERATURE, SHARPER = 0.02, 0.2
"""Rise of the score, after deformation, that makes a placement e times as likely, and what the
score lacks of 1 below which a smaller rise does: the better the fit, the more a rise says."""

LEAST_LIKELY = 0.55
"""Smallest probability at which a tie is settled. Below, to leave it open says more."""

SURE = 0.95
"""Smallest probability at which an asset without a tie takes the common rotation."""

OTHER_SCALE = 0.04
"""Smallest difference of the logarithms of two scales between which no rotation chooses."""

_QUARTERS = 24

NEAR_DEGREES = 30.0
"""Largest angle, in degrees, between two rotations that count as the same quarter turn."""


def find_consensus(transforms: ArrayLike, objects: Sequence[str]) -> Consensus | None:
    """Find the rotation that clear winners have in common, from their transforms (A, 4, 4).

    Assets of one of the `objects` (A,) may share their frame, so they count once for each quarter
    turn that they have. The result is the mean of the rotations near the most frequent one. Return
    None if fewer than `LEAST_WINNERS`, or less than `LEAST_SHARE` of all, agree.
    """
    linear = np.asarray(transforms, np.float64).reshape(-1, 4, 4)[:, :3, :3]
    rotations = linear / np.cbrt(np.linalg.det(linear))[:, None, None]
    if not len(rotations):
        return None
    nearest = _quarter_of(rotations)
    votes = [turn for _, turn in set(zip(map(str, objects), nearest.tolist(), strict=True))]
    # The lowest index wins a draw, so that the order of assets does not matter.
    counts = np.bincount(votes, minlength=_QUARTERS + 1)[:_QUARTERS]
    common = int(counts.argmax())
    agreeing = int(counts[common])
    if agreeing < LEAST_WINNERS or agreeing < LEAST_SHARE * len(votes):
        return None
    others = tuple(np.where(np.arange(_QUARTERS) == common, 0, counts).tolist())
    members: dict[str, list[NDArray[np.float64]]] = {}
    for k in np.flatnonzero(nearest == common).tolist():
        members.setdefault(str(objects[k]), []).append(rotations[k])
    means = [_mean_rotation(own) if own[1:] else own[0] for own in members.values()]
    return Consensus(_mean_rotation(means), len(votes), agreeing, others)


def settle(alignment: Alignment, latents: StructuredLatents, consensus: Consensus) -> Alignment:
    """Choose, among tied placements, the one nearest to the common rotation.

    Return the same object if nothing is tied, ties of one rotation have two scales, none has the
    common rotation, or another one is likelier.
    """
    if not alignment.placements:
        return alignment
    ties = [Placement(alignment.transform, alignment.score, 0.0), *alignment.placements]
    split = [split_transform(tie.transform) for tie in ties]
    rotations = np.array([rotation for rotation, _, _ in split])
    angles = degrees_between(rotations, consensus.rotation)
    chosen = int(np.argmin(angles))
    scales = np.log([scale for _, _, scale in split])
    # A rotation does not choose between two scales that tie in it, or in another rotation.
    alike = degrees_between(rotations[:, None], rotations) <= NEAR_DEGREES
    others = alike & (abs(scales[:, None] - scales) > OTHER_SCALE)
    if angles[chosen] > NEAR_DEGREES or others.any():
        return alignment
    odds, scores = _odds_of(consensus, rotations), np.array([tie.score for tie in ties])
    # The score is NaN for an engine that ranks by fitness alone.
    rise = np.nan_to_num((scores - scores[chosen]) / temperature_of(alignment.score))
    by = replace(consensus, probability=float(odds[chosen] / (odds * np.exp(rise)).sum()))
    if by.probability < LEAST_LIKELY:
        return alignment
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
    probability = probability_of_common(consensus, gain, alignment)
    if probability < SURE:
        return alignment
    left = replace(alignment, placements=(placement, *alignment.placements))
    return take(left, 0, latents, replace(consensus, probability=probability))


def is_common(transform: ArrayLike, consensus: Consensus) -> bool:
    """Return whether a transform (4, 4) has the common rotation."""
    return bool(degrees_between(split_transform(transform)[0], consensus.rotation) <= NEAR_DEGREES)


def probability_of_common(consensus: Consensus, gain: float, alignment: Alignment) -> float:
    """Return the probability of the common rotation against that of an alignment.

    `gain` is the rise of the asset's score in the common rotation, after deformation.
    """
    present = split_transform(alignment.transform)[0]
    common, other = _odds_of(consensus, np.array([consensus.rotation, present]))
    rise = min(-gain / temperature_of(alignment.score), 700.0)
    return float(1.0 / (1.0 + other / common * math.exp(rise)))


def temperature_of(score: float) -> float:
    """Return the rise of a score that makes a placement e times as likely; NaN counts as poor."""
    lacks = 1.0 if math.isnan(score) else (1.0 - score) / SHARPER
    return TEMPERATURE * min(max(lacks, 0.1), 1.0)


def _odds_of(consensus: Consensus, rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the frequencies in the dataset of the quarter turns of rotations (K, 3, 3)."""
    # One more asset is counted as disagreeing, so that no rotation has probability 0.
    left = consensus.winners + 1 - consensus.agreeing - sum(consensus.others)
    counts = np.array([*consensus.others, 0]) + left / (_QUARTERS - 1)
    common = degrees_between(rotations, consensus.rotation) <= NEAR_DEGREES
    odds = np.where(common, consensus.agreeing, counts[_quarter_of(rotations)])
    return np.asarray(odds / (consensus.winners + 1))


def _quarter_of(rotations: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the number of the quarter turn near each rotation (K, 3, 3), `_QUARTERS` if none."""
    quarters = [start.rotation for start in distinct_starts()]
    angles = np.stack([degrees_between(rotations, quarter) for quarter in quarters], axis=1)
    near = angles.min(axis=1) <= NEAR_DEGREES
    return np.where(near, angles.argmin(axis=1), _QUARTERS)


def degrees_between(rotation: ArrayLike, other: ArrayLike) -> Any:
    """Return the angle, in degrees, between one rotation (3, 3) or several and another."""
    trace = np.sum(np.asarray(rotation) * np.asarray(other), axis=(-2, -1))
    return np.degrees(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))


def _mean_rotation(rotations: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return the chordal mean: the rotation nearest to the mean matrix."""
    # Summed in sorted order: the mean must not depend on the order of assets.
    ordered = sorted(rotations, key=lambda rotation: rotation.tobytes())
    u, _, v = np.linalg.svd(np.mean(ordered, axis=0))
    sign = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ v)))])
    return np.asarray(u @ sign @ v)
