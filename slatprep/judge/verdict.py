"""Give a verdict, from calibrated probabilities, and the reasons for it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slatprep.judge.ambiguity import measure_ambiguity
from slatprep.parameters import SampleParameters
from slatprep.records import (
    MIRRORED,
    Alignment,
    Annotation,
    Judgement,
    MaterialField,
    Quality,
    StructuredLatents,
    Verdict,
)


@dataclass(frozen=True)
class Thresholds:
    """The limits between verdicts; docs/design/confidence.md says how they were chosen.

    Attributes
    ----------
    good_confidence : float
        Smallest probability that object and placement are right of a good asset.
    failed_confidence : float
        Probability below which an asset is failed: that of the same object, or that of the
        right placement if no other placement ties with it.
    good_accuracy : float
        Expected share of right labels; below it the asset is doubtful.
    good_valid_share : float
        Share of SLAT voxels with an annotation; below it the asset is doubtful.
    good_ambiguity : float
        Share of SLAT voxels whose labels depend on the choice among placements
        that fit equally well; above it the asset is doubtful.
    good_mirrored : float
        Rise of the score once one side is mirrored; above it the asset is doubtful, as the
        annotation is a mirror image of its object.
    good_fitness, failed_fitness : float
        Limits of the lower of the two fitnesses, used if no probability is known. This happens
        if a check finds another fit than the stored one.
    """

    good_confidence: float = 0.9
    failed_confidence: float = 0.5
    good_accuracy: float = 0.75
    good_valid_share: float = 0.8
    good_ambiguity: float = 0.05
    good_mirrored: float = MIRRORED
    good_fitness: float = 0.8
    failed_fitness: float = 0.65


THRESHOLDS = Thresholds()
"""The thresholds of `verdict_of`."""

LEAST_TARGETS, LEAST_DECOYS = 50, 40
"""Smallest number of assets and of decoys for a dataset's own model; otherwise chance would decide,
and the shipped model stays."""

_WORDS = {
    "shape": "the two sides show different shapes",
    "roughness": "the surfaces lie on each other roughly only",
}

_CONTRADICTED = "its latents contradict its labels: labels drawn at random would be likelier"


def judge(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    annotation: Annotation,
    parameters: SampleParameters,
) -> tuple[Judgement, NDArray[np.float32]]:
    """Judge the alignment of an asset.

    Parameters
    ----------
    field, latents : MaterialField, StructuredLatents
        The two sides of the asset.
    alignment : Alignment
        Its alignment, of any engine; its ``placements`` tie with the best.
    annotation : Annotation
        The lookup under that alignment.
    parameters : SampleParameters
        How annotations are looked up.

    Returns
    -------
    judgement : Judgement
        The ambiguity by ties, the probabilities of placement and labels, the verdict,
        and the reasons why it is not good.
    likely : ndarray of float32, shape (N,)
        Probability that the class of each SLAT voxel is right; see `voxel_confidence`.
    """
    from slatprep.judge.calibration import PLACEMENT, SAME_OBJECT
    from slatprep.judge.confidence import class_confidence
    from slatprep.judge.evidence import FIGURES, evidence_of, surroundings_of

    ambiguity, tied = measure_ambiguity(field, latents, alignment, annotation, parameters)
    around = surroundings_of(field, latents, alignment, annotation, tied)
    evidence = evidence_of(field, latents, alignment, annotation, around, ambiguity.material_share)
    same, placed = (float(one.probability(evidence)) for one in (SAME_OBJECT, PLACEMENT))
    if alignment.margin < 0.0:
        # A stated frame is right as often as the placement that leads it by so much is wrong.
        of_other = evidence.copy()
        of_other[FIGURES.index("margin")] = -alignment.margin
        placed = 1.0 - float(PLACEMENT.probability(of_other))
    by = alignment.settled_by
    if by is not None and ambiguity.material_share > THRESHOLDS.good_ambiguity:
        # So far `placed` is the probability that any of the ties is right; `by` chose one of them.
        placed *= by.probability
    valid = annotation.valid
    likely = class_confidence(around, same * placed, valid)
    expected = float(likely[valid].mean(dtype=np.float64)) if valid.any() else 0.0
    found = Judgement(
        ambiguity,
        Verdict.GOOD,
        confidence=same * placed,
        expected_accuracy=expected,
        same_object=same,
        right_placement=placed,
        evidence=tuple(evidence.tolist()),
    )
    share = float(valid.mean())
    verdict, reasons = verdict_of(alignment, found, share)
    return replace(found, verdict=verdict, reasons=reasons), likely


def contradicted(judgement: Judgement) -> Judgement:
    """Return the judgement of an asset whose latents contradict its labels."""
    return replace(_doubted(judgement, _CONTRADICTED), contradicted=True)


def _doubted(judgement: Judgement, reason: str) -> Judgement:
    """Return the judgement with one more reason, and at best doubtful."""
    verdict = Verdict.DOUBTFUL if judgement.verdict is Verdict.GOOD else judgement.verdict
    return replace(judgement, verdict=verdict, reasons=(*judgement.reasons, reason))


def merged(judgement: Judgement, annotation: Annotation) -> Judgement:
    """Return the judgement of several annotations together.

    `judgement` is that of the first annotation by its own labels. `annotation` is the result of
    `slatprep.sample.merge` for all. If fewer labels can be expected to be right because the
    annotations differ, the asset is doubtful.
    """
    valid = annotation.valid
    likely = np.zeros(1) if annotation.confidence is None else annotation.confidence[valid]
    expected = float(likely.mean(dtype=np.float64)) if valid.any() else 0.0
    together = replace(judgement, expected_accuracy=expected)
    least = THRESHOLDS.good_accuracy
    if not expected < least <= judgement.expected_accuracy:
        return together
    return _doubted(
        together,
        f"its annotations differ: only {expected:.1%} of the labels can be expected to be right "
        f"(good needs {least:.0%})",
    )


def voxel_confidence(
    field: MaterialField,
    latents: StructuredLatents,
    alignment: Alignment,
    annotation: Annotation,
    parameters: SampleParameters,
    confidence: float,
) -> NDArray[np.float32]:
    """Return the probability (N,) that the class of each SLAT voxel is right; 0 if not valid.

    Arguments are those of `judge`, and `confidence` is that of its judgement. The probability is
    calibrated for the mix of data that docs/quality.md names.
    """
    from slatprep.judge.confidence import class_confidence
    from slatprep.judge.evidence import surroundings_of

    _, tied = measure_ambiguity(field, latents, alignment, annotation, parameters)
    around = surroundings_of(field, latents, alignment, annotation, tied)
    return class_confidence(around, confidence, annotation.valid)


def verdict_of(
    alignment: Alignment, judgement: Judgement, valid_share: float
) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict on an alignment, and the reasons why it is not better.

    The fit is the alignment's. All else is the `judgement`'s, whose verdict and reasons are
    ignored. If its probabilities are NaN, the fitness decides. `valid_share` is the share of SLAT
    voxels that got an annotation.
    """
    limits, quality = THRESHOLDS, alignment.quality
    same_object, right_placement = judgement.same_object, judgement.right_placement
    ambiguity, ties = judgement.ambiguity.material_share, len(alignment.open_placements)
    # Nothing has chosen among the tied placements yet, so any of them may be right.
    tied = ties > 0 and ambiguity > limits.good_ambiguity
    reasons: list[str] = []
    if math.isnan(same_object * right_placement):
        fitnesses = quality.fitness, quality.fitness_backward
        failed = any(fitness < limits.failed_fitness for fitness in fitnesses)
        reasons += _low_fitness(quality, f"(good needs {limits.good_fitness:.0%})")
    else:
        wrong = right_placement < limits.failed_confidence and not tied
        failed = same_object < limits.failed_confidence or wrong
        if same_object * right_placement < limits.good_confidence:
            reasons += _doubts(quality, judgement, wrong)
    if judgement.expected_accuracy < limits.good_accuracy:
        reasons.append(
            f"only {judgement.expected_accuracy:.1%} of the labels can be expected to be right "
            f"(good needs {limits.good_accuracy:.0%})"
        )
    if valid_share < limits.good_valid_share:
        reasons.append(
            f"only {valid_share:.1%} of the SLAT voxels found an annotation "
            f"(good needs {limits.good_valid_share:.0%})"
        )
    if tied:
        others = "another placement fits" if ties == 1 else f"{ties} other placements fit"
        reasons.append(
            f"{others} about as well and would change the labels of {ambiguity:.1%} of "
            f"the voxels (good needs {limits.good_ambiguity:.0%})"
        )
    if alignment.margin < 0.0:
        reasons.append(
            f"another placement fits better than the stated frame, by {-alignment.margin:.3f} in "
            "score: check its shift, its direction, its order of axes, and that it is for column "
            "vectors"
        )
    mirrored = math.nan if alignment.figures is None else alignment.figures.mirrored
    # A mirror image of another object cannot be recognised.
    if mirrored > limits.good_mirrored and not same_object < limits.failed_confidence:
        reasons.append(
            "the annotation is a mirror image of its object, left for right: mirrored, it fits "
            f"better by {mirrored:.3f} in score (good needs at most {limits.good_mirrored:g})"
        )
    if judgement.contradicted:
        reasons.append(_CONTRADICTED)
    if failed:
        return Verdict.FAILED, tuple(reasons)
    return (Verdict.DOUBTFUL if reasons else Verdict.GOOD), tuple(reasons)


def _doubts(quality: Quality, judgement: Judgement, wrong: bool) -> list[str]:
    """Return the reasons for a low confidence, by object and placement, the worse one first."""
    from slatprep.judge.confidence import causes_of_doubt
    from slatprep.judge.evidence import FIGURES

    limits, sure = THRESHOLDS, ("perhaps", "probably")
    same_object, right_placement = judgement.same_object, judgement.right_placement
    good = f"(good needs {limits.good_confidence:.0%} for object and placement together)"
    because = ""
    if len(judgement.evidence) == len(FIGURES):  # An older store may hold other figures.
        because = f": {_WORDS[next(iter(causes_of_doubt(np.array(judgement.evidence))))]}"
    another = sure[same_object < limits.failed_confidence]
    of_object = (
        f"{another} another object: the two sides show the same one with a probability of "
        f"{same_object:.1%} {good}{because}"
    )
    of_placement = (
        f"{sure[wrong]} a wrong placement: it is right with a probability of "
        f"{right_placement:.1%} {good}"
    )
    doubts = sorted([(same_object, of_object), (right_placement, of_placement)])
    # A probability is told if it alone causes half of the allowed loss, in logarithms.
    told = [text for likely, text in doubts if likely < limits.good_confidence**0.5]
    reasons = told or [doubts[0][1]]
    if same_object < limits.failed_confidence:
        reasons = [of_object]  # No placement on another object is right.
    if same_object <= right_placement:
        reasons += _low_fitness(quality, "before any deformation")
    return reasons


def _low_fitness(quality: Quality, told: str) -> list[str]:
    """Return a reason for each of the two fitnesses that is low; each ends with `told`."""
    return [
        f"{fitness:.1%} of the {side} boundary lies within {quality.radius:g} voxel of the other "
        f"side {told}"
        for side, fitness in (("PixieVerse", quality.fitness), ("SLAT", quality.fitness_backward))
        if fitness < THRESHOLDS.good_fitness
    ]
