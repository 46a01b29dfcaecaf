"""Robust Gauss-Newton between two distance fields; the compiled inner loop.

Unknowns are a twist of the PixieVerse side in the SLAT frame (rotation w, shift
v), the logarithm of its scale, and an offset o between the two distances, all
about the centre c of the SLAT samples. With F = s f_P(T^-1 x) the PixieVerse
distance carried to the SLAT frame, the residuals are

    r = F(x) - f_S(x) - o            at SLAT samples x,
    r = f_S(T y) - s f_P(y) + o      at PixieVerse samples y,

each weighted by (1 + r^2 / tau^2)^-2, the Geman-McClure estimator, so that
bites, floaters and parts that only one side has lose their pull.

The derivative by the scale leaves out that s also stretches the distances: with
it, a smaller s would make the residuals of rough surfaces smaller, and scale
would pay for noise (1.5 % too small on thick, rough fields).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

UNKNOWNS = 8  # rotation 3, shift 3, log scale, offset

_OFFSET_PRIOR = 0.02
_LEVER = 30.0  # voxels; what a turn or a change of scale moves at the object's rim
_LONGEST_TURN = 0.35
_LARGEST_GROWTH = 0.1


@njit(cache=True, inline="always")
def interpolate(f, x, y, z):  # type: ignore[no-untyped-def]
    """Trilinear value and gradient; outside the box the distance to it is added."""
    n0, n1, n2 = f.shape
    cx = min(max(x, 0.0), n0 - 1.000001)
    cy = min(max(y, 0.0), n1 - 1.000001)
    cz = min(max(z, 0.0), n2 - 1.000001)
    i, j, k = int(cx), int(cy), int(cz)
    u, v, w = cx - i, cy - j, cz - k
    f000, f001, f010, f011 = f[i, j, k], f[i, j, k + 1], f[i, j + 1, k], f[i, j + 1, k + 1]
    i += 1
    f100, f101, f110, f111 = f[i, j, k], f[i, j, k + 1], f[i, j + 1, k], f[i, j + 1, k + 1]
    f00 = f000 + (f001 - f000) * w
    f01 = f010 + (f011 - f010) * w
    f10 = f100 + (f101 - f100) * w
    f11 = f110 + (f111 - f110) * w
    f0 = f00 + (f01 - f00) * v
    f1 = f10 + (f11 - f10) * v
    value = f0 + (f1 - f0) * u
    gx = f1 - f0
    gy = (f01 - f00) * (1.0 - u) + (f11 - f10) * u
    g0 = (f001 - f000) * (1.0 - v) + (f011 - f010) * v
    g1 = (f101 - f100) * (1.0 - v) + (f111 - f110) * v
    gz = g0 * (1.0 - u) + g1 * u
    ox, oy, oz = x - cx, y - cy, z - cz
    outside = ox * ox + oy * oy + oz * oz
    if outside > 1e-8:
        outside = math.sqrt(outside)
        value += outside
        gx, gy, gz = ox / outside, oy / outside, oz / outside
    return value, gx, gy, gz


@njit(cache=True)
def _accumulate(  # type: ignore[no-untyped-def]
    points, values, field, origin, rotation, shift, scale, offset, centre, tau, forward, normal, rhs
):
    """Add one side's residuals to the normal equations; return its summed weight and fit."""
    jacobian = np.zeros(UNKNOWNS)
    weight_sum, inliers, squares = 0.0, 0, 0.0
    sign = -1.0 if forward else 1.0
    inverse = rotation.T / scale
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    for m in range(points.shape[0]):
        px, py, pz = points[m, 0], points[m, 1], points[m, 2]
        if forward:  # a SLAT sample looks up the PixieVerse distance
            ax, ay, az = px - shift[0], py - shift[1], pz - shift[2]
            value, a, b, c = interpolate(
                field,
                inverse[0, 0] * ax + inverse[0, 1] * ay + inverse[0, 2] * az - origin[0],
                inverse[1, 0] * ax + inverse[1, 1] * ay + inverse[1, 2] * az - origin[1],
                inverse[2, 0] * ax + inverse[2, 1] * ay + inverse[2, 2] * az - origin[2],
            )
            gx = r00 * a + r01 * b + r02 * c
            gy = r10 * a + r11 * b + r12 * c
            gz = r20 * a + r21 * b + r22 * c
            carried = scale * value
            residual = carried - values[m] - offset
        else:  # a PixieVerse sample looks up the SLAT distance
            ax = scale * (r00 * px + r01 * py + r02 * pz) + shift[0]
            ay = scale * (r10 * px + r11 * py + r12 * pz) + shift[1]
            az = scale * (r20 * px + r21 * py + r22 * pz) + shift[2]
            value, gx, gy, gz = interpolate(field, ax - origin[0], ay - origin[1], az - origin[2])
            px, py, pz = ax, ay, az
            carried = scale * values[m]
            residual = value - carried + offset
        qx, qy, qz = px - centre[0], py - centre[1], pz - centre[2]
        jacobian[0] = sign * (qy * gz - qz * gy)
        jacobian[1] = sign * (qz * gx - qx * gz)
        jacobian[2] = sign * (qx * gy - qy * gx)
        jacobian[3] = sign * gx
        jacobian[4] = sign * gy
        jacobian[5] = sign * gz
        jacobian[6] = sign * (gx * qx + gy * qy + gz * qz)
        jacobian[7] = sign
        square = residual * residual
        kernel = 1.0 / (1.0 + square / (tau * tau))
        weight = kernel * kernel
        weight_sum += kernel
        if square <= 1.0:
            inliers += 1
            squares += square
        for i in range(UNKNOWNS):
            weighted = weight * jacobian[i]
            rhs[i] += weighted * residual
            for j in range(i, UNKNOWNS):
                normal[i, j] += weighted * jacobian[j]
    return weight_sum, inliers, squares


@njit(cache=True)
def _rotation_of(turn):  # type: ignore[no-untyped-def]
    """Rotation matrix of a rotation vector, by way of the unit quaternion."""
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


@njit(cache=True)
def solve(  # type: ignore[no-untyped-def]
    slat_points, slat_values, slat_field, slat_origin,
    pixie_points, pixie_values, pixie_field, pixie_origin,
    rotations, shifts, scales, offsets,
    taus, free_scale, size_by_slat, scale_low, scale_high, tolerance,
):  # fmt: skip
    """Refine poses of the PixieVerse surface on the SLAT surface, in place.

    Where `size_by_slat`, the equations of scale and offset are summed over the
    SLAT samples alone. Floaters, ground and bumps of a rough field are surface
    that only PixieVerse has, and all of it lies outside: its samples would make
    the object smaller.

    One Gauss-Newton step for each of `taus` (voxels), ended early once a step
    moves the object's rim by less than `tolerance` voxels. Returns, a row a
    pose, the mean kernel at tau = 1 voxel over the SLAT's and over the
    PixieVerse samples, the share of all samples within one voxel, and the rms
    residual of those.
    """
    centre = np.zeros(3)
    for m in range(slat_points.shape[0]):
        centre += slat_points[m]
    centre /= slat_points.shape[0]
    samples = slat_points.shape[0] + pixie_points.shape[0]
    normal, rhs = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
    by_slat, rhs_by_slat = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
    step = np.zeros(UNKNOWNS)
    fits = np.zeros((len(scales), 4))
    for pose in range(len(scales)):
        rotation, shift = rotations[pose], shifts[pose]
        scale, offset = scales[pose], offsets[pose]
        for tau in taus:
            normal[:] = 0.0
            rhs[:] = 0.0
            _accumulate(
                slat_points, slat_values, pixie_field, pixie_origin,
                rotation, shift, scale, offset, centre, tau, True, normal, rhs,
            )  # fmt: skip
            by_slat[:], rhs_by_slat[:] = normal, rhs
            _accumulate(
                pixie_points, pixie_values, slat_field, slat_origin,
                rotation, shift, scale, offset, centre, tau, False, normal, rhs,
            )  # fmt: skip
            for i in range(UNKNOWNS):
                for j in range(i):
                    normal[i, j] = normal[j, i]
            if size_by_slat:
                for i in range(6, UNKNOWNS):
                    rhs[i] = 2.0 * rhs_by_slat[i]
                    for j in range(UNKNOWNS):
                        normal[i, j] = 2.0 * by_slat[min(i, j), max(i, j)]
            # On a ball, offset and scale cannot be told apart: a weak prior keeps
            # the offset near 0. A little damping keeps a plane's slide at rest.
            normal[7, 7] += _OFFSET_PRIOR * samples
            rhs[7] += _OFFSET_PRIOR * samples * offset
            if not free_scale:
                normal[:, 6] = 0.0
                normal[6, :] = 0.0
                rhs[6] = 0.0
            for i in range(UNKNOWNS):
                normal[i, i] += 1e-4 * normal[i, i] + 1e-6 * samples
            solve_linear(normal, -rhs, step)
            angle = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            if angle > _LONGEST_TURN:
                step[:3] *= _LONGEST_TURN / angle
                angle = _LONGEST_TURN
            growth = math.exp(min(max(step[6], -_LARGEST_GROWTH), _LARGEST_GROWTH))
            growth = min(max(growth, scale_low / scale), scale_high / scale)
            turn = _rotation_of(step)
            shift[:] = centre + growth * _product(turn, shift - centre) + step[3:6]
            for column in range(3):
                rotation[:, column] = _product(turn, rotation[:, column])
            scale *= growth
            offset += step[7]
            moved = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
            if moved + _LEVER * (angle + abs(growth - 1.0)) < tolerance:
                break
        here, near, squares = _accumulate(
            slat_points, slat_values, pixie_field, pixie_origin,
            rotation, shift, scale, offset, centre, 1.0, True, normal, rhs,
        )  # fmt: skip
        back, near_back, squares_back = _accumulate(
            pixie_points, pixie_values, slat_field, slat_origin,
            rotation, shift, scale, offset, centre, 1.0, False, normal, rhs,
        )  # fmt: skip
        inliers = near + near_back
        scales[pose], offsets[pose] = scale, offset
        fits[pose, 0] = here / slat_points.shape[0]
        fits[pose, 1] = back / pixie_points.shape[0]
        fits[pose, 2] = inliers / samples
        fits[pose, 3] = math.sqrt((squares + squares_back) / max(inliers, 1))
    return fits


@njit(cache=True)
def _product(matrix, vector):  # type: ignore[no-untyped-def]
    product = np.zeros(3)
    for i in range(3):
        for j in range(3):
            product[i] += matrix[i, j] * vector[j]
    return product


@njit(cache=True)
def solve_linear(matrix, rhs, step):  # type: ignore[no-untyped-def]
    """Solve ``matrix @ step = rhs`` by elimination with partial pivoting, in place.

    A dozen unknowns take less time here than calling LAPACK does, and the bits
    do not depend on which kernels a BLAS picks for the processor.
    """
    n = len(rhs)
    for i in range(n):
        pivot = i + np.argmax(np.abs(matrix[i:, i]))
        if pivot != i:
            for j in range(i, n):
                matrix[i, j], matrix[pivot, j] = matrix[pivot, j], matrix[i, j]
            rhs[i], rhs[pivot] = rhs[pivot], rhs[i]
        for k in range(i + 1, n):
            factor = matrix[k, i] / matrix[i, i]
            for j in range(i + 1, n):
                matrix[k, j] -= factor * matrix[i, j]
            rhs[k] -= factor * rhs[i]
    for i in range(n - 1, -1, -1):
        total = rhs[i]
        for j in range(i + 1, n):
            total -= matrix[i, j] * step[j]
        step[i] = total / matrix[i, i]
