"""The map between the frames: both ways, bounded, without folds, the same bytes from JSON."""

from dataclasses import replace

import numpy as np
import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

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
from slatprep.geometry.frames import make_transform
from slatprep.records import Deformation
from slatprep.store.record_json import adapter_of

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


def points(count: int = 500, reach: float = 0.55, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-reach, reach, (count, 3))


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
        back = way.to_slat(way.to_pixieverse(x))
        assert np.abs(back - x).max() * 64 < 1e-3


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
    """One coefficient h: its second differences are 2 h along an axis, and h along two.

    So the second derivatives' Frobenius norm is at most sqrt(3 * 4 + 6) h / spacing^2. No point
    is farther than sqrt(3) / 2 of a step from the grid where scipy's splines give the derivative.
    """
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
        made = Deformation(IDENTITY, np.full(3, -0.5), spacing, height * unit)
        assert is_proper(made) is proper


def test_bending_is_shortened_to_the_bound_and_not_further():
    for voxels, expected in ((10.0, 10.0), (20.0, 16.0)):
        coefficients = np.zeros((7, 7, 7, 3))
        coefficients[..., 2] = voxels / 64  # everything moves alike, so nothing bends
        made = made_of(IDENTITY, coefficients)
        length = np.linalg.norm(made.coefficients, axis=-1) * 64
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
