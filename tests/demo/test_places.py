"""True places of shapes that differ: against the maps inverted by numbers, and the voxels."""

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import binary_fill_holes, distance_transform_edt, label, map_coordinates
from scipy.optimize import least_squares, root
from scipy.spatial import cKDTree

from slatprep.demo import make_demo
from slatprep.demo.asset import make_asset
from slatprep.demo.catalogue import CATALOGUE
from slatprep.demo.difficulty import LEVELS, QUARTER_TURNS, draw_frames, generate
from slatprep.demo.generated import draw_distortion
from slatprep.demo.nerf import UNLABELLED, nerf_field
from slatprep.demo.shapes import Solid

CUBE = np.array([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]])
KINDS = [list(CATALOGUE).index(c) for c in ("flowers", "rubber_ducks_and_toys", "soda_cans")]


@cache
def asset(index, level, views=1):
    return make_asset(12, index, levels=(level,), views=views)


def distortion(seed):
    return draw_distortion(np.random.default_rng(seed), CUBE, 2.0)


def centres_of(view):
    return (view.coords + 0.5) / 64 - 0.5


def inverse_of(transform, points):
    return (points - transform[:3, 3]) @ np.linalg.inv(transform[:3, :3]).T


@pytest.mark.parametrize("seed", range(6))
def test_a_distortion_folds_nowhere_and_keeps_its_bound(seed):
    shape = distortion(seed)
    points = np.random.default_rng(1).uniform(-0.7, 0.7, (3_000, 3))
    step = 1e-5
    columns = [
        (shape(points + step * e) - shape(points - step * e)) / (2 * step) for e in np.eye(3)
    ]
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
    waves = shape.waves
    wanted = skin[:20]

    def object_of(y):
        q = (y - shape.middle) / shape.size
        growth = 1.0 + np.tanh(4.0 * (shape.away @ q)) / 3.0
        bend = sum(
            a * np.sin(k @ q + p)
            for a, k, p in zip(waves.amplitude, waves.wave, waves.phase, strict=True)
        )
        return shape.middle + shape.size * (q + growth * bend) / shape.proportions

    for point in wanted:
        found = root(lambda y, p=point: object_of(y) - p, point, tol=1e-13)
        assert found.success
        in_slat, in_pixieverse = (
            pose.scale * pose.rotation @ (there - pose.centre) + pose.shift
            for pose, there in ((slat, found.x), (frames.pixieverse, point))
        )
        assert np.allclose(frames.places(in_slat[None])[0], in_pixieverse, atol=1e-10)


@pytest.mark.parametrize("level", [5, 6, 7])
@pytest.mark.parametrize("index", KINDS)
def test_labels_are_those_at_the_places(index, level):
    made = asset(index, level)
    (view,) = made.views
    ids = made.grid[..., 3]
    annotated = np.argwhere((ids >= 0) & (ids < 7))
    distance, nearest = cKDTree((annotated + 0.5) / 64 - 0.5).query(view.places)
    near = distance * 64 <= 2
    assert near.mean() > 0.95
    right = (ids[tuple(annotated[nearest].T)] == view.material)[near]
    assert right.mean() > 0.97
    properties = made.grid[tuple(annotated[nearest].T)][:, [1, 0, 2]]
    same = np.all(properties == view.properties, axis=1)[near]
    assert same.mean() > 0.95


@pytest.mark.parametrize("level", [5, 7])
@pytest.mark.parametrize("index", KINDS)
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
    off = 64 * np.linalg.norm(inverse_of(view.transform, centres) - view.places, axis=1)
    assert 0.7 < off.mean() < 4.5
    # It nearly fills the cube: where a surface left it, the outermost layer would show the cut.
    coords = view.coords.astype(int)
    faces = (coords == 0) | (coords == 63)
    assert faces.any(axis=1).sum() < 0.01 * len(coords)
    assert (coords.max(axis=0) - coords.min(axis=0)).max() >= 57


@pytest.mark.parametrize("index", KINDS)
def test_without_another_shape_the_transform_leads_to_the_places(index):
    (view,) = asset(index, 6).views
    assert np.allclose(inverse_of(view.transform, centres_of(view)), view.places, atol=1e-12)


def test_each_view_of_a_generated_asset_is_another_shape():
    first, second = asset(KINDS[1], 5, views=2).views
    turned = np.column_stack([63 - first.coords[:, 1].astype(int), first.coords[:, [0, 2]]])
    shared = set(map(tuple, turned.tolist())) & set(map(tuple, second.coords.tolist()))
    assert len(shared) < 0.5 * len(first.coords)
    # And the first is what it is without the second.
    alone = asset(KINDS[1], 5).views[0]
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
        pieces, count = label(occupied, np.ones((3, 3, 3)))
        body = pieces == pieces[16, 32, 38]
        unlabelled.append((field == UNLABELLED).sum())
        blobs.append(count - 1)
        hollow.append((binary_fill_holes(occupied) & ~occupied).sum())
        # Above the block's middle nothing of the ground is seen.
        signed = np.where(body, 0.5 - distance_transform_edt(body), 0)
        signed += np.where(body, 0, distance_transform_edt(~body) - 0.5)
        u, v = np.meshgrid(np.arange(22.0, 42.0), np.arange(28.0, 38.0))
        face = np.stack([np.full(u.size, 15.5), u.ravel(), v.ravel()])
        thick.append(-map_coordinates(signed, face, order=1))
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


def test_truth_files_name_places_where_shapes_differ_and_nowhere_else(tmp_path):
    assert set(make_demo(tmp_path, 4, 3, levels=(0, 4, 6, 7)).levels) == {0, 4, 6, 7}
    for path in (tmp_path / "truth").glob("*.npz"):
        with np.load(path) as truth:
            assert ("places" in truth) == (int(truth["level"]) >= 5)
            if "places" in truth:
                assert truth["places"].dtype == np.float64
                assert truth["places"].shape == (len(truth["material"]), 3)
                assert np.abs(truth["places"]).max() <= 0.5
