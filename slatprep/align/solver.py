"""Robust Gauss-Newton for similarities between two distance fields; compiled.

Unknowns are a twist of the PixieVerse side in the SLAT frame (rotation w, shift v), the logarithm
of its scale, and an offset o between the two distances. The centre of rotation and scale is the
centre c of the SLAT samples. With F = s f_P(T^-1 x) the PixieVerse distance carried to the SLAT
frame, the residuals are

    r = F(x) - f_S(x) - o            at SLAT samples x,
    r = f_S(T y) - s f_P(y) + o      at PixieVerse samples y,

each weighted by (1 + r^2 / tau^2)^-2 (Geman-McClure estimator), so that bites,
floaters and parts of one side only have little weight.

The derivative with respect to the scale ignores that s also stretches the distances. With that term
a smaller s would reduce the residuals of rough surfaces, and noise would bias the scale (1.5 % too
small on thick, rough fields).
"""

from __future__ import annotations

import math

import numpy as np

from slatprep.align.equations import (
    SIMILARITY,
    Link,
    accumulate,
    centre_of,
    fit_of,
    matrix_and_rhs,
    new_equations,
    solve_linear,
)
from slatprep.geometry.kernel import kernel

_OFFSET_PRIOR = 0.02
_LEVER = 30.0  # voxels; distance of the object's rim from its centre
_LONGEST_TURN = 0.35
_LARGEST_GROWTH = 0.1


@kernel()
def _links(rotation, shift, scale, offset, memory):  # type: ignore[no-untyped-def]
    """Return the `Link` of the SLAT samples at a pose, and that of the PixieVerse samples."""
    inverse, forth, minus, back = memory
    for i in range(3):
        back[i] = 0.0
        for j in range(3):
            forth[i, j] = scale * rotation[i, j]
            inverse[i, j] = rotation[j, i] / scale
            back[i] -= inverse[i, j] * shift[j]
    forward = Link(inverse, back, rotation, scale, offset, True)
    return forward, Link(forth, shift, minus, scale, offset, False)


@kernel()
def _rotation_of(turn):  # type: ignore[no-untyped-def]
    """Return the rotation matrix of a rotation vector, by way of the unit quaternion."""
    angle = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    w = math.cos(0.5 * angle)
    ratio = math.sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
    x, y, z = ratio * turn[0], ratio * turn[1], ratio * turn[2]
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@kernel()
def _sum_equations(slat, pixie, links, centre, tau, size_by_slat, equations, normal, rhs):  # type: ignore[no-untyped-def]
    """Write the normal equations of both sides' residuals to `normal` and `rhs`."""
    products = equations.products
    products[:] = 0.0
    accumulate(slat, pixie, links[0], centre, tau, 1.0, SIMILARITY, equations)
    by_slat = products.copy() if size_by_slat else products
    accumulate(pixie, slat, links[1], centre, tau, 1.0, SIMILARITY, equations)
    if size_by_slat:
        products[6:, 6:] = 2.0 * by_slat[6:, 6:]
    matrix_and_rhs(products, SIMILARITY, normal, rhs)
    if size_by_slat:
        for i in range(6, SIMILARITY):
            normal[i, :6] = 2.0 * by_slat[:6, i]


@kernel()
def _regularise(normal, rhs, offset, samples, free_scale):  # type: ignore[no-untyped-def]
    """Hold the offset near 0 and, unless it is free, the scale where it is; damp all unknowns."""
    # On a ball, offset and scale have the same effect, so a weak prior keeps the
    # offset near 0. A little damping (below) keeps a plane from sliding.
    normal[7, 7] += _OFFSET_PRIOR * samples
    rhs[7] -= _OFFSET_PRIOR * samples * offset
    if not free_scale:
        normal[:, 6] = 0.0
        normal[6, :] = 0.0
        rhs[6] = 0.0
    for i in range(SIMILARITY):
        normal[i, i] += 1e-4 * normal[i, i] + 1e-6 * samples


@kernel()
def _move(rotation, shift, step, growth, centre):  # type: ignore[no-untyped-def]
    """Turn and shift a pose in place by a step, and grow it about the centre."""
    turn = _rotation_of(step)
    away = _product(turn, shift[0] - centre[0], shift[1] - centre[1], shift[2] - centre[2])
    for axis in range(3):
        shift[axis] = centre[axis] + growth * away[axis] + step[3 + axis]
    for axis in range(3):
        x, y, z = rotation[0, axis], rotation[1, axis], rotation[2, axis]
        rotation[0, axis], rotation[1, axis], rotation[2, axis] = _product(turn, x, y, z)


@kernel()
def solve(slat, pixie, poses, taus, free_scale, size_by_slat, scale_bounds, tolerance):  # type: ignore[no-untyped-def]
    """Refine `Poses` of the PixieVerse surface on the SLAT surface, both `Samples`, in place.

    If `size_by_slat`, the equations of scale and offset are summed over the SLAT samples alone.
    Floaters, ground and bumps of a rough field are surface that only PixieVerse has, outside the
    object. Their samples would make the object smaller.

    Take one Gauss-Newton step for each of `taus` (voxels), and stop once a step moves the object's
    rim by less than `tolerance` voxels. Return an array (n, 4), a row for each pose.
    Its columns are the mean kernel at tau = 1 voxel of the SLAT samples, that of the PixieVerse
    samples, the share of all samples within one voxel, and their rms residual.
    """
    centre = centre_of(slat)
    scale_low, scale_high = scale_bounds
    samples = len(slat.values) + len(pixie.values)
    equations = new_equations()
    normal, rhs = np.zeros((SIMILARITY, SIMILARITY)), np.zeros(SIMILARITY)
    step = np.zeros(SIMILARITY)
    memory = np.empty((3, 3)), np.empty((3, 3)), -np.eye(3), np.empty(3)
    fits = np.zeros((len(poses.scales), 4))
    for pose in range(len(poses.scales)):
        rotation, shift = poses.rotations[pose], poses.shifts[pose]
        scale, offset = poses.scales[pose], poses.offsets[pose]
        for tau in taus:
            links = _links(rotation, shift, scale, offset, memory)
            _sum_equations(slat, pixie, links, centre, tau, size_by_slat, equations, normal, rhs)
            _regularise(normal, rhs, offset, samples, free_scale)
            solve_linear(normal, rhs, step)
            angle = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            if angle > _LONGEST_TURN:
                step[:3] *= _LONGEST_TURN / angle
                angle = _LONGEST_TURN
            growth = math.exp(min(max(step[6], -_LARGEST_GROWTH), _LARGEST_GROWTH))
            growth = min(max(growth, scale_low / scale), scale_high / scale)
            _move(rotation, shift, step, growth, centre)
            scale *= growth
            offset += step[7]
            moved = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
            if moved + _LEVER * (angle + abs(growth - 1.0)) < tolerance:
                break
        there, here = _links(rotation, shift, scale, offset, memory)
        ours, near, squares = fit_of(slat, pixie, there, equations)
        theirs, near_theirs, squares_theirs = fit_of(pixie, slat, here, equations)
        inliers = near + near_theirs
        poses.scales[pose], poses.offsets[pose] = scale, offset
        fits[pose, 0] = ours / len(slat.values)
        fits[pose, 1] = theirs / len(pixie.values)
        fits[pose, 2] = inliers / samples
        fits[pose, 3] = math.sqrt((squares + squares_theirs) / max(inliers, 1))
    return fits


@kernel()
def _product(matrix, x, y, z):  # type: ignore[no-untyped-def]
    """Return a matrix (3, 3) times a vector."""
    return (
        0.0 + matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
        0.0 + matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
        0.0 + matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
    )
