"""Sets of voxels, against scipy's morphology and by counting."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from slatprep.geometry.voxels import (
    above,
    boundary,
    bounding_box,
    filled,
    flat_index,
    outer_boundary,
    voxels_at,
    voxels_of,
)
from slatprep.records import Ground


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**32 - 1),
    side=st.integers(1, 7),
    share=st.sampled_from([0.1, 0.5, 0.8, 0.95, 1.0]),
)
def test_boundary_box_and_filling_are_those_of_scipy(seed, side, share):
    solid = np.random.default_rng(seed).random((side, side, side)) < share
    faces = ndimage.generate_binary_structure(3, 1)
    np.testing.assert_array_equal(boundary(solid), solid & ~ndimage.binary_erosion(solid, faces))
    np.testing.assert_array_equal(filled(solid), ndimage.binary_fill_holes(solid, faces))
    if solid.any():
        (box,) = ndimage.find_objects(solid.astype(int))
        assert bounding_box(solid) == box
    else:
        with pytest.raises(ValueError, match="empty"):
            bounding_box(solid)


def test_the_outer_boundary_has_no_voxel_of_an_inner_wall():
    solid = np.zeros((64, 64, 64), dtype=bool)
    solid[10:20, 10:20, 10:20] = True
    expected = np.argwhere(boundary(solid))
    solid[14:16, 14:16, 14:16] = False
    assert len(voxels_of(boundary(solid))) > len(expected)
    np.testing.assert_array_equal(outer_boundary(solid), expected)


@given(seed=st.integers(0, 2**32 - 1), side=st.integers(2, 200))
def test_places_in_the_flattened_grid_are_those_of_numpy(seed, side):
    voxels = np.random.default_rng(seed).integers(0, side, (20, 3)).astype(np.uint8)
    flat = flat_index(voxels, side)
    np.testing.assert_array_equal(flat, np.ravel_multi_index(tuple(voxels.T), (side,) * 3))
    np.testing.assert_array_equal(voxels_at(flat, (side,) * 3), voxels)
    small = voxels % 64
    np.testing.assert_array_equal(voxels_at(flat_index(small)), small)
    assert voxels_at(flat_index(small)).dtype == np.uint8


def test_what_is_above_the_ground_by_hand():
    """A hollow box from z = 10 to 19, on ground whose top is the upper face of layer 12."""
    hollow = np.zeros((64, 64, 64), dtype=bool)
    hollow[20:30, 25:35, 10:20] = True
    hollow[21:29, 26:34, 11:19] = False
    top = 13 / 64 - 0.5
    left = above(hollow, Ground(np.array([0.0, 0.0, 1.0]), top))
    expected = np.zeros((64, 64, 64), dtype=bool)
    expected[20:30, 25:35, 13:20] = True
    np.testing.assert_array_equal(left, expected)
    assert above(hollow, None) is hollow
    # A centre that lies in the ground's top is not above it.
    at_centre = above(hollow, Ground(np.array([0.0, 0.0, 1.0]), 13.5 / 64 - 0.5))
    assert not at_centre[:, :, 13].any() and at_centre[20:30, 25:35, 14].all()


def test_ground_may_slope_along_any_axis():
    full = np.ones((64, 64, 64), dtype=bool)
    normal = np.array([0.48, -0.6, 0.64])
    centres = (np.argwhere(full) + 0.5) / 64 - 0.5
    left = above(full, Ground(normal, 0.1))
    np.testing.assert_array_equal(left.reshape(-1), centres @ normal > 0.1)
