"""What the cells around points hold, counted by hand and by plain numpy."""

import numpy as np

from slatprep.geometry.surroundings import DIRECTIONS, shares_around


def test_a_flat_border_by_hand():
    # Class 1 below z = 32, class 2 on it up to z = 40, empty above.
    grid = np.full((64, 64, 64), 7, dtype=np.uint8)
    grid[:, :, :32], grid[:, :, 32:40] = 1, 2
    points = (np.array([[32, 32, 31], [32, 32, 39], [32, 32, 20]]) + 0.5) / 64 - 0.5
    others, solid = shares_around(grid, points, np.array([1, 2, 1], np.uint8), (1, 2), 7)
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
    others, solid = shares_around(grid, points, labels, (3,), 7)
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
    others, solid = shares_around(grid, np.array([[2.0, 0.0, 0.0]]), np.zeros(1, np.uint8), (1,), 7)
    assert others[0, 0] == solid[0, 0] == 0.0
