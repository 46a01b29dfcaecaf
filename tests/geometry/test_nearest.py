"""Nearest voxels, votes, distance, outside and surroundings: against a kd-tree, scipy and numpy."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from slatprep.geometry.distance import LARGEST_SIDE, signed_distance
from slatprep.geometry.fill import outside_of
from slatprep.geometry.frames import voxel_centres
from slatprep.geometry.nearest import VoxelIndex, _columns, _search_columns
from slatprep.geometry.surroundings import DIRECTIONS, labelled, shares_around
from slatprep.geometry.voxels import voxels_of


@settings(max_examples=40)
@given(st.integers(1, 3000), st.integers(0, 2**32 - 1), st.floats(0.2, 1.5), st.integers(1, 64))
def test_the_nearest_voxel_is_a_kd_tree_s(count, seed, spread, side):
    rng = np.random.default_rng(seed)
    corner = rng.integers(0, 65 - side, 3)
    voxels = np.unique(corner + rng.integers(0, side, (count, 3)), axis=0).astype(np.uint8)
    points = rng.uniform(-spread, spread, (200, 3))
    points[:50] = np.round(points[:50] * 128) / 128  # on voxels, faces and edges
    distance, index = VoxelIndex(voxels).nearest(points)
    expected, _ = cKDTree(voxel_centres(voxels)).query(points)
    np.testing.assert_allclose(distance, expected * 64, atol=1e-9)
    apart = np.linalg.norm(points - voxel_centres(voxels[index]), axis=1) * 64
    np.testing.assert_allclose(apart, distance, atol=1e-9)


def ends() -> tuple[np.ndarray, np.ndarray]:
    """Voxels at one of each pair of opposite ends alone; places around both, between cells."""
    ends = np.array([[0, 9, 9], [63, 30, 30], [9, 0, 40], [40, 63, 9], [20, 9, 0], [9, 50, 63],
                     [0, 0, 20], [63, 20, 63]])  # fmt: skip
    voxels = np.unique(np.concatenate([ends, np.roll(ends, 1, axis=1)]), axis=0)
    opposite = voxels + 64 * (voxels == 0) - 64 * (voxels == 63)
    nearby = np.argwhere(np.ones((5, 5, 5), dtype=bool)) - 2
    around = np.concatenate([opposite, voxels])[:, None] + nearby
    return voxels, 4 * around.reshape(-1, 3) + 1


def few() -> tuple[np.ndarray, np.ndarray]:
    """Few voxels, 12 apart and beside one another; the whole grid, far off and often tied."""
    voxels = np.array([[3, 3, 3], [3, 9, 3], [40, 40, 41], [40, 40, 40], [63, 0, 63], [3, 3, 15]])
    return voxels, 4 * np.argwhere(np.ones((64, 64, 64), dtype=bool))


def blocks() -> tuple[np.ndarray, np.ndarray]:
    """Blocks of eight voxels in any order; places half-way between cells, in the grid and out."""
    rng = np.random.default_rng(3)
    around = np.argwhere(np.ones((2, 2, 2), dtype=bool))
    voxels = np.unique((rng.integers(0, 63, (60, 1, 3)) + around).reshape(-1, 3), axis=0)
    rng.shuffle(voxels)
    return voxels, 2 * rng.integers(-20, 148, (4000, 3))


@pytest.mark.parametrize("limit", [0.5, 1.0, 2.5, 3.5, 6.5, 9.0, np.inf])
@pytest.mark.parametrize("held", [ends, few, blocks])
def test_of_equally_near_voxels_within_a_limit_the_first_is_found(held, limit):
    """Against brute force in whole numbers, quarters of a voxel."""
    voxels, quarters = held()
    squares = ((quarters[:, None] - 4 * voxels) ** 2).sum(axis=2)
    least = squares.min(axis=1)
    within = least <= (4 * limit) ** 2
    places = voxel_centres(quarters / 4)
    distance, index = VoxelIndex(voxels.astype(np.uint8)).nearest(places, limit=limit)
    np.testing.assert_array_equal(index, np.where(within, squares.argmin(axis=1), -1))
    np.testing.assert_allclose(distance[within], np.sqrt(least[within]) / 4, rtol=1e-12)
    assert within.any() and np.isinf(distance[~within]).all()


class _Counted:
    """An array that counts how often it is looked at."""

    def __init__(self, array: np.ndarray) -> None:
        self.array, self.shape, self.looks = array, array.shape, 0

    def __getitem__(self, index: object) -> object:
        self.looks += 1
        return self.array[index]


@pytest.mark.parametrize("held", ["two voxels", "a cube", "a shell", "dust"])
def test_a_point_that_is_far_off_costs_few_looks(held):
    """A SLAT that fills the grid has mostly such points."""
    cells = np.argwhere(np.ones((64, 64, 64), dtype=bool))
    inner = (np.abs(cells - 31.5) < 12).all(axis=1)
    rng = np.random.default_rng(0)
    voxels = {
        "two voxels": cells[:2],
        "a cube": cells[inner],
        "a shell": cells[inner & (np.abs(cells - 31.5) > 11).any(axis=1)],
        "dust": cells[rng.random(len(cells)) < 0.001],
    }[held]
    row = np.full((64, 64, 64), -1, dtype=np.int32)
    row[tuple(voxels.T)] = np.arange(len(voxels))
    turn = Rotation.from_euler("xyz", [10.0, 20.0, 30.0], degrees=True).as_matrix()
    points = (rng.choice(cells, 200) - 31.5) @ turn.T + 31.5
    columns = [_Counted(array) for array in _columns(row)]
    distance, _ = _search_columns.py_func(points, row, *columns, np.inf)
    np.testing.assert_allclose(distance, cKDTree(voxels).query(points)[0], rtol=1e-12)
    assert sum(array.looks for array in columns) < 400 * len(points)


def test_an_empty_set_is_refused():
    with pytest.raises(ValueError, match="empty"):
        VoxelIndex(np.zeros((0, 3), dtype=np.uint8))


def _voted(voxels, labels, points, width, most=2.0):
    return VoxelIndex(voxels).voted(points, labels, width, most)[1].tolist()


def test_where_nobody_votes_or_nothing_is_near_the_nearest_stands():
    voxels = np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0]], dtype=np.uint8)
    points, labels = voxel_centres([[0, 0, -3], [0, 0, -0.4]]), np.array([1, 0, 0], np.uint8)
    distance, index, near = VoxelIndex(voxels).voted(points, labels, 9.0, 2.0)
    assert (index.tolist(), near.tolist()) == ([0, 2], [False, True])
    np.testing.assert_allclose(distance, [3.0, 1.16**0.5])
    assert _voted(voxels, labels, points, 9.0, most=0.3) == [0, 0]


def test_each_vote_is_of_its_own_labels():
    """Of an index that has voted before, with labels that all agreed where these do not."""
    voxels = np.array([[30, 20, 20], [31, 20, 20], [31, 21, 20], [31, 19, 20]], dtype=np.uint8)
    point = voxel_centres([[30.4, 20, 20]])
    held = VoxelIndex(voxels)
    for labels, winner in (([0] * 4, 0), ([2, 5, 5, 5], 1), ([0] * 4, 0)):
        assert held.voted(point, np.array(labels, np.uint8), 1.0, 2.0)[1].tolist() == [winner]


def test_of_a_drawn_vote_the_lower_label_wins():
    voxels = np.array([[31, 20, 20], [29, 20, 20]], dtype=np.uint8)
    point = voxel_centres([[30, 20, 20]])
    for labels, winner in (([4, 3], 1), ([3, 4], 0), ([3, 3], 0)):
        assert _voted(voxels, np.array(labels, np.uint8), point, 0.7) == [winner]


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(0.3, 1.0))
def test_votes_are_those_of_a_plain_count(seed, width):
    rng = np.random.default_rng(seed)
    voxels = np.unique(rng.integers(20, 26, (80, 3)), axis=0).astype(np.uint8)
    # On one side all are alike, so that there is a border.
    labels = np.where(voxels[:, 0] > 22, 3, rng.integers(0, 7, len(voxels))).astype(np.uint8)
    points = voxel_centres(rng.integers(19, 27, (20, 3))) + rng.uniform(-0.5, 0.5, (20, 3)) / 64
    distances, spokesmen, _ = VoxelIndex(voxels).voted(points, labels, width, np.inf)
    for point, spokesman, distance in zip(points, spokesmen, distances, strict=True):
        index = (point + 0.5) * 64 - 0.5
        around = np.abs(voxels - np.rint(index)).max(axis=1) <= 1
        square = ((voxels - index) ** 2).sum(axis=1)
        assert distance == pytest.approx(square[spokesman] ** 0.5)
        if not around.any():
            assert square[spokesman] == pytest.approx(square.min())
            continue
        weights = np.zeros(7)
        np.add.at(weights, labels[around], np.exp(-0.5 * square[around] / width**2))
        assert weights[labels[spokesman]] == pytest.approx(weights.max())
        same = around & (labels == labels[spokesman])
        assert square[spokesman] == pytest.approx(square[same].min())


SEEDS = st.integers(0, 2**32 - 1)


def _expected(solid: np.ndarray) -> np.ndarray:
    inside, outside = map(ndimage.distance_transform_edt, (solid, ~solid))
    return np.where(solid, 0.5 - inside, outside - 0.5)


@given(st.tuples(*[st.integers(1, 12)] * 3), st.sampled_from([0.02, 0.3, 0.5, 0.97]), SEEDS)
@settings(max_examples=60)
def test_any_set_gets_the_exact_distance(shape, share, seed):
    solid = np.pad(np.random.default_rng(seed).random(shape) < share, 4)
    solid[4, 4, 4] = True
    for order in (solid, np.asfortranarray(solid)):
        np.testing.assert_allclose(signed_distance(order), _expected(solid), rtol=0, atol=1e-6)


def test_the_farthest_corners_of_the_largest_box_fit_the_integers():
    # The set touches all sides of its box and is as far from two corners as it can be.
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[0, 0, 0] = solid[63, 63, 63] = True
    padded = np.pad(solid, 4)
    assert padded.shape == (LARGEST_SIDE,) * 3
    np.testing.assert_allclose(signed_distance(padded), _expected(padded), rtol=0, atol=1e-5)


def test_too_large_a_box_and_too_long_a_line_are_refused():
    with pytest.raises(ValueError, match="at most 72"):
        signed_distance(np.zeros((73, 4, 4), dtype=bool))
    with pytest.raises(ValueError, match="at most 64"):
        outside_of(np.zeros((2, 2, 65), dtype=bool))


@given(
    st.tuples(*[st.integers(1, 9)] * 2, st.integers(1, 64)),
    st.sampled_from([0.0, 0.3, 0.6, 0.7, 1.0]),
    SEEDS,
)
@settings(max_examples=100)
def test_what_is_outside_of_any_set_is_scipy_s_region_of_a_corner(shape, share, seed):
    occupancy = np.random.default_rng(seed).random(shape) < share
    regions, _ = ndimage.label(~np.pad(occupancy, 1))
    outside = (regions == regions[0, 0, 0])[1:-1, 1:-1, 1:-1]
    np.testing.assert_array_equal(outside_of(occupancy), outside)


def test_a_flood_follows_a_winding_passage_back_and_forth():
    # Walls with gaps at alternating ends: the way in leads along every axis, both ways.
    occupancy = np.zeros((64, 64, 64), dtype=bool)
    occupancy[:, :, [0, 63]] = occupancy[:, [0, 63]] = occupancy[[0, 63]] = True
    occupancy[2:62:2] = True
    occupancy[2:62:4, 1, 1] = occupancy[4:62:4, 62, 62] = False
    assert not outside_of(occupancy).any()
    occupancy[0, 5, 5] = False
    np.testing.assert_array_equal(outside_of(occupancy), ~occupancy)


def test_shares_of_random_cells_by_plain_numpy():
    rng = np.random.default_rng(0)
    grid = rng.integers(5, 8, (64, 64, 64)).astype(np.uint8)
    points = rng.uniform(-0.6, 0.6, (200, 3))
    points[:20] = rng.uniform(-0.95, 0.95, (20, 3))
    labels = rng.integers(5, 7, 200).astype(np.uint8)
    voxels = voxels_of(grid != 7)
    cells = labelled(voxels, grid[tuple(voxels.T)], 3, 7)
    others, solid = shares_around(cells, points, labels, (1, 3), 7)
    axes = [s * row for row in np.eye(3) for s in (1, -1)]
    corners = [np.array(signs) / np.sqrt(3) for signs in itertools.product((1, -1), repeat=3)]
    padded = np.pad(grid, 64, constant_values=7)
    for column, radius in enumerate((1, 3)):
        steps = np.rint(radius * np.array(axes + corners)).astype(int)
        assert len(steps) == DIRECTIONS
        around = np.rint(points * 64 + 31.5).astype(int)[:, None] + steps + 64
        found = padded[tuple(np.moveaxis(around, -1, 0))]
        there = found != 7
        np.testing.assert_allclose(solid[:, column], there.mean(axis=1), rtol=1e-6)
        differ = (there & (found != labels[:, None])).sum(axis=1)
        expected = differ / np.maximum(there.sum(axis=1), 1)
        np.testing.assert_allclose(others[:, column], expected, rtol=1e-6)
