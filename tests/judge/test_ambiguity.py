"""What ties mean for the supervision, on shapes whose symmetry is known."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.shapes import GRID, chair, field_of, surface_latents

from slatprep.align import align
from slatprep.geometry.deformation import map_of
from slatprep.judge import measure_ambiguity
from slatprep.judge.ambiguity import FEWER, MOST_VOXELS, thinning
from slatprep.judge.evidence import surroundings_of
from slatprep.parameters import AlignParameters, SampleParameters
from slatprep.records import (
    Alignment,
    Ambiguity,
    Annotation,
    MaterialField,
    Placement,
    StructuredLatents,
)
from slatprep.sample import sample

BALL = ((GRID - 31.5) ** 2).sum(axis=-1) < 20**2


def _ambiguity(
    occupancy: np.ndarray, material: np.ndarray | None = None
) -> tuple[Alignment, Ambiguity]:
    field, latents = field_of(occupancy, material), surface_latents(occupancy)
    alignment = align(field, latents, AlignParameters())
    annotation = sample(field, map_of(alignment).places(latents.coords), SampleParameters())
    return alignment, measure_ambiguity(field, latents, alignment, annotation, SampleParameters())


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


def test_a_full_slat_is_judged_by_some_of_its_voxels_and_ties(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ball = ((GRID - 31.5) ** 2).sum(axis=-1) < 27**2
    field = field_of(ball, np.where(GRID[..., 2] < 32, 1, 3))
    coords = np.argwhere(ball).astype(np.uint8)
    latents = StructuredLatents(coords, np.zeros((len(coords), 8), np.float32))
    alignment = align(field, latents, AlignParameters())
    annotation = sample(field, map_of(alignment).places(coords), SampleParameters())
    assert len(coords) > 2 * MOST_VOXELS and len(alignment.placements) == 23
    assert [thinning(n) for n in (1, MOST_VOXELS, MOST_VOXELS + 1)] == [1, 1, 2]

    def judged() -> tuple[Ambiguity, np.ndarray]:
        ambiguity = measure_ambiguity(field, latents, alignment, annotation, SampleParameters())
        return ambiguity, surroundings_of(field, latents, alignment, annotation).tied

    some = judged()
    monkeypatch.setattr("slatprep.judge.ambiguity.MOST_VOXELS", 10**9)
    every = judged()
    assert abs(some[0].material_share - every[0].material_share) < 0.01
    np.testing.assert_allclose(some[0].property_change, every[0].property_change, rtol=0.02)
    assert abs(some[1].mean() - every[1].mean()) < 0.05


def test_the_voxels_of_a_full_grid_that_are_looked_at_lie_in_all_of_its_layers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Classes repeat every eight layers, as would steps of eight in a grid that is in order."""
    full = np.ones((64, 64, 64), dtype=bool)
    field = field_of(full, np.where(GRID[..., 2] % 8 == 0, 1, 3))
    coords = np.argwhere(full).astype(np.uint8)
    latents = StructuredLatents(coords, np.zeros((len(coords), 8), np.float32))
    upside_down = Placement(np.diag([-1.0, 1.0, -1.0, 1.0]), 1.0, 20.0)
    alignment = replace(align(field, latents, AlignParameters()), placements=(upside_down,))
    annotation = sample(field, map_of(alignment).places(coords), SampleParameters())
    looked: list[int] = []

    def counted(field: MaterialField, places: np.ndarray, *rest: Any, **options: Any) -> Annotation:
        looked.append(len(places))
        return sample(field, places, *rest, **options)

    monkeypatch.setattr("slatprep.judge.ambiguity.sample", counted)
    some = measure_ambiguity(field, latents, alignment, annotation, SampleParameters())
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
    field = replace(
        field, properties=properties, classified=False, material=np.zeros_like(field.material)
    )
    latents = StructuredLatents(field.voxels, np.zeros((len(field.voxels), 8), np.float32))
    half_a_turn = Placement(np.diag([-1.0, -1.0, 1.0, 1.0]), 1.0, 20.0)
    found = align(field_of(chair()), surface_latents(chair()), AlignParameters())
    alignment = replace(found, transform=np.eye(4), placements=(half_a_turn,))
    annotation = sample(field, map_of(alignment).places(latents.coords), SampleParameters())
    ambiguity = measure_ambiguity(field, latents, alignment, annotation, SampleParameters())
    assert ambiguity.material_share == pytest.approx((4 + 2) / 10)
    expected = ((1 + 0.05 + 0.05 + 1) / 4, 0.0, 0.0)
    np.testing.assert_allclose(ambiguity.property_change, expected, atol=1e-6)
