"""Every shape's distance is a bound, and its support is the edge of what is inside."""

import numpy as np
import pytest

from slatprep.demo import shapes
from slatprep.demo.catalogue import CATALOGUE
from slatprep.demo.model import direction, orient, rock, vessel
from slatprep.demo.shapes import Part, Solid, Stuff

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
