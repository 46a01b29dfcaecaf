"""Robust Gauss-Newton for a deformation between two distance fields; compiled inner loops.

A SLAT point x is looked up at T^-1 g(x), g(x) = A x + b + u(x) with a spline
displacement u (`bspline`). With the fields f_S and f_P, the scale s and offset
o of the similarity T (see `solver`), the residuals are

    r = s f_P(T^-1 g(x)) - f_S(x) - o     at SLAT samples x,
    r = f_S(g^-1(T y)) - s f_P(y) + o     at PixieVerse samples y.

A sample's derivative by the coefficients is one vector times its 64 weights, so
the normal equations are never formed: conjugate gradients apply them sample by
sample, always in the same order.
"""

from __future__ import annotations

import numpy as np

from slatprep.align.bspline import bend, gather, locate, scatter, strides_of
from slatprep.align.interpolation import interpolate
from slatprep.align.solver import solve_linear
from slatprep.geometry.kernel import kernel

OFFSET_PRIOR, RIDGE = 0.01, 1e-4
PIXIEVERSE_WEIGHT = 0.5
"""Weight of a PixieVerse sample in a fit: floaters and ground are surface that only they have."""

_INVERSE_STEPS = 2


@kernel()
def linearise(  # type: ignore[no-untyped-def]
    points, values, field, field_origin, places, forward, bent,
    rotation, shift, scale, offset, affine, inverse, coefficients, origin, spacing,
    tau, bases, weights, vectors, residuals,
):  # fmt: skip
    """Linearise one side's residuals at the current deformation.

    `places` holds, a row a sample, its point in the SLAT frame; where not
    `forward` it is improved first (a few steps of a fixed-point iteration from
    the last known place). Where not `bent` the lattice is not looked at. Writes
    control points, weights, and the weighted residuals with their derivatives
    by the sample's displacement; returns the mean kernel.
    """
    steps = 0 if forward else (_INVERSE_STEPS if bent else 1)
    moved, kernels = np.zeros(3), 0.0
    flat, strides = coefficients.reshape(-1), strides_of(coefficients.shape)
    for m in range(points.shape[0]):
        if not forward:
            p = points[m]
            for axis in range(3):
                moved[axis] = shift[axis] + scale * (
                    rotation[axis, 0] * p[0] + rotation[axis, 1] * p[1] + rotation[axis, 2] * p[2]
                )
        first, u0, u1, u2 = np.uint64(0), 0.0, 0.0, 0.0
        for step in range(steps + 1):
            if bent:
                first = locate(places[m], origin, spacing, coefficients.shape, weights[m])
                u0, u1, u2 = gather(flat, first, strides, weights[m])
            x, y, z = places[m, 0], places[m, 1], places[m, 2]
            q0 = affine[0, 0] * x + affine[0, 1] * y + affine[0, 2] * z + affine[0, 3] + u0
            q1 = affine[1, 0] * x + affine[1, 1] * y + affine[1, 2] * z + affine[1, 3] + u1
            q2 = affine[2, 0] * x + affine[2, 1] * y + affine[2, 2] * z + affine[2, 3] + u2
            if step == steps:
                break
            q0, q1, q2 = moved[0] - q0, moved[1] - q1, moved[2] - q2
            for axis in range(3):
                places[m, axis] += (
                    inverse[axis, 0] * q0 + inverse[axis, 1] * q1 + inverse[axis, 2] * q2
                )
        if forward:
            a, b, c = q0 - shift[0], q1 - shift[1], q2 - shift[2]
            value, ga, gb, gc = interpolate(
                field,
                (rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0] * c) / scale
                - field_origin[0],
                (rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1] * c) / scale
                - field_origin[1],
                (rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2] * c) / scale
                - field_origin[2],
            )
            residual = scale * value - values[m] - offset
            gx = rotation[0, 0] * ga + rotation[0, 1] * gb + rotation[0, 2] * gc
            gy = rotation[1, 0] * ga + rotation[1, 1] * gb + rotation[1, 2] * gc
            gz = rotation[2, 0] * ga + rotation[2, 1] * gb + rotation[2, 2] * gc
        else:
            value, ga, gb, gc = interpolate(
                field,
                places[m, 0] - field_origin[0],
                places[m, 1] - field_origin[1],
                places[m, 2] - field_origin[2],
            )
            residual = value - scale * values[m] + offset
            gx = -(inverse[0, 0] * ga + inverse[1, 0] * gb + inverse[2, 0] * gc)
            gy = -(inverse[0, 1] * ga + inverse[1, 1] * gb + inverse[2, 1] * gc)
            gz = -(inverse[0, 2] * ga + inverse[1, 2] * gb + inverse[2, 2] * gc)
        bases[m] = first
        # The kernel is the root of the weight of Geman and McClure.
        kernel = 1.0 / (1.0 + residual * residual / (tau * tau))
        kernels += kernel
        vectors[m, 0], vectors[m, 1], vectors[m, 2] = kernel * gx, kernel * gy, kernel * gz
        vectors[m, 3] = -kernel if forward else kernel
        residuals[m] = kernel * residual
    return kernels / points.shape[0]


@kernel()
def affine_step(  # type: ignore[no-untyped-def]
    places, vectors, residuals, centre, ridge, offset, offset_prior, step
):
    """Solve for 12 affine unknowns about `centre` and the offset; write them to `step` (13,)."""
    n = 13
    normal, rhs, row = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    for m in range(places.shape[0]):
        for i in range(3):
            v = vectors[m, i]
            row[4 * i] = v * (places[m, 0] - centre[0])
            row[4 * i + 1] = v * (places[m, 1] - centre[1])
            row[4 * i + 2] = v * (places[m, 2] - centre[2])
            row[4 * i + 3] = v
        row[12] = vectors[m, 3]
        for i in range(n):
            rhs[i] -= row[i] * residuals[m]
            for j in range(i, n):
                normal[i, j] += row[i] * row[j]
    normal[12, 12] += offset_prior
    rhs[12] -= offset_prior * offset
    for i in range(n):
        normal[i, i] += ridge * normal[i, i] + 1e-9 * places.shape[0]
    for i in range(n):
        for j in range(i):
            normal[i, j] = normal[j, i]
    solve_linear(normal, rhs, step)


@kernel()
def _apply(bases, weights, vectors, delta, delta_offset, strength, damping, out):  # type: ignore[no-untyped-def]
    """Write the normal matrix times (delta, delta_offset) to `out`; return the offset's part."""
    flat, to, strides = delta.reshape(-1), out.reshape(-1), strides_of(delta.shape)
    to[:] = 0.0
    out_offset = 0.0
    for m in range(bases.shape[0]):
        x, y, z = gather(flat, bases[m], strides, weights[m])
        v = vectors[m]
        along = v[0] * x + v[1] * y + v[2] * z + v[3] * delta_offset
        out_offset += v[3] * along
        scatter(to, bases[m], strides, weights[m], along * v[0], along * v[1], along * v[2])
    bend(delta, strength, out)
    for k in range(len(flat)):
        to[k] += damping * flat[k]
    return out_offset


@kernel()
def lattice_step(  # type: ignore[no-untyped-def]
    bases, weights, vectors, residuals, coefficients, strength, damping,
    offset, offset_prior, iterations,
):  # fmt: skip
    """One Gauss-Newton step of all coefficients and the offset, by conjugate gradients.

    Adds the step to `coefficients` and returns the new offset. The
    preconditioner is the matrix's diagonal.
    """
    shape = coefficients.shape
    size = coefficients.size
    gradient, diagonal, strides = np.zeros(shape), np.zeros(shape), strides_of(shape)
    g, d = gradient.reshape(-1), diagonal.reshape(-1)
    gradient_offset, diagonal_offset = offset_prior * offset, offset_prior
    squares = np.zeros(12)
    for m in range(bases.shape[0]):
        v, r = vectors[m], residuals[m]
        scatter(g, bases[m], strides, weights[m], r * v[0], r * v[1], r * v[2])
        for k in range(12):
            squares[k] = weights[m, k] * weights[m, k]
        scatter(d, bases[m], strides, squares, v[0] * v[0], v[1] * v[1], v[2] * v[2])
        gradient_offset += r * v[3]
        diagonal_offset += v[3] * v[3]
    bend(coefficients, strength, gradient)
    for k in range(size):
        g[k] += damping * coefficients.reshape(-1)[k]
        # An inner control point takes part in 3 * (1 + 4 + 1) + 2 * 3 * 4 squares.
        d[k] += 42.0 * strength + damping
    delta, direction, product = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    x, p, q = delta.reshape(-1), direction.reshape(-1), product.reshape(-1)
    x_offset = 0.0
    # Residual of the linear system: minus the gradient, as delta starts at zero.
    left = -gradient
    r = left.reshape(-1)
    r_offset = -gradient_offset
    p_offset = r_offset / diagonal_offset
    rho = r_offset * p_offset
    for k in range(size):
        p[k] = r[k] / d[k]
        rho += r[k] * p[k]
    for _ in range(iterations):
        if rho <= 1e-12:
            break
        q_offset = _apply(bases, weights, vectors, direction, p_offset, strength, damping, product)
        q_offset += offset_prior * p_offset
        curvature = p_offset * q_offset
        for k in range(size):
            curvature += p[k] * q[k]
        alpha = rho / curvature
        x_offset += alpha * p_offset
        r_offset -= alpha * q_offset
        fresh = r_offset * r_offset / diagonal_offset
        for k in range(size):
            x[k] += alpha * p[k]
            r[k] -= alpha * q[k]
            fresh += r[k] * r[k] / d[k]
        beta = fresh / rho
        rho = fresh
        p_offset = r_offset / diagonal_offset + beta * p_offset
        for k in range(size):
            p[k] = r[k] / d[k] + beta * p[k]
    c = coefficients.reshape(-1)
    for k in range(size):
        c[k] += x[k]
    return offset + x_offset
