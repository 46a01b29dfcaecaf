"""Verdicts, and the sentences that say what kept an asset from being good."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.shapes import field_of, latents_of

from slatprep.judge import THRESHOLDS, judge, verdict_of
from slatprep.judge.calibration import SAME_OBJECT
from slatprep.judge.confidence import causes_of_doubt
from slatprep.judge.evidence import FIGURES
from slatprep.judge.verdict import contradicted, merged
from slatprep.parameters import SampleParameters
from slatprep.records import (
    Alignment,
    Ambiguity,
    Annotation,
    Engine,
    FitFigures,
    Judgement,
    Model,
    Placement,
    Quality,
    Search,
    Verdict,
)

FINE = Quality(1.0, 0.5, 1.0, 0.5, 1.0, 1.0)
ROUGH = Quality(0.7, 0.5, 0.6, 0.5, 0.7, 1.5)


def judgement(verdict: Verdict, expected: float) -> Judgement:
    return Judgement(Ambiguity(0.0, (0.0,)), verdict, ("what it had",), 0.95, expected)


def annotation(confidence: list[float] | None, valid: list[bool]) -> Annotation:
    count = len(valid)
    return Annotation(
        np.ones((count, 3), np.float32),
        np.where(valid, 1, 255).astype(np.uint8),
        np.array(valid),
        np.zeros(count, np.float32),
        np.zeros((count, 3), np.float32),
        None if confidence is None else np.array(confidence, np.float32),
    )


def test_an_asset_on_every_limit_is_good_for_no_reason() -> None:
    limits = THRESHOLDS
    assert verdict_of(
        FINE,
        limits.good_valid_share,
        limits.good_ambiguity,
        3,
        limits.good_confidence,
        1.0,
        limits.good_accuracy,
    ) == (Verdict.GOOD, ())
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
        "(good needs 90% for object and placement together): the surfaces lie on each "
        "other roughly "
        "only",
        "perhaps a wrong placement: it is right with a probability of 80.0% (good needs "
        "90% for object "
        "and placement together)",
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


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (Verdict.GOOD, Verdict.DOUBTFUL),
        (Verdict.DOUBTFUL, Verdict.DOUBTFUL),
        (Verdict.FAILED, Verdict.FAILED),
    ],
)
def test_contradiction_and_samples_that_differ_make_good_ones_doubtful(
    before: Verdict, after: Verdict
) -> None:
    against = contradicted(judgement(before, 0.9))
    assert (against.verdict, against.contradicted) == (after, True)
    assert against.reasons[0] == "what it had"
    assert "contradict its labels" in against.reasons[1]
    several = merged(judgement(before, 0.9), annotation([0.5, 0.5, 0.0], [True, True, False]))
    assert (several.verdict, several.expected_accuracy) == (after, 0.5)
    assert several.reasons == (
        "what it had",
        "its annotations differ: only 50.0% of the labels can be expected to be right "
        "(good needs 75%)",
    )


@pytest.mark.parametrize(
    ("alone", "likely"),
    [
        (0.9, [0.75, 0.75]),  # just enough together
        (0.7, [0.6, 0.6]),  # too little before, which its own reasons tell
        (0.7, [0.8, 0.9]),
    ],
)
def test_samples_that_agree_add_no_reason(alone: float, likely: list[float]) -> None:
    before = judgement(Verdict.GOOD, alone)
    together = merged(before, annotation(likely, [True, True]))
    assert together.expected_accuracy == pytest.approx(np.mean(likely))
    assert replace(together, expected_accuracy=alone) == before


def test_samples_that_agree_by_just_enough_before_and_not_together_differ() -> None:
    several = merged(judgement(Verdict.GOOD, 0.75), annotation([0.5], [True]))
    assert several.verdict is Verdict.DOUBTFUL


@pytest.mark.parametrize("confidence", [None, [0.0, 0.0]])
def test_samples_without_any_label_are_right_nowhere(confidence: list[float] | None) -> None:
    several = merged(judgement(Verdict.GOOD, 0.9), annotation(confidence, [False, False]))
    assert (several.verdict, several.expected_accuracy) == (Verdict.DOUBTFUL, 0.0)


def test_what_takes_confidence_away_is_summed_by_cause_largest_first() -> None:
    own = {figure.name: figure.usual for figure in SAME_OBJECT.figures}
    usual = np.array([own.get(name, 1.0) for name in FIGURES])
    rng = np.random.default_rng(1)
    for _ in range(20):
        figures = usual * rng.uniform(0.3, 1.7, len(FIGURES))
        added = dict(zip(FIGURES, SAME_OBJECT.contributions(figures).tolist(), strict=True))
        taken = causes_of_doubt(figures)
        # Every figure belongs to one cause, and what adds confidence makes up for nothing.
        lost = [-value for value in added.values() if value < 0]
        assert sum(taken.values()) == pytest.approx(sum(lost))
        assert set(taken) == {"shape", "roughness"}
        assert list(taken.values()) == sorted(taken.values(), reverse=True)


def test_a_judgement_has_what_was_measured_of_its_asset() -> None:
    """A bar of two classes that fits as well with its ends swapped."""
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[22:42, 31:33, 31:33] = True
    classes = np.ones((64, 64, 64), dtype=np.uint8)
    classes[:32] = 3
    field = field_of(solid, classes)
    latents = latents_of(field.voxels)
    fit = FitFigures(0.9, 0.9, 0.9, math.nan, math.nan, (0.95, 0.97, 0.99), 0.0, 0.3)
    swapped = Placement(np.diag([-1.0, -1.0, 1.0, 1.0]), 0.9, 9.0)
    alignment = Alignment(
        np.eye(4), Engine.FIELD, Model.RIGID, Search.EULER64, FINE,
        margin=0.0, placements=(swapped,), figures=fit,
    )  # fmt: skip
    sampled = Annotation(
        field.properties,
        field.material,
        np.ones(len(field.voxels), dtype=bool),
        np.zeros(len(field.voxels), np.float32),
        latents.centres.astype(np.float32),
    )
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
