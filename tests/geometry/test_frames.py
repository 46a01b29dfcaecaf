"""Frames, sets of voxels, and the bent map between the frames: by hand, and against scipy."""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.spatial.transform import Rotation

from slatprep.geometry.bspline import refined
from slatprep.geometry.deformation import (
    GRAIN,
    LEAST_STRETCH,
    MOST_STRETCH,
    PlaceMap,
    bending_of,
    deform,
    is_proper,
    jacobian,
    make_deformation,
    undeform,
)
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
from slatprep.records import Deformation, Ground
from slatprep.storage.documents import adapter_of

numbers = st.floats(-2, 2)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
turns = vectors.map(lambda turn: Rotation.from_rotvec(turn).as_matrix())
poses = st.builds(make_transform, turns, vectors, st.floats(0.3, 3))


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


NO_TRANSFORMS = [np.eye(3), make_transform(np.eye(3), (1, 2, 3)).T, np.diag([1.0, 1, 1, 2])]
NO_SIMILARITIES = [
    np.diag([1.0, 1.0, -1.0, 1.0]),  # a mirror
    np.diag([1.0, 1.0, 0.0, 1.0]),  # flat
    np.diag([1.0, 1.0, 2.0, 1.0]),  # no uniform scale
    np.full((4, 4), np.nan),
    np.diag([1.0, 1.0, 1.0, np.nan]),
]


@pytest.mark.parametrize("matrix", [*NO_TRANSFORMS, *NO_SIMILARITIES])
def test_what_is_no_transform_or_no_similarity_is_refused(matrix):
    with pytest.raises(ValueError, match="a transform"):
        split_transform(matrix)
    if not any(matrix is one for one in NO_SIMILARITIES):
        with pytest.raises(ValueError, match="a transform"):
            apply_transform(matrix, [[1, 2, 3]])


def test_of_mirrored_points_the_nearest_similarity_is_no_mirror():
    """Of a cloud of the widths 3, 2 and 1 it is the half turn that leaves the widest two right."""
    points = np.concatenate([np.diag([3.0, 2.0, 1.0]), -np.diag([3.0, 2.0, 1.0])])
    found = nearest_similarity(points, -points)
    scale = (3**2 + 2**2 - 1**2) / (3**2 + 2**2 + 1**2)
    np.testing.assert_allclose(found[:3, :3], scale * np.diag([-1.0, -1.0, 1.0]), atol=1e-12)


@given(st.sets(st.tuples(*[st.integers(0, 63)] * 3), min_size=1, max_size=50))
def test_voxels_and_occupancy_are_two_forms_of_one_set(voxels):
    assert {tuple(v) for v in voxels_of(occupancy_of(np.array(sorted(voxels)))).tolist()} == voxels


def test_an_occupancy_has_no_centres():
    with pytest.raises(ValueError, match=r"an occupancy .* is given; expected the indices"):
        voxel_centres(np.ones((2, 2, 3), bool))


def test_displacement_by_hand():
    shifted = make_transform(np.eye(3), [3 / 64, 4 / 64, 0])
    some = voxel_centres([[1, 2, 3], [60, 5, 9]])
    assert displacement(shifted, np.eye(4), some) == pytest.approx(5.0)
    # Scaled by 2, the inverse looks half as far from the cube's centre: half a voxel on each axis.
    doubled = make_transform(np.eye(3), scale=2.0)
    apart = displacement(doubled, np.eye(4), voxel_centres([[32, 32, 32]]))
    assert apart == pytest.approx(np.sqrt(3) * 0.25)


@pytest.mark.parametrize("side", [2, 31, 64, 96, 128, 256])
def test_cells_of_voxels_of_any_grid_are_those_that_centres_say(side):
    voxels = np.unique(np.random.default_rng(side).integers(0, side, (300, 3)), axis=0)
    voxels = np.random.default_rng(0).permutation(voxels).astype(np.uint8)
    cells, row = shown_in_cells(voxels, side)
    expected, found = (np.full((64,) * 3, -1) for _ in range(2))
    if side < 64:
        numbers = np.full((side,) * 3, -1)
        numbers[tuple(voxels.T)] = np.arange(len(voxels))
        holder = [math.floor(Fraction(2 * i + 1, 128) * side) for i in range(64)]
        expected = numbers[np.ix_(holder, holder, holder)]
    else:
        for number, voxel in enumerate(voxels.tolist()):
            # The cell that the voxel's centre lies in; on a border, the one that begins there.
            cell = tuple(math.floor(Fraction(2 * i + 1, 2 * side) * 64) for i in voxel)
            if expected[cell] < 0:
                expected[cell] = number
    found[tuple(cells.T)] = row
    np.testing.assert_array_equal(found, expected)
    assert len(cells) == len(row) == (found >= 0).sum() and cells.dtype == np.uint8
    np.testing.assert_array_equal(occupancy_of(voxels, side), found >= 0)


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
    """A hollow box from z = 10 to 19 on ground up to layer 12, of which what is under it stays."""
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


BOX = np.array([[-0.5] * 3, [0.5] * 3])
AFFINE = np.array([[1.1, 0.03, 0.0, 0.01], [-0.02, 0.95, 0.04, 0.0], [0.01, 0.0, 1.02, -0.02]])
IDENTITY = np.eye(3, 4)
NO_BENDING = np.zeros((0, 0, 0, 3))


def bent(seed: int = 0, voxels: float = 3.0, shape: tuple[int, ...] = (7, 6, 8)) -> Deformation:
    coefficients = np.random.default_rng(seed).normal(size=(*shape, 3)) * voxels / 64
    return made_of(AFFINE, coefficients)


def made_of(affine: np.ndarray, coefficients: np.ndarray = NO_BENDING, points: np.ndarray = BOX,
            most: float = 16.0) -> Deformation | None:  # fmt: skip
    return make_deformation(affine, [-0.5] * 3, 0.25, coefficients, points, most)


def points(count: int = 500, reach: float = 0.55) -> np.ndarray:
    return np.random.default_rng(1).uniform(-reach, reach, (count, 3))


def test_a_spline_is_the_sum_of_its_basis_functions():
    # Independent truth: scipy's B-splines, axis by axis.
    from scipy.interpolate import BSpline

    made = replace(bent(), affine=IDENTITY)
    x = points(reach=0.24)
    weights = []
    for axis, n in enumerate(made.coefficients.shape[:3]):
        position = (x[:, axis] - made.origin[axis]) / made.spacing
        knots = np.arange(-3.0, n + 1.0)
        weights.append(BSpline.design_matrix(position, knots, 3).toarray())
    expected = x + np.einsum("na,nb,nc,abcd->nd", *weights, made.coefficients)
    assert np.allclose(deform(made, x), expected, atol=1e-12)


def test_a_point_goes_there_and_back():
    transform = make_transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0.02, -0.01, 0.03), 0.9)
    for deformation in (None, made_of(AFFINE), bent()):
        way = PlaceMap(transform, deformation)
        x = points(reach=0.6)
        assert np.abs(way.to_slat(way.to_pixieverse(x)) - x).max() * 64 < 1e-3
        for wrong in ([0.1, 0.2, 0.3], np.zeros((2, 2, 3)), np.zeros((2, 4))):
            for method in (way.to_slat, way.to_pixieverse, way.volume_ratios):
                with pytest.raises(ValueError, match=r"have shape .*; expected \(N, 3\)"):
                    method(wrong)


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), voxels=st.floats(0.1, 40.0))
def test_nothing_folds_and_nothing_moves_too_far(seed, voxels):
    made = bent(seed, voxels, (6, 5, 7))
    assert is_proper(made)
    x = points(4_000, 0.5)
    assert np.linalg.det(jacobian(made, x)).min() > 0
    moved = deform(made, x) - x @ AFFINE[:, :3].T - AFFINE[:, 3]
    assert np.linalg.norm(moved, axis=1).max() * 64 <= 16.0
    assert np.abs(undeform(made, deform(made, x)) - x).max() * 64 < 1e-3


def test_how_much_bending_is_certain_not_to_fold_by_hand():
    """One coefficient h: its second differences are 2 h along an axis, and h along two."""
    # So the second derivatives' Frobenius norm is at most sqrt(3 * 4 + 6) h / spacing^2. No point
    # is farther than sqrt(3) / 2 of a step from the grid where scipy's splines give the derivative.
    from scipy.interpolate import BSpline
    from scipy.optimize import brentq

    spacing, n = 0.25, 7
    knots = np.arange(-3.0, n + 1.0)
    unit = np.zeros((n, n, n, 3))
    unit[3, 3, 3, 1] = 1.0

    def room(height: float, steps: int) -> float:
        at = np.arange(steps * (n - 3) + 1) / steps
        spline = BSpline(knots, np.eye(n)[3], 3)
        parts = np.tile(spline(at), (3, 3, 1)) + np.eye(3)[..., None] * (
            spline.derivative()(at) / spacing - spline(at)
        )  # by the axis along which the derivative is, and by axis
        gradient = height * np.einsum("di,dj,dk->ijkd", *np.moveaxis(parts, 1, 0))
        determinant = 1.0 + gradient[..., 1]
        squares = 3.0 + 2.0 * gradient[..., 1] + (gradient**2).sum(axis=-1)
        most = np.sqrt(3 * 4 + 6) * height / spacing**2
        return float((2 * determinant / squares).min() - most * np.sqrt(3) / 2 * spacing / steps)

    limits = {steps: brentq(room, 0.0, 0.2, args=(steps,)) for steps in (2, 4)}
    assert limits[2] < limits[4]
    for height, proper in ((0.999 * limits[4], True), (1.001 * limits[4], False)):
        assert is_proper(Deformation(IDENTITY, np.full(3, -0.5), spacing, height * unit)) is proper


def test_bending_is_shortened_to_the_bound_and_not_further():
    for voxels, expected in ((10.0, 10.0), (20.0, 16.0)):
        coefficients = np.zeros((7, 7, 7, 3))
        coefficients[..., 2] = voxels / 64  # everything moves alike, so nothing bends
        length = np.linalg.norm(made_of(IDENTITY, coefficients).coefficients, axis=-1) * 64
        np.testing.assert_allclose(length, expected, rtol=1e-5)
        assert length.max() <= expected + 64 * GRAIN


def test_how_much_an_affine_part_may_stretch():
    for low, high, allowed in (
        (1.001 * LEAST_STRETCH, 0.999 * MOST_STRETCH, True),
        (0.999 * LEAST_STRETCH, 1.0, False),
        (1.0, 1.001 * MOST_STRETCH, False),
        (1.0, -1.0, False),  # a mirror
    ):
        made = made_of(np.diag([low, 1.0, high]) @ IDENTITY, points=np.zeros((1, 3)))
        assert (made is not None) is allowed


def test_no_zero_is_negative():
    made = made_of(IDENTITY, np.full((7, 7, 7, 3), -1e-15))
    assert made.coefficients.tobytes() == np.zeros((7, 7, 7, 3)).tobytes()


def test_how_far_is_asked_of_the_points_and_not_of_corners_where_nothing_is():
    grown = 1.5 * IDENTITY
    cross = np.concatenate([0.45 * np.eye(3), -0.45 * np.eye(3)])  # moved by 14.4 voxels
    corner = np.full((1, 3), 0.45)  # moved by 24.9
    allowed = [made_of(grown, NO_BENDING, *how) for how in ((cross,), (cross, 14.0), (corner,))]
    assert [made is not None for made in allowed] == [True, False, False]


def test_the_derivative_is_the_derivative():
    made, x, step = bent(), points(200, 0.24), 1e-6
    for axis in range(3):
        aside = step * np.eye(3)[axis]
        numeric = (deform(made, x + aside) - deform(made, x - aside)) / (2 * step)
        assert np.allclose(jacobian(made, x)[:, :, axis], numeric, atol=1e-6)


def test_half_the_spacing_is_the_same_displacement():
    made = bent()
    fine = replace(made, spacing=made.spacing / 2, coefficients=refined(made.coefficients))
    x = points(500, 0.24)
    assert np.allclose(deform(made, x), deform(fine, x), atol=1e-12)


def test_json_gives_back_the_same_bits():
    for made in (bent(), made_of(AFFINE)):
        text = orjson.dumps(made, option=orjson.OPT_SERIALIZE_NUMPY)
        again = adapter_of(Deformation).validate_json(text, strict=True)
        assert orjson.dumps(again, option=orjson.OPT_SERIALIZE_NUMPY) == text
        assert again.coefficients.shape == made.coefficients.shape
        x = points()
        assert deform(again, x).tobytes() == deform(made, x).tobytes()
        grains = made.coefficients / GRAIN
        assert np.array_equal(grains, np.round(grains))


def test_broken_numbers_are_named():
    made = bent()
    broken = {
        "spacing": 0.0,
        "origin": np.zeros(2),
        "affine": np.full((3, 4), np.nan),
        "coefficients": np.zeros((4, 3, 4, 3)),
    }
    for name, value in broken.items():
        with pytest.raises(ValueError, match="finite numbers"):
            replace(made, **{name: value})


def test_only_bending_bends():
    assert bending_of(replace(bent(), coefficients=np.full((6, 6, 6, 3), 0.1))) == 0.0
    # u = a x^2 / 2 has the second derivative a, here in 1 / voxel.
    index = np.arange(8.0)
    quadratic = np.zeros((8, 8, 8, 3))
    quadratic[..., 0] = 0.5 * 64 * 0.01 * ((index * 0.1) ** 2)[:, None, None]
    made = Deformation(IDENTITY, np.full(3, -0.5), 0.1, quadratic)
    assert bending_of(made) == pytest.approx(0.01)
    # u = a x y has the second derivative a twice: by x and y, and by y and x.
    twisted = np.zeros((8, 8, 8, 3))
    twisted[..., 2] = 64 * 0.01 * np.multiply.outer(index * 0.1, index * 0.1)[:, :, None]
    assert bending_of(replace(made, coefficients=twisted)) == pytest.approx(0.01 * np.sqrt(2))
