"""Uniform cubic B-splines on a lattice of control points; the compiled inner loops.

A displacement is u(x) = sum_ijk B(a - i) B(b - j) B(c - k) C_ijk, where (a, b, c)
is x in units of the lattice's spacing. 64 control points move each point.
Coefficients are (n0, n1, n2, 3). The splines' domain is the n - 3 spans of each
axis. A point outside has the displacement of the domain's nearest point.
"""

from __future__ import annotations

import numpy as np

from slatprep.geometry.frames import Array
from slatprep.geometry.kernel import kernel


@kernel(inline="always")
def _axis_weights(position, spans, weights, at):  # type: ignore[no-untyped-def]
    """Write the four weights of a position (in spans) from ``weights[at]`` on; return the base."""
    position = min(max(position, 0.0), float(spans))
    base = min(int(position), spans - 1)
    t = position - base
    s = 1.0 - t
    weights[at] = s * s * s / 6.0
    weights[at + 1] = (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0
    weights[at + 2] = (3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0
    weights[at + 3] = t * t * t / 6.0
    return base


@kernel(inline="always")
def locate(point, origin, spacing, shape, weights):  # type: ignore[no-untyped-def]
    """Write the weights (12,) of a point along the axes; return its first coefficient's index.

    The index counts numbers of the flattened coefficients. It is unsigned, so that
    the compiler need not handle negative indices in the loops below.
    """
    first = 0
    for axis in range(3):
        position = (point[axis] - origin[axis]) / spacing
        base = _axis_weights(position, shape[axis] - 3, weights, 4 * axis)
        first = first * shape[axis] + base
    return np.uint64(3 * first)


@kernel(inline="always")
def gather(flat, first, strides, weights):  # type: ignore[no-untyped-def]
    """Return the displacement of a point: its coefficients, weighted and added up.

    The sums are written out by coordinate, so that the compiler vectorises them.
    """
    plane, line = strides[0], strides[1]
    x0 = x1 = x2 = x3 = y0 = y1 = y2 = y3 = z0 = z1 = z2 = z3 = 0.0
    for i in range(4):
        at_line = first
        for j in range(4):
            w, n = weights[i] * weights[4 + j], at_line
            x0 += w * flat[n]
            y0 += w * flat[n + np.uint64(1)]
            z0 += w * flat[n + np.uint64(2)]
            x1 += w * flat[n + np.uint64(3)]
            y1 += w * flat[n + np.uint64(4)]
            z1 += w * flat[n + np.uint64(5)]
            x2 += w * flat[n + np.uint64(6)]
            y2 += w * flat[n + np.uint64(7)]
            z2 += w * flat[n + np.uint64(8)]
            x3 += w * flat[n + np.uint64(9)]
            y3 += w * flat[n + np.uint64(10)]
            z3 += w * flat[n + np.uint64(11)]
            at_line += line
        first += plane
    a, b, c, d = weights[8], weights[9], weights[10], weights[11]
    return (
        a * x0 + b * x1 + c * x2 + d * x3,
        a * y0 + b * y1 + c * y2 + d * y3,
        a * z0 + b * z1 + c * z2 + d * z3,
    )


@kernel(inline="always")
def scatter(flat, first, strides, weights, x, y, z):  # type: ignore[no-untyped-def]
    """Add a point's vector to its coefficients, weighted: the transpose of `gather`."""
    plane, line = strides[0], strides[1]
    a, b, c, d = weights[8], weights[9], weights[10], weights[11]
    x0, y0, z0, x1, y1, z1 = a * x, a * y, a * z, b * x, b * y, b * z
    x2, y2, z2, x3, y3, z3 = c * x, c * y, c * z, d * x, d * y, d * z
    for i in range(4):
        at_line = first
        for j in range(4):
            w, n = weights[i] * weights[4 + j], at_line
            flat[n] += w * x0
            flat[n + np.uint64(1)] += w * y0
            flat[n + np.uint64(2)] += w * z0
            flat[n + np.uint64(3)] += w * x1
            flat[n + np.uint64(4)] += w * y1
            flat[n + np.uint64(5)] += w * z1
            flat[n + np.uint64(6)] += w * x2
            flat[n + np.uint64(7)] += w * y2
            flat[n + np.uint64(8)] += w * z2
            flat[n + np.uint64(9)] += w * x3
            flat[n + np.uint64(10)] += w * y3
            flat[n + np.uint64(11)] += w * z3
            at_line += line
        first += plane


@kernel()
def strides_of(shape):  # type: ignore[no-untyped-def]
    """Return the strides, in numbers, from plane to plane and from line to line."""
    return np.uint64(3 * shape[1] * shape[2]), np.uint64(3 * shape[2])


@kernel()
def displacements(points, origin, spacing, coefficients, out):  # type: ignore[no-untyped-def]
    """Write the displacement of each point (N, 3) to `out`."""
    weights, flat = np.zeros(12), coefficients.reshape(-1)
    strides = strides_of(coefficients.shape)
    for m in range(points.shape[0]):
        first = locate(points[m], origin, spacing, coefficients.shape, weights)
        out[m, 0], out[m, 1], out[m, 2] = gather(flat, first, strides, weights)


@kernel()
def _axis_slopes(position, spans, slopes, at):  # type: ignore[no-untyped-def]
    """Write the derivatives [1 / span] of the four weights; 0 outside the domain."""
    if position < 0.0 or position > spans:
        slopes[at : at + 4] = 0.0
        return
    t = position - min(int(position), spans - 1)
    s = 1.0 - t
    slopes[at] = -0.5 * s * s
    slopes[at + 1] = 1.5 * t * t - 2.0 * t
    slopes[at + 2] = -1.5 * s * s + 2.0 * s
    slopes[at + 3] = 0.5 * t * t


@kernel()
def jacobians(points, origin, spacing, coefficients, out):  # type: ignore[no-untyped-def]
    """Write ``out[m, i, j]``, the derivative of displacement i along axis j, for each point."""
    weights, mixed = np.zeros(12), np.zeros(12)
    flat, strides = coefficients.reshape(-1), strides_of(coefficients.shape)
    for m in range(points.shape[0]):
        first = locate(points[m], origin, spacing, coefficients.shape, weights)
        for axis in range(3):
            position = (points[m, axis] - origin[axis]) / spacing
            mixed[:] = weights
            _axis_slopes(position, coefficients.shape[axis] - 3, mixed, 4 * axis)
            mixed[4 * axis : 4 * axis + 4] /= spacing
            x, y, z = gather(flat, first, strides, mixed)
            out[m, 0, axis], out[m, 1, axis], out[m, 2, axis] = x, y, z


def refined(coefficients: Array) -> Array:
    """Return the coefficients of the same displacement on a lattice of half the spacing."""
    for axis in range(3):
        c = np.moveaxis(coefficients, axis, 0)
        # Knot insertion: new control points lie on the inner old ones and halfway between
        # old ones. New points on the outermost old ones serve no span.
        fine = np.empty((2 * len(c) - 3, *c.shape[1:]))
        fine[1::2] = (c[:-2] + 6.0 * c[1:-1] + c[2:]) / 8.0
        fine[0::2] = (c[:-1] + c[1:]) / 2.0
        coefficients = np.moveaxis(fine, 0, axis)
    return np.ascontiguousarray(coefficients)


@kernel()
def bend(coefficients, strength, out):  # type: ignore[no-untyped-def]
    """Add `strength` times half the gradient of the bending energy to `out`.

    The energy is the sum over the lattice of all squared second differences, with
    mixed ones counted twice. It is zero for affine displacements only.
    """
    n0, n1, n2, _ = coefficients.shape
    flat, to = coefficients.reshape(-1), out.reshape(-1)
    strides = (3 * n1 * n2, 3 * n2, 3)
    shape = (n0, n1, n2)
    for axis in range(3):
        a = strides[axis]
        for i in range(n0 - 2 if axis == 0 else n0):
            for j in range(n1 - 2 if axis == 1 else n1):
                start = i * strides[0] + j * strides[1]
                for k in range(start, start + 3 * (n2 - 2 if axis == 2 else n2)):
                    second = strength * (flat[k] - 2.0 * flat[k + a] + flat[k + 2 * a])
                    to[k] += second
                    to[k + a] -= 2.0 * second
                    to[k + 2 * a] += second
    for axis in range(3):
        other = (axis + 1) % 3
        a, b = strides[axis], strides[other]
        for i in range(shape[0] - (axis == 0 or other == 0)):
            for j in range(shape[1] - (axis == 1 or other == 1)):
                start = i * strides[0] + j * strides[1]
                for k in range(start, start + 3 * (shape[2] - (axis == 2 or other == 2))):
                    mixed = flat[k + a + b] - flat[k + a] - flat[k + b] + flat[k]
                    mixed *= 2.0 * strength
                    to[k] += mixed
                    to[k + a] -= mixed
                    to[k + b] -= mixed
                    to[k + a + b] += mixed
