"""The truth of demo assets, from the voxels and the maps inverted by numbers; shapes, voxels."""

from functools import cache

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.optimize import least_squares, root
from scipy.spatial import cKDTree

from slatprep.demo import shapes
from slatprep.demo.asset import make_asset, object_id
from slatprep.demo.catalogue import CATALOGUE
from slatprep.demo.difficulty import LEVELS, QUARTER_TURNS, SAME_SHAPE_LEVELS, draw_frames, generate
from slatprep.demo.generated import draw_distortion
from slatprep.demo.model import MATERIALS, direction, orient, rock, vessel
from slatprep.demo.nerf import UNLABELLED, nerf_field
from slatprep.demo.shapes import Part, Solid, Stuff
from slatprep.demo.voxelise import voxelise
from slatprep.geometry.frames import voxel_centres
from slatprep.geometry.voxels import occupancy_of
from slatprep.records import FEATS_MEAN, FEATS_STD

KINDS = range(2 * len(CATALOGUE))
"""Two turns through the categories: the first two kinds of each."""

SOME = [list(CATALOGUE).index(c) for c in ("flowers", "rubber_ducks_and_toys", "soda_cans")]


@cache
def asset(index, level, **options):
    return make_asset(11, index, levels=(level,), **options)


def centres_of(view):
    return (view.coords + 0.5) / 64 - 0.5


def looked_up(view):
    """Return where SLAT voxels truly lie in the grid's frame, by the inverse of the transform."""
    centres = centres_of(view) - view.transform[:3, 3]
    return centres @ np.linalg.inv(view.transform[:3, :3]).T


@pytest.mark.parametrize("index", KINDS)
def test_quarter_turn_is_an_exact_permutation_of_the_axes(index):
    made = asset(index, 0)
    turn = made.views[0].transform[:3, :3]
    assert any(np.allclose(turn, quarter, atol=1e-12) for quarter in QUARTER_TURNS)
    assert np.allclose(made.views[0].transform[:3, 3], 0, atol=1e-12)
    surface = occupancy_of(np.rint((looked_up(made.views[0]) + 0.5) * 64 - 0.5).astype(int))
    # The filled grid holds every surface voxel, and no face of what is not one is bare.
    assert not np.any(surface & ~made.occupancy)
    padded = np.pad(made.occupancy, 1)
    faces = ndimage.generate_binary_structure(3, 1)
    inside = ndimage.binary_erosion(padded, faces)[1:-1, 1:-1, 1:-1]
    assert not np.any(made.occupancy & ~inside & ~surface)
    # The object fills the cube on both sides.
    for voxels in (made.views[0].coords, np.argwhere(made.occupancy)):
        low, high = voxels.min(axis=0), voxels.max(axis=0)
        assert (high - low).max() == 63
        assert np.all(np.abs(low + high.astype(int) - 63) <= 1)


@pytest.mark.parametrize("index", KINDS)
def test_true_transform_lands_on_the_object(index):
    made = asset(index, 1)
    occupied = (np.argwhere(made.occupancy) + 0.5) / 64 - 0.5
    distance = cKDTree(occupied).query(looked_up(made.views[0]))[0] * 64
    # A SLAT voxel is within half a diagonal of the surface, which is as near to a grid's voxel.
    assert distance.max() <= 3**0.5
    assert np.quantile(distance, 0.98) <= 1.0


@pytest.mark.parametrize(("index", "level", "least", "near"), [
    *((index, 1, 0.97, 1.0) for index in KINDS),
    *((index, 2 + index % 2, 0.95, 0.9) for index in range(len(CATALOGUE))),
    *((index, 4, 0.95, 0.97) for index in range(len(CATALOGUE))),
    *((index, level, 0.97, 0.95) for index in SOME for level in (5, 6, 7)),
])  # fmt: skip
def test_labels_are_those_at_the_true_places(index, level, least, near):
    made = asset(index, level)
    (view,) = made.views
    places = looked_up(view) if view.places is None else view.places
    annotated = np.argwhere((made.grid[..., 3] >= 0) & (made.grid[..., 3] < 7))
    distance, nearest = cKDTree((annotated + 0.5) / 64 - 0.5).query(places)
    within = distance * 64 <= 2
    assert within.mean() >= near
    density, modulus, ratio, material = made.grid[tuple(annotated[nearest].T)].T
    assert (material == view.material)[within].mean() > least
    same = np.all(np.stack([modulus, density, ratio], axis=1) == view.properties, axis=1)
    assert same[within].mean() > least - 0.02


@pytest.mark.parametrize("index", KINDS)
def test_properties_follow_the_material_and_stay_in_the_published_span(index):
    made = asset(index, 1)
    view = made.views[0]
    some = zip(view.material[::97], view.properties[::97], strict=True)
    for material, (modulus, density, poisson) in some:
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
    surface = occupancy_of(voxels)
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
    pieces = ndimage.label(made.occupancy, np.ones((3, 3, 3)))[1]
    assert pieces > ndimage.label(whole.occupancy, np.ones((3, 3, 3)))[1]
    unlabelled = made.grid[..., 3] == -1
    assert 0 < unlabelled.sum() < 0.01 * made.occupancy.sum()
    assert not made.grid[unlabelled, :3].any()
    assert np.array_equal(made.occupancy, made.grid[..., 3] != 7)


@pytest.mark.parametrize("index", range(0, len(CATALOGUE), 2))
def test_scale_and_tilt_of_each_level(index):
    linear = [asset(index, level).views[0].transform[:3, :3] for level in SAME_SHAPE_LEVELS]
    scales = np.cbrt(np.linalg.det(linear))
    assert scales[[0, 1, 4]] == pytest.approx(1.0, abs=1e-12)
    assert 0.0199 <= abs(scales[2] - 1.0) <= 0.1001
    # The angle to the nearest quarter turn: its cosine is (trace - 1) / 2.
    for level in (1, 2, 4):
        traces = [(linear[level] / scales[level] * turn).sum() for turn in QUARTER_TURNS]
        assert 0.0 < np.degrees(np.arccos((max(traces) - 1) / 2)) <= 15.0


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
    (view,) = asset(SOME[0], 4).views
    off = 64 * np.linalg.norm(looked_up(view) - view.places, axis=1)
    assert 0.8 < off.mean() < 1.2


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
    numbers = range(20, 20 + 14 * 3 * 20, 14 * 3)
    made = (make_asset(4, k, levels=(0,), habitual_share=0.8) for k in numbers)
    turns = [one.views[0].transform[:3, :3] for one in made]
    counts = np.unique(np.rint(turns).reshape(20, 9), axis=0, return_counts=True)[1]
    assert 12 <= counts.max() <= 19


@pytest.mark.parametrize("kind", ["placeholder", "material"])
def test_latents_have_the_published_statistics_or_tell_materials_apart(kind):
    made = asset(10, 0, latents=kind)
    feats, material = made.views[0].feats, made.views[0].material
    assert feats.dtype == np.float32
    centred = (feats - np.array(FEATS_MEAN)) / np.array(FEATS_STD)
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


CUBE = np.array([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]])


def distortion(seed):
    return draw_distortion(np.random.default_rng(seed), CUBE, 2.0)


@pytest.mark.parametrize("seed", range(6))
def test_a_distortion_folds_nowhere_and_keeps_its_bound(seed):
    shape = distortion(seed)
    points = np.random.default_rng(1).uniform(-0.7, 0.7, (3_000, 3))
    columns = [(shape(points + e) - shape(points - e)) / 2e-5 for e in 1e-5 * np.eye(3)]
    jacobian = np.stack(columns, axis=-1)
    assert np.linalg.det(jacobian).min() > 0.2
    assert np.linalg.norm(jacobian, 2, axis=(1, 2)).max() <= shape.stretch
    assert np.allclose(shape(shape.inverse(points)), points, atol=1e-9)


def test_a_distortion_is_as_far_off_as_its_level_says():
    points = np.random.default_rng(2).uniform(-0.5, 0.5, (5_000, 3))
    seen, unseen, errors = [], [], []
    for seed in range(15):
        shape = distortion(seed)
        errors.append(np.sort(np.abs(shape.proportions - 1.0)))
        # Without the proportions what is left is the bend.
        bend = 64 * np.linalg.norm(shape(points) * shape.proportions - points, axis=1)
        side = points @ shape.away
        seen.append((bend[side < -0.25] ** 2).mean())
        unseen.append((bend[side > 0.25] ** 2).mean())
    errors = np.array(errors)
    assert not errors[:, :2].any()
    assert 0.1 <= errors[:, 2].min() <= errors[:, 2].max() <= 0.25
    near, far = np.sqrt(np.mean(seen)), np.sqrt(np.mean(unseen))
    assert far / near == pytest.approx(2.0, rel=0.2)
    assert np.sqrt((near**2 + far**2) / 2) == pytest.approx(2.0, rel=0.2)


def test_places_are_where_the_maps_inverted_by_numbers_put_them():
    """A point of the object is sent to both sides; its place must lead from one to the other."""
    rng = np.random.default_rng(5)
    solid = Solid(CATALOGUE["tree"](rng, 0).parts)
    frames = draw_frames(rng, solid, LEVELS[5], QUARTER_TURNS[7])
    skin = rng.uniform(*solid.extent, (500, 3))
    frames = generate(rng, frames, LEVELS[5].bend, solid, skin)
    shape, slat = frames.distortion, frames.slat
    waves = shape.waves.amplitude, shape.waves.wave, shape.waves.phase

    def object_of(y):
        q = (y - shape.middle) / shape.size
        growth = 1.0 + np.tanh(4.0 * (shape.away @ q)) / 3.0
        bend = sum(a * np.sin(k @ q + p) for a, k, p in zip(*waves, strict=True))
        return shape.middle + shape.size * (q + growth * bend) / shape.proportions

    def placed(pose, there):
        return pose.scale * pose.rotation @ (there - pose.centre) + pose.shift

    for point in skin[:20]:
        found = root(lambda y, p=point: object_of(y) - p, point, tol=1e-13)
        assert found.success
        there = frames.places(placed(slat, found.x)[None])[0]
        assert np.allclose(there, placed(frames.pixieverse, point), atol=1e-10)


@pytest.mark.parametrize("level", [5, 7])
@pytest.mark.parametrize("index", SOME)
def test_transform_is_the_similarity_with_the_least_squares(index, level):
    (view,) = asset(index, level).views
    centres = centres_of(view)

    def residuals(x):
        turn = np.cross(np.eye(3), x[:3]).T
        linear = np.exp(x[3]) * (np.eye(3) + turn + turn @ turn / 2) @ view.transform[:3, :3]
        return (view.places @ linear.T + view.transform[:3, 3] + x[4:] - centres).ravel()

    # To second order in the turn it is a similarity: the gradient tells, and the step.
    found = least_squares(residuals, np.zeros(7), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert np.abs(found.x).max() < 1e-6
    off = 64 * np.linalg.norm(looked_up(view) - view.places, axis=1)
    assert 0.7 < off.mean() < 4.5
    # It nearly fills the cube: where a surface left it, the outermost layer would show the cut.
    coords = view.coords.astype(int)
    faces = (coords == 0) | (coords == 63)
    assert faces.any(axis=1).sum() < 0.01 * len(coords)
    assert (coords.max(axis=0) - coords.min(axis=0)).max() >= 57


@pytest.mark.parametrize("index", SOME)
def test_without_another_shape_the_transform_leads_to_the_places(index):
    (view,) = asset(index, 6).views
    assert np.allclose(looked_up(view), view.places, atol=1e-12)


def test_each_view_of_a_generated_asset_is_another_shape():
    first, second = asset(SOME[1], 5, views=2).views
    turned = np.column_stack([63 - first.coords[:, 1].astype(int), first.coords[:, [0, 2]]])
    shared = set(map(tuple, turned.tolist())) & set(map(tuple, second.coords.tolist()))
    assert len(shared) < 0.5 * len(first.coords)
    # And the first is what it is without the second.
    alone = asset(SOME[1], 5).views[0]
    assert np.array_equal(alone.coords, first.coords)
    assert np.array_equal(alone.places, first.places)


def block(low, high):
    stuff = np.full((64, 64, 64), -1, np.int16)
    stuff[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = 0
    return stuff


def test_a_nerf_field_is_thick_and_rough_with_hollows_and_blobs():
    stuff = block((16, 16, 16), (48, 48, 40))
    thick, hollow, blobs, unlabelled, grounds = [], [], [], [], 0
    for seed in range(20):
        field = nerf_field(np.random.default_rng(seed), stuff, np.array([0.0, 0.0, 1.0]), 3)
        occupied = field != -1
        pieces, count = ndimage.label(occupied, np.ones((3, 3, 3)))
        body = pieces == pieces[16, 32, 38]
        unlabelled.append((field == UNLABELLED).sum())
        blobs.append(count - 1)
        hollow.append((ndimage.binary_fill_holes(occupied) & ~occupied).sum())
        # Above the block's middle nothing of the ground is seen, nor what is far of the side.
        body = body[4:30, 8:56, 16:52]
        inner, outer = map(ndimage.distance_transform_edt, (body, ~body))
        signed = np.where(body, 0.5 - inner, outer - 0.5)
        u, v = np.meshgrid(np.arange(22.0, 42.0), np.arange(28.0, 38.0))
        face = np.stack([np.full(u.size, 15.5 - 4), u.ravel() - 8, v.ravel() - 16])
        thick.append(-ndimage.map_coordinates(signed, face, order=1))
        grounds += occupied[20:44, 20:44, 14].mean() > 0.9
    assert np.mean(thick) == pytest.approx(0.5, abs=0.2) and 0.3 < np.std(thick) < 1.0
    assert np.mean(np.array(hollow) > 0) > 0.9
    assert min(blobs) >= 1 and min(unlabelled) > 0
    assert 0.15 < grounds / 20 < 0.55


def test_a_nerf_field_loses_some_thin_parts_but_never_the_object():
    stuff = block((16, 16, 16), (48, 48, 32))
    for x in range(18, 48, 6):
        for y in range(18, 48, 6):
            stuff[x : x + 2, y : y + 2, 32:52] = 1
    lost = []
    for seed in range(10):
        field = nerf_field(np.random.default_rng(seed), stuff, np.array([0.0, 0.0, 1.0]), 2)
        rods = stuff == 1
        lost.append((field[rods] == -1).mean())
        assert (field[stuff >= 0] == -1).sum() < 0.3 * (stuff >= 0).sum()
    assert 0.02 < np.mean(lost) < 0.9
    only_thin = np.where(stuff == 1, np.int16(0), np.int16(-1))
    field = nerf_field(np.random.default_rng(0), only_thin, np.array([0.0, 0.0, 1.0]), 1)
    assert ((field == 0) & (only_thin == 0)).sum() > 0.6 * (only_thin == 0).sum()


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
    coat = (shapes.half_space((0.3, 0, 0), (0, 0, 1)), stuffs[2])
    left, right = (shapes.sphere((x, 0, 0), 0.25) for x in (-0.3, 0.3))
    solid = Solid([Part(left, stuffs[0]), Part(right, stuffs[1], (coat,))])
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
    # Farther than its reach the solid says no more than "at least so far".
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
