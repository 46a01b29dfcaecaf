"""Filled sets, their distance fields and samples."""

import numpy as np
from scipy.ndimage import binary_fill_holes
from support.shapes import GRID, chair

from slatprep.align.surface import BAND, CENTRE, DILATION, surface_of
from slatprep.geometry.voxels import boundary, filled, voxels_of


def test_a_shell_and_its_solid_have_the_same_surface():
    solid = chair()
    shell = boundary(solid)
    here, there = surface_of(shell), surface_of(solid)
    np.testing.assert_array_equal(here.distance, there.distance)
    np.testing.assert_array_equal(here.points, there.points)
    np.testing.assert_array_equal(here.boundary, there.boundary)


def test_filling_agrees_with_scipy_and_leaves_open_vessels_open():
    rng = np.random.default_rng(0)
    for _ in range(5):
        noise = rng.random((64, 64, 64)) < 0.6
        np.testing.assert_array_equal(filled(noise), binary_fill_holes(noise))
    box = np.zeros((64, 64, 64), dtype=bool)
    box[10:30, 10:30, 10:30] = True
    box[12:28, 12:28, 12:28] = False
    assert filled(box).sum() == 20**3
    box[20, 20, 28:30] = False  # a hole through the lid
    np.testing.assert_array_equal(filled(box), box)


def test_the_distance_is_that_to_the_faces_less_the_dilation():
    slab = np.zeros((64, 64, 64), dtype=bool)
    slab[:, :, 20:40] = True  # faces at 19.5 and 39.5 in index units
    surface = surface_of(slab)
    z = np.arange(surface.distance.shape[2]) + surface.origin[2] + CENTRE
    middle = tuple(n // 2 for n in surface.distance.shape[:2])
    expected = np.maximum(19.5 - z, z - 39.5) + DILATION
    np.testing.assert_allclose(surface.distance[middle], expected, atol=1e-6)


def test_the_distance_is_euclidean():
    dot = np.zeros((64, 64, 64), dtype=bool)
    dot[30, 30, 30] = True
    surface = surface_of(dot)
    lattice = np.argwhere(np.ones(surface.distance.shape)) + surface.origin + CENTRE
    expected = np.linalg.norm(lattice - 30, axis=1) - 0.5 + DILATION
    expected[np.all(lattice == 30, axis=1)] = -0.5 + DILATION
    np.testing.assert_allclose(surface.distance.ravel(), expected, atol=1e-5)


def test_samples_lie_near_the_faces_on_both_sides():
    ball = ((GRID - 31.5) ** 2).sum(axis=-1) < 20**2
    surface = surface_of(ball)
    radius = np.linalg.norm(surface.points, axis=1)
    assert abs(radius.mean() - 20) < 0.1
    assert (radius < 20).any() and (radius > 20).any()
    assert np.abs(radius - 20).max() < 2.5
    assert abs(surface.size - 20) < 0.2


def test_a_subset_is_even_and_repeatable():
    surface = surface_of(chair())
    some = surface.subset(300)
    assert 250 <= len(some.points) <= 300
    np.testing.assert_array_equal(some.points, surface.subset(300).points)
    assert np.abs(some.centroid - surface.centroid).max() < 1.0
    assert len(surface.subset(10**9).points) == len(surface.points)


def test_positions_are_counted_from_the_centre_of_the_cube():
    middle = np.zeros((64, 64, 64), dtype=bool)
    middle[20:44, 22:42, 30:34] = True  # as far from either end, so its centre is the cube's
    np.testing.assert_allclose(surface_of(middle).centroid, 0.0, atol=1e-12)


def test_the_boundary_is_that_of_the_filled_set():
    for solid in (chair(), boundary(chair())):
        rows = np.array(sorted(map(tuple, surface_of(solid).boundary.tolist())))
        np.testing.assert_array_equal(rows, voxels_of(boundary(filled(solid))))


def test_samples_are_all_lattice_points_of_the_band_with_the_distance_there():
    surface = surface_of(chair())
    index = np.rint(surface.points - surface.origin).astype(int)
    np.testing.assert_allclose(index + surface.origin, surface.points, atol=1e-12)
    np.testing.assert_allclose(surface.distance[tuple(index.T)], surface.values, atol=1e-6)
    # To the faces the distance is that less the dilation.
    in_band = np.abs(surface.distance.astype(np.float64) - DILATION) <= BAND + 1e-6
    assert len(index) == in_band.sum()


def test_the_size_does_not_depend_on_where_it_is():
    ball = ((GRID - 31.5) ** 2).sum(axis=-1) < 10**2
    aside = np.roll(ball, (15, -12, 9), axis=(0, 1, 2))
    assert surface_of(aside).size == surface_of(ball).size


def test_a_subset_has_no_sample_twice_and_others_from_another_start():
    surface = surface_of(chair())
    total = len(surface.points)
    assert len(surface.subset(total).points) == total
    # Nearly as many choices as there are samples: some would be chosen twice.
    for count in (300, total - 1):
        some = surface.subset(count)
        assert len(np.unique(some.points, axis=0)) == len(some.points) == len(some.values)
    first, second = (
        set(map(tuple, surface.subset(300, start).points.tolist())) for start in (0, 300)
    )
    assert first.isdisjoint(second)
