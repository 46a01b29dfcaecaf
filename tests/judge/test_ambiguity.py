"""What ties mean for the supervision, on shapes whose symmetry is known."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.shapes import GRID, aligned, chair, field_of, latents_of, surface_latents

from slatprep.align import align
from slatprep.geometry.deformation import map_of
from slatprep.geometry.frames import cube_symmetries, make_transform
from slatprep.judge import measure_ambiguity
from slatprep.judge.ambiguity import FEWER, MOST_VOXELS, thinning
from slatprep.judge.evidence import surroundings_of
from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.records import Ambiguity, Annotation, MaterialField
from slatprep.sample import sample

BALL = ((GRID - 31.5) ** 2).sum(axis=-1) < 20**2


PARAMETERS = SampleParameters()


def _ambiguity(occupancy: np.ndarray, material: np.ndarray | None = None) -> tuple[Any, Ambiguity]:
    field, latents = field_of(occupancy, material), surface_latents(occupancy)
    alignment = align(field, latents, AlignParameters())
    annotation = sample(field, map_of(alignment).places(latents.coords), PARAMETERS)
    return alignment, measure_ambiguity(field, latents, alignment, annotation, PARAMETERS)


def test_a_ball_of_one_material_is_ambiguous_and_harmless() -> None:
    alignment, ambiguity = _ambiguity(BALL)
    assert len(alignment.placements) == 23  # all other quarter turns
    assert alignment.margin < 1e-6
    assert ambiguity.material_share == 0.0
    assert ambiguity.property_change == (0.0, 0.0, 0.0)


def test_a_ball_with_a_painted_half_is_not_harmless() -> None:
    painted = np.where(GRID[..., 2] < 32, 1, 3)
    _, ambiguity = _ambiguity(BALL, painted)
    # Turned upside down every voxel changes class: E by two decades, density
    # from 200 to 400, Poisson's ratio by 0.02.
    assert ambiguity.material_share == 1.0
    np.testing.assert_allclose(ambiguity.property_change, (2.0, np.log10(2), 0.02), rtol=1e-5)


def test_a_box_with_a_painted_end_by_hand() -> None:
    # 40 x 20 x 10: the turns that keep it are by 180 degrees about each axis,
    # and two of the three swap the ends.
    box = np.zeros((64, 64, 64), dtype=bool)
    box[12:52, 22:42, 27:37] = True
    painted = np.where(GRID[..., 0] < 20, 2, 1)  # 8 of 40 layers
    alignment, ambiguity = _ambiguity(box, painted)
    assert len(alignment.placements) == 3
    assert all(p.displacement > 5 for p in alignment.placements)
    surface = surface_latents(box).coords
    expected = ((surface[:, 0] < 20) | (surface[:, 0] >= 44)).mean()
    assert ambiguity.material_share == np.float64(expected)


def test_a_chair_has_one_placement() -> None:
    alignment, ambiguity = _ambiguity(chair(), np.where(GRID[..., 2] < 32, 1, 3))
    assert alignment.placements == ()
    assert ambiguity.material_share == 0.0
    assert alignment.margin > 0.1


def test_a_full_slat_is_judged_by_some_of_its_voxels_and_ties(monkeypatch):
    ball = ((GRID - 31.5) ** 2).sum(axis=-1) < 27**2
    field = field_of(ball, np.where(GRID[..., 2] < 32, 1, 3))
    latents = latents_of(np.argwhere(ball))
    turns = [make_transform(turn) for turn in cube_symmetries() if np.linalg.det(turn) > 0]
    alignment = aligned(*turns)
    annotation = sample(field, latents.centres, PARAMETERS)
    assert len(latents.coords) > 2 * MOST_VOXELS
    assert [thinning(n) for n in (1, MOST_VOXELS, MOST_VOXELS + 1)] == [1, 1, 2]

    def judged() -> tuple[Ambiguity, np.ndarray]:
        ambiguity = measure_ambiguity(field, latents, alignment, annotation, PARAMETERS)
        return ambiguity, surroundings_of(field, latents, alignment, annotation).tied

    some = judged()
    monkeypatch.setattr("slatprep.judge.ambiguity.MOST_VOXELS", 10**9)
    every = judged()
    assert abs(some[0].material_share - every[0].material_share) < 0.01
    np.testing.assert_allclose(some[0].property_change, every[0].property_change, rtol=0.02)
    assert abs(some[1].mean() - every[1].mean()) < 0.05


def test_the_voxels_of_a_full_grid_that_are_looked_at_lie_in_all_of_its_layers(monkeypatch):
    """Classes repeat every eight layers, as would steps of eight in a grid that is in order."""
    full = np.ones((64, 64, 64), dtype=bool)
    field = field_of(full, np.where(GRID[..., 2] % 8 == 0, 1, 3))
    latents = latents_of(np.argwhere(full))
    annotation = sample(field, latents.centres, PARAMETERS)
    looked: list[int] = []

    def counted(field: MaterialField, places: np.ndarray, *rest: Any, **options: Any) -> Annotation:
        looked.append(len(places))
        return sample(field, places, *rest, **options)

    monkeypatch.setattr("slatprep.judge.ambiguity.sample", counted)
    upside_down = aligned(np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0]))
    some = measure_ambiguity(field, latents, upside_down, annotation, PARAMETERS)
    # Layers 0, 8, 16... change with layers 7, 15, 23...: two of eight.
    assert some.material_share == pytest.approx(0.25, abs=0.01)
    assert looked == [pytest.approx(MOST_VOXELS / FEWER, rel=0.05)]


def test_without_classes_a_property_that_changes_notably_counts_by_hand() -> None:
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
    ambiguity = measure_ambiguity(field, latents, half_a_turn, annotation, PARAMETERS)
    assert ambiguity.material_share == pytest.approx((4 + 2) / 10)
    expected = ((1 + 0.05 + 0.05 + 1) / 4, 0.0, 0.0)
    np.testing.assert_allclose(ambiguity.property_change, expected, atol=1e-6)
