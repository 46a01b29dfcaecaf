"""What is squashed or lengthened is placed by its features, not by its proportions."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support.shapes import chair

from slatprep import align_voxels
from slatprep.align.consensus import degrees_between
from slatprep.align.stretch import stretch
from slatprep.align.surface import surface_of
from slatprep.geometry.frames import split_transform
from slatprep.parameters import AlignParameters

CENTRES = np.indices((64, 64, 64)).reshape(3, -1).T - 31.5


def crate(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points (N, 3), in voxels, are in a crate with a pole and a flag on its lid."""
    x, y, z = points.T
    body = (x / 15) ** 4 + (y / 18) ** 4 + (z / 18) ** 4 < 1
    pole = (x**2 + y**2 < 4) & (z > 0) & (z < 25)
    flag = (abs(z - 23) < 2) & (x > 0) & (x < 9) & (abs(y) < 3)
    return (body | pole | flag).reshape(64, 64, 64)


@pytest.mark.parametrize("factors", [(1.1, 1.1, 0.7), (1.15, 1.05, 0.75)])
@pytest.mark.parametrize("seed", [0, 1, 3])
def test_a_squashed_object_is_not_laid_on_its_side(
    factors: tuple[float, float, float], seed: int
) -> None:
    """As a similarity the lid fits best where a wall was, which is as near as the lid is now."""
    rotation = Rotation.random(random_state=seed).as_matrix()
    other = crate(CENTRES @ rotation / factors)
    found = align_voxels(crate(CENTRES), other)
    turn = degrees_between(split_transform(found.transform)[0], rotation)
    assert turn < 15.0
    as_similarity = align_voxels(crate(CENTRES), other, AlignParameters(model="similarity"))
    assert degrees_between(split_transform(as_similarity.transform)[0], rotation) > 60.0


def test_a_known_affine_map_is_found_from_a_pose_beside_it() -> None:
    """The map that was applied brings the SLAT's samples back to a quarter of a voxel."""
    shape = chair()
    inside = np.argwhere(shape) - 31.5
    linear = np.array([[1.1, 0.05, 0.0], [0.0, 0.85, 0.04], [-0.03, 0.0, 1.05]])
    # A SLAT point x shows the point linear @ x of the solid.
    at = np.rint(CENTRES @ linear.T + 31.5).astype(int)
    within = ((at >= 0) & (at < 64)).all(axis=1)
    moved = np.zeros(64**3, dtype=bool)
    moved[within] = shape[tuple(at[within].T)]
    slat, pixie = surface_of(moved.reshape(64, 64, 64)), surface_of(shape)
    few, many = slat.subset(300), pixie.subset(300)
    affines, offsets = np.eye(3, 4)[None].copy(), np.zeros(1)
    centre = inside.mean(axis=0)
    start = centre - np.linalg.inv(linear) @ centre
    turn = Rotation.from_euler("xyz", [8, -6, 5], degrees=True).as_matrix()
    scores = stretch(
        few.points, few.values, few.distance, few.origin,
        many.points, many.values, many.distance, many.origin,
        turn[None], -start[None], np.ones(1), affines, offsets, np.array([5.0, 4, 3, 2, 2, 1.5]),
    )  # fmt: skip
    found = (few.points @ affines[0, :, :3].T + affines[0, :, 3] + start) @ turn
    apart = np.linalg.norm(found - few.points @ linear.T, axis=1)
    assert np.median(apart) < 0.25
    assert scores[0] > 0.8


def test_a_pose_that_would_be_squashed_flat_scores_nothing() -> None:
    """An eighth of the volume is another shape, whatever the fit."""
    block = np.zeros((64, 64, 64), dtype=bool)
    block[20:44, 20:44, 20:44] = True
    flat = surface_of(block).subset(60)
    affines, offsets = np.eye(3, 4)[None].copy(), np.zeros(1)
    affines[0, :, :3] *= 0.5
    scores = stretch(
        flat.points, flat.values, flat.distance, flat.origin,
        flat.points, flat.values, flat.distance, flat.origin,
        np.eye(3)[None], np.zeros((1, 3)), np.ones(1), affines, offsets, np.array([5.0]),
    )  # fmt: skip
    assert scores[0] == 0.0
