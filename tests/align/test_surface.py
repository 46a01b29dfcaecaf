"""What a search starts from, surfaces and orientations, and the figures of what it found."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.shapes import GRID, chair, field_of, latents_of, surface_latents

from slatprep.align.quality import compare, measure_quality
from slatprep.align.starts import candidates_of, distinct_starts, euler_starts, so3_starts
from slatprep.align.surface import BAND, CENTRE, DILATION, surface_of
from slatprep.geometry.frames import make_transform
from slatprep.geometry.voxels import boundary, filled, voxels_of


def test_a_shell_and_its_solid_have_the_same_surface():
    solid = chair()
    here, there = surface_of(boundary(solid)), surface_of(solid)
    np.testing.assert_array_equal(here.distance, there.distance)
    np.testing.assert_array_equal(here.points, there.points)
    rows = [sorted(map(tuple, one.boundary.tolist())) for one in (here, there)]
    assert rows == [[tuple(row) for row in voxels_of(boundary(filled(solid))).tolist()]] * 2


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


def test_a_subset_is_even_and_repeatable_and_has_no_sample_twice():
    surface = surface_of(chair())
    total = len(surface.points)
    some, other = surface.subset(300), surface.subset(300, 300)
    assert 250 <= len(some.points) <= 300
    np.testing.assert_array_equal(some.points, surface.subset(300).points)
    assert np.abs(some.centroid - surface.centroid).max() < 1.0
    assert not {*map(tuple, some.points.tolist())} & {*map(tuple, other.points.tolist())}
    assert len(surface.subset(total).points) == len(surface.subset(10**9).points) == total
    # Nearly as many choices as there are samples: some would be chosen twice.
    for part in (some, surface.subset(total - 1)):
        assert len(np.unique(part.points, axis=0)) == len(part.points) == len(part.values)


def test_the_size_is_the_mean_radius_wherever_a_ball_lies():
    ball = ((GRID - 31.5) ** 2).sum(axis=-1) < 10**2
    aside = np.roll(ball, (15, -12, 9), axis=(0, 1, 2))
    assert surface_of(aside).size == surface_of(ball).size == pytest.approx(10, abs=0.2)


def test_samples_are_all_lattice_points_of_the_band_with_the_distance_there():
    surface = surface_of(chair())
    index = np.rint(surface.points - surface.origin).astype(int)
    np.testing.assert_allclose(index + surface.origin, surface.points, atol=1e-12)
    np.testing.assert_allclose(surface.distance[tuple(index.T)], surface.values, atol=1e-6)
    # To the faces the distance is that less the dilation.
    in_band = np.abs(surface.distance.astype(np.float64) - DILATION) <= BAND + 1e-6
    assert len(index) == in_band.sum()


def test_starts_turn_about_x_then_y_then_z_and_their_entries_are_whole():
    turn_x = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    turn_y = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    turn_z = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    power = np.linalg.matrix_power
    for start in euler_starts():
        x, y, z = (int(angle) // 90 for angle in start.euler_degrees)
        expected = (power(turn_z, z) @ power(turn_y, y) @ power(turn_x, x)).astype(np.float64)
        assert start.rotation.tobytes() == expected.tobytes()
    first = [(0, 0, 0), (0, 0, 90), (0, 0, 180), (0, 0, 270), (0, 90, 0)]
    assert [start.euler_degrees for start in euler_starts()][:5] == first


def test_of_64_starts_24_are_different_and_the_others_name_their_twin():
    starts = euler_starts()
    assert len(starts) == 64
    assert len(distinct_starts()) == 24
    for start in starts:
        if start.same_as is not None:
            assert start.same_as < start.index
            assert starts[start.same_as].same_as is None
            np.testing.assert_array_equal(start.rotation, starts[start.same_as].rotation)


def test_the_distinct_starts_are_the_rotation_group_of_the_cube():
    keys = {tuple(start.rotation.ravel()) for start in distinct_starts()}
    turns = [start.rotation for start in distinct_starts()]
    assert {tuple((a @ b).ravel()) for a in turns for b in turns} == keys
    assert all(np.linalg.det(turn) > 0 for turn in turns)


def test_repeated_candidates_carry_the_scores_of_their_twin():
    fits = {start.index: (start.index / 64, 0.5) for start in distinct_starts()}
    candidates = candidates_of(fits)
    assert [c.index for c in candidates] == list(range(64))
    for candidate in candidates:
        twin = candidate.index if candidate.same_as is None else candidate.same_as
        assert candidate.fitness == twin / 64


def test_240_starts_leave_no_orientation_far_from_one():
    starts = Rotation.from_matrix(so3_starts(240))
    anywhere = Rotation.random(2000, random_state=0).as_quat()
    dots = np.abs(anywhere @ starts.as_quat().T).max(axis=1)
    assert np.degrees(2 * np.arccos(dots.min())) < 40.0


def test_the_spirals_advance_by_the_published_numbers():
    """Alexa 2022: by 1 / sqrt(2) and 1 / psi of a turn, where psi^4 = psi + 4."""
    psi = max(root.real for root in np.roots([1, 0, 0, -1, -4]) if abs(root.imag) < 1e-12)
    x, y, z, w = Rotation.from_matrix(so3_starts(50)).as_quat().T
    # A quaternion and its negative are one rotation, so phases are known to half a turn.
    for phase, turns in ((np.arctan2(x, y), np.sqrt(2)), (np.arctan2(z, w), psi)):
        off = (np.diff(phase) - 2 * np.pi / turns) / np.pi
        np.testing.assert_allclose(off, np.round(off), atol=1e-9)
    np.testing.assert_allclose(x**2 + y**2, (np.arange(50) + 0.5) / 50)
    first = np.pi / np.sqrt(2), np.pi / psi
    found = np.arctan2(x[0], y[0]), np.arctan2(z[0], w[0])
    np.testing.assert_allclose(np.tan(found), np.tan(first))


LINE = np.array([[i, 30, 30] for i in range(10)], dtype=np.uint8)


def test_a_shift_along_a_line_by_hand():
    # Ten voxels in a row, three and a half along: six have a partner, and so has one past the end.
    quality = compare(LINE, LINE, make_transform(np.eye(3), [3.5 / 64, 0, 0]), radius=1.0)
    shares = quality.fitness, quality.fitness_backward, quality.overlap
    assert shares == pytest.approx((0.7, 0.7, 0.7))
    assert quality.inlier_rmse == pytest.approx(0.5)


def test_radius_and_distances_are_in_voxels_of_the_slat_frame_both_ways():
    # A PixieVerse voxel and a half is 0.75 of a SLAT voxel at this scale, and three are 1.5.
    pixieverse = np.array([[32, 32, 32]], dtype=np.uint8)
    for off, near in ((1.5, 1.0), (3, 0.0)):
        transform = make_transform(np.eye(3), np.array([0.5 * off + 0.25, 0.25, 0.25]) / 64, 0.5)
        quality = compare(pixieverse, pixieverse, transform, radius=1.0)
        assert (quality.fitness, quality.fitness_backward) == (near, near)
        rmse = quality.inlier_rmse, quality.inlier_rmse_backward
        assert rmse == pytest.approx((0.5 * off * near,) * 2)


def test_far_sets_have_no_inlier_and_no_nan():
    quality = compare(LINE, LINE, make_transform(np.eye(3), [0, 0.4, 0]), radius=1.0)
    assert (quality.fitness, quality.inlier_rmse, quality.overlap) == (0.0, 0.0, 0.0)


def test_voxels_inside_the_slat_do_not_count_against_it():
    solid = chair()
    latents = surface_latents(solid)
    crowded = latents_of(np.vstack([latents.coords, [[30, 30, 25]]]))  # a wall between two parts
    for either in (latents, crowded):
        quality = measure_quality(field_of(solid), either, np.eye(4), 1.0)
        assert quality.fitness == quality.fitness_backward == quality.overlap == 1.0
