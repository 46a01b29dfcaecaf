"""The 64 published starts and the even cover of all orientations."""

import numpy as np
from scipy.spatial.transform import Rotation

from slatprep.align.starts import candidates_of, distinct_starts, euler_starts, so3_starts


def test_starts_are_scipy_s_euler_rotations():
    for start in euler_starts():
        expected = Rotation.from_euler("xyz", start.euler_degrees, degrees=True).as_matrix()
        np.testing.assert_allclose(start.rotation, expected, atol=1e-12)
    assert [s.euler_degrees for s in euler_starts()][:5] == [
        (0, 0, 0), (0, 0, 90), (0, 0, 180), (0, 0, 270), (0, 90, 0),
    ]  # fmt: skip


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
    products = {
        tuple((a.rotation @ b.rotation).ravel())
        for a in distinct_starts()
        for b in distinct_starts()
    }
    assert products == keys
    assert all(np.linalg.det(start.rotation) > 0 for start in distinct_starts())


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
