"""What witnesses say: against plain loops, scipy's Gaussians, and by hand; and heard as a whole."""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal
from support.shapes import GRID, aligned, chair, field_of, latents_of

from slatprep.geometry.frames import make_transform
from slatprep.geometry.voxels import boundary, voxels_of
from slatprep.judge.witness import (
    BLOCK,
    DECISIVE,
    FOLDS,
    HARMLESS,
    REACH,
    LatentEvidence,
    LatentModel,
    Reliability,
    choice_of,
    fit_models,
    fold_of,
    moments_of,
    reliability_of,
    weigh,
)
from slatprep.parameters import SampleParameters
from slatprep.records import UNANNOTATED, MaterialField, StructuredLatents

Array = NDArray[np.float64]


def ids_of(part: int, number: int) -> list[str]:
    """Return so many ids of objects that belong to a part."""
    return [name for name in map(str, range(99)) if fold_of(name) == part][:number]


def a_model() -> LatentModel:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(8, 8))
    shares = np.array([0.3, 0.1, 0.2, 0.0, 0.25, 0.1, 0.05])
    return LatentModel(rng.normal(size=(7, 8)), root @ root.T + np.eye(8), shares)


def test_moments_of_an_asset_have_the_weight_of_one_asset():
    rng = np.random.default_rng(0)
    for known in (1, 2, 30):
        feats = rng.normal(size=(known + 3, 8)).astype(np.float32)
        material = rng.integers(0, 7, known + 3).astype(np.uint8)
        material[-3:] = (7, UNANNOTATED, UNANNOTATED)
        moments = moments_of(feats, material)
        assert moments.weight.sum() == pytest.approx(1.0)
        z = feats[:known].astype(np.float64)
        np.testing.assert_allclose(moments.total.sum(axis=0), z.mean(axis=0))
        np.testing.assert_allclose(moments.products, sum(np.outer(one, one) for one in z) / known)
    nothing = moments_of(feats, np.full(33, UNANNOTATED, dtype=np.uint8))
    assert not nothing.weight.any() and not nothing.products.any()


def test_a_model_has_the_moments_of_the_classes_about_their_means():
    """In two passes over weighted voxels. Some classes have less than one asset's weight in all."""
    rng = np.random.default_rng(1)
    (part, *others) = range(FOLDS)
    samples, moments = [], []
    for name in (ids_of(other, 1)[0] for other in others):
        known = int(rng.integers(20, 60))
        material = rng.choice([0, 2, 5], known, p=[0.7, 0.1, 0.2]).astype(np.uint8)
        feats = rng.normal(size=(known, 8)) * [0.2, 1, 3, 1, 1, 1, 5, 0]
        feats[:, 1:] += material[:, None]
        feats[:, 7] = 4.0  # the same everywhere
        feats = feats.astype(np.float32)
        samples.append((feats.astype(np.float64), material, np.full(known, 1.0 / known)))
        moments.append((name, moments_of(feats, material)))
    strange = moments_of(feats + 9, material)
    models = fit_models([*moments, (ids_of(part, 1)[0], strange)])
    assert models is not None
    z, material, weight = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    mean = np.average(z, axis=0, weights=weight)
    within, means, shares = np.zeros((8, 8)), np.tile(mean, (7, 1)), np.zeros(7)
    for label in (0, 2, 5):
        own, w = z[material == label], weight[material == label]
        about = own - np.average(own, axis=0, weights=w)
        within += (w[:, None] * about).T @ about / len(samples)
        means[label] = (w @ own + mean) / (w.sum() + 1.0)  # one asset's worth of the common mean
        shares[label] = w.sum() / len(samples)
    assert shares[2] * len(samples) < 1.0
    variance = np.average((z - mean) ** 2, axis=0, weights=weight)
    variance[7] = 1.0
    np.testing.assert_allclose(models[part].means, means, rtol=1e-9)
    np.testing.assert_allclose(models[part].shares, shares, atol=1e-12)
    covariance = np.linalg.inv(models[part].precision)
    np.testing.assert_allclose(covariance, within + 1e-3 * np.diag(variance), rtol=1e-6, atol=1e-9)


def test_two_classes_in_two_parts_are_enough_for_models_and_less_is_not():
    feats = np.random.default_rng(2).normal(size=(40, 8)).astype(np.float32)
    two, one = np.repeat([1, 4], 20).astype(np.uint8), np.full(40, 4, dtype=np.uint8)
    here, there = ids_of(0, 1), ids_of(1, 1)
    assert fit_models((name, moments_of(feats, two)) for name in here + there) is not None
    assert fit_models((name, moments_of(feats, two)) for name in ids_of(0, 4)) is None
    assert fit_models([]) is None
    differ = [(here[0], moments_of(feats, two)), (there[0], moments_of(feats, one))]
    assert fit_models(differ) is None


def test_likelihoods_and_gain_are_those_of_gaussians():
    model = a_model()
    rng = np.random.default_rng(3)
    feats = rng.normal(size=(50, 8)).astype(np.float32)
    material = rng.choice([0, 1, 2, 4, 5, 6], 50).astype(np.uint8)
    material[::7] = UNANNOTATED
    covariance = np.linalg.inv(model.precision)
    logs = np.stack([multivariate_normal.logpdf(feats, m, covariance) for m in model.means], 1)
    likely = model.log_likelihood(feats)
    np.testing.assert_allclose(likely - likely[:, :1], logs - logs[:, :1], atol=1e-9)
    known = np.flatnonzero(material != UNANNOTATED)
    chance = np.log(np.exp(logs[known]) @ model.shares)
    expected = (logs[known, material[known]] - chance).mean()
    assert model.gain(feats, material) == pytest.approx(expected)
    assert model.gain(feats, np.full(50, UNANNOTATED, dtype=np.uint8)) == 0.0


LOW, HIGH = np.array([22, 18, 12]), np.array([42, 46, 52])  # of a box about the cube's centre
TOP = 40  # from here on nothing of the box is annotated


def box(classes: str) -> tuple[MaterialField, StructuredLatents, NDArray[np.uint8]]:
    """Return a box with classes by level or by octant, its latents, and their labels."""
    solid = ((GRID >= LOW) & (GRID < HIGH)).all(axis=-1)
    upper = GRID >= [30, 28, 26]
    by = {"levels": upper[..., 2], "octants": upper @ [1, 2, 4] % 7}[classes]
    material = by.astype(np.uint8)
    coords = voxels_of(boundary(solid))
    feats = np.random.default_rng(4).normal(size=(len(coords), 8)).astype(np.float32)
    labels = material[tuple(coords.T.astype(int))]
    labels[(coords[:, 2] >= TOP) | (coords[:, 0] % 5 == 0)] = UNANNOTATED
    annotated = solid & (GRID[..., 2] < TOP)
    field = field_of(annotated, material)
    return field, StructuredLatents(latents_of(coords).coords, feats), labels


def class_at(field: MaterialField) -> dict[tuple[int, ...], int]:
    return dict(zip(map(tuple, field.voxels.tolist()), field.material.tolist(), strict=True))


@pytest.mark.parametrize(("classes", "axes"), [("levels", [0, 1]), ("octants", [0, 1, 2])])
def test_labels_are_compared_with_those_half_a_turn_away_block_by_block(classes, axes):
    """About the box's three axes, the shortest first. A place above the top looks down to it."""
    field, latents, labels = box(classes)
    model, there = a_model(), class_at(field)
    likely = model.log_likelihood(latents.feats)
    expected = []
    for axis in axes:
        sums: dict[tuple[int, ...], float] = defaultdict(float)
        differing, compared = set(), 0
        rows = zip(latents.coords.astype(int).tolist(), labels.tolist(), strict=True)
        for row, (voxel, own) in enumerate(rows):
            turned = [c if k == axis else 63 - c for k, c in enumerate(voxel)]
            if own == UNANNOTATED or turned[2] - (TOP - 1) > REACH:
                continue
            turned[2] = min(turned[2], TOP - 1)
            other = there[tuple(turned)]
            block = tuple(c // BLOCK for c in voxel)
            sums[block] += likely[row, own] - likely[row, other]
            compared += 1
            if own != other:
                differing.add(block)
        assert compared
        expected.append(sorted(sums[block] for block in differing))
    evidence = weigh(field, latents, aligned(), labels, model, SampleParameters())
    assert len(evidence.against) == len(expected)
    for found, wanted in zip(evidence.against, expected, strict=True):
        np.testing.assert_allclose(np.sort(found), wanted, rtol=1e-9, atol=1e-9)


def test_of_placements_the_voxels_count_that_have_a_class_under_all():
    field, latents, labels = box("octants")
    model, there = a_model(), class_at(field)
    likely = model.log_likelihood(latents.feats)
    over = make_transform(Rotation.from_euler("x", 180, degrees=True).as_matrix())
    parameters = SampleParameters(method="nearest", max_distance=2.0)
    found = weigh(field, latents, aligned(np.eye(4), over), labels, model, parameters)
    support, differing, voxels = np.zeros(2), 0, 0
    for row, (x, y, z) in enumerate(latents.coords.astype(int).tolist()):
        if max(z, 63 - z) > TOP - 1 + 2:
            continue
        one = there[x, y, min(z, TOP - 1)]
        two = there[x, 63 - y, min(63 - z, TOP - 1)]
        support += likely[row, [one, two]]
        differing += one != two
        voxels += 1
    assert 0 < differing < voxels == found.voxels
    np.testing.assert_allclose(found.support, support)
    np.testing.assert_array_equal(found.differing, [[0, differing], [differing, 0]])
    assert found.gain == model.gain(latents.feats, labels)


def test_what_has_no_label_or_no_axes_is_not_compared():
    field, latents, labels = box("octants")
    none = np.full_like(labels, UNANNOTATED)
    parameters, model = SampleParameters(), a_model()
    assert weigh(field, latents, aligned(), none, model, parameters).against == ()
    pair = np.zeros((64, 64, 64), dtype=bool)
    pair[30:32, 30, 30] = True
    field = field_of(pair, GRID[..., 0] % 2)
    for number, turns in ((1, 0), (2, 2)):  # Two voxels change places about two of the axes.
        some = StructuredLatents(field.voxels[:number], latents.feats[:number])
        found = weigh(field, some, aligned(), field.material[:number], model, parameters)
        assert len(found.against) == turns


def test_a_turn_that_changes_few_classes_is_left_out():
    """A stripe of the box has the other class; of a fifth of its voxels, or of few."""
    solid = ((GRID >= LOW) & (GRID < HIGH)).all(axis=-1)
    coords = voxels_of(boundary(solid))
    latents = StructuredLatents(coords, np.zeros((len(coords), 8), dtype=np.float32))
    for end, turns in ((LOW[2] + 1, 2), (LOW[2], 0)):
        rim = (GRID[..., 2] < end) | (abs(GRID - [LOW[0], LOW[1], 30]) < 1).all(axis=-1)
        field = field_of(solid, rim)
        labels = rim[tuple(coords.T.astype(int))].astype(np.uint8)
        turned = (np.where(axis, coords, 63 - coords.astype(int)) for axis in np.eye(3))
        shares = [np.mean(labels != rim[tuple(voxels.T)]) for voxels in turned]
        assert sum(share > HARMLESS for share in shares) == turns
        found = weigh(field, latents, aligned(), labels, a_model(), SampleParameters())
        assert len(found.against) == turns


def compared(*blocks: list[float], gain: float = 1.0) -> LatentEvidence:
    """Return what latents of an asset say that is compared about so many axes."""
    against = tuple(np.array(some) for some in blocks)
    return LatentEvidence(np.zeros(1), np.zeros((1, 1), np.int64), 9, gain, against)


def apart(evidence: list[LatentEvidence]) -> list[tuple[str, LatentEvidence]]:
    """Return what assets of an object each say."""
    return [(str(number), one) for number, one in enumerate(evidence)]


HALF = 0.2 * 11 / 12 + 0.4
"""Of shares p and 1 - p with log odds f and -f, the slope is 0 where
sigma(f) = (2 p - 1) target + 1 - p, with Platt's target of n that agree, (n + 1) / (n + 2)."""

AGREES, DIFFERS = compared([0.3, 0.2], [-0.5, 0.6]), compared([5.0], [-0.1])

HEARD = [
    # All agree, and the log odds of Platt's target are log(n + 1).
    ([compared([0.25])] * 20, 20, 20, np.log(21.0) / 0.25),
    ([compared([2.5])] * 20, 20, 20, np.log(21.0) / 2.5),
    # Blocks disagree; an asset of many of them counts as much as another.
    ([compared([3.0] * 3 * k + [-3.0] * 2 * k) for k in (1,) * 5 + (7,) * 5], 10, 10,
     np.log(HALF / (1 - HALF)) / 3.0),
    # Its labels have to be likelier than those of every turn. Of heads as many were rarer than
    # one in a thousand: 1 of 1,024 and 17 of 65,536 are, 2 and 137 are not.
    ([AGREES] * 15 + [DIFFERS, compared()], 16, 15, None),
    ([AGREES, DIFFERS, compared([1.0, -1.0])], 3, 1, 0.0),
    ([compared([1.0])] * 10, 10, 10, None),
    ([compared([1.0])] * 9, 9, 9, 0.0),
    ([compared([1.0])] * 15 + [compared([-0.1])], 16, 15, None),
    ([compared([1.0])] * 14 + [compared([-0.1])] * 2, 16, 14, 0.0),
    # One contradicts more than all agree.
    ([compared([1.0])] * 30 + [compared([-99.0])], 31, 30, 0.0),
    ([], 0, 0, 0.0),
    ([compared()] * 20, 0, 0, 0.0),
]  # fmt: skip
"""What assets say, how many are compared and agree, and the factor: None for any above 0."""


@pytest.mark.parametrize(("evidence", "witnesses", "agreeing", "factor"), HEARD)
def test_a_factor_makes_log_odds_where_witnesses_agree(evidence, witnesses, agreeing, factor):
    found = reliability_of(apart(evidence))
    assert (found.witnesses, found.agreeing) == (witnesses, agreeing)
    assert (
        found.factor > 0.0 if factor is None else found.factor == pytest.approx(factor, 1e-6, 0.0)
    )
    assert found.least_gain == -np.inf if factor == 0.0 else np.isfinite(found.least_gain)


def test_assets_of_one_object_are_one_witness():
    """They share their latents or their labels, and agree or differ together."""
    same = [(f"{k % 3}", compared([1.0])) for k in range(36)]
    assert (found := reliability_of(same)).factor == 0.0 and found.witnesses == 3
    found = reliability_of([(str(k), compared([0.25])) for k in range(20) for _ in range(k + 1)])
    assert (found.witnesses, found.agreeing) == (20, 20)
    assert found.factor == pytest.approx(np.log(21.0) / 0.25)
    # An object agrees if most of its assets do.
    duck, cup = [AGREES, DIFFERS], [AGREES, AGREES, DIFFERS]
    found = reliability_of([*(("duck", one) for one in duck), *(("cup", one) for one in cup)])
    assert (found.witnesses, found.agreeing) == (2, 1)


def test_a_model_counts_each_object_once():
    rng = np.random.default_rng(5)
    one, two = (rng.normal(size=(50, 8)).astype(np.float32) for _ in range(2))
    halves = np.repeat([0, 1], 25).astype(np.uint8)
    first, second = (moments_of(feats, halves) for feats in (one, two))
    here, there, *_ = (ids_of(fold, 1)[0] for fold in range(3))
    once = fit_models([(here, first), (there, second)])
    often = fit_models([(here, first), *[(there, second)] * 7])
    for before, after in zip(once, often, strict=True):
        np.testing.assert_allclose(after.means, before.means)
        np.testing.assert_allclose(after.precision, before.precision)


def test_the_least_gain_is_that_of_one_asset_in_two_hundred_and_never_positive():
    gains = np.arange(201.0) - 5.0
    evidence = [compared([1.0], gain=gain) for gain in gains]
    assert reliability_of(apart(evidence)).least_gain == pytest.approx(-4.0)
    assert reliability_of(apart([compared([1.0], gain=5.0)] * 20)).least_gain == 0.0


SURE = Reliability(200, 200, 0.5, 0.0)
JUST = Reliability(18, 18, 0.5, 0.0)
"""By the rule of succession it is as sure as `DECISIVE`."""

TWO = [[0, 300], [300, 0]]
SAME, OTHER = 10, 400  # one voxel in a hundred, and more
LAST_TWO = [[0, OTHER, OTHER], [OTHER, 0, SAME], [OTHER, SAME, 0]]
FIRST_TWO = [[0, SAME, OTHER], [SAME, 0, OTHER], [OTHER, OTHER, 0]]
FOUR = [[0, 200, 300, 400], [200, 0, 250, 350], [300, 250, 0, 150], [400, 350, 150, 0]]


def odds(*logs: float) -> float:
    """Return how likely the first is of some log odds, half of the log likelihoods."""
    return float(np.exp(logs[0]) / np.exp(logs).sum())


CHOICES = [
    # Ten more in log likelihood, each worth half: log odds of five.
    ([-40.0, -30.0], TWO, SURE, (1, odds(5.0, 0.0), 10.0, 300)),
    ([-30.0, -40.0], TWO, SURE, (0, odds(5.0, 0.0), 10.0, 300)),
    # Log odds of 2.9 are a probability of 0.948, of 3.0 one of 0.953.
    ([0.0, 5.8], TWO, SURE, None),
    ([0.0, 6.0], TWO, SURE, (1, odds(3.0, 0.0), 6.0, 300)),
    # No choice is surer than witnesses are: 19 of 20 is 20 / 22, and 37 of 37 is 38 / 39.
    ([0.0, 500.0], TWO, Reliability(20, 19, 0.5, 0.0), None),
    ([0.0, 500.0], TWO, Reliability(37, 37, 0.5, 0.0), (1, 38 / 39, 500.0, 300)),
    ([0.0, 500.0], TWO, JUST, (1, DECISIVE, 500.0, 300)),
    # Placements of the same labels share what is likely.
    ([0.0, 6.0, 5.5], LAST_TWO, SURE, (1, 1 - odds(0.0, 3.0, 2.75), 6.0, OTHER)),
    # The one the asset has stands where it has the labels of the likeliest.
    ([5.0, 6.0, -2.0], FIRST_TWO, SURE, (0, 1 - odds(-1.0, 2.5, 3.0), 8.0, OTHER)),
    # The rival is the likeliest of other labels.
    ([-9.0, -4.0, 5.0, -7.0], FOUR, SURE, (2, odds(2.5, -2.0, -3.5, -4.5), 9.0, 250)),
    # Latents that are not used, and labels that are the same, choose nothing.
    ([0.0, 500.0], TWO, Reliability(200, 120, 0.0, -np.inf), None),
    ([0.0, 500.0], [[0, SAME], [SAME, 0]], SURE, None),
    ([0.0, 500.0], [[0, 11], [11, 0]], SURE, (1, 201 / 202, 500.0, 11)),
]
"""Log likelihoods of placements, in how many of 1,000 voxels they differ, the witnesses, and what
is chosen: which, with what probability, what in log likelihood and voxels decides it."""


@pytest.mark.parametrize(("support", "differing", "reliability", "expected"), CHOICES)
def test_the_likeliest_placement_is_taken_if_decisive(support, differing, reliability, expected):
    tied = LatentEvidence(np.array(support), np.array(differing), 1000, 1.0, ())
    chosen = choice_of(tied, reliability)
    assert (chosen is None) == (expected is None)
    if chosen is not None:
        found = chosen[1]
        told = chosen[0], found.probability, found.evidence, found.voxels
        assert told == pytest.approx(expected)
        assert (found.witnesses, found.agreeing) == (reliability.witnesses, reliability.agreeing)


def test_nothing_compared_chooses_nothing():
    nothing = LatentEvidence(np.array([0.0, 500.0]), np.zeros((2, 2), np.int64), 0, 1.0, ())
    assert choice_of(nothing, SURE) is None


BOX = np.zeros((64, 64, 64), dtype=bool)
BOX[16:48, 16:48, 12:52] = True
SOLIDS = chair(), BOX
SHELLS = [voxels_of(boundary(solid)) for solid in SOLIDS]

CODES = np.linalg.qr(np.random.default_rng(7).normal(size=(8, 8)))[0]

Latents = Callable[[np.random.Generator, np.ndarray], np.ndarray]


def telling(rng: np.random.Generator, material: np.ndarray) -> np.ndarray:
    """Latents that carry the class, and noise that an object's voxels share."""
    return CODES[material] + 0.3 * rng.normal(size=8) + rng.normal(size=(len(material), 8))


def noise(rng: np.random.Generator, material: np.ndarray) -> np.ndarray:
    return rng.normal(size=(len(material), 8))


def shuffled(rng: np.random.Generator, material: np.ndarray) -> np.ndarray:
    """Latents that know the classes of an object, and not where they are."""
    return rng.permutation(telling(rng, material))


def of_object(rng: np.random.Generator, material: np.ndarray) -> np.ndarray:
    """Latents that an object's voxels have in common."""
    return 2 * rng.normal(size=8) + rng.normal(size=(len(material), 8))


class Asset:
    """A box, or a chair, of two classes that part at a height of its own."""

    def __init__(self, number: int, latents: Latents, boxy: bool = False) -> None:
        rng = np.random.default_rng([number, 77])
        solid, coords = SOLIDS[boxy], SHELLS[boxy]
        low, high = rng.choice(7, 2, replace=False)
        cut = rng.integers(22, 30)
        classes = np.where(GRID[..., 2] < cut, low, high).astype(np.uint8)
        self.object_id = f"object {number}"
        self.field: MaterialField = field_of(solid, classes)
        self.material = classes[tuple(coords.T.astype(int))]
        feats = latents(rng, self.material).astype(np.float32)
        self.latents = StructuredLatents(latents_of(coords).coords, feats)

    def evidence(self, models: list[LatentModel], *tied: np.ndarray) -> LatentEvidence:
        given = self.field, self.latents, aligned(*tied), self.material
        return weigh(*given, models[fold_of(self.object_id)], SampleParameters())


@cache
def models_of(latents: Latents) -> tuple[list[LatentModel], Reliability]:
    assets = [Asset(number, latents) for number in range(40)]
    models = fit_models((a.object_id, moments_of(a.latents.feats, a.material)) for a in assets)
    assert models is not None
    return models, reliability_of((asset.object_id, asset.evidence(models)) for asset in assets)


UPSIDE_DOWN = make_transform(Rotation.from_euler("x", 180, degrees=True).as_matrix())


def test_latents_that_know_classes_choose_the_right_one_of_two_placements():
    models, reliability = models_of(telling)
    assert reliability.agreeing == reliability.witnesses == 40
    for number in range(100, 120):
        box = Asset(number, telling, boxy=True)
        right_first = choice_of(box.evidence(models, np.eye(4), UPSIDE_DOWN), reliability)
        wrong_first = choice_of(box.evidence(models, UPSIDE_DOWN, np.eye(4)), reliability)
        assert right_first is not None and wrong_first is not None
        assert (right_first[0], wrong_first[0]) == (0, 1)
        choice = wrong_first[1]
        assert choice.probability >= DECISIVE
        assert choice.evidence > 0
        box_of = {tuple(c): m for c, m in zip(box.latents.coords, box.material, strict=True)}
        turned = [box_of[(x, 63 - y, 63 - z)] for x, y, z in box.latents.coords.astype(int)]
        assert choice.voxels == np.count_nonzero(np.array(turned) != box.material)


def test_latents_leave_ties_open_that_change_properties_within_a_class():
    """Of three placements one is upside down, and one has the same classes, from x to -x."""
    models, reliability = models_of(telling)
    sideways = np.diag([-1.0, -1.0, 1.0, 1.0])
    for number, changes in [(100, False), (101, True)]:
        box = Asset(number, telling, boxy=True)
        left = box.field.voxels[:, :1] < 32
        factors = np.where(left, 1.0, (3.0 if changes else 1.9, 1.0, 1.0))
        properties = (box.field.properties * factors).astype(np.float32)
        box.field = replace(box.field, properties=properties)
        choice = choice_of(box.evidence(models, np.eye(4), UPSIDE_DOWN, sideways), reliability)
        assert (choice is None) is changes


@pytest.mark.parametrize("latents", [noise, shuffled, of_object])
def test_latents_that_know_nothing_of_places_settle_and_contradict_nothing(latents):
    models, reliability = models_of(latents)
    assert reliability.factor == 0.0
    for number in range(100, 110):
        evidence = Asset(number, latents, boxy=True).evidence(models, np.eye(4), UPSIDE_DOWN)
        assert choice_of(evidence, reliability) is None
        assert not evidence.gain < reliability.least_gain


def test_labels_of_another_object_are_contradicted_and_true_ones_are_not():
    models, reliability = models_of(telling)
    for number in range(100, 130):
        asset = Asset(number, telling)
        assert not asset.evidence(models).gain < reliability.least_gain
        asset.material = (asset.material + 1) % 7
        assert asset.evidence(models).gain < reliability.least_gain
