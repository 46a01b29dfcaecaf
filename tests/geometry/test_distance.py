"""Distance, outside and surroundings of voxel sets, against scipy and plain numpy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from slatprep.geometry.distance import LARGEST_SIDE, signed_distance
from slatprep.geometry.fill import outside_of
from slatprep.geometry.surroundings import DIRECTIONS, labelled, shares_around
from slatprep.geometry.voxels import voxels_of


def _expected(solid: np.ndarray) -> np.ndarray:
    inside = ndimage.distance_transform_edt(solid)
    outside = ndimage.distance_transform_edt(~solid)
    return np.where(solid, 0.5 - inside, outside - 0.5)


@given(
    shape=st.tuples(*[st.integers(1, 12)] * 3),
    share=st.sampled_from([0.02, 0.3, 0.5, 0.97]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=60)
def test_any_set_gets_the_exact_distance(shape, share, seed):
    rng = np.random.default_rng(seed)
    solid = np.pad(rng.random(shape) < share, 4)
    solid[4, 4, 4] = True
    np.testing.assert_allclose(signed_distance(solid), _expected(solid), rtol=0, atol=1e-6)


def test_the_farthest_corners_of_the_largest_box_fit_the_integers():
    # The set touches all sides of its box and is as far from two corners as it can be.
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[0, 0, 0] = solid[63, 63, 63] = True
    padded = np.pad(solid, 4)
    assert padded.shape == (LARGEST_SIDE,) * 3
    np.testing.assert_allclose(signed_distance(padded), _expected(padded), rtol=0, atol=1e-5)


def test_memory_order_does_not_matter():
    solid = np.pad(np.random.default_rng(3).random((9, 7, 11)) < 0.4, 4)
    np.testing.assert_array_equal(signed_distance(np.asfortranarray(solid)), signed_distance(solid))


def test_too_large_a_box_is_refused():
    with pytest.raises(ValueError, match="at most 72"):
        signed_distance(np.zeros((73, 4, 4), dtype=bool))


def _outside(occupancy: np.ndarray) -> np.ndarray:
    regions, _ = ndimage.label(~np.pad(occupancy, 1))
    return (regions == regions[0, 0, 0])[1:-1, 1:-1, 1:-1]


@given(
    shape=st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 64)),
    share=st.sampled_from([0.0, 0.3, 0.6, 0.7, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=100)
def test_any_set(shape, share, seed):
    occupancy = np.random.default_rng(seed).random(shape) < share
    np.testing.assert_array_equal(outside_of(occupancy), _outside(occupancy))


def test_a_flood_follows_a_winding_passage_back_and_forth():
    # Walls with gaps at alternating ends: the way in leads along every axis, both ways.
    occupancy = np.zeros((64, 64, 64), dtype=bool)
    occupancy[:, :, [0, 63]] = occupancy[:, [0, 63]] = occupancy[[0, 63]] = True
    occupancy[2:62:2] = True
    occupancy[2:62:4, 1, 1] = occupancy[4:62:4, 62, 62] = False
    assert not outside_of(occupancy).any()
    occupancy[0, 5, 5] = False
    np.testing.assert_array_equal(outside_of(occupancy), ~occupancy)


def test_longer_lines_than_a_word_are_refused():
    with pytest.raises(ValueError, match="at most 64"):
        outside_of(np.zeros((2, 2, 65), dtype=bool))


def _shares(grid, points, labels, radii):
    voxels = voxels_of(grid != 7)
    cells = labelled(voxels, grid[tuple(voxels.T)], max(radii), 7)
    return shares_around(cells, points, labels, radii, 7)


def test_a_flat_border_by_hand():
    # Class 1 below z = 32, class 2 on it up to z = 40, empty above.
    grid = np.full((64, 64, 64), 7, dtype=np.uint8)
    grid[:, :, :32], grid[:, :, 32:40] = 1, 2
    points = (np.array([[32, 32, 31], [32, 32, 39], [32, 32, 20]]) + 0.5) / 64 - 0.5
    others, solid = _shares(grid, points, np.array([1, 2, 1], np.uint8), (1, 2))
    # Of the 14 directions five lead up: one axis and four diagonals.
    np.testing.assert_allclose(others[0], 5 / 14)
    np.testing.assert_allclose(solid[1], 9 / 14)
    np.testing.assert_allclose(others[1:], 0.0)
    np.testing.assert_allclose(solid[[0, 2]], 1.0)


def test_random_cells_by_plain_numpy():
    rng = np.random.default_rng(0)
    grid = rng.integers(5, 8, (64, 64, 64)).astype(np.uint8)
    points = rng.uniform(-0.6, 0.6, (200, 3))
    labels = rng.integers(5, 7, 200).astype(np.uint8)
    others, solid = _shares(grid, points, labels, (3,))
    axes = [s * row for row in np.eye(3) for s in (1, -1)]
    corners = [np.array([a, b, c]) / np.sqrt(3) for a in (1, -1) for b in (1, -1) for c in (1, -1)]
    steps = np.rint(3 * np.array(axes + corners)).astype(int)
    assert len(steps) == DIRECTIONS
    padded = np.full((192, 192, 192), 7, dtype=np.uint8)
    padded[64:128, 64:128, 64:128] = grid
    cells = np.rint(points * 64 + 31.5).astype(int)[:, None] + steps + 64
    found = padded[tuple(np.moveaxis(cells, -1, 0))]
    there = found != 7
    np.testing.assert_allclose(solid[:, 0], there.mean(axis=1), rtol=1e-6)
    expected = (there & (found != labels[:, None])).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
    np.testing.assert_allclose(others[:, 0], expected, rtol=1e-6)


def test_a_point_far_outside_sees_nothing():
    grid = np.zeros((64, 64, 64), dtype=np.uint8)
    others, solid = _shares(grid, np.array([[2.0, 0.0, 0.0]]), np.zeros(1, np.uint8), (1,))
    assert others[0, 0] == solid[0, 0] == 0.0
