"""Error rates by decoys, on made figures of which it is known what is right."""

import numpy as np
import pytest
from scipy.special import logit

from slatprep.judge.calibration import PLACEMENT, SAME_OBJECT
from slatprep.judge.confidence import right_placements, same_objects
from slatprep.judge.decoys import FOLDS, ErrorRates, error_rates
from slatprep.judge.evidence import FIGURES
from slatprep.judge.verdict import LEAST_TARGETS, THRESHOLDS

OF_PLACEMENT = ("margin", "clear_by", "ties", "alike")


def _ends(name: str) -> tuple[float, float]:
    """Return a figure's value for usual right ones, and for the worst that the model knows."""
    model = PLACEMENT if name in OF_PLACEMENT else SAME_OBJECT
    own = [figure for figure in model.figures if figure.name == name]
    if not own:
        return 0.0, 0.0  # It counts for nothing.
    usual = next((f.usual for f in own if f.low < f.usual < f.high), own[0].usual)
    low, high = own[0].low, own[-1].high
    return usual, (low if usual - low > high - usual else high)


USUAL, WORST = np.array([_ends(name) for name in FIGURES]).T


def made(count: int, towards: tuple[float, float], seed: int) -> np.ndarray:
    """Make figures of alignments that lie by so much between usual and worst."""
    rng = np.random.default_rng(seed)
    part = rng.uniform(*towards, (count, 1)) + rng.normal(0, 0.05, (count, len(FIGURES)))
    figures = USUAL + part * (WORST - USUAL)
    for name in OF_PLACEMENT:
        figures[:, FIGURES.index(name)] = USUAL[FIGURES.index(name)]
    return figures


def right(count: int, seed: int = 0) -> np.ndarray:
    return made(count, (-0.1, 0.25), seed)


def wrong(count: int, seed: int = 1) -> np.ndarray:
    return made(count, (0.2, 1.0), seed)


def rated(targets: np.ndarray, decoys: np.ndarray) -> ErrorRates:
    folds = (np.arange(len(targets)) % FOLDS, np.arange(len(decoys)) % FOLDS)
    return error_rates(targets, decoys, *folds, **called_good(targets, decoys))


def called_good(targets: np.ndarray, decoys: np.ndarray) -> dict[str, np.ndarray]:
    return {
        name: same_objects(figures) * right_placements(figures) >= THRESHOLDS.good_confidence
        for name, figures in (("good", targets), ("good_decoys", decoys))
    }


@pytest.mark.parametrize("mixed", [0, 20, 80, 160])
def test_the_stated_rates_are_the_true_ones(mixed: int) -> None:
    count = 400
    truly = np.arange(count) < mixed
    targets = np.concatenate([wrong(mixed, 5), right(count - mixed)])
    found = rated(targets, wrong(200))
    low, high = found.wrong_share_range
    assert found.refitted
    assert low <= truly.mean() <= high
    assert abs(found.wrong_share - truly.mean()) < 0.05
    kept = found.rates <= 0.01
    assert truly[kept].mean() <= 0.02
    assert kept[~truly].mean() > 0.7
    # Probabilities of single assets add up to the number of wrong ones.
    assert abs(found.errors.sum() - mixed) < 0.05 * count
    sure = SAME_OBJECT.probability(targets) * PLACEMENT.probability(targets) >= 0.9
    least, most = found.good_wrong_range
    assert found.good == sure.sum()
    assert np.floor(least) <= (sure & truly).sum() <= np.ceil(most)


def test_of_shuffled_pairs_hardly_any_is_kept() -> None:
    found = rated(wrong(300, 7), wrong(200))
    assert found.wrong_share > 0.9
    assert found.kept(0.01)[0] <= 3
    assert found.errors.mean() > 0.9


def test_where_decoys_fit_as_well_nothing_can_be_told() -> None:
    """A dataset of balls: any SLAT is as good as the own one."""
    found = rated(right(200), right(100, 9))
    assert found.wrong_share > 0.8
    assert found.kept(0.01)[0] <= 4
    assert found.good > 0 and found.good_wrong > 0.5 * found.good


@pytest.mark.parametrize("count", [1, 10, LEAST_TARGETS - 1])
def test_few_assets_are_judged_by_the_shipped_model(count: int) -> None:
    targets = right(count)
    found = rated(targets, wrong(count))
    assert not found.refitted
    np.testing.assert_allclose(found.scores, logit(SAME_OBJECT.probability(targets)))
    assert 0.0 <= found.wrong_share_range[0] <= found.wrong_share_range[1] <= 1.0


def test_errors_never_rise_with_the_score() -> None:
    found = rated(np.concatenate([wrong(60, 3), right(240)]), wrong(200))
    order = np.argsort(found.scores)
    assert (np.diff(found.errors[order]) <= 1e-12).all()
    assert (np.diff(found.rates[order]) <= 1e-12).all()
    assert ((found.errors >= 0) & (found.errors <= 1)).all()


def test_the_order_of_assets_does_not_matter() -> None:
    targets, decoys = np.concatenate([wrong(40, 3), right(160)]), wrong(100)
    folds = np.arange(len(targets)) % FOLDS
    rest = (np.arange(100) % FOLDS,)
    good = called_good(targets, decoys)
    first = error_rates(targets, decoys, folds, *rest, **good)
    order = np.random.default_rng(0).permutation(len(targets))
    second = error_rates(
        targets[order], decoys, folds[order], *rest, **good | {"good": good["good"][order]}
    )
    np.testing.assert_allclose(second.errors, first.errors[order], atol=1e-6)
    assert second.wrong_share == pytest.approx(first.wrong_share)


def test_a_dataset_that_the_shipped_model_finds_rough_is_set_right_by_its_decoys() -> None:
    """All fit worse than what the model was fitted to, and decoys worse still."""
    targets, decoys = made(200, (0.3, 0.5), 2), made(150, (0.7, 1.0), 3)
    found = rated(targets, decoys)
    assert found.refitted
    assert found.kept(0.01)[0] > 190
    assert found.wrong_share < 0.05
