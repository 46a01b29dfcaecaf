"""What is fitted at a placement that a pass over the dataset takes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.deformed import MOVES, occupancy
from support.shapes import chair, field_of, surface_latents

from slatprep.align import align
from slatprep.align.quality import measure_quality
from slatprep.align.settle import refit, take
from slatprep.geometry.deformation import map_of
from slatprep.geometry.frames import VOXEL_SIZE, apply_transform, make_transform, voxel_centres
from slatprep.parameters import AlignParameters
from slatprep.records import (
    Alignment,
    LatentChoice,
    MaterialField,
    Model,
    Placement,
    StructuredLatents,
)

BY = LatentChoice(0.99, 12.0, 300, 40, 40)
ELSEWHERE = make_transform(Rotation.from_euler("x", 180, degrees=True).as_matrix())


def with_another_first(
    field: MaterialField, latents: StructuredLatents, parameters: AlignParameters
) -> tuple[Alignment, Alignment]:
    """Align; return that, and it as if another placement had been taken for the best."""
    found = align(field, latents, parameters)
    other = replace(
        found,
        transform=ELSEWHERE,
        deformation=None,
        figures=None,
        model=Model.RIGID,
        placements=(Placement(found.transform, found.score, 20.0),),
    )
    return found, other


@pytest.mark.parametrize(("name", "model"), [("bent", Model.DEFORMABLE), ("long", Model.AFFINE)])
def test_a_placement_that_is_taken_is_deformed_as_aligning_would_deform_it(name, model):
    field = field_of(occupancy(lambda points: points))
    latents = surface_latents(occupancy(MOVES[name]))
    parameters = AlignParameters()
    found, other = with_another_first(field, latents, parameters)
    assert found.model is model
    taken = take(other, 0, latents, BY)
    assert taken.deformation is None
    np.testing.assert_array_equal(taken.placements[0].transform, ELSEWHERE)
    settled = refit(taken, field, latents, parameters)
    assert settled.model is model
    assert settled.settled_by == BY
    places = map_of(settled).places(latents.coords)
    off = np.linalg.norm(places - MOVES[name](voxel_centres(latents.coords)), axis=1) / VOXEL_SIZE
    assert np.median(off) < 0.7
    # The search leaves the best placement slightly off where a new fit ends.
    apart = np.linalg.norm(places - map_of(found).places(latents.coords), axis=1) / VOXEL_SIZE
    assert apart.max() < 0.2
    assert settled.figures.score_slat == pytest.approx(found.figures.score_slat, abs=0.01)
    assert settled.quality == measure_quality(field, latents, settled.transform, parameters.radius)


def test_where_shapes_are_the_same_nothing_is_deformed():
    field, latents = field_of(chair()), surface_latents(chair())
    found, other = with_another_first(field, latents, AlignParameters())
    settled = refit(take(other, 0, latents, BY), field, latents, AlignParameters())
    assert (settled.model, settled.deformation) == (Model.RIGID, None)
    np.testing.assert_allclose(settled.transform, found.transform, atol=1e-3)
    assert settled.placements[0].displacement > 5


@pytest.mark.parametrize("model", ["rigid", "similarity"])
def test_what_the_parameters_forbid_is_not_fitted(model):
    field = field_of(occupancy(lambda points: points))
    latents = surface_latents(occupancy(MOVES["bent"]))
    parameters = AlignParameters(model=model)
    _, other = with_another_first(field, latents, parameters)
    settled = refit(take(other, 0, latents, BY), field, latents, parameters)
    assert settled.model == model
    assert settled.deformation is None


def test_taking_a_placement_leaves_the_others_and_the_model_of_a_rigid_fit():
    latents = surface_latents(chair())
    found = align(field_of(chair()), latents, AlignParameters())
    turns = [
        make_transform(Rotation.from_euler(axis, 180, degrees=True).as_matrix()) for axis in "xyz"
    ]
    placements = tuple(Placement(turn, 0.9 - 0.1 * k, 20.0) for k, turn in enumerate(turns))
    taken = take(replace(found, placements=placements), 1, latents, BY)
    np.testing.assert_array_equal(taken.transform, turns[1])
    assert (taken.model, taken.score) == (found.model, placements[1].score)
    assert [one.score for one in taken.placements] == [found.score, 0.9, pytest.approx(0.7)]
    for left, transform in zip(
        taken.placements, (found.transform, turns[0], turns[2]), strict=True
    ):
        np.testing.assert_array_equal(left.transform, transform)
        there = [
            apply_transform(np.linalg.inv(one), latents.centres) for one in (transform, turns[1])
        ]
        apart = np.linalg.norm(there[0] - there[1], axis=1).mean() / VOXEL_SIZE
        assert left.displacement == pytest.approx(apart)
