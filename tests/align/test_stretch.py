"""What is squashed or lengthened is placed by its features, not by its proportions."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support.residuals import carried, mean_kernel, residuals, within_box
from support.shapes import chair, crate

from slatprep import align_voxels
from slatprep.align.consensus import degrees_between
from slatprep.align.deform_solver import OFFSET_PRIOR, PIXIEVERSE_WEIGHT
from slatprep.align.pose import Poses, Similarity
from slatprep.align.stretch import RIDGE, stretch
from slatprep.align.surface import Surface, surface_of
from slatprep.geometry.frames import split_transform
from slatprep.parameters import AlignParameters

CENTRES = np.indices((64, 64, 64)).reshape(3, -1).T - 31.5


def stretched(
    slat: Surface, pixie: Surface, pose: Similarity, affine: NDArray[np.float64], *taus: float
) -> tuple[NDArray[np.float64], float, float]:
    """Return the affine map and the offset after steps of these widths, and the score."""
    affines, poses = affine[None].copy(), Poses.of([pose])
    (score,) = stretch(slat.samples, pixie.samples, poses, affines, np.array(taus))
    return affines[0], float(poses.offsets[0]), float(score)


@pytest.fixture(scope="module")
def beside() -> tuple[Surface, Surface, Similarity, NDArray[np.float64]]:
    """Two sides beside each other, of other sizes, and a map that is nowhere along an axis.

    The samples fill no whole number of blocks, and some lie outside the other's box.
    """
    slat = surface_of(crate(CENTRES - [3, -2, 4])).subset(150)
    pixie = surface_of(crate((CENTRES - [-2, -5, 1]) / 0.8)).subset(200)
    turn = Rotation.from_euler("xyz", [25, -40, 70], degrees=True).as_matrix()
    affine = np.array([[1.1, 0.07, -0.05, 1.3], [-0.04, 0.9, 0.06, -0.7], [0.03, -0.08, 1.05, 0.4]])
    return slat, pixie, Similarity(turn, np.array([4.0, -3.0, 6.0]), 1.2, offset=0.3), affine


Beside = tuple[Surface, Surface, Similarity, NDArray[np.float64]]


def test_without_a_step_the_score_is_the_mean_kernel_of_both_sides(beside):
    slat, pixie, pose, affine = beside
    forward, backward = residuals(slat, pixie, pose, affine)
    same, offset, score = stretched(slat, pixie, pose, affine)
    assert score == pytest.approx(0.5 * (mean_kernel(forward) + mean_kernel(backward)), rel=1e-5)
    np.testing.assert_array_equal(same, affine)
    assert offset == pose.offset


@pytest.mark.parametrize("tau", [1.5, 5.0])
def test_a_step_is_that_of_least_squares_on_numerical_derivatives(beside, tau):
    """Of Gauss and Newton, with the weights of Geman and McClure and two small priors.

    Of samples within the other's box, as of others the search knows an approximate derivative.
    """
    slat, pixie, pose, affine = beside
    there, here = carried(slat, pixie, pose, affine)
    forward, backward = within_box(pixie, there), within_box(slat, here)
    slat = replace(slat, points=slat.points[forward], values=slat.values[forward])
    pixie = replace(pixie, points=pixie.points[backward], values=pixie.values[backward])
    assert min(len(slat.points), len(pixie.points)) > 64  # more than one block of the sums
    centre = slat.points.mean(axis=0)
    count = len(slat.points) + len(pixie.points)

    def after(step: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Return map and offset after a step, a map's row and its shift at a time."""
        rows = step[:12].reshape(3, 4)
        change = np.column_stack([rows[:, :3], rows[:, 3] - rows[:, :3] @ centre])
        return affine + change, pose.offset + float(step[12])

    def at(step: NDArray[np.float64]) -> NDArray[np.float64]:
        moved, offset = after(step)
        return np.concatenate(residuals(slat, pixie, pose._replace(offset=offset), moved))

    tiny = 1e-6 * np.eye(13)
    jacobian = np.stack([(at(one) - at(-one)) / 2e-6 for one in tiny], axis=1)
    residual = at(np.zeros(13))
    side = np.repeat([1.0, PIXIEVERSE_WEIGHT], [len(slat.points), len(pixie.points)])
    weight = side / (1.0 + (residual / tau) ** 2) ** 2
    normal = jacobian.T @ (weight[:, None] * jacobian)
    right = -jacobian.T @ (weight * residual)
    normal[12, 12] += OFFSET_PRIOR * count
    right[12] -= OFFSET_PRIOR * count * pose.offset
    normal += RIDGE * np.diag(np.diag(normal)) + 1e-9 * count * np.eye(13)
    expected, offset = after(np.linalg.solve(normal, right))
    found, found_offset, _ = stretched(slat, pixie, pose, affine, tau)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert found_offset == pytest.approx(offset, abs=1e-4)


def test_poses_are_stretched_each_by_itself(beside):
    slat, pixie, pose, affine = beside
    other = pose._replace(shift=pose.shift + 2.0, scale=1.1, offset=-0.1)
    affines, poses = np.stack([np.eye(3, 4), affine]), Poses.of([other, pose])
    scores = stretch(slat.samples, pixie.samples, poses, affines, np.array([4.0, 2.0]))
    for k, alone in enumerate(
        [
            stretched(slat, pixie, other, np.eye(3, 4), 4.0, 2.0),
            stretched(slat, pixie, pose, affine, 4.0, 2.0),
        ]
    ):
        np.testing.assert_array_equal(affines[k], alone[0])
        assert (poses.offsets[k], scores[k]) == alone[1:]


@pytest.mark.parametrize("factors", [(1.1, 1.1, 0.7), (1.15, 1.05, 0.75)])
@pytest.mark.parametrize("seed", [0, 1, 3])
def test_a_squashed_object_is_not_laid_on_its_side(factors, seed):
    """As a similarity the lid fits best where a wall was, which is as near as the lid is now."""
    rotation = Rotation.random(random_state=seed).as_matrix()
    other = crate(CENTRES @ rotation / factors)
    found = align_voxels(crate(CENTRES), other)
    turn = degrees_between(split_transform(found.transform)[0], rotation)
    assert turn < 15.0
    as_similarity = align_voxels(crate(CENTRES), other, AlignParameters(model="similarity"))
    assert degrees_between(split_transform(as_similarity.transform)[0], rotation) > 60.0


def test_a_known_affine_map_is_found_from_a_pose_beside_it():
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
    affines = np.eye(3, 4)[None].copy()
    centre = inside.mean(axis=0)
    start = centre - np.linalg.inv(linear) @ centre
    turn = Rotation.from_euler("xyz", [8, -6, 5], degrees=True).as_matrix()
    poses = Poses.of([Similarity(turn, -start, 1.0)])
    taus = np.array([5.0, 4, 3, 2, 2, 1.5])
    scores = stretch(few.samples, many.samples, poses, affines, taus)
    found = (few.points @ affines[0, :, :3].T + affines[0, :, 3] + start) @ turn
    apart = np.linalg.norm(found - few.points @ linear.T, axis=1)
    assert np.median(apart) < 0.25
    assert scores[0] > 0.8


def test_a_pose_that_would_be_squashed_flat_scores_nothing():
    """An eighth of the volume is another shape, whatever the fit."""
    block = np.zeros((64, 64, 64), dtype=bool)
    block[20:44, 20:44, 20:44] = True
    flat = surface_of(block).subset(60)
    affines, poses = np.eye(3, 4)[None].copy(), Poses.of([Similarity(np.eye(3), np.zeros(3), 1.0)])
    affines[0, :, :3] *= 0.5
    scores = stretch(flat.samples, flat.samples, poses, affines, np.array([5.0]))
    assert scores[0] == 0.0
