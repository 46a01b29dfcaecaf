"""Verdicts and their reasons, and what ties mean, on shapes whose symmetry is known."""

import math
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from support.shapes import GRID, aligned, annotated, field_of, latents_of, surface_latents

from slatprep import records
from slatprep.align import align
from slatprep.geometry.deformation import map_of
from slatprep.geometry.frames import cube_symmetries, make_transform
from slatprep.judge import THRESHOLDS, judge, measure_ambiguity, verdict_of
from slatprep.judge.ambiguity import FEWER, MOST_VOXELS, compare_labels
from slatprep.judge.evidence import FIGURES
from slatprep.judge.verdict import contradicted, merged
from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.records import Ambiguity, FitFigures, Judgement, MaterialField, Quality, Verdict
from slatprep.sample import sample

FINE = Quality(1.0, 0.5, 1.0, 0.5, 1.0, 1.0)
ROUGH = Quality(0.7, 0.5, 0.6, 0.5, 0.7, 1.5)


def said_of(
    quality: Quality = FINE,
    valid: float = 1.0,
    ambiguity: float = 0.0,
    ties: int = 0,
    mirrored: float = math.nan,
    worst: str = "",
    held: int = len(FIGURES),
    **others: Any,
) -> tuple[Verdict, tuple[str, ...]]:
    """Return the verdict on an alignment with these figures; of those `held`, `worst` is 0."""
    figures = FitFigures(1.0, 1.0, 1.0, math.nan, math.nan, (1.0, 1.0, 1.0), 0.0, 0.0)
    figures = replace(figures, mirrored=mirrored)
    alignment = aligned(*[np.eye(4)] * (ties + 1), quality=quality, figures=figures)
    evidence = tuple(0.0 if name == worst else math.nan for name in FIGURES[:held]) if worst else ()
    known = Judgement(Ambiguity(ambiguity, (0.0,)), Verdict.GOOD, evidence=evidence, **others)
    return verdict_of(alignment, known, valid)


def judgement(verdict: Verdict, expected: float) -> Judgement:
    return Judgement(Ambiguity(0.0, (0.0,)), verdict, ("what it had",), 0.95, expected)


def annotation(likely: list[float] | None, unlabelled: int = 0) -> records.Annotation:
    """Return an annotation whose labels are that likely, and that many voxels without one."""
    classes = np.repeat([1, 255], [len(likely or ()), unlabelled])
    confidence = np.array([*(likely or ()), *[0.0] * unlabelled], np.float32)
    return annotated(classes, confidence=None if likely is None else confidence)


def test_an_asset_on_every_limit_is_good_for_no_reason():
    least = THRESHOLDS
    shares = least.good_valid_share, least.good_ambiguity
    sure = {"same_object": least.good_confidence, "right_placement": 1.0}
    given = said_of(FINE, *shares, 3, **sure, expected_accuracy=least.good_accuracy)
    assert given == (Verdict.GOOD, ())
    # Where object and placement are sure, the fitness does not matter.
    assert said_of(ROUGH, same_object=0.96, right_placement=0.95) == (Verdict.GOOD, ())


@pytest.mark.parametrize(("fitness", "backward", "verdict", "word"), [
    (THRESHOLDS.good_fitness, 1.0, Verdict.GOOD, ""),
    (0.79, 1.0, Verdict.DOUBTFUL, "PixieVerse boundary"),
    (1.0, 0.79, Verdict.DOUBTFUL, "SLAT boundary"),
    (1.0, 0.64, Verdict.FAILED, "SLAT boundary"),
    (THRESHOLDS.failed_fitness, 1.0, Verdict.DOUBTFUL, ""),
    (0.64, 1.0, Verdict.FAILED, "64.0%"),
])  # fmt: skip
def test_verdicts_by_fitness_alone(fitness, backward, verdict, word):
    given, reasons = said_of(Quality(fitness, 0.5, backward, 0.5, 0.9, 1.0), 1.0, 0.05, ties=1)
    assert given is verdict
    assert word in " ".join(reasons)
    assert bool(reasons) == (verdict is not Verdict.GOOD)


def test_a_tie_that_something_settled_is_as_good_as_its_probability():
    assert said_of(ambiguity=0.4, same_object=0.99, right_placement=0.97) == (Verdict.GOOD, ())
    still_open, _ = said_of(ambiguity=0.4, ties=1, same_object=0.99, right_placement=0.97)
    assert still_open is Verdict.DOUBTFUL


def test_every_reason_is_named_once():
    unsure = {"same_object": 0.6, "right_placement": 0.8, "expected_accuracy": 0.7}
    verdict, reasons = said_of(ROUGH, 0.7, 0.4, 2, worst="score_slat", contradicted=True, **unsure)
    assert verdict is Verdict.DOUBTFUL
    assert reasons == (
        "perhaps another object: the two sides show the same one with a probability of 60.0% "
        "(good needs 90% for object and placement together): the surfaces lie on each other "
        "roughly only",
        "perhaps a wrong placement: it is right with a probability of 80.0% (good needs 90% for "
        "object and placement together)",
        "70.0% of the PixieVerse boundary lies within 1.5 voxel of the other side before any "
        "deformation",
        "60.0% of the SLAT boundary lies within 1.5 voxel of the other side before any deformation",
        "only 70.0% of the labels can be expected to be right (good needs 75%)",
        "only 70.0% of the SLAT voxels found an annotation (good needs 80%)",
        "2 other placements fit about as well and would change the labels of 40.0% of the voxels "
        "(good needs 5%)",
        "its latents contradict its labels: labels drawn at random would be likelier",
    )


@pytest.mark.parametrize(("gain", "good"), [(math.nan, True), (0.025, True), (0.026, False)])
def test_a_mirrored_annotation_is_doubtful_however_sure_its_placement_is(gain, good):
    verdict, reasons = said_of(same_object=0.99, right_placement=1.0, mirrored=gain)
    assert verdict is (Verdict.GOOD if good else Verdict.DOUBTFUL)
    assert len(reasons) == (0 if good else 1)
    # Of another object it says nothing.
    verdict, (reason,) = said_of(same_object=0.01, right_placement=1.0, mirrored=gain)
    assert verdict is Verdict.FAILED
    assert reason.startswith("probably another object")


def test_without_a_cause_none_is_named_and_the_fitness_is():
    _, (first, *fitnesses) = said_of(ROUGH, same_object=0.6, right_placement=1.0)
    assert first.endswith("together)")
    assert len(fitnesses) == 2
    # So it is of an older store, whose records hold other figures.
    _, older = said_of(ROUGH, worst="score_slat", held=33, same_object=0.6, right_placement=1.0)
    assert older == (first, *fitnesses)
    # Of placements the fitness says nothing, as another one fits as well.
    _, reasons = said_of(ROUGH, worst="within_3", same_object=1.0, right_placement=0.6)
    assert len(reasons) == 1
    assert reasons[0].startswith("perhaps a wrong placement")


@pytest.mark.parametrize(("same", "placed", "verdict", "first"), [
    (0.89, 1.0, Verdict.DOUBTFUL, "perhaps another object"),
    (0.49, 1.0, Verdict.FAILED, "probably another object"),
    (0.5, 1.0, Verdict.DOUBTFUL, "perhaps another object"),
    (1.0, 0.49, Verdict.FAILED, "probably a wrong placement"),
    (1.0, 0.5, Verdict.DOUBTFUL, "perhaps a wrong placement"),
    # Neither is improbable, though both together are.
    (0.6, 0.7, Verdict.DOUBTFUL, "perhaps another object"),
])  # fmt: skip
def test_failed_says_which_of_the_two_questions_failed(same, placed, verdict, first):
    given, reasons = said_of(worst="within_3", same_object=same, right_placement=placed)
    assert given is verdict
    assert reasons[0].startswith(first)
    assert reasons[0].endswith("different shapes") == ("object" in first)


@pytest.mark.parametrize(("ties", "ambiguity", "verdict"), [
    (1, 0.06, Verdict.DOUBTFUL),  # Nothing has chosen among them yet.
    (5, 0.06, Verdict.DOUBTFUL),
    (0, 0.06, Verdict.FAILED),
    (3, THRESHOLDS.good_ambiguity, Verdict.FAILED),  # As labels they are one.
])  # fmt: skip
def test_a_placement_that_ties_is_not_failed(ties, ambiguity, verdict):
    given, _ = said_of(FINE, 1.0, ambiguity, ties, same_object=1.0, right_placement=0.2)
    assert given is verdict
    other, _ = said_of(FINE, 1.0, ambiguity, ties, same_object=0.2, right_placement=1.0)
    assert other is Verdict.FAILED


@pytest.mark.parametrize("before", Verdict)
def test_contradiction_and_samples_that_differ_make_good_ones_doubtful(before):
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
def test_samples_that_agree_add_no_reason(alone, likely):
    before = judgement(Verdict.GOOD, alone)
    together = merged(before, annotation(likely))
    assert together.expected_accuracy == pytest.approx(np.mean(likely))
    assert replace(together, expected_accuracy=alone) == before
    assert merged(judgement(Verdict.GOOD, 0.75), annotation([0.5])).verdict is Verdict.DOUBTFUL


@pytest.mark.parametrize("likely", [None, []])
def test_samples_without_any_label_are_right_nowhere(likely):
    several = merged(judgement(Verdict.GOOD, 0.9), annotation(likely, 2))
    assert (several.verdict, several.expected_accuracy) == (Verdict.DOUBTFUL, 0.0)


def test_a_judgement_has_what_was_measured_of_its_asset():
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


BALL = ((GRID - 31.5) ** 2).sum(axis=-1) < 20**2


PARAMETERS = SampleParameters()


def _ambiguity(occupancy: np.ndarray, material: np.ndarray | None = None) -> tuple[Any, Ambiguity]:
    field, latents = field_of(occupancy, material), surface_latents(occupancy)
    alignment = align(field, latents, AlignParameters())
    annotation = sample(field, map_of(alignment).places(latents.coords), PARAMETERS)
    return alignment, measure_ambiguity(field, latents, alignment, annotation, PARAMETERS)[0]


@pytest.mark.parametrize(("material", "share", "change"), [
    (None, 0.0, (0.0, 0.0, 0.0)),
    # Upside down every class changes: E by two decades, density from 200 to 400, nu by 0.02.
    (np.where(GRID[..., 2] < 32, 1, 3), 1.0, (2.0, np.log10(2), 0.02)),
], ids=["of one material", "painted"])  # fmt: skip
def test_a_ball_is_ambiguous_and_harmless_unless_half_of_it_is_painted(material, share, change):
    alignment, ambiguity = _ambiguity(BALL, material)
    assert len(alignment.placements) == 23  # all other quarter turns
    assert alignment.margin < 1e-6
    assert ambiguity.material_share == share
    np.testing.assert_allclose(ambiguity.property_change, change, rtol=1e-5)


def _two_metals(
    second: tuple[float, float, float], classified: bool = True
) -> tuple[MaterialField, records.StructuredLatents]:
    """Return a bar of one class whose halves along x have different properties, and its surface."""
    bar = np.zeros((64, 64, 64), dtype=bool)
    bar[12:52, 24:40, 28:36] = True
    field = field_of(bar, np.ones((64, 64, 64), dtype=int))
    left = field.voxels[:, :1] < 32
    properties = np.where(left, (6e10, 2700.0, 0.3), second).astype(np.float32)
    field = replace(field, classified=classified, material=field.material * classified)
    return replace(field, properties=properties), surface_latents(bar)


@pytest.mark.parametrize("classified", [True, False])
@pytest.mark.parametrize(("second", "harmless"), [
    ((2e11, 7800.0, 0.3), False),
    *(((6e10 * factor, 2700.0 / factor, 0.3), True) for factor in (1.0 + 1e-6, 1.8)),
])  # fmt: skip
def test_ties_are_harmless_below_a_factor_of_two_in_properties(classified, second, harmless):
    field, latents = _two_metals(second, classified)
    alignment = align(field, latents, AlignParameters())
    annotation = sample(field, map_of(alignment).places(latents.coords), PARAMETERS)
    judgement, likely = judge(field, latents, alignment, annotation, PARAMETERS)
    assert len(alignment.placements) == 3
    assert judgement.ambiguity.material_share == (0.0 if harmless else 1.0)
    assert judgement.verdict is (Verdict.GOOD if harmless else Verdict.DOUBTFUL)
    # Two of the three ties and the chosen placement swap the ends: half of the labels are right.
    _, tied = measure_ambiguity(field, latents, alignment, annotation, PARAMETERS)
    np.testing.assert_allclose(tied, 0.0 if harmless else 0.5)
    if not harmless:
        assert any("would change the labels of 100.0%" in reason for reason in judgement.reasons)
        assert likely.mean() < 0.55


def test_other_labels_by_hand():
    """The second property, of extent [-1, 1], is not mapped: only a change of 0.2 can count."""
    field, _ = _two_metals((2e11, 7800.0, 0.3))
    table = (records.Property("E", "Pa", True), records.Property("charge", "C", False))
    ends = np.where(field.voxels[:, :1] < 32, (6e10, -1.0), (2e11, 1.0)).astype(np.float32)
    field = replace(field, properties=ends, table=table)
    rows = [
        # class, E, charge, and the same of the other, and whether they are other labels
        (1, 1e10, 0.0, 1, 2.0e10, 0.0, False),
        (1, 1e10, 0.0, 1, 2.1e10, 0.0, True),
        (1, 1e10, 0.05, 1, 1e10, -0.1, False),
        (1, 1e10, 0.05, 1, 1e10, 0.26, True),
        (1, 1e10, 1.0, 1, 1e10, 0.81, False),
        (1, 1e10, 1.0, 1, 1e10, 0.79, True),
        (1, 1e3, 0.0, 1, 2.1e3, 0.0, True),
        (1, 1e10, 0.0, 2, 1e10, 0.0, True),
        (1, 1e10, 0.0, 255, np.nan, np.nan, True),
        (255, np.nan, np.nan, 255, np.nan, np.nan, False),
    ]
    numbers = np.array(rows)
    sides = numbers[:, :3], numbers[:, 3:6]
    one, two = (annotated(s[:, 0], properties=s[:, 1:].astype(np.float32)) for s in sides)
    expected = [row[-1] for row in rows]
    assert compare_labels(field, one, two)[0].tolist() == expected
    assert compare_labels(field, two, one)[0].tolist() == expected


def test_a_box_with_a_painted_end_by_hand():
    # 40 x 20 x 10: half turns about each axis keep it, and two of the three swap the ends.
    box = np.zeros((64, 64, 64), dtype=bool)
    box[12:52, 22:42, 27:37] = True
    painted = np.where(GRID[..., 0] < 20, 2, 1)  # 8 of 40 layers
    alignment, ambiguity = _ambiguity(box, painted)
    assert len(alignment.placements) == 3
    assert all(p.displacement > 5 for p in alignment.placements)
    surface = surface_latents(box).coords
    expected = ((surface[:, 0] < 20) | (surface[:, 0] >= 44)).mean()
    assert ambiguity.material_share == np.float64(expected)


def test_a_full_slat_is_judged_by_some_of_its_voxels_and_ties(monkeypatch):
    ball = ((GRID - 31.5) ** 2).sum(axis=-1) < 27**2
    field = field_of(ball, np.where(GRID[..., 2] < 32, 1, 3))
    latents = latents_of(np.argwhere(ball))
    turns = [make_transform(turn) for turn in cube_symmetries() if np.linalg.det(turn) > 0]
    alignment = aligned(*turns)
    annotation = sample(field, latents.centres, PARAMETERS)
    assert len(latents.coords) > 2 * MOST_VOXELS
    some = measure_ambiguity(field, latents, alignment, annotation, PARAMETERS)
    monkeypatch.setattr("slatprep.judge.ambiguity.MOST_VOXELS", 10**9)
    every = measure_ambiguity(field, latents, alignment, annotation, PARAMETERS)
    assert abs(some[0].material_share - every[0].material_share) < 0.01
    np.testing.assert_allclose(some[0].property_change, every[0].property_change, rtol=0.02)
    assert abs(some[1].mean() - every[1].mean()) < 0.05


def test_of_a_full_grid_each_tie_is_looked_at_in_all_layers_and_some_ties_at_all_voxels(
    monkeypatch,
):
    """Classes repeat every eight layers, as would steps of eight in a grid that is in order."""
    full = np.ones((64, 64, 64), dtype=bool)
    field = field_of(full, np.where(GRID[..., 2] % 8 == 0, 1, 3))
    latents, watched = latents_of(np.argwhere(full)), Mock(wraps=sample)
    annotation = sample(field, latents.centres, PARAMETERS)
    monkeypatch.setattr("slatprep.judge.ambiguity.sample", watched)
    # The first tie changes nothing, and the second turns the grid upside down.
    ties = aligned(np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0]), np.diag([-1.0, 1.0, -1.0, 1.0]))
    some, _ = measure_ambiguity(field, latents, ties, annotation, PARAMETERS)
    # Layers 0, 8, 16... change with layers 7, 15, 23...: two of eight.
    assert some.material_share == pytest.approx(0.25, abs=0.01)
    looked = [len(called.args[1]) for called in watched.call_args_list]
    assert looked == [64**3, pytest.approx(MOST_VOXELS / FEWER, rel=0.05)]


def test_without_classes_a_property_that_changes_notably_counts_by_hand():
    """log10 E along x is 5, 5.45, 5.5, 6, twice, and 5 aside; half a turn about z swaps x.

    So it changes by 1, 0.05, 0.05 and 1 in four layers, of a range of 1, of which a tenth is
    notable; the two voxels aside are carried to where nothing is annotated.
    """
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[30:34, 31:33, 32] = solid[40, 31:33, 32] = True
    field = field_of(solid)
    powers = dict(zip([30, 31, 32, 33, 40], [5.0, 5.45, 5.5, 6.0, 5.0], strict=True))
    properties = np.full((len(field.voxels), 3), [1e5, 1e3, 0.3], dtype=np.float32)
    properties[:, 0] = [10.0 ** powers[int(x)] for x in field.voxels[:, 0]]
    nothing = np.zeros_like(field.material)
    field = replace(field, properties=properties, classified=False, material=nothing)
    latents = latents_of(field.voxels)
    half_a_turn = aligned(np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0]))
    annotation = sample(field, latents.centres, PARAMETERS)
    ambiguity, _ = measure_ambiguity(field, latents, half_a_turn, annotation, PARAMETERS)
    assert ambiguity.material_share == pytest.approx((4 + 2) / 10)
    reasons = judge(field, latents, half_a_turn, annotation, PARAMETERS)[0].reasons
    assert any("would change the labels of 60.0% of the voxels" in one for one in reasons)
    expected = ((1 + 0.05 + 0.05 + 1) / 4, 0.0, 0.0)
    np.testing.assert_allclose(ambiguity.property_change, expected, atol=1e-6)
