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

from slatprep.geometry.kernel import kernel

UNKNOWNS = 8  # rotation 3, shift 3, log scale, offset

_OFFSET_PRIOR = 0.02
_LEVER = 30.0  # voxels; what a turn or a change of scale moves at the object's rim
_LONGEST_TURN = 0.35
_LARGEST_GROWTH = 0.1
_BLOCK = 64  # samples whose products are summed at once: they stay in the processor's first cache


@kernel(inline="always", error_model="numpy")
def interpolate(f, x, y, z):  # type: ignore[no-untyped-def]
    """Trilinear value and gradient; outside the box the distance to it is added."""
    n0, n1, n2 = f.shape
    cx = min(max(x, 0.0), n0 - 1.000001)
    cy = min(max(y, 0.0), n1 - 1.000001)
    cz = min(max(z, 0.0), n2 - 1.000001)
    # Unsigned, so that no negative index has to be provided for.
    i, j, k, one = np.uint64(cx), np.uint64(cy), np.uint64(cz), np.uint64(1)
    u, v, w = cx - np.float64(i), cy - np.float64(j), cz - np.float64(k)
    f000, f001, f010, f011 = f[i, j, k], f[i, j, k + one], f[i, j + one, k], f[i, j + one, k + one]
    i += one
    f100, f101, f110, f111 = f[i, j, k], f[i, j, k + one], f[i, j + one, k], f[i, j + one, k + one]
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


@kernel(error_model="numpy")
def _accumulate(  # type: ignore[no-untyped-def]
    points, values, field, origin, rotation, shift, scale, offset, centre, tau, forward, equations
):
    """Add one side's residuals to the normal equations; return its summed weight and fit.

    With the rows A = (J, r), a sample a row, the equations are A^T W A: the
    normal matrix, and beside it, as the last column, the right-hand side.
    """
    rows, weighted = np.empty((_BLOCK, UNKNOWNS + 1)), np.empty((_BLOCK, UNKNOWNS + 1))
    weight_sum, inliers, squares = 0.0, 0, 0.0
    sign = -1.0 if forward else 1.0
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    # Out of the loop, as the compiler cannot know that what it writes is not one of these.
    i00, i01, i02 = r00 / scale, r10 / scale, r20 / scale
    i10, i11, i12 = r01 / scale, r11 / scale, r21 / scale
    i20, i21, i22 = r02 / scale, r12 / scale, r22 / scale
    s0, s1, s2 = shift[0], shift[1], shift[2]
    o0, o1, o2 = origin[0], origin[1], origin[2]
    c0, c1, c2 = centre[0], centre[1], centre[2]
    n = 0
    for m in range(points.shape[0]):
        px, py, pz = points[m, 0], points[m, 1], points[m, 2]
        if forward:  # a SLAT sample looks up the PixieVerse distance
            ax, ay, az = px - s0, py - s1, pz - s2
            value, a, b, c = interpolate(
                field,
                i00 * ax + i01 * ay + i02 * az - o0,
                i10 * ax + i11 * ay + i12 * az - o1,
                i20 * ax + i21 * ay + i22 * az - o2,
            )
            gx = r00 * a + r01 * b + r02 * c
            gy = r10 * a + r11 * b + r12 * c
            gz = r20 * a + r21 * b + r22 * c
            residual = scale * value - values[m] - offset
        else:  # a PixieVerse sample looks up the SLAT distance
            ax, ay, az = px, py, pz
            px = scale * (r00 * ax + r01 * ay + r02 * az) + s0
            py = scale * (r10 * ax + r11 * ay + r12 * az) + s1
            pz = scale * (r20 * ax + r21 * ay + r22 * az) + s2
            value, gx, gy, gz = interpolate(field, px - o0, py - o1, pz - o2)
            residual = value - scale * values[m] + offset
        qx, qy, qz = px - c0, py - c1, pz - c2
        square = residual * residual
        kernel = 1.0 / (1.0 + square / (tau * tau))
        weight_sum += kernel
        near = square <= 1.0
        inliers += near
        squares += square if near else 0.0
        row = rows[n]
        row[0] = sign * (qy * gz - qz * gy)
        row[1] = sign * (qz * gx - qx * gz)
        row[2] = sign * (qx * gy - qy * gx)
        row[3] = sign * gx
        row[4] = sign * gy
        row[5] = sign * gz
        row[6] = sign * (gx * qx + gy * qy + gz * qz)
        row[7] = sign
        row[8] = residual
        for i in range(UNKNOWNS + 1):
            weighted[n, i] = kernel * kernel * row[i]
        n += 1
        if n == _BLOCK or m == points.shape[0] - 1:
            _add_products(weighted[:n], rows[:n], equations)
            n = 0
    return weight_sum, inliers, squares


@kernel()
def _add_products(left, right, out):  # type: ignore[no-untyped-def]
    """Add the sum over m of ``left[m, i] * right[m, j]`` to ``out[i, j]``, the upper triangle.

    By blocks of three rows and columns, written out, so that the compiler keeps
    the sums in registers; below the diagonal blocks nothing is added.
    """
    for i in range(0, UNKNOWNS + 1, 3):
        for j in range(i, UNKNOWNS + 1, 3):
            to = out[i : i + 3, j : j + 3]
            a, b, c = to[0, 0], to[0, 1], to[0, 2]
            d, e, f = to[1, 0], to[1, 1], to[1, 2]
            g, h, k = to[2, 0], to[2, 1], to[2, 2]
            for m in range(left.shape[0]):
                p, q, r = left[m, i], left[m, i + 1], left[m, i + 2]
                x, y, z = right[m, j], right[m, j + 1], right[m, j + 2]
                a += p * x
                b += p * y
                c += p * z
                d += q * x
                e += q * y
                f += q * z
                g += r * x
                h += r * y
                k += r * z
            to[0, 0], to[0, 1], to[0, 2] = a, b, c
            to[1, 0], to[1, 1], to[1, 2] = d, e, f
            to[2, 0], to[2, 1], to[2, 2] = g, h, k


@kernel()
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


@kernel()
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
    equations = np.zeros((UNKNOWNS + 1, UNKNOWNS + 1))
    by_slat = np.zeros((UNKNOWNS + 1, UNKNOWNS + 1))
    normal, rhs = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
    step = np.zeros(UNKNOWNS)
    fits = np.zeros((len(scales), 4))
    for pose in range(len(scales)):
        rotation, shift = rotations[pose], shifts[pose]
        scale, offset = scales[pose], offsets[pose]
        for tau in taus:
            equations[:] = 0.0
            _accumulate(
                slat_points, slat_values, pixie_field, pixie_origin,
                rotation, shift, scale, offset, centre, tau, True, equations,
            )  # fmt: skip
            by_slat[:] = equations
            _accumulate(
                pixie_points, pixie_values, slat_field, slat_origin,
                rotation, shift, scale, offset, centre, tau, False, equations,
            )  # fmt: skip
            if size_by_slat:
                equations[6:, 6:] = 2.0 * by_slat[6:, 6:]
            for i in range(UNKNOWNS):
                rhs[i] = equations[i, UNKNOWNS]
                for j in range(UNKNOWNS):
                    normal[i, j] = equations[min(i, j), max(i, j)]
            if size_by_slat:
                for i in range(6, UNKNOWNS):
                    normal[i, :6] = 2.0 * by_slat[:6, i]
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
            rotation, shift, scale, offset, centre, 1.0, True, equations,
        )  # fmt: skip
        back, near_back, squares_back = _accumulate(
            pixie_points, pixie_values, slat_field, slat_origin,
            rotation, shift, scale, offset, centre, 1.0, False, equations,
        )  # fmt: skip
        inliers = near + near_back
        scales[pose], offsets[pose] = scale, offset
        fits[pose, 0] = here / slat_points.shape[0]
        fits[pose, 1] = back / pixie_points.shape[0]
        fits[pose, 2] = inliers / samples
        fits[pose, 3] = math.sqrt((squares + squares_back) / max(inliers, 1))
    return fits


@kernel()
def _product(matrix, vector):  # type: ignore[no-untyped-def]
    product = np.zeros(3)
    for i in range(3):
        for j in range(3):
            product[i] += matrix[i, j] * vector[j]
    return product


@kernel()
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
