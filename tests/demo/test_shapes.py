"""Shapes' distances are bounds and give the voxels that the surface meets."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from slatprep.demo import shapes
from slatprep.demo.catalogue import CATALOGUE
from slatprep.demo.model import direction, orient, rock, vessel
from slatprep.demo.shapes import Part, Solid, Stuff
from slatprep.demo.voxelise import voxelise
from slatprep.geometry.frames import voxel_centres

SHAPES = {
    "sphere": shapes.sphere((0.1, 0.0, -0.1), 0.3),
    "ellipsoid": shapes.ellipsoid((0.1, 0.0, 0.0), (0.4, 0.2, 0.1), orient(0.7, 0.4)),
    "dome": shapes.dome((0.0, 0.1, 0.0), (0.4, 0.3, 0.2)),
    "capsule": shapes.capsule((-0.2, 0.0, 0.1), (0.2, 0.1, 0.3), 0.1),
    "cone": shapes.cone((0.0, 0.0, -0.2), (0.1, 0.2, 0.3), 0.3, 0.1),
    "cylinder": shapes.cylinder((0.0, 0.0, -0.2), (0.2, 0.0, 0.2), 0.2),
    "box": shapes.box((0.0, 0.1, 0.0), (0.3, 0.2, 0.1), orient(0.3, 0.2), rounding=0.05),
    "torus": shapes.torus((0.0, 0.0, 0.1), (1.0, 1.0, 2.0), 0.3, 0.1),
    "rock": rock(np.random.default_rng(0), (0.1, -0.1, 0.1), (0.3, 0.25, 0.2)),
    "vessel": vessel(-0.3, 0.3, 0.2, 0.4, 0.08, floor=0.1),
}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())
def test_distance_never_changes_faster_than_the_way_gone(shape):
    rng = np.random.default_rng(1)
    start = rng.uniform(-0.7, 0.7, (20_000, 3))
    step = rng.normal(0.0, 0.05, start.shape)
    change = np.abs(shape.distance(start + step) - shape.distance(start))
    assert np.all(change <= np.linalg.norm(step, axis=1) * (1 + 1e-9))


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())
def test_support_is_the_edge_of_what_is_inside(shape):
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.7, 0.7, (200_000, 3))
    inside = points[shape.distance(points) <= 0]
    for axis in [*np.eye(3), *-np.eye(3), *(direction(rng) for _ in range(5))]:
        farthest = (inside @ axis).max()
        assert farthest <= shape.support(axis) + 1e-12
        # Random points come near the edge: a sharp tip is hit less often.
        assert farthest >= shape.support(axis) - 0.05


def test_point_belongs_to_the_nearest_part_and_its_coat():
    stuffs = [Stuff(k, 10.0 ** (k + 4), 100.0 * (k + 1), 0.3) for k in range(3)]
    solid = Solid(
        [
            Part(shapes.sphere((-0.3, 0, 0), 0.25), stuffs[0]),
            Part(
                shapes.sphere((0.3, 0, 0), 0.25),
                stuffs[1],
                ((shapes.half_space((0.3, 0, 0), (0, 0, 1)), stuffs[2]),),
            ),
        ]
    )
    points = np.array([[-0.3, 0, 0.1], [0.3, 0, 0.1], [0.3, 0, -0.1], [0.52, 0.0, 0.01]])
    assert solid.stuff_at(points).tolist() == [0, 2, 1, 2]
    material, properties = solid.table()
    assert material.tolist() == [0, 1, 2]
    assert properties.dtype == np.float32
    assert properties[2].tolist() == pytest.approx([1e6, 300.0, 0.3])
    with pytest.raises(ValueError, match="no part"):
        solid.stuff_at(np.array([[0.0, 0.0, 0.6]]))


@pytest.mark.parametrize("category", CATALOGUE)
def test_shortcut_near_each_part_equals_the_plain_minimum(category):
    model = CATALOGUE[category](np.random.default_rng(5), 1)
    solid = Solid(model.parts)
    rng = np.random.default_rng(6)
    points = rng.uniform(solid.extent[0] - 0.05, solid.extent[1] + 0.05, (5_000, 3))
    plain = np.min([part.shape.distance(points) for part in model.parts], axis=0)
    distance, _ = solid.evaluate(points)
    # Farther than its reach the solid says no more than "at least so far",
    # and so does a bound that is not the distance itself.
    close = plain < solid.reach
    assert np.all((distance <= 0) == (plain <= 0))
    assert np.all(distance[close] >= plain[close])
    inside = plain <= 0
    assert np.array_equal(distance[inside], plain[inside])


ALL = np.argwhere(np.ones((64, 64, 64), dtype=bool))
CENTRES = voxel_centres(ALL)
HALF = 0.5 / 64

unit = st.floats(-1.0, 1.0)
directions = st.tuples(unit, unit, unit).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=10)
@given(normal=directions, offset=st.floats(-0.6, 0.6))
def test_plane_meets_the_cubes_whose_corners_it_parts(normal, offset):
    n = np.array(normal) / np.linalg.norm(normal)
    surface, filled = voxelise(lambda p: p @ n - offset)
    # A cube's corners reach |n| . h to either side of its centre.
    at_centre = CENTRES @ n - offset
    reach = HALF * np.abs(n).sum()
    margin = 1e-9
    surely = (np.abs(at_centre) < reach - margin).reshape(surface.shape)
    perhaps = (np.abs(at_centre) <= reach + margin).reshape(surface.shape)
    assert not np.any(surely & ~surface)
    assert not np.any(surface & ~perhaps)
    assert np.array_equal(filled, surface | (at_centre <= 0).reshape(surface.shape))


@settings(max_examples=10)
@given(centre=st.tuples(*[st.floats(-0.2, 0.2)] * 3), radius=st.floats(0.03, 0.3))
@example(centre=(0.0, 0.0, 0.1640625), radius=0.0625)
def test_sphere_meets_the_cubes_between_nearest_and_farthest_point(centre, radius):
    surface, filled = voxelise(lambda p: np.linalg.norm(p - centre, axis=1) - radius)
    away = np.abs(CENTRES - centre)
    nearest = np.linalg.norm(np.maximum(away - HALF, 0.0), axis=1)
    farthest = np.linalg.norm(away + HALF, axis=1)
    met = ((nearest <= radius) & (farthest >= radius)).reshape(surface.shape)
    assert not np.any(surface & ~met)
    # What is missed, the sphere enters by less than a tenth of a voxel.
    depth = np.minimum(radius - nearest, farthest - radius).reshape(surface.shape)
    missed = met & ~surface
    assert np.all(depth[missed] < HALF / 5)
    # On an axis of the grid it misses with a cube the seven that mirrors make of it, too.
    images = 8 if sum(c == 0 for c in centre) >= 2 else 2
    assert missed.sum() <= 0.01 * met.sum() + images
    solid = (nearest <= radius).reshape(surface.shape)
    assert not np.any(filled & ~solid)
    assert np.array_equal(filled ^ solid, missed & solid & ~filled)


def test_thin_sheet_has_no_holes():
    # A slab a third of a voxel thick, between two layers of centres.
    surface, _ = voxelise(lambda p: np.abs(p[:, 2]) - HALF / 3)
    assert surface[:, :, 31].all()
    assert surface[:, :, 32].all()
    assert surface.sum() == 2 * 64 * 64


@pytest.mark.parametrize(("value", "count"), [(1.0, 0), (-1.0, 64**3)])
def test_empty_and_full_cube(value, count):
    surface, filled = voxelise(lambda p: np.full(len(p), value))
    assert not surface.any()
    assert filled.sum() == count
