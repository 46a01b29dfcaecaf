"""A mirrored annotation is told from its object, unless the object is its own mirror image."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import affine_transform
from scipy.spatial.transform import Rotation
from support.shapes import GRID, chair, field_of, judged, surface_latents

from slatprep.align import align
from slatprep.align.surface import surface_of
from slatprep.judge import THRESHOLDS
from slatprep.parameters import AlignParameters
from slatprep.records import Verdict

DEFAULT = AlignParameters()
LIMIT = THRESHOLDS.good_mirrored


def gain(solid: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    found = align(field_of(solid), surface_latents(other), DEFAULT)
    return found.figures.mirrored


def turned(solid: NDArray[np.bool_], seed: int) -> NDArray[np.bool_]:
    """Return a solid in any rotation about the cube's centre."""
    turn = Rotation.random(random_state=seed).as_matrix()
    middle = np.full(3, 31.5)
    at = affine_transform(solid.astype(float), turn, middle - turn @ middle, order=1)
    return at > 0.5


def bitten(solid: NDArray[np.bool_], at: tuple[int, int, int]) -> NDArray[np.bool_]:
    return solid & (((GRID - np.array(at)) ** 2).sum(axis=-1) > 40)


def table() -> NDArray[np.bool_]:
    """A solid that is its own mirror image in x, and in nothing else."""
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[10:54, 16:46, 40:46] = True
    solid[14:20, 20:26, 16:40] = solid[44:50, 20:26, 16:40] = True
    solid[28:36, 40:44, 16:40] = True
    return solid


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_surface_of_a_mirrored_set_is_the_mirrored_surface(axis):
    solid = np.moveaxis(chair(), axis, 0)
    here, there = surface_of(solid).mirrored(), surface_of(solid[::-1])
    np.testing.assert_array_equal(here.distance, there.distance)
    np.testing.assert_allclose(here.origin, there.origin)
    for ours, theirs in ((here.points, there.points), (here.boundary, there.boundary)):
        assert {tuple(row) for row in ours.tolist()} == {tuple(row) for row in theirs.tolist()}


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_a_mirrored_annotation_is_told_in_any_rotation(seed):
    solid, mirrored = bitten(chair(), (30, 24, 28)), chair()[::-1]
    other = mirrored if seed is None else turned(mirrored, seed)
    assert gain(solid, other) > 2 * LIMIT


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_an_annotation_that_is_not_mirrored_is_not_told_to_be(seed):
    solid, other = bitten(chair(), (30, 24, 28)), chair()
    found = gain(solid, other if seed is None else turned(other, seed))
    assert not found > 0.0


def test_an_object_that_is_its_own_mirror_image_is_not_told_to_be_mirrored():
    """Bites on both sides, so that neither fits so well that no mirror is tried."""
    for at in ((14, 20, 43), (50, 40, 43)):
        found = gain(bitten(table(), at), table()[:, :, ::-1])
        assert abs(found) < LIMIT


def test_what_fits_too_well_is_not_tried():
    assert np.isnan(gain(chair(), chair()))


def test_a_mirrored_annotation_is_not_good_and_is_told_as_what_it_is():
    """Nearly all of the labels are right: the solid is a mirror image but for a small fin."""
    solid = table()
    solid[44:50, 26:32, 16:40] = True
    field, latents = field_of(solid), surface_latents(solid[::-1])
    found = align(field, latents, DEFAULT)
    judgement = judged(field, latents, found)
    assert judgement.verdict is not Verdict.GOOD
    assert any("mirror image of its object" in reason for reason in judgement.reasons)
