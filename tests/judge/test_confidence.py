"""Confidence against made figures and against fresh demo objects, to which nothing was fitted."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import expit
from support.demos import Case, made_cases
from support.shapes import GRID, chair, field_of, surface_latents

from slatprep import records
from slatprep.align import align
from slatprep.align.figures import measure_figures
from slatprep.inspect.verify.assets import roundings
from slatprep.judge import THRESHOLDS, evidence, voxel_confidence
from slatprep.judge.calibration import PLACEMENT, SAME_OBJECT, VOXEL
from slatprep.judge.confidence import causes_of_doubt
from slatprep.judge.decoys import FOLDS, LEARNED, ErrorRates, _fit, error_rates
from slatprep.judge.model import FLOOR
from slatprep.judge.verdict import LEAST_TARGETS
from slatprep.judge.witness import fold_of
from slatprep.normalize import (
    PIXIE_RANGES,
    denormalize_properties,
    from_mapped,
    normalize_properties,
)
from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.pipeline.annotate import look_up
from slatprep.records import Alignment, MaterialField, StructuredLatents, Verdict
from slatprep.sample import sample

OF_PLACEMENT = ("margin", "clear_by", "ties", "alike")


def _ends(name: str) -> tuple[float, float]:
    """Return a figure's value for usual right ones, and for the worst that the model knows."""
    model = PLACEMENT if name in OF_PLACEMENT else SAME_OBJECT
    own = [term for term in model.terms if term.name == name]
    if not own:
        return 0.0, 0.0  # It counts for nothing.
    usual = next((f.usual for f in own if f.low < f.usual < f.high), own[0].usual)
    low, high = own[0].low, own[-1].high
    return usual, (low if usual - low > high - usual else high)


USUAL, WORST = np.array([_ends(name) for name in evidence.FIGURES]).T


def made(count: int, towards: tuple[float, float], seed: int) -> np.ndarray:
    """Make figures of alignments that lie by so much between usual and worst."""
    rng = np.random.default_rng(seed)
    part = rng.uniform(*towards, (count, 1)) + rng.normal(0, 0.05, (count, len(evidence.FIGURES)))
    figures = USUAL + part * (WORST - USUAL)
    for name in OF_PLACEMENT:
        figures[:, evidence.FIGURES.index(name)] = USUAL[evidence.FIGURES.index(name)]
    return figures


def right(count: int, seed: int = 0) -> np.ndarray:
    return made(count, (-0.1, 0.25), seed)


def wrong(count: int, seed: int = 1) -> np.ndarray:
    return made(count, (0.2, 1.0), seed)


def apart(figures: np.ndarray) -> list[str]:
    """Return names of objects with one row each."""
    return list(map(str, range(len(figures))))


def rated(targets: np.ndarray, decoys: np.ndarray) -> ErrorRates:
    good = called_good(targets, decoys)
    found = error_rates(targets, decoys, apart(targets), apart(decoys), **good)
    # Errors never rise with the score.
    order = np.argsort(found.scores)
    assert (np.diff(found.errors[order]) <= 1e-12).all()
    assert (np.diff(found.rates[order]) <= 1e-12).all()
    assert ((found.errors >= 0) & (found.errors <= 1)).all()
    return found


def called_good(targets: np.ndarray, decoys: np.ndarray) -> dict[str, np.ndarray]:
    return {
        name: np.multiply(*(model.probability(figures) for model in (SAME_OBJECT, PLACEMENT)))
        >= THRESHOLDS.good_confidence
        for name, figures in (("good", targets), ("good_decoys", decoys))
    }


@pytest.mark.parametrize("far", [0.7, 1.4, 5.0])
def test_wrong_pairs_that_score_as_low_as_scores_go_are_counted(far):
    # All of them, and all decoys, at the floor of probability, or of the score.
    targets = np.concatenate([right(20), made(10, (far, far), 3)])
    found = rated(targets, made(25, (far, far), 4))
    low, high = found.wrong_share_range
    assert not found.refitted
    assert low <= 1 / 3 <= high
    assert abs(found.wrong_share - 1 / 3) < 0.15
    assert found.errors[20:].min() > 0.9 > 0.5 > found.errors[:20].max()


@pytest.mark.parametrize("mixed", [0, 20, 80, 160])
def test_the_stated_rates_are_the_true_ones(mixed):
    count = 400
    truly = np.arange(count) < mixed
    targets = np.concatenate([wrong(mixed, 5), right(count - mixed)])
    found = rated(targets, wrong(200))
    low, high = found.wrong_share_range
    assert found.refitted
    assert low <= truly.mean() <= high
    assert abs(found.wrong_share - truly.mean()) < 0.05
    # Of 200 decoys none need be above a score for some wrong pair to be there.
    assert found.rates.min() >= found.wrong_share / 201 and (found.errors.min() > 0 or not mixed)
    kept = found.rates <= 0.01
    assert truly[kept].mean() <= 0.02
    assert kept[~truly].mean() > 0.7
    # Probabilities of single assets add up to the number of wrong ones.
    assert abs(found.errors.sum() - mixed) < 0.05 * count
    sure = SAME_OBJECT.probability(targets) * PLACEMENT.probability(targets) >= 0.9
    least, most = found.good_wrong_range
    assert found.good == sure.sum()
    assert np.floor(least) <= (sure & truly).sum() <= np.ceil(most)


@pytest.mark.parametrize("few", [1, 2, 3, 5])
def test_the_interval_of_few_decoys_holds_the_true_share(few):
    """Its upper end is to be too low in one draw of 40."""
    pool = made(200, (0.3, 0.5), 1)
    targets = np.concatenate([made(60, (0.3, 0.5), 5), right(140)])
    rng = np.random.default_rng(few)
    draws = [rated(targets, pool[rng.choice(200, few, replace=False)]) for _ in range(200)]
    assert np.mean([found.wrong_share_range[1] < 0.3 for found in draws]) < 0.05


def test_the_interval_holds_the_true_share_where_whole_objects_are_wrong():
    """Of 28 objects of eight rows each a fifth is wrong, all rows of it together."""
    rng, names = np.random.default_rng(4), [str(k) for k in range(28) for _ in range(8)]
    held = []
    for seed in range(60):
        bad = np.repeat(rng.random(28) < 0.2, 8)
        targets = right(224, seed)
        targets[bad] = wrong(224, seed + 1000)[bad]
        decoys = wrong(112, seed + 2000)
        good = called_good(targets, decoys)
        found = error_rates(targets, decoys, names, names[::2], **good, seed=seed)
        assert not found.refitted
        held.append(found.wrong_share_range[0] <= 0.2 <= found.wrong_share_range[1])
    assert np.mean(held) > 0.9


def test_of_shuffled_pairs_hardly_any_is_kept():
    found = rated(wrong(300, 7), wrong(200))
    assert found.wrong_share > 0.9
    assert found.kept(0.01)[0] <= 3
    assert found.errors.mean() > 0.9


def test_where_decoys_fit_as_well_nothing_can_be_told():
    """A dataset of balls: any SLAT is as good as the own one."""
    found = rated(right(200), right(100, 9))
    assert found.wrong_share > 0.8
    assert found.kept(0.01)[0] <= 4
    assert found.good > 0 and found.good_wrong > 0.5 * found.good


@pytest.mark.parametrize("count", [1, 10, LEAST_TARGETS - 1])
def test_few_assets_are_judged_by_the_shipped_model(count):
    targets = right(count)
    found = rated(targets, wrong(count))
    assert not found.refitted
    # Its probabilities have a floor, where scores go on.
    likely = np.clip(expit(found.scores), FLOOR, 1 - FLOOR)
    np.testing.assert_allclose(likely, SAME_OBJECT.probability(targets))
    assert 0.0 <= found.wrong_share_range[0] <= found.wrong_share_range[1] <= 1.0


def test_the_order_of_assets_does_not_matter():
    targets, decoys = np.concatenate([wrong(40, 3), right(160)]), wrong(100)
    names, good = np.array(apart(targets)), called_good(targets, decoys)
    first = error_rates(targets, decoys, names, apart(decoys), **good)
    order = np.random.default_rng(0).permutation(len(targets))
    good["good"] = good["good"][order]
    second = error_rates(targets[order], decoys, names[order], apart(decoys), **good)
    np.testing.assert_allclose(second.errors, first.errors[order], atol=1e-6)
    assert second.wrong_share == pytest.approx(first.wrong_share)


def test_a_dataset_that_the_shipped_model_finds_rough_is_set_right_by_its_decoys():
    """All fit worse than what the model was fitted to, and decoys worse still."""
    targets, decoys = made(200, (0.3, 0.5), 2), made(150, (0.7, 1.0), 3)
    found = rated(targets, decoys)
    assert found.refitted
    kept, lowest = found.kept(0.01)
    assert (found.scores >= lowest).sum() == kept > 190
    assert found.wrong_share < 0.05


@pytest.mark.parametrize("name", LEARNED)
def test_a_figure_counts_for_a_dataset_if_its_decoys_are_worse_in_it(name):
    """Beyond the worst the shipped model sees no difference; the fit to the decoys does."""
    at, better = evidence.FIGURES.index(name), 1 if name in SPEAK_FOR else -1
    targets, decoys = right(200), wrong(150)
    targets[1] = targets[0]
    rng, names = np.random.default_rng(6), ["0", *apart(targets)[:-1]]
    for sign, counts in ((1, True), (-1, False)):
        for rows, off in ((targets, 12.0), (decoys, 20.0)):
            steps = off if sign == 1 else 32.0 - off
            rows[:, at] = WORST[at] - better * (steps + rng.normal(size=len(rows)))
        targets[:2, at] = WORST[at] - better * np.array([12.0, 20.0])
        found = error_rates(targets, decoys, names, apart(decoys), **called_good(targets, decoys))
        assert found.refitted
        assert (found.scores[0] > found.scores[1]) == counts
        assert counts or found.scores[0] == found.scores[1]


@pytest.mark.parametrize("counts", [(30, 90), (80, 25)])
def test_a_fit_to_decoys_is_the_minimum_that_another_solver_finds(counts):
    """Each side counts one half; three samples of the rarer side hold the shipped model's weight.

    The third figure speaks against the truth, so its weight is held at 0.
    """
    rng = np.random.default_rng(4)
    sides = [rng.normal(0.6 * sign, 1.0, (n, 3)) for n, sign in zip(counts, (1, -1), strict=True)]
    for side in sides:
        side[:, 2] *= -1.0

    def loss(weights: np.ndarray) -> float:
        odds = (side @ weights[:3] + weights[3] for side in sides)
        misfit = sum(
            0.5 * np.log1p(np.exp(-s * o)).mean() for s, o in zip((1, -1), odds, strict=True)
        )
        off = (weights[0] - 1.0) ** 2 + weights[1] ** 2 + weights[2] ** 2 + 0.1 * weights[3] ** 2
        return float(misfit + 0.5 * 3.0 / min(counts) * off)

    bounds = [(0.0, None)] * 3 + [(None, None)]
    best = minimize(loss, np.ones(4), method="SLSQP", bounds=bounds, options={"ftol": 1e-14})
    found = _fit(*sides)
    assert found[2] == 0.0 == pytest.approx(best.x[2], abs=1e-9)
    np.testing.assert_allclose(found, best.x, atol=2e-3)


def test_an_object_is_scored_by_a_fit_that_saw_neither_its_targets_nor_its_decoys():
    targets, decoys = right(200), wrong(150)
    names, grids = np.array(apart(targets)), apart(targets)[::-1][: len(decoys)]
    own = np.array([fold_of(grid, FOLDS) == 1 for grid in grids])
    moved = targets.copy()
    moved[[fold_of(name, FOLDS) == 1 for name in names]] *= 1.0 + 1e-9
    scores = [
        error_rates(some, decoys, names, grids, **called_good(some, decoys)).decoy_scores
        for some in (targets, moved)
    ]
    np.testing.assert_array_equal(scores[0] == scores[1], own)


def test_of_the_good_targets_as_many_are_wrong_as_decoys_that_pass_say():
    """A fifth of the wrong pairs looks right: 20 of 100 targets, 40 of 200 decoys."""
    sure = right(100, 1)
    sure = sure[called_good(sure, sure)["good"]]
    targets = np.concatenate([sure[:20], wrong(80, 5), right(300)])
    found = rated(targets, np.concatenate([sure[20:60], wrong(160)]))
    assert found.good_wrong == pytest.approx(20, abs=4)
    assert found.good_wrong_range[0] < 20 < found.good_wrong_range[1]


Judged = tuple[records.Judgement, records.Annotation, Alignment]
OfAChair = tuple[MaterialField, StructuredLatents, Alignment, records.Annotation]

SPEAK_FOR = {"score_slat", "score_pixieverse", "score_similarity", "within_1", "within_2",
             "within_3", "margin", "clear_by", "fitness", "fitness_backward", "valid_share",
             "blocks_near", "blocks_middle", "blocks_far", "slat_within_half", "slat_within_1",
             "slat_within_15", "pixieverse_within_half", "pixieverse_within_1",
             "pixieverse_within_15"}  # fmt: skip

MODELS = {"same object": SAME_OBJECT, "right placement": PLACEMENT}


def _judged(
    field: MaterialField, latents: StructuredLatents, alignment: Alignment | None = None
) -> Judged:
    if alignment is None:
        alignment = align(field, latents, AlignParameters())
    annotation, judgement = look_up(field, latents, alignment, SampleParameters())
    return judgement, annotation, alignment


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> list[Case]:
    return made_cases(tmp_path_factory.mktemp("fresh"), 8, 4_711, 1, 5, 6, 7)


@pytest.fixture(scope="module")
def judged(cases: list[Case]) -> list[Judged]:
    return [_judged(field, latents) for field, latents, _ in cases]


def shares_right(likely: list[np.ndarray], right: list[np.ndarray]) -> list[np.floating]:
    """Hold that so many voxels of assets are right; return the shares by quarters, surest last."""
    assert len(likely) >= 5
    said, so = np.concatenate(likely), np.concatenate(right)
    assert abs(said.mean() - so.mean()) < 0.05
    order = np.argsort(said, kind="stable")
    return [so[part].mean() for part in np.array_split(order, 4)]


def test_labels_are_right_as_often_as_they_are_said_to_be(cases, judged):
    said, right = [], []
    for (_, _, truth), (judgement, annotation, _) in zip(cases, judged, strict=True):
        valid, likely = annotation.valid, annotation.confidence
        # One coin decides about all voxels of an asset whose ties differ in class.
        if judgement.ambiguity.material_share == 0:
            said.append(likely[valid])
            right.append((annotation.material == truth.material)[valid])
        assert judgement.expected_accuracy == pytest.approx(likely[valid].mean(), abs=1e-6)
        assert 0.0 < judgement.confidence < 1.0
        assert likely.dtype == np.float32 and (likely[~valid] == 0).all()
        assert ((likely[valid] > 0) & (likely[valid] < 1)).all()
    shares = shares_right(said, right)
    assert shares[0] < shares[-1] and shares[-1] > 0.97


def test_without_classes_it_is_said_how_likely_the_properties_are_right(cases, judged):
    # Of the same objects, as a source without classes has them: the same values, all of class 0.
    said, right = [], []
    for (field, latents, truth), (*_, alignment) in zip(cases, judged, strict=True):
        plain = replace(field, material=np.zeros_like(field.material), classified=False)
        judgement, annotation, _ = _judged(plain, latents, alignment)
        if judgement.ambiguity.material_share > 0:
            continue
        with np.load(truth.path) as file:
            same = np.isclose(annotation.properties, file["properties"], rtol=0.01).all(axis=1)
        said.append(annotation.confidence[annotation.valid])
        right.append(same[annotation.valid])
        assert judgement.expected_accuracy == pytest.approx(said[-1].mean(), abs=1e-6)
    shares = shares_right(said, right)
    assert shares[0] < 0.95 < shares[-1]


def test_properties_that_differ_little_are_one_label(of_a_chair):
    field, latents, alignment, annotation = of_a_chair
    plain = replace(field, material=np.zeros_like(field.material), classified=False)
    by_value = voxel_confidence(plain, latents, alignment, annotation, SampleParameters(), 0.9)
    by_class = voxel_confidence(field, latents, alignment, annotation, SampleParameters(), 0.9)
    # The chair's two classes have two sets of properties.
    np.testing.assert_array_equal(by_value, by_class)
    noise = np.random.default_rng(0).uniform(0.999, 1.001, field.properties.shape)
    rough = replace(plain, properties=(field.properties * noise).astype(np.float32))
    near = sample(rough, annotation.place, SampleParameters())
    np.testing.assert_array_equal(
        voxel_confidence(rough, latents, alignment, near, SampleParameters(), 0.9), by_value
    )


def test_rounding_in_a_store_changes_no_label_where_labels_are_said_to_hold(of_a_chair):
    field, _, _, annotation = of_a_chair
    rng = np.random.default_rng(0)
    held, changed = [], 0
    for width in [0.3] * 8 + [1e-3] * 8:
        span = rng.uniform(0.0, width, field.properties.shape) * (4.0, 1.0, 0.2)
        values = from_mapped(span + np.array([5.0, 3.0, 0.3])).astype(np.float32)
        exact = replace(field, classified=False, properties=values)
        at = replace(exact, properties=denormalize_properties(normalize_properties(values)))
        # float32 twice, in the ranges of a whole dataset, as a store and its reader do
        labels = []
        for one in (exact, at):
            own = sample(one, annotation.place, SampleParameters())
            labels.append(np.concatenate(evidence._labels_of(one, own)))
        holds = evidence.labels_hold(at, own, roundings(PIXIE_RANGES))
        held.append(holds)
        same = np.array_equal(*labels)
        changed += not same
        assert same or not holds
    assert any(held[:8])
    assert changed


def test_own_objects_pass_and_other_objects_fail(cases, judged):
    assert np.median([judgement.confidence for judgement, _, _ in judged]) > 0.9
    assert sum(judgement.verdict is Verdict.FAILED for judgement, _, _ in judged) <= 1
    for k, (field, _, truth) in enumerate(cases):
        _, latents, other = cases[(k + 3) % len(cases)]
        assert truth.name != other.name
        judgement, _, _ = _judged(field, latents)
        assert judgement.confidence < THRESHOLDS.good_confidence
        assert judgement.verdict is not Verdict.GOOD
        assert judgement.reasons


@pytest.mark.parametrize(
    ("asked", "name"),
    sorted({(asked, term.name) for asked in MODELS for term in MODELS[asked].terms}),
)
def test_a_better_figure_never_lowers_confidence(asked, name):
    model = MODELS[asked]
    assert model.names == evidence.FIGURES
    own = [term for term in model.terms if term.name == name]
    assert all(first.high == then.low for first, then in pairwise(own))
    values = np.repeat(USUAL[None], 40, axis=0)
    values[:, evidence.FIGURES.index(name)] = np.linspace(own[0].low - 0.1, own[-1].high + 0.1, 40)
    confidences = model.probability(values)
    if name not in SPEAK_FOR:
        confidences = confidences[::-1]
    assert all(before <= after for before, after in pairwise(confidences))


def test_each_question_has_figures_of_its_own():
    looked_at = {name: {term.name for term in model.terms} for name, model in MODELS.items()}
    assert looked_at["right placement"] <= set(OF_PLACEMENT)
    assert not looked_at["same object"] & set(OF_PLACEMENT)
    assert all(looked_at.values())


def test_the_voxels_curve_rises():
    assert VOXEL.names == evidence.VOXEL_FIGURES
    odds, shares = np.array(VOXEL.curve).T
    assert (np.diff(odds) > 0).all() and (np.diff(shares) >= 0).all()
    assert shares[0] >= 0 and shares[-1] <= 1


def test_a_figure_that_is_not_known_adds_nothing():
    values = USUAL.copy()
    known = PLACEMENT.probability(values)
    values[evidence.FIGURES.index("margin")] = math.nan
    assert PLACEMENT.probability(values) == known


@pytest.fixture(scope="module")
def of_a_chair() -> OfAChair:
    solid = chair()
    field, latents = field_of(solid, np.where(GRID[..., 2] < 32, 1, 3)), surface_latents(solid)
    _, annotation, alignment = _judged(field, latents)
    return field, latents, alignment, annotation


def test_any_engine_is_judged_by_the_same_figures(of_a_chair):
    field, latents, alignment, annotation = of_a_chair
    around = evidence.surroundings_of(
        field, latents, alignment, annotation, np.zeros(len(annotation.place), np.float32)
    )
    own = evidence.evidence_of(field, latents, alignment, annotation, around, 0.0)
    bare = replace(alignment, figures=None)
    measured = evidence.evidence_of(field, latents, bare, annotation, around, 0.0)
    np.testing.assert_allclose(measured, own, atol=0.05)
    assert measure_figures(field, latents, bare).score_slat > 0.9


def test_doubt_is_where_the_border_is(of_a_chair):
    field, latents, alignment, annotation = of_a_chair
    likely = voxel_confidence(field, latents, alignment, annotation, SampleParameters(), 0.9)
    height = np.abs(latents.coords[:, 2] - 31.5)
    assert likely[height < 1].mean() < likely[height > 8].mean()
    unsure = voxel_confidence(field, latents, alignment, annotation, SampleParameters(), 0.2)
    assert (unsure <= likely).all() and unsure.mean() < likely.mean()


def test_a_turned_placement_is_no_longer_sure(of_a_chair):
    field, latents, alignment, _ = of_a_chair
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    wrong = replace(alignment, transform=half_turn @ alignment.transform, figures=None)
    judgement, _, _ = _judged(field, latents, wrong)
    assert judgement.verdict is Verdict.FAILED
    assert judgement.confidence < THRESHOLDS.failed_confidence


def test_what_takes_confidence_away_is_summed_by_cause_largest_first():
    assert all(taken == 0 for taken in causes_of_doubt(USUAL).values())
    bent = USUAL.copy()
    bent[evidence.FIGURES.index("bending")] = 1.0
    assert next(iter(causes_of_doubt(bent))) == "shape"
    rng = np.random.default_rng(1)
    for _ in range(20):
        figures = USUAL * rng.uniform(0.3, 1.7, len(evidence.FIGURES))
        taken = causes_of_doubt(figures)
        # Every figure belongs to one cause, and what adds confidence makes up for nothing.
        added = SAME_OBJECT.contributions(figures)
        assert sum(taken.values()) == pytest.approx(-added[added < 0].sum())
        assert set(taken) == {"shape", "roughness"}
        assert list(taken.values()) == sorted(taken.values(), reverse=True)
