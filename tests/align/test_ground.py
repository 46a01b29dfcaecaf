"""What a SLAT does not show: a slab of ground, and that its annotation is mirrored."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, map_coordinates
from scipy.spatial.transform import Rotation
from support.shapes import GRID, chair, field_of, judged, surface_latents

from slatprep import records
from slatprep.align import align
from slatprep.align import field as engine
from slatprep.align.ground import find_layers, gain, relative_width
from slatprep.align.mirror import mirror_gain
from slatprep.align.pair import Pair
from slatprep.align.pose import Similarity
from slatprep.align.quality import measure_quality
from slatprep.align.settle import refit, take
from slatprep.align.surface import surface_of
from slatprep.geometry.frames import displacement, make_transform, split_transform
from slatprep.geometry.voxels import boundary, voxels_of
from slatprep.judge import THRESHOLDS
from slatprep.parameters import AlignParameters

DEFAULT = AlignParameters()
FOOT = 20
"""The lowest voxels of the chair."""


def larger(solid: np.ndarray, scale: float) -> np.ndarray:
    """Return a solid scaled about the cube's centre."""
    at = (np.moveaxis(GRID, -1, 0) - 31.5) / scale + 31.5
    return map_coordinates(solid.astype(float), at, order=1) > 0.5


def slab(thickness: float, degrees: float = 0.0, radius: float = np.inf) -> np.ndarray:
    """Return a slab whose top touches the chair's foot in its middle, tilted about x."""
    normal = Rotation.from_euler("x", degrees, degrees=True).apply([0.0, 0.0, 1.0])
    apart = GRID - [29.0, 30.0, FOOT - 0.5]
    heights = apart @ normal
    away = np.linalg.norm(apart - heights[..., None] * normal, axis=-1)
    return (heights < 0) & (heights > -thickness) & (away < radius)


Placed = tuple[records.MaterialField, records.StructuredLatents, records.Alignment]


def hold_placed(solid: np.ndarray, ground: np.ndarray, scale: float, within: float) -> Placed:
    """Hold that a solid on ground is found by its surface, which is larger by a scale."""
    field, latents = field_of(solid | ground), surface_latents(larger(solid, scale))
    found, true = align(field, latents, DEFAULT), make_transform(np.eye(3), scale=scale)
    assert displacement(found.transform, true, latents.centres) < within
    return field, latents, found


@pytest.mark.parametrize(("thickness", "degrees", "radius", "scale"), [
    (1.0, 0.0, np.inf, 1.0), (3.0, 0.0, np.inf, 1.35), (3.0, 10.0, np.inf, 1.2), (4, 0, 26, 1.35),
])  # fmt: skip
def test_an_object_on_ground_is_placed_as_without(thickness, degrees, radius, scale):
    field, latents, found = hold_placed(chair(), slab(thickness, degrees, radius), scale, 1.5)
    normal = Rotation.from_euler("x", degrees, degrees=True).apply([0.0, 0.0, 1.0])
    assert np.degrees(np.arccos(found.ground.normal @ normal)) < 1.5
    assert judged(field, latents, found).verdict is records.Verdict.GOOD
    # The same heading is fitted without the ground too, and fits as well.
    rotation, _, _ = split_transform(found.transform)
    again, lead = engine.fitted_near(found, rotation, field, latents, DEFAULT)
    assert displacement(again.transform, found.transform, latents.centres) < 0.2
    assert abs(lead) < 0.01


def test_the_top_of_a_slab_is_found():
    for way in (1, -1):  # below and above
        ground = find_layers(surface_of((chair() | slab(3.0))[:, :, ::way]))[0]
        np.testing.assert_allclose(ground.normal, [0, 0, way], atol=0.01)
        # The slab's highest voxels have the index FOOT - 1; centres are half a voxel off.
        assert ground.height * 64 + 31.5 == pytest.approx(FOOT - 0.5, abs=0.75)


def board() -> np.ndarray:
    """A board on wheels with a tail: nearly all of it is one flat layer above the ground."""
    x, y, z = np.moveaxis(GRID, -1, 0)
    deck = (x >= 10) & (x < 54) & (y >= 25) & (y < 38) & (z >= FOOT + 5) & (z < FOOT + 8)
    tail = (x >= 50) & (x < 58) & (y >= 26) & (y < 37) & (z >= FOOT + 7) & (z < FOOT + 10)
    wheels = (abs(abs(y - 31.5) - 5) < 2) & ((abs(x - 18) < 3) | (abs(x - 44) < 3))
    return deck | tail | (wheels & (z >= FOOT) & (z < FOOT + 6))


@pytest.mark.parametrize("radius", [np.inf, 30.0])
def test_the_lid_of_a_low_object_is_not_taken_for_its_ground(radius):
    """More voxels go away at the lid than at the slab's top, but nothing lies above it."""
    *_, found = hold_placed(board(), slab(2.0, radius=radius), 1.1, 1.5)
    assert found.ground.height * 64 + 31.5 == pytest.approx(FOOT - 0.5, abs=2.5)


@pytest.mark.parametrize(("thick", "sunk", "below", "radius", "within"), [
    (3, 1, 1, np.inf, 0.5), (3, 2, 1, 25, 1.5), (4, 2, 2, np.inf, 1.2), (6, 2, 2, np.inf, 1.6),
])  # fmt: skip
def test_a_rug_that_lies_in_the_ground_is_placed(thick, sunk, below, radius, within):
    """What is cut off with the ground is drawn down again, or the rug would be half as thick."""
    x, y, z = np.moveaxis(GRID, -1, 0)
    rug = (abs(x - 31.5) < 16) & (abs(y - 31.5) < 11) & (z >= FOOT) & (z < FOOT + thick)
    rug |= (abs(x - 22) < 5) & (abs(y - 36) < 4) & (z >= FOOT) & (z < FOOT + thick + 3)
    ground = (z >= FOOT - below) & (z < FOOT + sunk) & (np.hypot(x - 31.5, y - 31.5) < radius)
    hold_placed(rug, ground, 1.3, within)


@pytest.mark.parametrize(("scale", "mark"), [(1.3, 3), (1.3, 5), (1.5, 3)])
def test_a_rug_on_a_disc_of_about_its_size_is_placed(scale, mark):
    """Of the heights at which the ground may end only one leaves a rug."""
    x, y, z = np.moveaxis(GRID, -1, 0)
    rug = (abs(x - 31.5) < 16) & (abs(y - 31.5) < 12) & (z >= FOOT) & (z < FOOT + 3)
    rug |= (np.hypot(x - 36, y - 34) < mark) & (z >= FOOT) & (z < FOOT + 5)
    disc = (z >= FOOT - 4) & (z < FOOT + 1) & (np.hypot(x - 31.5, y - 31.5) < 20)
    hold_placed(rug, disc, scale, 0.5)


def test_a_layer_counts_by_its_width_over_that_of_what_stands_on_it():
    """Of a disc's voxels 95 % are within the root of that of its radius, however tall it is."""
    away = np.hypot(GRID[..., 0] - 31.5, GRID[..., 1] - 31.5)
    hoop = (abs(away - 12) < 0.5) & (abs(GRID[..., 2] - 11) < 2)
    pillar, wide = (away < 12) & (GRID[..., 2] >= 13), (away < 30) & (abs(GRID[..., 2] - 11) < 2)
    up, down = (records.Ground(np.array([0.0, 0.0, way]), 0.0) for way in (1.0, -1.0))
    assert relative_width(up, hoop | pillar, pillar) == pytest.approx(0.95**-0.5, abs=0.05)
    assert relative_width(up, wide | pillar, pillar) == 1.2, "at most"
    assert relative_width(down, wide | pillar, wide) == pytest.approx(12 / 30, abs=0.03)
    assert relative_width(up, pillar, pillar) == 0.0, "nothing is left out"


@pytest.mark.parametrize("by_width", [True, False])
def test_of_two_layers_that_may_be_ground_the_wider_one_is(by_width, monkeypatch):
    """A table with a rough lid on a larger mat: upside down, the mat is the smoother lid."""
    monkeypatch.setattr(engine, "WIDTH", 0.3 * by_width)
    x, y, z = np.moveaxis(GRID - 31.5, -1, 0)
    lid = (abs(x) < 15) & (abs(y) < 13) & (z > -3) & (z < 0)
    table = lid | ((abs(x) < 2) & (abs(y) < 2) & (z > -12) & (z < 0))
    lumpy = table | ((abs(x) < 20) & (abs(y) < 16) & (z > -14) & (z < -12))
    for lump in np.random.default_rng(1).choice(voxels_of(boundary(lid)), 52):
        lumpy |= (abs(GRID - lump) <= 1).all(axis=-1)
    found = align(field_of(lumpy), surface_latents(table), DEFAULT)
    assert (found.ground.normal[2] > 0.99) == (found.transform[2, 2] > 0.9) == by_width


def test_what_may_bend_is_not_held_against_what_may_not():
    stiff = align(field_of(chair()), surface_latents(chair()), DEFAULT)
    low = replace(stiff.figures, score_similarity=0.6, score_slat=0.9, score_pixieverse=0.8)
    bent = replace(stiff, model=records.Model.DEFORMABLE, figures=low)
    high = replace(low, score_similarity=0.7, score_slat=0.8, score_pixieverse=0.7)
    assert gain(replace(stiff, figures=high), bent) == pytest.approx(0.1)
    assert gain(replace(bent, figures=high), bent) == pytest.approx(0.1)
    higher = replace(low, score_slat=1.0, score_pixieverse=1.0)
    assert gain(replace(bent, figures=higher), bent) == pytest.approx(0.15)
    assert gain(replace(stiff, figures=higher), bent) == 0.0


def test_a_flat_part_that_both_sides_have_is_no_ground():
    """Where the SLAT shows the layer too, it is the object's, however badly the rest fits."""
    solid = chair() | slab(3.0)
    latents = surface_latents(solid)
    blobs = np.zeros_like(solid)
    for centre in np.random.default_rng(3).integers([4, 4, FOOT + 4], 60, (60, 3)):
        blobs |= ((GRID - centre) ** 2).sum(axis=-1) < 16
    found = align(field_of(solid | blobs), latents, DEFAULT)
    assert found.score < engine.POOR
    assert find_layers(surface_of(solid | blobs))
    assert found.ground is None
    assert displacement(found.transform, np.eye(4), latents.centres) < 2.0


def test_where_the_sides_fit_no_ground_is_looked_for(monkeypatch):
    monkeypatch.setattr(engine, "find_layers", None)  # Who looks for ground calls it.
    assert align(field_of(chair()), surface_latents(chair()), DEFAULT).ground is None


@pytest.mark.parametrize(("radius", "scale", "rise", "taken"), [
    (20, 1.2, 0.049, False), (20, 1.2, 0.051, True),
    (np.inf, 1.2, -0.011, False), (np.inf, 1.2, -0.009, True),
    (np.inf, 1.0, 0.049, False), (np.inf, 1.0, 0.051, True),  # It lies in the ground as on it.
])  # fmt: skip
def test_ground_is_what_the_object_fits_clearly_better_without(
    radius, scale, rise, taken, monkeypatch
):
    """About as well is enough without a layer far wider than it, in which it lay elsewhere."""
    monkeypatch.setattr(engine, "gain", lambda without, found: rise)
    ground = slab(3.0, radius=radius)
    found = align(field_of(chair() | ground), surface_latents(larger(chair(), scale)), DEFAULT)
    assert (found.ground is not None) == taken


def test_a_ball_a_slab_alone_and_a_few_voxels_have_no_ground():
    ball = ((GRID - 31.5) ** 2).sum(axis=-1) < 400
    few = [(GRID >= [10, 20, 30]) & ([11, 21, 30 + count] > GRID) for count in (1, 2, 5)]
    for solid in (ball, slab(3.0), *(one.all(axis=-1) for one in few)):
        assert not find_layers(surface_of(solid))


def test_quality_does_not_count_the_ground():
    field, latents = field_of(chair() | slab(3.0)), surface_latents(chair())
    found = align(field, latents, DEFAULT)
    assert found.quality.fitness > 0.9
    assert found.quality == measure_quality(field, latents, found.transform, 1.0, found.ground)
    assert measure_quality(field, latents, found.transform, 1.0).fitness < 0.5


def test_a_placement_that_is_taken_is_fitted_without_the_ground():
    field, latents = field_of(chair() | slab(3.0)), surface_latents(larger(chair(), 1.2))
    found = align(field, latents, DEFAULT)
    elsewhere = make_transform(Rotation.from_euler("x", 180, degrees=True).as_matrix())
    first = records.Placement(found.transform, found.score, 20.0)
    other = replace(found, transform=elsewhere, placements=(first,))
    taken = take(other, 0, latents, records.LatentChoice(0.99, 12.0, 300, 40, 40))
    settled = refit(taken, field, latents, DEFAULT)
    assert settled.ground is found.ground
    assert displacement(settled.transform, found.transform, latents.centres) < 0.2
    assert settled.quality.fitness == pytest.approx(found.quality.fitness, abs=0.01)


LIMIT = THRESHOLDS.good_mirrored


def mirrored_gain(solid: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    return align(field_of(solid), surface_latents(other), DEFAULT).figures.mirrored


def turned(solid: NDArray[np.bool_], seed: int) -> NDArray[np.bool_]:
    """Return a solid in any rotation about the cube's centre."""
    turn = Rotation.random(random_state=seed).as_matrix()
    middle = np.full(3, 31.5)
    return affine_transform(solid.astype(float), turn, middle - turn @ middle, order=1) > 0.5


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
def test_a_mirrored_annotation_is_told_in_any_rotation_and_no_other(seed):
    gains = []
    for other in (chair()[::-1], chair()):
        there = other if seed is None else turned(other, seed)
        gains.append(mirrored_gain(bitten(chair(), (30, 24, 28)), there))
    assert gains[0] > 2 * LIMIT and not gains[1] > 0.0


def test_a_mirrored_annotation_is_told_by_what_is_left_once_deformed():
    solid = bitten(chair(), (30, 24, 28))
    for other, told in ((chair()[::-1], True), (chair(), False)):
        found = align(field_of(solid), surface_latents(other), DEFAULT)
        pair = Pair(surface_of(other), surface_of(solid), DEFAULT)
        gained = mirror_gain(pair, Similarity.of(found.transform), poor=True)
        assert gained > 2 * LIMIT if told else gained < 0.0


def boxes(seed: int) -> NDArray[np.bool_]:
    """Return a box with three others on it, which has several placements that fit nearly."""
    rng = np.random.default_rng(seed)
    solid, half = np.zeros((64, 64, 64), dtype=bool), rng.integers(8, 16, 3)
    parts = [(np.full(3, 32), half)]
    parts += [(rng.integers(32 - half, 33 + half), rng.integers(2, 7, 3)) for _ in range(3)]
    for centre, size in parts:
        solid[tuple(map(slice, centre - size, centre + size))] = True
    return solid


@pytest.mark.parametrize("seed", [1, 11, 19, 35])
def test_a_mirrored_annotation_is_told_where_its_own_placement_is_wrong(seed):
    """A reflection of that placement is none of the right one."""
    solid = boxes(seed)
    assert mirrored_gain(solid, turned(solid[::-1], seed)) > 3 * LIMIT
    assert mirrored_gain(solid, turned(solid, seed)) < -3 * LIMIT


def test_an_object_that_is_its_own_mirror_image_is_not_told_to_be_mirrored():
    """Bites on both sides, so that neither fits so well that no mirror is tried."""
    for at in ((14, 20, 43), (50, 40, 43)):
        assert abs(mirrored_gain(bitten(table(), at), table()[:, :, ::-1])) < LIMIT


def test_a_mirrored_annotation_is_not_good_and_is_told_as_what_it_is():
    """Nearly all of the labels are right: the solid is a mirror image but for a small fin."""
    solid = table()
    solid[44:50, 26:32, 16:40] = True
    field, latents = field_of(solid), surface_latents(solid[::-1])
    judgement = judged(field, latents, align(field, latents, DEFAULT))
    assert judgement.verdict is not records.Verdict.GOOD
    assert any("mirror image of its object" in reason for reason in judgement.reasons)
