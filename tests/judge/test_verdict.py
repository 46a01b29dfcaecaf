"""Verdicts, and the sentences that say what kept an asset from being good."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.shapes import aligned, annotated, field_of, latents_of

from slatprep.judge import THRESHOLDS, judge, verdict_of
from slatprep.judge.verdict import contradicted, merged
from slatprep.parameters import SampleParameters
from slatprep.records import Ambiguity, Annotation, FitFigures, Judgement, Quality, Verdict

FINE = Quality(1.0, 0.5, 1.0, 0.5, 1.0, 1.0)
ROUGH = Quality(0.7, 0.5, 0.6, 0.5, 0.7, 1.5)


def judgement(verdict: Verdict, expected: float) -> Judgement:
    return Judgement(Ambiguity(0.0, (0.0,)), verdict, ("what it had",), 0.95, expected)


def annotation(likely: list[float] | None, unlabelled: int = 0) -> Annotation:
    """Return an annotation whose labels are that likely, and that many voxels without one."""
    classes = np.repeat([1, 255], [len(likely or ()), unlabelled])
    confidence = np.array([*(likely or ()), *[0.0] * unlabelled], np.float32)
    return annotated(classes, confidence=None if likely is None else confidence)


def test_an_asset_on_every_limit_is_good_for_no_reason() -> None:
    least = THRESHOLDS
    shares = least.good_valid_share, least.good_ambiguity
    given = verdict_of(FINE, *shares, 3, least.good_confidence, 1.0, least.good_accuracy)
    assert given == (Verdict.GOOD, ())
    # Where object and placement are sure, the fitness does not matter.
    assert verdict_of(ROUGH, 1.0, same_object=0.96, right_placement=0.95) == (Verdict.GOOD, ())


def test_a_tie_that_something_settled_is_as_good_as_its_probability() -> None:
    settled = verdict_of(FINE, 1.0, 0.4, 0, same_object=0.99, right_placement=0.97)
    assert settled == (Verdict.GOOD, ())
    still_open, _ = verdict_of(FINE, 1.0, 0.4, 1, same_object=0.99, right_placement=0.97)
    assert still_open is Verdict.DOUBTFUL


def test_every_reason_is_named_once() -> None:
    verdict, reasons = verdict_of(ROUGH, 0.7, 0.4, 2, 0.6, 0.8, 0.7, "roughness", contradicted=True)
    assert verdict is Verdict.DOUBTFUL
    assert reasons == (
        "perhaps another object: the two sides show the same one with a probability of 60.0% "
        "(good needs 90% for object and placement together): the surfaces lie on each other "
        "roughly only",
        "perhaps a wrong placement: it is right with a probability of 80.0% (good needs 90% for "
        "object and placement together)",
        "only 70.0% of the PixieVerse boundary lies within 1.5 voxel of the other side "
        "(good needs 80%)",
        "only 60.0% of the SLAT boundary lies within 1.5 voxel of the other side (good needs 80%)",
        "only 70.0% of the labels can be expected to be right (good needs 75%)",
        "only 70.0% of the SLAT voxels found an annotation (good needs 80%)",
        "2 other placements fit about as well and would change the class of 40.0% of the voxels "
        "(good needs 5%)",
        "its latents contradict its labels: labels drawn at random would be likelier",
    )


@pytest.mark.parametrize(("gain", "good"), [(math.nan, True), (0.025, True), (0.026, False)])
def test_a_mirrored_annotation_is_doubtful_however_sure_its_placement_is(
    gain: float, good: bool
) -> None:
    verdict, reasons = verdict_of(FINE, 1.0, same_object=0.99, right_placement=1.0, mirrored=gain)
    assert verdict is (Verdict.GOOD if good else Verdict.DOUBTFUL)
    assert len(reasons) == (0 if good else 1)


def test_one_tie_is_named_as_one() -> None:
    verdict, (reason,) = verdict_of(FINE, 1.0, 0.06, 1)
    assert verdict is Verdict.DOUBTFUL
    assert reason.startswith("another placement fits about")


def test_without_a_cause_none_is_named_and_the_fitness_is() -> None:
    _, (first, *fitnesses) = verdict_of(ROUGH, 1.0, same_object=0.6, right_placement=1.0)
    assert first.endswith("together)")
    assert len(fitnesses) == 2
    # Of placements the fitness says nothing, as another one fits as well.
    _, reasons = verdict_of(ROUGH, 1.0, same_object=1.0, right_placement=0.6, cause="shape")
    assert len(reasons) == 1
    assert reasons[0].startswith("perhaps a wrong placement")


@pytest.mark.parametrize(
    ("same", "placed", "verdict", "first"),
    [
        (0.89, 1.0, Verdict.DOUBTFUL, "perhaps another object"),
        (0.49, 1.0, Verdict.FAILED, "probably another object"),
        (0.5, 1.0, Verdict.DOUBTFUL, "perhaps another object"),
        (1.0, 0.49, Verdict.FAILED, "probably a wrong placement"),
        (1.0, 0.5, Verdict.DOUBTFUL, "perhaps a wrong placement"),
        # Neither is improbable, though both together are.
        (0.6, 0.7, Verdict.DOUBTFUL, "perhaps another object"),
    ],
)
def test_failed_says_which_of_the_two_questions_failed(
    same: float, placed: float, verdict: Verdict, first: str
) -> None:
    given, reasons = verdict_of(FINE, 1.0, 0, 0, same, placed, cause="shape")
    assert given is verdict
    assert reasons[0].startswith(first)
    assert reasons[0].endswith("different shapes") == ("object" in first)


@pytest.mark.parametrize(
    ("ties", "ambiguity", "verdict"),
    [
        (1, 0.06, Verdict.DOUBTFUL),  # Nothing has chosen among them yet.
        (5, 0.06, Verdict.DOUBTFUL),
        (0, 0.06, Verdict.FAILED),
        (3, THRESHOLDS.good_ambiguity, Verdict.FAILED),  # As labels they are one.
    ],
)
def test_a_placement_that_ties_is_not_failed(ties: int, ambiguity: float, verdict: Verdict) -> None:
    given, _ = verdict_of(FINE, 1.0, ambiguity, ties, same_object=1.0, right_placement=0.2)
    assert given is verdict
    assert verdict_of(FINE, 1.0, ambiguity, ties, 0.2, 1.0)[0] is Verdict.FAILED


@pytest.mark.parametrize("before", Verdict)
def test_contradiction_and_samples_that_differ_make_good_ones_doubtful(before: Verdict) -> None:
    after = Verdict.DOUBTFUL if before is Verdict.GOOD else before
    against = contradicted(judgement(before, 0.9))
    assert (against.verdict, against.contradicted) == (after, True)
    assert against.reasons[0] == "what it had"
    assert "contradict its labels" in against.reasons[1]
    several = merged(judgement(before, 0.9), annotation([0.5, 0.5], 1))
    assert (several.verdict, several.expected_accuracy) == (after, 0.5)
    assert several.reasons == (
        "what it had",
        "its annotations differ: only 50.0% of the labels can be expected to be right "
        "(good needs 75%)",
    )


@pytest.mark.parametrize(("alone", "likely"), [
    (0.9, [0.75, 0.75]),  # just enough together
    (0.7, [0.6, 0.6]),  # too little before, which its own reasons tell
    (0.7, [0.8, 0.9]),
])  # fmt: skip
def test_samples_that_agree_add_no_reason(alone: float, likely: list[float]) -> None:
    before = judgement(Verdict.GOOD, alone)
    together = merged(before, annotation(likely))
    assert together.expected_accuracy == pytest.approx(np.mean(likely))
    assert replace(together, expected_accuracy=alone) == before
    just = merged(judgement(Verdict.GOOD, 0.75), annotation([0.5]))
    assert just.verdict is Verdict.DOUBTFUL


@pytest.mark.parametrize("likely", [None, []])
def test_samples_without_any_label_are_right_nowhere(likely: list[float] | None) -> None:
    several = merged(judgement(Verdict.GOOD, 0.9), annotation(likely, 2))
    assert (several.verdict, several.expected_accuracy) == (Verdict.DOUBTFUL, 0.0)


def test_a_judgement_has_what_was_measured_of_its_asset() -> None:
    """A bar of two classes that fits as well with its ends swapped."""
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[22:42, 31:33, 31:33] = True
    classes = np.ones((64, 64, 64), dtype=np.uint8)
    classes[:32] = 3
    field = field_of(solid, classes)
    latents = latents_of(field.voxels)
    fit = FitFigures(0.9, 0.9, 0.9, math.nan, math.nan, (0.95, 0.97, 0.99), 0.0, 0.3)
    swapped = np.diag([-1.0, -1.0, 1.0, 1.0])
    alignment = aligned(np.eye(4), swapped, quality=FINE, margin=0.0, figures=fit)
    sampled = annotated(field.material, latents.centres, properties=field.properties)
    found, likely = judge(field, latents, alignment, sampled, SampleParameters())
    assert found.ambiguity.material_share == 1.0
    assert found.verdict is not Verdict.GOOD
    assert found.reasons[-1].startswith("another placement fits about as well and would change")
    assert found.expected_accuracy == pytest.approx(likely.mean())
    assert (likely <= 0.5).all()  # the two are as likely
    part = replace(sampled, valid=latents.coords[:, 0] >= 32)
    halved, likely = judge(field, latents, alignment, part, SampleParameters())
    assert any("50.0% of the SLAT voxels" in reason for reason in halved.reasons)
    assert halved.expected_accuracy == pytest.approx(likely[part.valid].mean())
    nothing = replace(sampled, valid=np.zeros(len(field.voxels), dtype=bool))
    lost, likely = judge(field, latents, alignment, nothing, SampleParameters())
    assert lost.expected_accuracy == 0.0 and not likely.any()
    assert lost.verdict is not Verdict.GOOD
