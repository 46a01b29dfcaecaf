"""Affine fits of many poses at once; the compiled loop of the search among shapes that differ.

Residuals and weights are those of `slatprep.align.deform_solver`, without its lattice.
With g the derivative of a residual by where a sample lies in the SLAT frame, and q its
place from the centre, with a 1 behind, the derivatives by the twelve unknowns are g q^T. So
of a sample only the products of g with itself and of q with itself are made, six and
ten, and the sums of their products are the normal matrix.
"""

from __future__ import annotations

import math

import numpy as np

from slatprep.align.deform_solver import OFFSET_PRIOR, PIXIEVERSE_WEIGHT, RIDGE
from slatprep.align.interpolation import interpolate
from slatprep.align.solver import solve_linear
from slatprep.geometry.kernel import kernel

_LEAST, _MOST = 0.2, 5.0
"""Between these the determinant stays: what is flatter or longer is not the shape any more."""

_BLOCK = 64
_UNKNOWNS = 13  # nine of the matrix and three of the shift, row by row, and the offset


@kernel(error_model="numpy")
def _accumulate(  # type: ignore[no-untyped-def]
    points, values, field, origin, rotation, shift, scale, offset, affine, inverse, centre,
    tau, weight, forward, quadratic, linear, constant,
):  # fmt: skip
    """Add one side's residuals to the sums; return its mean kernel."""
    left, right = np.zeros((_BLOCK, 12)), np.zeros((_BLOCK, 12))
    sums = np.zeros((12, 12))
    n = 0
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    a00, a01, a02, a03 = affine[0, 0], affine[0, 1], affine[0, 2], affine[0, 3]
    a10, a11, a12, a13 = affine[1, 0], affine[1, 1], affine[1, 2], affine[1, 3]
    a20, a21, a22, a23 = affine[2, 0], affine[2, 1], affine[2, 2], affine[2, 3]
    i00, i01, i02 = inverse[0, 0], inverse[0, 1], inverse[0, 2]
    i10, i11, i12 = inverse[1, 0], inverse[1, 1], inverse[1, 2]
    i20, i21, i22 = inverse[2, 0], inverse[2, 1], inverse[2, 2]
    s0, s1, s2 = shift[0], shift[1], shift[2]
    o0, o1, o2 = origin[0], origin[1], origin[2]
    c0, c1, c2 = centre[0], centre[1], centre[2]
    kernels = 0.0
    sign = -1.0 if forward else 1.0
    for m in range(points.shape[0]):
        x, y, z = points[m, 0], points[m, 1], points[m, 2]
        if forward:
            u = a00 * x + a01 * y + a02 * z + a03 - s0
            v = a10 * x + a11 * y + a12 * z + a13 - s1
            w = a20 * x + a21 * y + a22 * z + a23 - s2
            value, a, b, c = interpolate(
                field,
                (r00 * u + r10 * v + r20 * w) / scale - o0,
                (r01 * u + r11 * v + r21 * w) / scale - o1,
                (r02 * u + r12 * v + r22 * w) / scale - o2,
            )
            residual = scale * value - values[m] - offset
            gx = r00 * a + r01 * b + r02 * c
            gy = r10 * a + r11 * b + r12 * c
            gz = r20 * a + r21 * b + r22 * c
        else:
            u = scale * (r00 * x + r01 * y + r02 * z) + s0 - a03
            v = scale * (r10 * x + r11 * y + r12 * z) + s1 - a13
            w = scale * (r20 * x + r21 * y + r22 * z) + s2 - a23
            x = i00 * u + i01 * v + i02 * w
            y = i10 * u + i11 * v + i12 * w
            z = i20 * u + i21 * v + i22 * w
            value, a, b, c = interpolate(field, x - o0, y - o1, z - o2)
            residual = value - scale * values[m] + offset
            gx = -(i00 * a + i10 * b + i20 * c)
            gy = -(i01 * a + i11 * b + i21 * c)
            gz = -(i02 * a + i12 * b + i22 * c)
        kernel = 1.0 / (1.0 + residual * residual / (tau * tau))
        kernels += kernel
        x, y, z = x - c0, y - c1, z - c2
        q, g = right[n], left[n]
        q[0], q[1], q[2], q[3] = x * x, x * y, x * z, x
        q[4], q[5], q[6] = y * y, y * z, y
        q[7], q[8], q[9] = z * z, z, 1.0
        factor = weight * kernel * kernel
        g[0], g[1], g[2] = factor * gx * gx, factor * gx * gy, factor * gx * gz
        g[3], g[4], g[5] = factor * gy * gy, factor * gy * gz, factor * gz * gz
        pull, turn = factor * sign, factor * residual
        g[6], g[7], g[8] = pull * gx, pull * gy, pull * gz
        g[9], g[10], g[11] = turn * gx, turn * gy, turn * gz
        n += 1
        if n == _BLOCK or m == points.shape[0] - 1:
            for i in range(0, 12, 3):
                for j in range(0 if i < 6 else 3, 12, 3):
                    these = left[:n, i], left[:n, i + 1], left[:n, i + 2]
                    those = right[:n, j], right[:n, j + 1], right[:n, j + 2]
                    _add_products(these, those, sums[i : i + 3, j : j + 3])
            n = 0
        constant[0] += factor
        constant[1] += factor * sign * residual
    for i in range(6):
        for j in range(10):
            quadratic[i, j] += sums[i, j]
        linear[i, 0] += sums[6 + i, 3]
        linear[i, 1] += sums[6 + i, 6]
        linear[i, 2] += sums[6 + i, 8]
        linear[i, 3] += sums[6 + i, 9]
    return kernels / points.shape[0]


@kernel()
def _solve(quadratic, linear, constant, offset, offset_prior, ridge, normal, rhs, step):  # type: ignore[no-untyped-def]
    """Put the sums together as normal equations, and solve them."""
    pair = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    place = np.array([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])
    for i in range(3):
        for k in range(4):
            for j in range(3):
                for n in range(4):
                    normal[4 * i + k, 4 * j + n] = quadratic[pair[i, j], place[k, n]]
            normal[4 * i + k, 12] = normal[12, 4 * i + k] = linear[i, k]
            rhs[4 * i + k] = -linear[3 + i, k]
    normal[12, 12] = constant[0] + offset_prior
    rhs[12] = -constant[1] - offset_prior * offset
    for i in range(_UNKNOWNS):
        normal[i, i] += RIDGE * normal[i, i] + ridge
    solve_linear(normal, rhs, step)


@kernel()
def _invert(affine, inverse):  # type: ignore[no-untyped-def]
    """Write the inverse of the 3x3 part; return the determinant."""
    for i in range(3):
        for j in range(3):
            k, n, u, v = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            inverse[i, j] = affine[k, u] * affine[n, v] - affine[k, v] * affine[n, u]
    determinant = 0.0
    for i in range(3):
        determinant += affine[0, i] * inverse[i, 0]
    inverse /= determinant
    return determinant


@kernel()
def stretch(  # type: ignore[no-untyped-def]
    slat_points, slat_values, slat_field, slat_origin,
    pixie_points, pixie_values, pixie_field, pixie_origin,
    rotations, shifts, scales, affines, offsets, taus,
):  # fmt: skip
    """Fit an affine map before each pose, in place, one step for each of `taus` (voxels).

    Returns the mean kernel at tau = 1 voxel of each, the sides with equal weight;
    0 where the shape would be squashed flat.
    """
    here, back = slat_points.shape[0], pixie_points.shape[0]
    quadratic, linear, constant = np.zeros((6, 12)), np.zeros((6, 4)), np.zeros(2)
    normal, rhs = np.zeros((_UNKNOWNS, _UNKNOWNS)), np.zeros(_UNKNOWNS)
    step, inverse, centre = np.zeros(_UNKNOWNS), np.zeros((3, 3)), np.zeros(3)
    for m in range(here):
        centre += slat_points[m]
    centre /= here
    scores = np.zeros(len(scales))
    for pose in range(len(scales)):
        rotation, shift, scale, affine = rotations[pose], shifts[pose], scales[pose], affines[pose]
        for turn in range(len(taus) + 1):
            determinant = _invert(affine, inverse)
            if not _LEAST < determinant < _MOST:
                break
            tau = taus[turn] if turn < len(taus) else 1.0
            quadratic[:], linear[:], constant[:] = 0.0, 0.0, 0.0
            score = _accumulate(
                slat_points, slat_values, pixie_field, pixie_origin, rotation, shift, scale,
                offsets[pose], affine, inverse, centre, tau, 1.0, True,
                quadratic, linear, constant,
            )  # fmt: skip
            score += _accumulate(
                pixie_points, pixie_values, slat_field, slat_origin, rotation, shift, scale,
                offsets[pose], affine, inverse, centre, tau, PIXIEVERSE_WEIGHT, False,
                quadratic, linear, constant,
            )  # fmt: skip
            if turn == len(taus):
                scores[pose] = 0.5 * score
                break
            count = here + back
            _solve(
                quadratic, linear, constant, offsets[pose], OFFSET_PRIOR * count, 1e-9 * count,
                normal, rhs, step,
            )  # fmt: skip
            for i in range(3):
                for j in range(3):
                    affine[i, j] += step[4 * i + j]
                    affine[i, 3] -= step[4 * i + j] * centre[j]
                affine[i, 3] += step[4 * i + 3]
            offsets[pose] += step[12]
            if not math.isfinite(offsets[pose]):
                break
    return scores


@kernel()
def _add_products(left, right, out):  # type: ignore[no-untyped-def]
    """Add the sum over m of ``left[i][m] * right[j][m]`` to ``out[i, j]``; three columns of each.

    Written out, so that the compiler keeps the sums in registers.
    """
    p, q, r = left
    x, y, z = right
    a, b, c = out[0, 0], out[0, 1], out[0, 2]
    d, e, f = out[1, 0], out[1, 1], out[1, 2]
    g, h, k = out[2, 0], out[2, 1], out[2, 2]
    for m in range(len(p)):
        a += p[m] * x[m]
        b += p[m] * y[m]
        c += p[m] * z[m]
        d += q[m] * x[m]
        e += q[m] * y[m]
        f += q[m] * z[m]
        g += r[m] * x[m]
        h += r[m] * y[m]
        k += r[m] * z[m]
    out[0, 0], out[0, 1], out[0, 2] = a, b, c
    out[1, 0], out[1, 1], out[1, 2] = d, e, f
    out[2, 0], out[2, 1], out[2, 2] = g, h, k
