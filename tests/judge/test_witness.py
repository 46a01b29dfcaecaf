"""Latents as witnesses: heard where they know of classes, silent where they do not."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.shapes import GRID, chair, field_of, latents_of

from slatprep.geometry.frames import make_transform
from slatprep.geometry.voxels import boundary, voxels_of
from slatprep.judge.witness import (
    DECISIVE,
    FOLDS,
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
from slatprep.records import (
    Alignment,
    Engine,
    MaterialField,
    Model,
    Placement,
    Quality,
    Search,
    StructuredLatents,
)

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


def aligned(transform: np.ndarray, *others: np.ndarray) -> Alignment:
    return Alignment(
        transform,
        Engine.FIELD,
        Model.RIGID,
        Search.EULER64,
        Quality(1, 0, 1, 0, 1, 1),
        placements=tuple(Placement(other, 1.0, 9.0) for other in others),
    )


class Asset:
    """A box, or a chair, of two classes that part at a height of its own."""

    def __init__(self, number: int, latents: Latents, boxy: bool = False) -> None:
        rng = np.random.default_rng([number, 77])
        solid = chair()
        if boxy:
            solid = np.zeros((64, 64, 64), dtype=bool)
            solid[16:48, 16:48, 12:52] = True
        low, high = rng.choice(7, 2, replace=False)
        cut = rng.integers(22, 30)
        classes = np.where(GRID[..., 2] < cut, low, high).astype(np.uint8)
        coords = voxels_of(boundary(solid))
        self.object_id = f"object {number}"
        self.field: MaterialField = field_of(solid, classes)
        self.material = classes[tuple(coords.T.astype(int))]
        feats = latents(rng, self.material).astype(np.float32)
        self.latents = StructuredLatents(latents_of(coords).coords, feats)

    def evidence(self, models: list[LatentModel], *tied: np.ndarray) -> LatentEvidence:
        first = aligned(*(tied or (np.eye(4),)))
        model = models[fold_of(self.object_id)]
        return weigh(self.field, self.latents, first, self.material, model, SampleParameters())


def models_of(latents: Latents) -> tuple[list[LatentModel], Reliability]:
    assets = [Asset(number, latents) for number in range(40)]
    models = fit_models((a.object_id, moments_of(a.latents.feats, a.material)) for a in assets)
    assert models is not None
    return models, reliability_of([asset.evidence(models) for asset in assets])


UPSIDE_DOWN = make_transform(Rotation.from_euler("x", 180, degrees=True).as_matrix())


def test_latents_that_know_classes_choose_the_right_one_of_two_placements() -> None:
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


@pytest.mark.parametrize("latents", [noise, shuffled, of_object])
def test_latents_that_know_nothing_of_places_settle_and_contradict_nothing(
    latents: Latents,
) -> None:
    models, reliability = models_of(latents)
    assert reliability.factor == 0.0
    for number in range(100, 110):
        evidence = Asset(number, latents, boxy=True).evidence(models, np.eye(4), UPSIDE_DOWN)
        assert choice_of(evidence, reliability) is None
        assert not evidence.gain < reliability.least_gain


def test_labels_of_another_object_are_contradicted_and_true_ones_are_not() -> None:
    models, reliability = models_of(telling)
    for number in range(100, 130):
        asset = Asset(number, telling)
        assert not asset.evidence(models).gain < reliability.least_gain
        asset.material = (asset.material + 1) % 7
        assert asset.evidence(models).gain < reliability.least_gain


def test_an_object_is_never_heard_by_a_model_that_has_seen_it() -> None:
    assets = [Asset(number, telling) for number in range(30)]
    moments = [(a.object_id, moments_of(a.latents.feats, a.material)) for a in assets]
    models = fit_models(moments)
    strange = moments_of(assets[3].latents.feats + 50, assets[3].material)
    moments[3] = (assets[3].object_id, strange)
    again = fit_models(moments)
    assert models is not None and again is not None
    same = [np.array_equal(a.means, b.means) for a, b in zip(models, again, strict=True)]
    assert [fold for fold in range(FOLDS) if same[fold]] == [fold_of(assets[3].object_id)]
