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

from slatprep.align.interpolation import trilinear
from slatprep.geometry.kernel import kernel

UNKNOWNS = 8  # rotation 3, shift 3, log scale, offset

_OFFSET_PRIOR = 0.02
_LEVER = 30.0  # voxels; what a turn or a change of scale moves at the object's rim
_LONGEST_TURN = 0.35
_LARGEST_GROWTH = 0.1
_BLOCK = 64  # samples a step at a time: what is kept of them stays in the processor's first cache
_LANES = 8  # sums of each product, of every eighth sample each: as many on any processor
_PRODUCTS = 6 * 9  # of the upper triangle's six blocks of three rows and columns
_VALUE, _GX, _GY, _GZ, _U, _V, _W, _X, _Y, _Z, _OX, _OY, _OZ, _BEYOND, _ROWS = range(
    0, 15 * _BLOCK, _BLOCK
)
_WEIGHTED = _ROWS + (UNKNOWNS + 1) * _BLOCK
_SUMS = _WEIGHTED + (UNKNOWNS + 1) * _BLOCK
_NUMBERS = _SUMS + _PRODUCTS * _LANES
"""How many numbers a block has, and before it where those of each kind begin: in one array, which
is no other's memory, so that the compiler makes vector instructions of the loops over them."""


@kernel(error_model="numpy")
def _accumulate(  # type: ignore[no-untyped-def]
    points, values, field, origin, rotation, shift, scale, offset, centre, tau, forward, equations
):
    """Add one side's residuals to the normal equations.

    With the rows A = (J, r), a sample a row, the equations are A^T W A: the
    normal matrix, and beside it, as the last column, the right-hand side.
    """
    block, cells = np.empty(_NUMBERS), np.empty(_BLOCK, np.int64)
    corners = np.empty(8 * _BLOCK, np.float32)
    block[_SUMS:] = 0.0
    for first in range(0, points.shape[0], _BLOCK):
        own, known = points[first : first + _BLOCK], values[first : first + _BLOCK]
        _carry(own, rotation, shift, scale, origin, field.shape, forward, block, cells)
        _look_up(field, cells, len(own), corners, block)
        _weigh(known, scale, offset, tau, forward, block)
        _linearise(len(own), rotation, centre, forward, block)
        _add_products(len(own), block)
    _add_sums(block, equations)


@kernel(error_model="numpy")
def _fit(points, values, field, origin, rotation, shift, scale, offset, forward):  # type: ignore[no-untyped-def]
    """Of one side at tau = 1, the summed kernel, and the number and squares of the inliers."""
    block, cells = np.empty(_ROWS), np.empty(_BLOCK, np.int64)
    corners = np.empty(8 * _BLOCK, np.float32)
    weight_sum, inliers, sum_of_squares = 0.0, 0, 0.0
    for first in range(0, points.shape[0], _BLOCK):
        own, known = points[first : first + _BLOCK], values[first : first + _BLOCK]
        _carry(own, rotation, shift, scale, origin, field.shape, forward, block, cells)
        _look_up(field, cells, len(own), corners, block)
        _weigh(known, scale, offset, 1.0, forward, block)
        for m in range(len(own)):
            square = block[_V + m]
            near = square <= 1.0
            weight_sum += block[_U + m]
            inliers += near
            sum_of_squares += square if near else 0.0
    return weight_sum, inliers, sum_of_squares


@kernel(error_model="numpy")
def _carry(points, rotation, shift, scale, origin, shape, forward, block, cells):  # type: ignore[no-untyped-def]
    """Find the points in the SLAT frame, and their cells and places in the other side's field."""
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    # Out of the loop, as the compiler cannot know that what it writes is not one of these.
    i00, i01, i02 = r00 / scale, r10 / scale, r20 / scale
    i10, i11, i12 = r01 / scale, r11 / scale, r21 / scale
    i20, i21, i22 = r02 / scale, r12 / scale, r22 / scale
    s0, s1, s2 = shift[0], shift[1], shift[2]
    o0, o1, o2 = origin[0], origin[1], origin[2]
    n0, n1, n2 = shape
    if forward:  # a SLAT sample looks up the PixieVerse distance
        for m in range(len(points)):
            px, py, pz = points[m, 0], points[m, 1], points[m, 2]
            ax, ay, az = px - s0, py - s1, pz - s2
            block[_X + m], block[_Y + m], block[_Z + m] = px, py, pz
            block[_OX + m] = i00 * ax + i01 * ay + i02 * az - o0
            block[_OY + m] = i10 * ax + i11 * ay + i12 * az - o1
            block[_OZ + m] = i20 * ax + i21 * ay + i22 * az - o2
    else:  # a PixieVerse sample looks up the SLAT distance
        for m in range(len(points)):
            ax, ay, az = points[m, 0], points[m, 1], points[m, 2]
            px = scale * (r00 * ax + r01 * ay + r02 * az) + s0
            py = scale * (r10 * ax + r11 * ay + r12 * az) + s1
            pz = scale * (r20 * ax + r21 * ay + r22 * az) + s2
            block[_X + m], block[_Y + m], block[_Z + m] = px, py, pz
            block[_OX + m], block[_OY + m], block[_OZ + m] = px - o0, py - o1, pz - o2
    for m in range(len(points)):
        x, y, z = block[_OX + m], block[_OY + m], block[_OZ + m]
        cx = min(max(x, 0.0), n0 - 1.000001)
        cy = min(max(y, 0.0), n1 - 1.000001)
        cz = min(max(z, 0.0), n2 - 1.000001)
        i, j, k = np.int64(cx), np.int64(cy), np.int64(cz)
        cells[m] = (i * n1 + j) * n2 + k
        block[_U + m] = cx - np.float64(i)
        block[_V + m] = cy - np.float64(j)
        block[_W + m] = cz - np.float64(k)
        x, y, z = x - cx, y - cy, z - cz
        block[_OX + m], block[_OY + m], block[_OZ + m] = x, y, z
        block[_BEYOND + m] = x * x + y * y + z * z


@kernel(error_model="numpy")
def _look_up(field, cells, count, corners, block):  # type: ignore[no-untyped-def]
    """Do what `interpolate` does for a block; as vectors but for the reading of the corners."""
    values, row = field.reshape(-1), field.shape[2]
    plane = field.shape[1] * row
    for m in range(count):
        # Unsigned, so that no negative index has to be provided for.
        for corner in range(8):
            step = (corner >> 2) * plane + (corner >> 1 & 1) * row + (corner & 1)
            corners[corner * _BLOCK + m] = values[np.uint64(cells[m] + step)]
    for m in range(count):
        value, gx, gy, gz = trilinear(
            corners[m], corners[_BLOCK + m], corners[2 * _BLOCK + m], corners[3 * _BLOCK + m],
            corners[4 * _BLOCK + m], corners[5 * _BLOCK + m], corners[6 * _BLOCK + m],
            corners[7 * _BLOCK + m], block[_U + m], block[_V + m], block[_W + m],
        )  # fmt: skip
        block[_VALUE + m], block[_GX + m], block[_GY + m], block[_GZ + m] = value, gx, gy, gz
    for m in range(count):
        outside = block[_BEYOND + m]
        if outside > 1e-8:
            outside = math.sqrt(outside)
            block[_VALUE + m] += outside
            block[_GX + m] = block[_OX + m] / outside
            block[_GY + m] = block[_OY + m] / outside
            block[_GZ + m] = block[_OZ + m] / outside


@kernel(error_model="numpy")
def _weigh(values, scale, offset, tau, forward, block):  # type: ignore[no-untyped-def]
    """Set a block's residuals, their kernels (U) and their squares (V)."""
    if forward:
        for m in range(len(values)):
            block[_VALUE + m] = scale * block[_VALUE + m] - values[m] - offset
    else:
        for m in range(len(values)):
            block[_VALUE + m] = block[_VALUE + m] - scale * values[m] + offset
    for m in range(len(values)):
        square = block[_VALUE + m] * block[_VALUE + m]
        block[_U + m], block[_V + m] = 1.0 / (1.0 + square / (tau * tau)), square


@kernel(error_model="numpy")
def _linearise(count, rotation, centre, forward, block):  # type: ignore[no-untyped-def]
    """Set a block's rows of A and of W A; rows of zeros make it as long as all lanes."""
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    c0, c1, c2 = centre[0], centre[1], centre[2]
    sign = -1.0 if forward else 1.0
    if forward:
        for m in range(count):
            a, b, c = block[_GX + m], block[_GY + m], block[_GZ + m]
            block[_GX + m] = r00 * a + r01 * b + r02 * c
            block[_GY + m] = r10 * a + r11 * b + r12 * c
            block[_GZ + m] = r20 * a + r21 * b + r22 * c
    for m in range(count):
        gx, gy, gz, residual = block[_GX + m], block[_GY + m], block[_GZ + m], block[_VALUE + m]
        qx, qy, qz = block[_X + m] - c0, block[_Y + m] - c1, block[_Z + m] - c2
        kernel = block[_U + m]
        block[_ROWS + m] = sign * (qy * gz - qz * gy)
        block[_ROWS + _BLOCK + m] = sign * (qz * gx - qx * gz)
        block[_ROWS + 2 * _BLOCK + m] = sign * (qx * gy - qy * gx)
        block[_ROWS + 3 * _BLOCK + m] = sign * gx
        block[_ROWS + 4 * _BLOCK + m] = sign * gy
        block[_ROWS + 5 * _BLOCK + m] = sign * gz
        block[_ROWS + 6 * _BLOCK + m] = sign * (gx * qx + gy * qy + gz * qz)
        block[_ROWS + 7 * _BLOCK + m] = sign
        block[_ROWS + 8 * _BLOCK + m] = residual
        for i in range(UNKNOWNS + 1):
            block[_WEIGHTED + i * _BLOCK + m] = kernel * kernel * block[_ROWS + i * _BLOCK + m]
    for m in range(count, -(-count // _LANES) * _LANES):
        for i in range(UNKNOWNS + 1):
            block[_ROWS + i * _BLOCK + m] = block[_WEIGHTED + i * _BLOCK + m] = 0.0


@kernel()
def _add_products(count, block):  # type: ignore[no-untyped-def]
    """Add a block's products to their sums; of the symmetric matrix the upper triangle alone."""
    for first in range(0, _BLOCK, _LANES):
        # Not the end of the range: the compiler would have to expect a negative `first`, and
        # a check of each index keeps it from vector instructions.
        if first >= count:
            break
        _add_nine_products(block, first, 0, 0, 0)
        _add_nine_products(block, first, 0, 3, 1)
        _add_nine_products(block, first, 0, 6, 2)
        _add_nine_products(block, first, 3, 3, 3)
        _add_nine_products(block, first, 3, 6, 4)
        _add_nine_products(block, first, 6, 6, 5)


@kernel(inline="always")
def _add_nine_products(block, first, row, column, number):  # type: ignore[no-untyped-def]
    """Add those of three rows of W A and three of A, `row` and `column` the first of them.

    Written out, and the numbers constants, so that the compiler makes vectors of the lanes.
    """
    left, right = _WEIGHTED + row * _BLOCK + first, _ROWS + column * _BLOCK + first
    for m in range(_LANES):
        p, q, r = block[left + m], block[left + _BLOCK + m], block[left + 2 * _BLOCK + m]
        x, y, z = block[right + m], block[right + _BLOCK + m], block[right + 2 * _BLOCK + m]
        at = _SUMS + 9 * number * _LANES + m
        block[at] += p * x
        block[at + _LANES] += p * y
        block[at + 2 * _LANES] += p * z
        block[at + 3 * _LANES] += q * x
        block[at + 4 * _LANES] += q * y
        block[at + 5 * _LANES] += q * z
        block[at + 6 * _LANES] += r * x
        block[at + 7 * _LANES] += r * y
        block[at + 8 * _LANES] += r * z


@kernel()
def _add_sums(block, equations):  # type: ignore[no-untyped-def]
    """Add up the lanes, and add the sums to the upper triangle of the equations."""
    for number in range(_PRODUCTS):
        at = _SUMS + number * _LANES
        even = (block[at] + block[at + 4]) + (block[at + 2] + block[at + 6])
        odd = (block[at + 1] + block[at + 5]) + (block[at + 3] + block[at + 7])
        block[number] = even + odd
    number = 0
    for row in range(0, UNKNOWNS + 1, 3):
        for column in range(row, UNKNOWNS + 1, 3):
            for i in range(row, row + 3):
                for j in range(column, column + 3):
                    equations[i, j] += block[number]
                    number += 1


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
        here, near, squares = _fit(
            slat_points, slat_values, pixie_field, pixie_origin,
            rotation, shift, scale, offset, True,
        )  # fmt: skip
        back, near_back, squares_back = _fit(
            pixie_points, pixie_values, slat_field, slat_origin,
            rotation, shift, scale, offset, False,
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
