"""Nearest voxels and votes, against a kd-tree and by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from slatprep.geometry.frames import voxel_centres
from slatprep.geometry.nearest import Lattice, _columns, _search_columns


@settings(max_examples=40)
@given(st.integers(1, 3000), st.integers(0, 2**32 - 1), st.floats(0.2, 1.5), st.integers(1, 64))
def test_the_nearest_voxel_is_a_kd_tree_s(count, seed, spread, side):
    rng = np.random.default_rng(seed)
    corner = rng.integers(0, 65 - side, 3)
    voxels = np.unique(corner + rng.integers(0, side, (count, 3)), axis=0).astype(np.uint8)
    points = rng.uniform(-spread, spread, (200, 3))
    points[:50] = np.round(points[:50] * 128) / 128  # on voxels, faces and edges
    distance, index = Lattice(voxels).nearest(points)
    expected, _ = cKDTree(voxel_centres(voxels)).query(points)
    np.testing.assert_allclose(distance, expected * 64, atol=1e-9)
    apart = np.linalg.norm(points - voxel_centres(voxels[index]), axis=1) * 64
    np.testing.assert_allclose(apart, distance, atol=1e-9)


def test_of_equally_near_voxels_the_first_is_taken():
    voxels = np.array([[11, 10, 10], [9, 10, 10], [10, 11, 10]], dtype=np.uint8)
    for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        _, index = Lattice(voxels[order]).nearest(voxel_centres([[10, 10, 10]]))
        assert index.tolist() == [0]


def test_of_two_voxels_as_near_as_the_searched_cells_reach_the_first_is_taken():
    """One of them, 3.5 voxels off, lies among the cells around the point, the other beyond."""
    for first, second in ((14, 7), (7, 14)):
        voxels = np.array([[first, 30, 30], [second, 30, 30]], dtype=np.uint8)
        distance, index = Lattice(voxels).nearest(voxel_centres([[10.5, 30, 30]]))
        assert (distance.tolist(), index.tolist()) == ([3.5], [0])


@pytest.mark.parametrize("limit", [0.5, 1.5, 3.0, np.inf])
def test_the_ends_of_the_grid_are_far_apart(limit):
    """Against brute force around faces, edges and corners: no look-up runs over into another row.

    Of each pair of opposite ends one alone has voxels, along a line here and there.
    """
    ends = np.array([[0, 9, 9], [63, 30, 30], [9, 0, 40], [40, 63, 9], [20, 9, 0], [9, 50, 63],
                     [0, 0, 20], [63, 20, 63]], dtype=np.uint8)  # fmt: skip
    voxels = np.unique(np.concatenate([ends, np.roll(ends, 1, axis=1)]), axis=0)
    across = (64 * (voxels == 0)) - 64 * (voxels == 63).astype(int)
    nearby = np.argwhere(np.ones((5, 5, 5), dtype=bool)) - 2
    opposite = (voxels + across)[:, None] + nearby
    index = np.concatenate([opposite, voxels[:, None] + nearby]).reshape(-1, 3) + 0.25
    squares = ((index[:, None] - voxels.astype(int)) ** 2).sum(axis=2)
    within = squares.min(axis=1) <= limit**2
    distance, found = Lattice(voxels).nearest(voxel_centres(index), limit=limit)
    assert within.any()
    np.testing.assert_array_equal(found, np.where(within, squares.argmin(axis=1), -1))
    np.testing.assert_allclose(distance[within], np.sqrt(squares.min(axis=1)[within]))


@pytest.mark.parametrize("limit", [0.5, 1.0, 3.0, 6.5, 9.0, np.inf])
def test_every_cell_of_the_grid_finds_the_first_of_its_nearest_voxels(limit):
    """Against all distances by brute force, in whole numbers: near, far, and often tied."""
    voxels = np.array(
        [[3, 3, 3], [3, 9, 3], [40, 40, 41], [40, 40, 40], [63, 0, 63], [3, 3, 15]], dtype=np.uint8
    )
    cells = np.argwhere(np.ones((64, 64, 64), dtype=bool))
    squares = ((cells[:, None] - voxels.astype(int)) ** 2).sum(axis=2)
    least = squares.min(axis=1)
    first = squares.argmin(axis=1)
    distance, index = Lattice(voxels).nearest(voxel_centres(cells), limit=limit)
    within = least <= limit**2
    assert within.any()
    np.testing.assert_array_equal(index, np.where(within, first, -1))
    np.testing.assert_allclose(distance[within], np.sqrt(least[within]), rtol=1e-12)
    assert np.isinf(distance[~within]).all()


@pytest.mark.parametrize("limit", [3.5, 9.0, np.inf])
def test_half_way_between_voxels_the_first_of_the_nearest_is_found(limit):
    """Against brute force in doubled whole numbers, where every axis has ties."""
    rng = np.random.default_rng(3)
    corners = rng.integers(0, 63, (60, 3))
    around = np.argwhere(np.ones((2, 2, 2), dtype=bool))
    voxels = np.unique((corners[:, None] + around).reshape(-1, 3), axis=0).astype(np.uint8)
    rng.shuffle(voxels)
    doubled = rng.integers(-20, 148, (4000, 3))
    squares = ((doubled[:, None] - 2 * voxels.astype(int)) ** 2).sum(axis=2)
    within = squares.min(axis=1) <= (2 * limit) ** 2
    distance, index = Lattice(voxels).nearest(voxel_centres(doubled / 2), limit=limit)
    np.testing.assert_array_equal(index, np.where(within, squares.argmin(axis=1), -1))
    np.testing.assert_allclose(distance[within], np.sqrt(squares.min(axis=1)[within]) / 2)


def test_beyond_the_limit_nothing_is_found():
    voxels = np.array([[0, 0, 0]], dtype=np.uint8)
    points = voxel_centres([[2, 0, 0], [3, 0, 0], [63, 63, 63]])
    distance, index = Lattice(voxels).nearest(points, limit=2.0)
    assert distance.tolist() == [2.0, np.inf, np.inf]
    assert index.tolist() == [0, -1, -1]


@pytest.mark.parametrize("limit", [0.5, 1.0, 2.5, 3.5])
def test_just_at_the_limit_a_voxel_is_found_wherever_it_lies(limit):
    """Along a whole line of the grid, from either side."""
    for last in range(4, 60):
        voxels = np.array([[last, 30, 30]], dtype=np.uint8)
        points = voxel_centres([[last - limit, 30, 30], [last + limit, 30, 30]])
        distance, index = Lattice(voxels).nearest(points, limit=limit)
        assert (distance.tolist(), index.tolist()) == ([limit] * 2, [0, 0])


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
        Lattice(np.zeros((0, 3), dtype=np.uint8))


def test_two_voters_outvote_a_nearer_one():
    # The point sits 0.4 of the way from voxel 30 to 31: class 2 is nearest, but
    # class 5 speaks from x = 31 and from both sides in y.
    voxels = np.array([[30, 20, 20], [31, 20, 20], [31, 21, 20], [31, 19, 20]], dtype=np.uint8)
    labels = np.array([2, 5, 5, 5], dtype=np.uint8)
    point = voxel_centres([[30, 20, 20]]) + np.array([[0.4, 0, 0]]) / 64
    weight = {2: np.exp(-2 * 0.4**2), 5: np.exp(-2 * 0.6**2) + 2 * np.exp(-2 * (0.6**2 + 1))}
    assert weight[5] < weight[2]  # with a width of 0.5 the nearest one still holds
    assert Lattice(voxels).vote(point, labels, 0.5).tolist() == [0]
    assert Lattice(voxels).vote(point, labels, 1.0).tolist() == [1]  # with 1.0 it does not


def test_a_vote_without_voters_is_empty():
    voxels = np.array([[0, 0, 0]], dtype=np.uint8)
    assert Lattice(voxels).vote(
        voxel_centres([[5, 5, 5]]), np.zeros(1, np.uint8), 0.5
    ).tolist() == [-1]


def test_each_vote_is_of_its_own_labels():
    """Of a lattice that has voted before, with labels that all agreed where these do not."""
    voxels = np.array([[30, 20, 20], [31, 20, 20], [31, 21, 20], [31, 19, 20]], dtype=np.uint8)
    point = voxel_centres([[30.4, 20, 20]])
    lattice = Lattice(voxels)
    alike, mixed = np.zeros(4, np.uint8), np.array([2, 5, 5, 5], dtype=np.uint8)
    assert [lattice.vote(point, labels, 1.0).tolist() for labels in (alike, mixed, alike)] == [
        [0], [1], [0],
    ]  # fmt: skip


def test_of_a_drawn_vote_the_lower_label_wins():
    voxels = np.array([[31, 20, 20], [29, 20, 20]], dtype=np.uint8)
    point = voxel_centres([[30, 20, 20]])
    for labels, winner in (([4, 3], 1), ([3, 4], 0), ([3, 3], 0)):
        assert Lattice(voxels).vote(point, np.array(labels, np.uint8), 0.7).tolist() == [winner]


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(0.3, 1.0))
def test_votes_are_those_of_a_plain_count(seed, width):
    rng = np.random.default_rng(seed)
    voxels = np.unique(rng.integers(20, 26, (80, 3)), axis=0).astype(np.uint8)
    labels = rng.integers(0, 7, len(voxels)).astype(np.uint8)
    points = voxel_centres(rng.integers(19, 27, (20, 3))) + rng.uniform(-0.5, 0.5, (20, 3)) / 64
    spokesmen = Lattice(voxels).vote(points, labels, width)
    for point, spokesman in zip(points, spokesmen, strict=True):
        index = (point + 0.5) * 64 - 0.5
        around = np.abs(voxels - np.rint(index)).max(axis=1) <= 1
        square = ((voxels - index) ** 2).sum(axis=1)
        if not around.any():
            assert spokesman == -1
            continue
        weights = np.zeros(7)
        np.add.at(weights, labels[around], np.exp(-0.5 * square[around] / width**2))
        assert weights[labels[spokesman]] == pytest.approx(weights.max())
        same = around & (labels == labels[spokesman])
        assert square[spokesman] == pytest.approx(square[same].min())
