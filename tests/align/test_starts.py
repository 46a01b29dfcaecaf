"""The 64 published starts and the even cover of all orientations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from slatprep.align.starts import candidates_of, distinct_starts, euler_starts, so3_starts


def test_starts_are_scipy_s_euler_rotations() -> None:
    for start in euler_starts():
        expected = Rotation.from_euler("xyz", start.euler_degrees, degrees=True).as_matrix()
        np.testing.assert_allclose(start.rotation, expected, atol=1e-12)
    assert [s.euler_degrees for s in euler_starts()][:5] == [
        (0, 0, 0), (0, 0, 90), (0, 0, 180), (0, 0, 270), (0, 90, 0),
    ]  # fmt: skip


def test_of_64_starts_24_are_different_and_the_others_name_their_twin() -> None:
    starts = euler_starts()
    assert len(starts) == 64
    assert len(distinct_starts()) == 24
    for start in starts:
        if start.same_as is not None:
            assert start.same_as < start.index
            assert starts[start.same_as].same_as is None
            np.testing.assert_array_equal(start.rotation, starts[start.same_as].rotation)


def test_the_distinct_starts_are_the_rotation_group_of_the_cube() -> None:
    keys = {tuple(start.rotation.ravel()) for start in distinct_starts()}
    products = {
        tuple((a.rotation @ b.rotation).ravel())
        for a in distinct_starts()
        for b in distinct_starts()
    }
    assert products == keys
    assert all(np.linalg.det(start.rotation) > 0 for start in distinct_starts())


def test_repeated_candidates_carry_the_scores_of_their_twin() -> None:
    fits = {start.index: (start.index / 64, 0.5) for start in distinct_starts()}
    candidates = candidates_of(fits)
    assert [c.index for c in candidates] == list(range(64))
    for candidate in candidates:
        twin = candidate.index if candidate.same_as is None else candidate.same_as
        assert candidate.fitness == twin / 64


def test_240_starts_leave_no_orientation_far_from_one() -> None:
    starts = Rotation.from_matrix(so3_starts(240))
    anywhere = Rotation.random(2000, random_state=0).as_quat()
    dots = np.abs(anywhere @ starts.as_quat().T).max(axis=1)
    assert np.degrees(2 * np.arccos(dots.min())) < 40.0
