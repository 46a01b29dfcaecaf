"""What the search makes small, as the docstring of `slatprep.align.solver` has it, by scipy."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from slatprep.align.pose import Similarity
from slatprep.align.surface import Surface

Array = NDArray[np.float64]


def distance_at(surface: Surface, points: Array) -> Array:
    """Return the signed distance at points; outside the box the distance to it is added."""
    index = points - surface.origin
    inside = np.clip(index, 0.0, np.array(surface.distance.shape) - 1.0)
    field = surface.distance.astype(np.float64)
    return np.asarray(
        map_coordinates(field, inside.T, order=1) + np.linalg.norm(index - inside, axis=1)
    )


def carried(slat: Surface, pixie: Surface, pose: Similarity, affine: Array) -> tuple[Array, Array]:
    """Return where both sides' samples are looked up; `affine` (3, 4) is the SLAT's, first."""
    matrix, shift = affine[:, :3], affine[:, 3]
    there = (slat.points @ matrix.T + shift - pose.shift) @ pose.rotation / pose.scale
    placed = pose.scale * pixie.points @ pose.rotation.T + pose.shift
    return there, np.linalg.solve(matrix, (placed - shift).T).T


def residuals(
    slat: Surface, pixie: Surface, pose: Similarity, affine: Array
) -> tuple[Array, Array]:
    """Return the residuals at the SLAT's and at the PixieVerse samples."""
    there, here = carried(slat, pixie, pose, affine)
    forward = pose.scale * distance_at(pixie, there) - slat.values - pose.offset
    backward = distance_at(slat, here) - pose.scale * pixie.values + pose.offset
    return forward, backward


def within_box(surface: Surface, points: Array) -> NDArray[np.bool_]:
    """Say which points have a signed distance of their own."""
    index = points - surface.origin
    inside = (index > 0) & (index < np.array(surface.distance.shape) - 1)
    return np.asarray(inside.all(axis=1))


def mean_kernel(residual: Array) -> float:
    """Return the mean robust kernel at a width of one voxel."""
    return float((1.0 / (1.0 + residual**2)).mean())
