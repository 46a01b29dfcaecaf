"""Distance, outside and surroundings of voxel sets, against scipy and plain numpy."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from slatprep.geometry.distance import LARGEST_SIDE, signed_distance
from slatprep.geometry.fill import outside_of
from slatprep.geometry.surroundings import DIRECTIONS, labelled, shares_around
from slatprep.geometry.voxels import voxels_of

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


def _outside(occupancy: np.ndarray) -> np.ndarray:
    regions, _ = ndimage.label(~np.pad(occupancy, 1))
    return (regions == regions[0, 0, 0])[1:-1, 1:-1, 1:-1]


@given(
    st.tuples(*[st.integers(1, 9)] * 2, st.integers(1, 64)),
    st.sampled_from([0.0, 0.3, 0.6, 0.7, 1.0]),
    SEEDS,
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
