"""Frames, transforms and sets of voxels: by hand, and against scipy."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.spatial.transform import Rotation

from slatprep.geometry.frames import (
    apply_transform,
    displacement,
    invert_transform,
    make_transform,
    nearest_similarity,
    split_transform,
    voxel_centres,
)
from slatprep.geometry.voxels import (
    above,
    boundary,
    bounding_box,
    filled,
    flat_index,
    occupancy_of,
    outer_boundary,
    shown_in_cells,
    voxels_at,
    voxels_of,
)
from slatprep.records import Ground

numbers = st.floats(-2, 2)
poses = st.tuples(
    st.tuples(numbers, numbers, numbers), st.tuples(numbers, numbers, numbers), st.floats(0.3, 3)
).map(
    lambda p: make_transform(Rotation.from_rotvec(np.array(p[0])).as_matrix(), np.array(p[1]), p[2])
)


def test_a_transform_turns_and_scales_before_it_shifts():
    # A quarter turn about z takes x to y, and y to -x.
    turn = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    moved = apply_transform(make_transform(turn, (10, 20, 30), 2.0), [[1, 2, 3]])
    assert moved.tolist() == [[10 - 4, 20 + 2, 30 + 6]]


@given(poses)
def test_inverses_and_parts_of_a_transform(transform):
    np.testing.assert_allclose(invert_transform(transform), np.linalg.inv(transform), atol=1e-9)
    np.testing.assert_allclose(make_transform(*split_transform(transform)), transform, atol=1e-9)
    # The nearest similarity of points that one has moved is that.
    points = np.random.default_rng(0).normal((3.0, -1.0, 2.0), size=(50, 3))
    found = nearest_similarity(points, apply_transform(transform, points))
    np.testing.assert_allclose(found, transform, atol=1e-9)
    np.testing.assert_array_equal(found[3], [0, 0, 0, 1])


@pytest.mark.parametrize(
    "matrix",
    [
        np.eye(3),
        np.diag([1.0, 1.0, -1.0, 1.0]),  # a mirror
        np.diag([1.0, 1.0, 0.0, 1.0]),  # flat
        np.diag([1.0, 1.0, 2.0, 1.0]),  # no uniform scale
        np.full((4, 4), np.nan),
    ],
)
def test_what_is_no_similarity_is_refused(matrix):
    with pytest.raises(ValueError, match="a transform"):
        split_transform(matrix)


def test_of_mirrored_points_the_nearest_similarity_is_no_mirror():
    """Of a cloud of the widths 3, 2 and 1 it is the half turn that leaves the widest two right."""
    points = np.concatenate([np.diag([3.0, 2.0, 1.0]), -np.diag([3.0, 2.0, 1.0])])
    found = nearest_similarity(points, -points)
    scale = (3**2 + 2**2 - 1**2) / (3**2 + 2**2 + 1**2)
    np.testing.assert_allclose(found[:3, :3], scale * np.diag([-1.0, -1.0, 1.0]), atol=1e-12)


@given(st.sets(st.tuples(*[st.integers(0, 63)] * 3), min_size=1, max_size=50))
def test_voxels_and_occupancy_are_two_forms_of_one_set(voxels):
    occupancy = occupancy_of(np.array(sorted(voxels)))
    assert {tuple(v) for v in voxels_of(occupancy).tolist()} == voxels


def test_displacement_by_hand():
    shifted = make_transform(np.eye(3), [3 / 64, 4 / 64, 0])
    some = voxel_centres([[1, 2, 3], [60, 5, 9]])
    assert displacement(shifted, np.eye(4), some) == pytest.approx(5.0)
    # Scaled by 2, the inverse looks half as far from the cube's centre, here half a voxel on each
    # axis.
    doubled = make_transform(np.eye(3), scale=2.0)
    apart = displacement(doubled, np.eye(4), voxel_centres([[32, 32, 32]]))
    assert apart == pytest.approx(np.sqrt(3) * 0.25)


@pytest.mark.parametrize("side", [2, 31, 64, 96, 128, 256])
def test_cells_of_voxels_of_any_grid_are_those_that_centres_say(side):
    voxels = np.unique(np.random.default_rng(side).integers(0, side, (300, 3)), axis=0)
    voxels = np.random.default_rng(0).permutation(voxels).astype(np.uint8)
    cells, row = shown_in_cells(voxels, side)
    known = {tuple(voxel): number for number, voxel in enumerate(voxels.tolist())}
    expected: dict[tuple[int, ...], int] = {}
    for number, voxel in enumerate(voxels.tolist()):
        # The cell that the voxel's centre lies in; on a border, the one that begins there.
        cell = tuple(math.floor(Fraction(2 * i + 1, 2 * side) * 64) for i in voxel)
        if side >= 64 and cell not in expected:
            expected[cell] = number
    if side < 64:
        holder = [math.floor(Fraction(2 * i + 1, 128) * side) for i in range(64)]
        for cell in itertools.product(range(64), repeat=3):
            number = known.get(tuple(holder[i] for i in cell), -1)
            if number >= 0:
                expected[cell] = number
    assert dict(zip(map(tuple, cells.tolist()), row.tolist(), strict=True)) == expected
    assert cells.dtype == np.uint8
    occupied = {tuple(cell) for cell in np.argwhere(occupancy_of(voxels, side)).tolist()}
    assert occupied == expected.keys()


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1, 7), st.sampled_from([0.1, 0.5, 0.8, 0.95, 1.0]))
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
    """A hollow box from z = 10 to 19, on ground whose top is the upper face of layer 12.

    Of the ground only what is under the box stays, a layer whose centres are half a voxel down.
    """
    hollow = np.zeros((64, 64, 64), dtype=bool)
    hollow[:, :, 9:13] = True
    hollow[20:30, 25:35, 10:20] = True
    hollow[21:29, 26:34, 11:19] = False
    top = 13 / 64 - 0.5
    left = above(hollow, Ground(np.array([0.0, 0.0, 1.0]), top))
    expected = np.zeros((64, 64, 64), dtype=bool)
    expected[20:30, 25:35, 12:20] = True
    np.testing.assert_array_equal(left, expected)
    assert above(hollow, None) is hollow
    # Of two layers the centres lie in the top and a voxel under it; those of the next are two down.
    at_centre = above(hollow, Ground(np.array([0.0, 0.0, 1.0]), 13.5 / 64 - 0.5))
    np.testing.assert_array_equal(at_centre, expected)


def test_ground_may_slope_along_any_axis():
    full = np.ones((64, 64, 64), dtype=bool)
    normal = np.array([0.48, -0.6, 0.64])
    centres = (np.argwhere(full) + 0.5) / 64 - 0.5
    left, heights = above(full, Ground(normal, 0.1)).reshape(-1), centres @ normal - 0.1
    assert left[heights > 0].all()
    assert not left[heights < -1.501 / 64].any()
    # What would stand on them is outside the grid for some at its faces.
    assert left[(heights > -1.499 / 64) & (abs(centres).max(axis=1) < 0.45)].all()
