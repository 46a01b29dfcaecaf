"""The truth of demo assets, from the voxels themselves; distances of shapes and their voxels."""

from functools import cache

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_erosion, generate_binary_structure, label
from scipy.spatial import cKDTree

from slatprep.demo import shapes
from slatprep.demo.asset import make_asset, object_id
from slatprep.demo.catalogue import CATALOGUE
from slatprep.demo.difficulty import LEVELS, QUARTER_TURNS, SAME_SHAPE_LEVELS, draw_frames
from slatprep.demo.latents import MEAN, STD
from slatprep.demo.model import MATERIALS, direction, orient, rock, vessel
from slatprep.demo.shapes import Part, Solid, Stuff
from slatprep.demo.voxelise import voxelise
from slatprep.geometry.frames import voxel_centres

KINDS = range(2 * len(CATALOGUE))
"""Two turns through the categories: the first two kinds of each."""


@cache
def asset(index, level, **options):
    return make_asset(11, index, levels=(level,), **options)


def looked_up(made, view=0):
    """Map SLAT voxel centres into the grid's frame by the inverse of the true transform."""
    centres = (made.views[view].coords + 0.5) / 64 - 0.5
    inverse = np.linalg.inv(made.views[view].transform)
    return centres @ inverse[:3, :3].T + inverse[:3, 3]


def label_share(made):
    ids = made.grid[..., 3]
    annotated = np.argwhere((ids >= 0) & (ids < 7))
    distance, nearest = cKDTree((annotated + 0.5) / 64 - 0.5).query(looked_up(made))
    voxels = tuple(annotated[nearest].T)
    near = distance * 64 <= 2
    right = ids[voxels] == made.views[0].material
    return right[near].mean(), near.mean()


@pytest.mark.parametrize("index", KINDS)
def test_quarter_turn_is_an_exact_permutation_of_the_axes(index):
    made = asset(index, 0)
    turn = made.views[0].transform[:3, :3]
    assert any(np.allclose(turn, quarter, atol=1e-12) for quarter in QUARTER_TURNS)
    assert np.allclose(made.views[0].transform[:3, 3], 0, atol=1e-12)
    voxels = np.rint((looked_up(made) + 0.5) * 64 - 0.5).astype(int)
    surface = np.zeros((64,) * 3, dtype=bool)
    surface[tuple(voxels.T)] = True
    # The filled grid holds every surface voxel, and whatever of it is not one
    # lies inside: no face of it is bare.
    assert not np.any(surface & ~made.occupancy)
    padded = np.pad(made.occupancy, 1)
    inside = binary_erosion(padded, generate_binary_structure(3, 1))[1:-1, 1:-1, 1:-1]
    assert not np.any(made.occupancy & ~inside & ~surface)
    # The object fills the cube on both sides.
    for voxels in (made.views[0].coords, np.argwhere(made.occupancy)):
        low, high = voxels.min(axis=0), voxels.max(axis=0)
        assert (high - low).max() == 63
        assert np.all(np.abs(low + high.astype(int) - 63) <= 1)


@pytest.mark.parametrize("index", KINDS)
def test_true_transform_lands_on_the_object_and_on_its_material(index):
    made = asset(index, 1)
    occupied = (np.argwhere(made.occupancy) + 0.5) / 64 - 0.5
    distance = cKDTree(occupied).query(looked_up(made))[0] * 64
    # A SLAT voxel's centre is within half a diagonal of the surface, and the
    # surface within another half of the centre of a voxel that it meets.
    assert distance.max() <= 3**0.5
    assert np.quantile(distance, 0.98) <= 1.0
    right, near = label_share(made)
    assert right > 0.97 and near == 1.0


@pytest.mark.parametrize("index", range(len(CATALOGUE)))
@pytest.mark.parametrize(("levels", "least"), [((2, 3), 0.95), ((4,), 0.93)])
def test_true_transform_of_harder_levels_finds_the_material(index, levels, least):
    right, near = label_share(asset(index, levels[index % len(levels)]))
    assert right > least and near > 0.9


@pytest.mark.parametrize("index", KINDS)
def test_properties_follow_the_material_and_stay_in_the_published_span(index):
    made = asset(index, 1)
    view = made.views[0]
    for material, (modulus, density, poisson) in zip(
        view.material[::97], view.properties[::97], strict=True
    ):
        assert any(
            cls == material
            and e[0] * 0.99 <= modulus <= e[1] * 1.01
            and d[0] * 0.99 <= density <= d[1] * 1.01
            and nu[0] - 0.01 <= poisson <= nu[1] + 0.001
            for cls, e, d, nu in MATERIALS.values()
        )
    grid = made.grid[made.grid[..., 3] < 7].astype(float)
    assert 1.7031894 <= np.log10(grid[:, 0]).min() <= np.log10(grid[:, 0]).max() <= 3.8714323
    assert 3.0183003 <= np.log10(grid[:, 1]).min() <= np.log10(grid[:, 1]).max() <= 10.8816805
    assert 0.2102763 <= grid[:, 2].min() <= grid[:, 2].max() <= 0.4492689
    # Both sides know the same stuffs, in their own column orders.
    sides = grid[:, [1, 0, 2]], view.properties
    known = [{tuple(row) for row in np.unique(side.astype(np.float32), axis=0)} for side in sides]
    assert known[1] <= known[0]


@pytest.mark.parametrize("index", KINDS)
def test_symmetric_says_whether_another_quarter_turn_fits_as_well(index):
    made = asset(index, 0)
    voxels = made.views[0].coords.astype(int)
    surface = np.zeros((64,) * 3, dtype=bool)
    surface[tuple(voxels.T)] = True
    overlaps = []
    for turn in QUARTER_TURNS:
        if not np.array_equal(turn, np.eye(3)):
            turned = np.rint((voxels - 31.5) @ turn.T + 31.5).astype(int)
            both = surface[tuple(turned.T)].sum()
            overlaps.append(both / (2 * len(voxels) - both))
    assert max(overlaps) > 0.99 if made.symmetric else max(overlaps) < 0.85


def test_half_painted_ball_is_symmetric_in_shape_but_not_in_material():
    made = asset(list(CATALOGUE).index("sport_balls"), 0)
    assert made.symmetric
    share = np.bincount(made.views[0].material) / len(made.views[0].coords)
    assert sorted(share[share > 0]) == pytest.approx([0.5, 0.5], abs=0.02)


@pytest.mark.parametrize("index", range(0, len(CATALOGUE), 3))
def test_damage_bites_and_adds_floaters_one_without_a_label(index):
    made, whole = asset(index, 2), asset(index, 1)
    pieces = label(made.occupancy, np.ones((3, 3, 3)))[1]
    assert pieces > label(whole.occupancy, np.ones((3, 3, 3)))[1]
    unlabelled = made.grid[..., 3] == -1
    assert 0 < unlabelled.sum() < 0.01 * made.occupancy.sum()
    assert not made.grid[unlabelled, :3].any()
    assert np.array_equal(made.occupancy, made.grid[..., 3] != 7)


@pytest.mark.parametrize("index", range(len(CATALOGUE)))
def test_scale_of_each_level(index):
    linear = [asset(index, level).views[0].transform[:3, :3] for level in SAME_SHAPE_LEVELS]
    scales = np.cbrt(np.linalg.det(linear))
    assert scales[[0, 1, 4]] == pytest.approx(1.0, abs=1e-12)
    assert 0.0199 <= abs(scales[2] - 1.0) <= 0.1001


@pytest.mark.parametrize("seed", range(8))
def test_frames_agree_with_their_transform(seed):
    rng = np.random.default_rng(seed)
    solid = Solid(CATALOGUE["tree"](rng, 0).parts)
    frames = draw_frames(rng, solid, LEVELS[seed % 4], QUARTER_TURNS[seed])
    points = rng.uniform(-0.5, 0.5, (100, 3))
    matrix = frames.transform()
    moved = points @ matrix[:3, :3].T + matrix[:3, 3]
    assert np.allclose(frames.slat_to_object(moved), frames.pixieverse.to_object(points))
    tilt = matrix[:3, :3].T @ QUARTER_TURNS[seed].T
    if seed % 4 in (1, 2):
        cosine = (np.trace(tilt / np.cbrt(np.linalg.det(tilt))) - 1) / 2
        assert np.degrees(np.arccos(min(1.0, cosine))) <= 15.0


def test_warp_is_smooth_and_about_a_voxel():
    rng = np.random.default_rng(3)
    solid = Solid(CATALOGUE["rocks"](rng, 0).parts)
    rms = []
    for _ in range(20):
        warp = draw_frames(rng, solid, LEVELS[4], np.eye(3)).warp
        points = rng.uniform(-0.5, 0.5, (2_000, 3))
        away = np.linalg.norm(warp(points) - points, axis=1)
        assert away.max() <= warp.reach
        rms.append(np.sqrt((away**2).mean()) * 64)
        step = rng.normal(0.0, 0.01, points.shape)
        stretch = np.linalg.norm(warp(points + step) - warp(points), axis=1)
        assert np.all(stretch <= warp.stretch * np.linalg.norm(step, axis=1))
    assert 0.8 < np.mean(rms) < 1.2


def test_views_turn_the_slat_side_about_z():
    made = asset(0, 1, views=3)
    first, second, third = made.views
    assert [view.view for view in made.views] == ["view_0", "view_1", "view_2"]
    quarter = second.transform[:3, :3] @ first.transform[:3, :3].T
    assert np.allclose(quarter, [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = {(63 - y, x, z) for x, y, z in first.coords.tolist()}
    assert turned == set(map(tuple, second.coords.tolist()))
    assert np.allclose(third.transform[:3, :3] @ first.transform[:3, :3].T, np.diag([-1, -1, 1]))


def test_habitual_share_gives_most_assets_one_quarter_turn():
    turns = [
        make_asset(4, 20 + 14 * 3 * k, levels=(0,), habitual_share=0.8).views[0].transform[:3, :3]
        for k in range(20)
    ]
    counts = np.unique(np.rint(turns).reshape(20, 9), axis=0, return_counts=True)[1]
    assert 12 <= counts.max() <= 19


@pytest.mark.parametrize("kind", ["placeholder", "material"])
def test_latents_have_the_published_statistics_or_tell_materials_apart(kind):
    made = asset(10, 0, latents=kind)
    feats, material = made.views[0].feats, made.views[0].material
    assert feats.dtype == np.float32
    centred = (feats - MEAN) / STD
    if kind == "placeholder":
        assert np.allclose(centred.mean(axis=0), 0, atol=0.05)
        assert np.allclose(centred.std(axis=0), 1, atol=0.05)
        return
    # The nearest class mean names the class of nearly all, which noise cannot.
    present = np.unique(material)
    means = np.stack([centred[material == m].mean(axis=0) for m in present])
    named = present[cKDTree(means).query(centred)[1]]
    assert (named == material).mean() > 0.9


def test_every_category_has_a_builder_and_every_object_an_id():
    assert {asset(k, 0).category for k in range(len(CATALOGUE))} == set(CATALOGUE)
    ids = [object_id(0, k) for k in range(100)] + [object_id(1, k) for k in range(100)]
    assert len(set(ids)) == 200
    assert all(len(i) == 32 and set(i) <= set("0123456789abcdef") for i in ids)


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
@example(normal=(1.0, 0.0, 0.0), offset=0.6)
@example(normal=(1.0, 0.0, 0.0), offset=-0.6)
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
