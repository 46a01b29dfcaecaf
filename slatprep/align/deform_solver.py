"""Robust Gauss-Newton for a deformation between two distance fields; compiled inner loops.

A SLAT point x corresponds to the PixieVerse point T^-1 g(x), with g(x) = A x + b + u(x)
and a spline displacement u (`bspline`). With the fields f_S and f_P, the scale s and offset
o of the similarity T (see `solver`), the residuals are

    r = s f_P(T^-1 g(x)) - f_S(x) - o     at SLAT samples x,
    r = f_S(g^-1(T y)) - s f_P(y) + o     at PixieVerse samples y.

The derivative of a residual with respect to the coefficients is one vector times 64 weights. So the
normal matrix is never formed: conjugate gradients apply it sample by sample, always in the same
order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.align.equations import interpolate, invert
from slatprep.align.warp import NO_SPACING
from slatprep.geometry.bspline import bend, gather, locate, scatter, strides_of
from slatprep.geometry.kernel import kernel

OFFSET_PRIOR = 0.01
PIXIEVERSE_WEIGHT = 0.5
"""Weight of a PixieVerse sample in a fit; low, as only this side has floaters and ground."""

_INVERSE_STEPS = 2


class Lines(NamedTuple):
    """The data of M samples in the equations of a lattice; kernels write them."""

    places: NDArray[np.float64]  # (M, 3), positions in the SLAT frame
    bases: NDArray[np.uint64]  # (M,), flat index of the first control point
    weights: NDArray[np.float64]  # (M, 12), of four control points along each axis
    vectors: NDArray[np.float64]  # (M, 4), weighted derivatives by displacement and offset
    residuals: NDArray[np.float64]  # (M,), weighted

    @classmethod
    def at(cls, places: NDArray[np.float64]) -> Lines:
        """Return lines for samples at `places` (M, 3), with all other numbers unset."""
        n = len(places)
        return cls(places, np.empty(n, np.uint64), np.empty((n, 12)), np.empty((n, 4)), np.empty(n))

    def rows(self, chosen: slice | NDArray[np.intp]) -> Lines:
        """Return the chosen rows; a slice shares memory."""
        return Lines._make(numbers[chosen] for numbers in self)


@kernel()
def linearise(here, there, pose, warp, lines, forward, tau):  # type: ignore[no-untyped-def]
    """Linearise one side's residuals at the current deformation.

    `here` and `there` are `Samples`, `pose` is a `Similarity` and `warp` a `Warp`. If not
    `forward`, the `lines`' places are improved first, by a fixed-point iteration from the last
    known places. If the warp has no lattice, its coefficients are not used.
    """
    columns, values, field, field_origin = here.columns, here.values, there.distance, there.origin
    places, bases, weights = lines.places, lines.bases, lines.weights
    vectors, residuals = lines.vectors, lines.residuals
    rotation, shift, scale = pose.rotation, pose.shift, pose.scale
    affine, offset, origin = warp.affine, warp.offset, warp.origin
    spacing, coefficients = warp.spacing, warp.coefficients
    bent = spacing < NO_SPACING
    inverse = np.zeros((3, 3))
    invert(affine, inverse)
    steps = 0 if forward else (_INVERSE_STEPS if bent else 1)
    moved = np.zeros(3)
    flat, strides = coefficients.reshape(-1), strides_of(coefficients.shape)
    for m in range(len(values)):
        if not forward:
            p = columns[0, m], columns[1, m], columns[2, m]
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
        vectors[m, 0], vectors[m, 1], vectors[m, 2] = kernel * gx, kernel * gy, kernel * gz
        vectors[m, 3] = -kernel if forward else kernel
        residuals[m] = kernel * residual


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
def lattice_step(lines, coefficients, offset, strength, damping, offset_prior, iterations):  # type: ignore[no-untyped-def]
    """Take one Gauss-Newton step of all coefficients and the offset, by conjugate gradients.

    Add the step to `coefficients` and return the new offset. The preconditioner is the
    matrix's diagonal.
    """
    bases, weights, vectors, residuals = lines.bases, lines.weights, lines.vectors, lines.residuals
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
        # The bending energy's diagonal at an inner point is 3 * (1 + 4 + 1) + 2 * 3 * 4.
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
