"""Normal equations of a fit between two distance fields; the compiled inner loop.

Each SLAT sample reads the PixieVerse distance field, and each PixieVerse sample the SLAT's; `Link`
gives the positions. r are the residuals, J their derivatives and A = (J, r) the rows. W are the
squared Geman-McClure kernels 1 / (1 + r^2 / tau^2). The equations are A^T W A: the normal matrix,
with the negative right-hand side as the last column.

g is the derivative of a residual with respect to the position of the deformed SLAT point, and q the
sample's position from the centre. For an affine map of the SLAT side, J is g q^T and g: twelve
unknowns, row by row. For a rotation, shift and growth of the PixieVerse side, J is -(q x g), -g and
-(q . g). The offset is the last unknown of both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.geometry.kernel import kernel

SIMILARITY = 8  # unknowns: turn 3, shift 3, log scale, offset
AFFINE = 13  # unknowns: nine of the matrix and three of the shift, row by row, and the offset

_BLOCK = 64  # samples processed at a time; their data stay in the first-level cache
_LANES = 8  # partial sums of each product, over every eighth sample; the same on any processor
_STEP = 16  # samples that are added to the partial sums before these are stored again
_FEW = ((0, 0), (0, 3), (0, 6), (3, 3), (3, 6), (6, 6))
_MANY = (*_FEW, (0, 9), (0, 12), (3, 9), (3, 12), (6, 9), (6, 12), (9, 9), (9, 12), (12, 12))
# First row and column of each block of three by three products in the upper triangle.
_SIZE = 15  # rows of A (unknowns and residual), rounded up to blocks of three
_VALUE, _GX, _GY, _GZ, _U, _V, _W, _X, _Y, _Z, _OX, _OY, _OZ, _BEYOND, _ROWS = range(
    0, 15 * _BLOCK, _BLOCK
)
_SUMS = _ROWS + _SIZE * _BLOCK
_NUMBERS = _SUMS + 9 * len(_MANY) * _LANES
"""Length of a block's array; the names before it are offsets of its parts. One array that overlaps
no other lets the compiler vectorise the loops."""


class Link(NamedTuple):
    """The map from one side's samples to positions in the other side's distance field.

    `matrix` (3, 3) and `shift` (3,) map a SLAT sample to the PixieVerse frame if `forward`, else a
    PixieVerse sample to the SLAT frame. `turn` (3, 3) converts the gradient there to g.
    """

    matrix: NDArray[np.float64]
    shift: NDArray[np.float64]
    turn: NDArray[np.float64]
    scale: float
    offset: float
    forward: bool


class Equations(NamedTuple):
    """The equations (`products`, upper triangle only), and the work arrays of one block."""

    products: NDArray[np.float64]
    block: NDArray[np.float64]
    cells: NDArray[np.int64]
    corners: NDArray[np.float32]


@kernel(inline="always", error_model="numpy")
def trilinear(f000, f001, f010, f011, f100, f101, f110, f111, u, v, w):  # type: ignore[no-untyped-def]
    """Return the value and gradient at (u, v, w) in a cell, from its corners."""
    f00 = f000 + (f001 - f000) * w
    f01 = f010 + (f011 - f010) * w
    f10 = f100 + (f101 - f100) * w
    f11 = f110 + (f111 - f110) * w
    f0 = f00 + (f01 - f00) * v
    f1 = f10 + (f11 - f10) * v
    gy = (f01 - f00) * (1.0 - u) + (f11 - f10) * u
    g0 = (f001 - f000) * (1.0 - v) + (f011 - f010) * v
    g1 = (f101 - f100) * (1.0 - v) + (f111 - f110) * v
    return f0 + (f1 - f0) * u, f1 - f0, gy, g0 * (1.0 - u) + g1 * u


@kernel(inline="always", error_model="numpy")
def interpolate(f, x, y, z):  # type: ignore[no-untyped-def]
    """Return the trilinear value and gradient; outside the box, add the distance to it."""
    n0, n1, n2 = f.shape
    cx = min(max(x, 0.0), n0 - 1.000001)
    cy = min(max(y, 0.0), n1 - 1.000001)
    cz = min(max(z, 0.0), n2 - 1.000001)
    # Unsigned, so that the compiler need not handle negative indices.
    i, j, k, one = np.uint64(cx), np.uint64(cy), np.uint64(cz), np.uint64(1)
    u, v, w = cx - np.float64(i), cy - np.float64(j), cz - np.float64(k)
    f000, f001, f010, f011 = f[i, j, k], f[i, j, k + one], f[i, j + one, k], f[i, j + one, k + one]
    i += one
    f100, f101, f110, f111 = f[i, j, k], f[i, j, k + one], f[i, j + one, k], f[i, j + one, k + one]
    value, gx, gy, gz = trilinear(f000, f001, f010, f011, f100, f101, f110, f111, u, v, w)
    ox, oy, oz = x - cx, y - cy, z - cz
    outside = ox * ox + oy * oy + oz * oz
    if outside > 1e-8:
        outside = math.sqrt(outside)
        value += outside
        gx, gy, gz = ox / outside, oy / outside, oz / outside
    return value, gx, gy, gz


@kernel()
def new_equations():  # type: ignore[no-untyped-def]
    """Return equations of zeros, with work arrays."""
    cells, corners = np.empty(_BLOCK, np.int64), np.empty(8 * _BLOCK, np.float32)
    return Equations(np.zeros((_SIZE, _SIZE)), np.empty(_NUMBERS), cells, corners)


@kernel(error_model="numpy")
def accumulate(here, there, link, centre, tau, weight, unknowns, equations):  # type: ignore[no-untyped-def]
    """Add one side's residuals, times `weight`, to the equations."""
    block = equations.block
    blocks = len(_FEW) if unknowns == SIMILARITY else len(_MANY)
    block[_SUMS : _SUMS + 9 * blocks * _LANES] = 0.0
    for first in range(0, len(here.values), _BLOCK):
        values = here.values[first : first + _BLOCK]
        _residuals_of(here.columns, first, values, link, there, tau, equations)
        _linearise(len(values), link, centre, weight, block)
        if unknowns == SIMILARITY:
            _rows_of_similarity(len(values), link.forward, block)
        else:
            _rows_of_affine(len(values), link.forward, block)
        _add_products(len(values), unknowns, block)
    _add_sums(blocks, block, equations.products)


@kernel(error_model="numpy")
def fit_of(here, there, link, equations):  # type: ignore[no-untyped-def]
    """Return one side's kernel sum at tau = 1, its inlier count and the inliers' sum of squares.

    Only the work arrays of `equations` are used.
    """
    block = equations.block
    kernels, inliers, sum_of_squares = 0.0, 0, 0.0
    for first in range(0, len(here.values), _BLOCK):
        values = here.values[first : first + _BLOCK]
        _residuals_of(here.columns, first, values, link, there, 1.0, equations)
        for m in range(len(values)):
            square = block[_V + m]
            near = square <= 1.0
            kernels += block[_U + m]
            inliers += near
            sum_of_squares += square if near else 0.0
    return kernels, inliers, sum_of_squares


@kernel(error_model="numpy")
def _residuals_of(columns, first, values, link, there, tau, equations):  # type: ignore[no-untyped-def]
    """Compute the residuals, gradients and kernels of a block of samples from `first` on."""
    block, cells = equations.block, equations.cells
    _carry(columns, first, len(values), link, there, block, cells)
    _look_up(there.distance, cells, len(values), equations.corners, block)
    _weigh(values, link, tau, block)


@kernel(error_model="numpy")
def _carry(columns, first, count, link, there, block, cells):  # type: ignore[no-untyped-def]
    """Compute positions in the SLAT frame, and cells and positions in the other side's field."""
    # Read before the loop, as the compiler cannot know that the loop does not overwrite them.
    matrix, shift, origin = link.matrix, link.shift, there.origin
    m00, m01, m02, s0 = matrix[0, 0], matrix[0, 1], matrix[0, 2], shift[0]
    m10, m11, m12, s1 = matrix[1, 0], matrix[1, 1], matrix[1, 2], shift[1]
    m20, m21, m22, s2 = matrix[2, 0], matrix[2, 1], matrix[2, 2], shift[2]
    o0, o1, o2 = origin[0], origin[1], origin[2]
    n0, n1, n2 = there.distance.shape
    forward, end = link.forward, first + count
    xs, ys, zs = columns[0, first:end], columns[1, first:end], columns[2, first:end]
    for m in range(count):
        x, y, z = xs[m], ys[m], zs[m]
        a = m00 * x + m01 * y + m02 * z + s0
        b = m10 * x + m11 * y + m12 * z + s1
        c = m20 * x + m21 * y + m22 * z + s2
        block[_X + m], block[_Y + m], block[_Z + m] = (x, y, z) if forward else (a, b, c)
        block[_OX + m], block[_OY + m], block[_OZ + m] = a - o0, b - o1, c - o2
    for m in range(count):
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
    """Do what `interpolate` does for a block; all but the reading of corners is vectorised."""
    values, row = field.reshape(-1), field.shape[2]
    plane = field.shape[1] * row
    for m in range(count):
        # Unsigned, so that the compiler need not handle negative indices.
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
    beyond = 0
    for m in range(count):
        beyond += block[_BEYOND + m] > 1e-8
    for m in range(count if beyond else 0):
        outside = block[_BEYOND + m]
        if outside > 1e-8:
            outside = math.sqrt(outside)
            block[_VALUE + m] += outside
            block[_GX + m] = block[_OX + m] / outside
            block[_GY + m] = block[_OY + m] / outside
            block[_GZ + m] = block[_OZ + m] / outside


@kernel(error_model="numpy")
def _weigh(values, link, tau, block):  # type: ignore[no-untyped-def]
    """Compute a block's residuals, their kernels (`_U`) and their squares (`_V`)."""
    scale, offset = link.scale, link.offset
    if link.forward:
        for m in range(len(values)):
            block[_VALUE + m] = scale * block[_VALUE + m] - values[m] - offset
    else:
        for m in range(len(values)):
            block[_VALUE + m] = block[_VALUE + m] - scale * values[m] + offset
    for m in range(len(values)):
        square = block[_VALUE + m] * block[_VALUE + m]
        block[_U + m], block[_V + m] = 1.0 / (1.0 + square / (tau * tau)), square


@kernel(error_model="numpy")
def _linearise(count, link, centre, weight, block):  # type: ignore[no-untyped-def]
    """Compute a block's g, q and W (`_U`); pad weights and rows with zeros to a whole step."""
    turn = link.turn
    r00, r01, r02 = turn[0, 0], turn[0, 1], turn[0, 2]
    r10, r11, r12 = turn[1, 0], turn[1, 1], turn[1, 2]
    r20, r21, r22 = turn[2, 0], turn[2, 1], turn[2, 2]
    c0, c1, c2 = centre[0], centre[1], centre[2]
    for m in range(count):
        a, b, c = block[_GX + m], block[_GY + m], block[_GZ + m]
        block[_GX + m] = r00 * a + r01 * b + r02 * c
        block[_GY + m] = r10 * a + r11 * b + r12 * c
        block[_GZ + m] = r20 * a + r21 * b + r22 * c
        block[_X + m] -= c0
        block[_Y + m] -= c1
        block[_Z + m] -= c2
        kernel = block[_U + m]
        block[_U + m] = weight * kernel * kernel
    end = -(-count // _STEP) * _STEP
    block[_U + count : _U + end] = 0.0
    for row in range(_ROWS, _SUMS, _BLOCK):
        block[row + count : row + end] = 0.0


@kernel(error_model="numpy")
def _rows_of_similarity(count, forward, block):  # type: ignore[no-untyped-def]
    """Compute a block's rows of A for a similarity."""
    sign = -1.0 if forward else 1.0
    for m in range(count):
        gx, gy, gz = block[_GX + m], block[_GY + m], block[_GZ + m]
        qx, qy, qz = block[_X + m], block[_Y + m], block[_Z + m]
        block[_ROWS + m] = qz * gy - qy * gz
        block[_ROWS + _BLOCK + m] = qx * gz - qz * gx
        block[_ROWS + 2 * _BLOCK + m] = qy * gx - qx * gy
        block[_ROWS + 3 * _BLOCK + m] = -gx
        block[_ROWS + 4 * _BLOCK + m] = -gy
        block[_ROWS + 5 * _BLOCK + m] = -gz
        block[_ROWS + 6 * _BLOCK + m] = -(gx * qx + gy * qy + gz * qz)
        block[_ROWS + 7 * _BLOCK + m] = sign
        block[_ROWS + 8 * _BLOCK + m] = block[_VALUE + m]


@kernel(error_model="numpy")
def _rows_of_affine(count, forward, block):  # type: ignore[no-untyped-def]
    """Compute a block's rows of A for an affine map; the last row is zero."""
    sign = -1.0 if forward else 1.0
    for m in range(count):
        gx, gy, gz = block[_GX + m], block[_GY + m], block[_GZ + m]
        qx, qy, qz = block[_X + m], block[_Y + m], block[_Z + m]
        block[_ROWS + m] = gx * qx
        block[_ROWS + _BLOCK + m] = gx * qy
        block[_ROWS + 2 * _BLOCK + m] = gx * qz
        block[_ROWS + 3 * _BLOCK + m] = gx
        block[_ROWS + 4 * _BLOCK + m] = gy * qx
        block[_ROWS + 5 * _BLOCK + m] = gy * qy
        block[_ROWS + 6 * _BLOCK + m] = gy * qz
        block[_ROWS + 7 * _BLOCK + m] = gy
        block[_ROWS + 8 * _BLOCK + m] = gz * qx
        block[_ROWS + 9 * _BLOCK + m] = gz * qy
        block[_ROWS + 10 * _BLOCK + m] = gz * qz
        block[_ROWS + 11 * _BLOCK + m] = gz
        block[_ROWS + 12 * _BLOCK + m] = sign
        block[_ROWS + 13 * _BLOCK + m] = block[_VALUE + m]
        block[_ROWS + 14 * _BLOCK + m] = 0.0


@kernel()
def _add_products(count, unknowns, block):  # type: ignore[no-untyped-def]
    """Add a block's products to their sums, for the upper triangle of the symmetric matrix."""
    for first in range(0, _BLOCK, _STEP):
        # With a range up to `count` the compiler would expect a negative `first`, and a check of
        # each index would prevent vectorisation.
        if first >= count:
            break
        _add_nine_products(block, first, 0, 0, 0)
        _add_nine_products(block, first, 0, 3, 1)
        _add_nine_products(block, first, 0, 6, 2)
        _add_nine_products(block, first, 3, 3, 3)
        _add_nine_products(block, first, 3, 6, 4)
        _add_nine_products(block, first, 6, 6, 5)
        if unknowns == AFFINE:
            _add_nine_products(block, first, 0, 9, 6)
            _add_nine_products(block, first, 0, 12, 7)
            _add_nine_products(block, first, 3, 9, 8)
            _add_nine_products(block, first, 3, 12, 9)
            _add_nine_products(block, first, 6, 9, 10)
            _add_nine_products(block, first, 6, 12, 11)
            _add_nine_products(block, first, 9, 9, 12)
            _add_nine_products(block, first, 9, 12, 13)
            _add_nine_products(block, first, 12, 12, 14)


@kernel(forceinline=True)
def _add_nine_products(block, first, row, column, number):  # type: ignore[no-untyped-def]
    """Add the products of three rows of W A, from `row` on, and three of A, from `column` on.

    They are written out, with constant numbers, so that the compiler vectorises the lanes.
    """
    left, right = _ROWS + row * _BLOCK + first, _ROWS + column * _BLOCK + first
    for lane in range(_LANES):
        at = _SUMS + 9 * number * _LANES + lane
        a, b, c = block[at], block[at + _LANES], block[at + 2 * _LANES]
        d, e, f = block[at + 3 * _LANES], block[at + 4 * _LANES], block[at + 5 * _LANES]
        g, h, i = block[at + 6 * _LANES], block[at + 7 * _LANES], block[at + 8 * _LANES]
        for m in range(lane, lane + _STEP, _LANES):
            weight = block[_U + first + m]
            p, q, r = block[left + m], block[left + _BLOCK + m], block[left + 2 * _BLOCK + m]
            p, q, r = weight * p, weight * q, weight * r
            x, y, z = block[right + m], block[right + _BLOCK + m], block[right + 2 * _BLOCK + m]
            a, b, c = a + p * x, b + p * y, c + p * z
            d, e, f = d + q * x, e + q * y, f + q * z
            g, h, i = g + r * x, h + r * y, i + r * z
        block[at], block[at + _LANES], block[at + 2 * _LANES] = a, b, c
        block[at + 3 * _LANES], block[at + 4 * _LANES], block[at + 5 * _LANES] = d, e, f
        block[at + 6 * _LANES], block[at + 7 * _LANES], block[at + 8 * _LANES] = g, h, i


@kernel()
def _add_sums(blocks, block, products):  # type: ignore[no-untyped-def]
    """Add up the lanes, and add the sums to the upper triangle of `products`."""
    for number in range(9 * blocks):
        at = _SUMS + number * _LANES
        even = (block[at] + block[at + 4]) + (block[at + 2] + block[at + 6])
        odd = (block[at + 1] + block[at + 5]) + (block[at + 3] + block[at + 7])
        block[number] = even + odd
    number = 0
    for k in range(blocks):
        row, column = _MANY[k]
        for i in range(row, row + 3):
            for j in range(column, column + 3):
                products[i, j] += block[number]
                number += 1


@kernel()
def centre_of(samples):  # type: ignore[no-untyped-def]
    """Return the mean position (3,) of the samples."""
    centre = np.zeros(3)
    for axis in range(3):
        for place in samples.columns[axis]:
            centre[axis] += place
    return centre / len(samples.values)


@kernel()
def matrix_and_rhs(products, unknowns, normal, rhs):  # type: ignore[no-untyped-def]
    """Write the full normal matrix to `normal` and the right-hand side to `rhs`."""
    for i in range(unknowns):
        rhs[i] = -products[i, unknowns]
        for j in range(unknowns):
            normal[i, j] = products[min(i, j), max(i, j)]


@kernel()
def solve_linear(matrix, rhs, step):  # type: ignore[no-untyped-def]
    """Solve ``matrix @ step = rhs`` by elimination with partial pivoting, in place.

    For a dozen unknowns this is faster than a call of LAPACK. The bits do not depend on
    the kernels that a BLAS picks for the processor.
    """
    n = len(rhs)
    for i in range(n):
        pivot = i
        for k in range(i + 1, n):
            pivot = k if abs(matrix[k, i]) > abs(matrix[pivot, i]) else pivot
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


@kernel()
def invert(affine, inverse):  # type: ignore[no-untyped-def]
    """Write the inverse of the 3x3 part to `inverse`; return the determinant."""
    for i in range(3):
        for j in range(3):
            k, n, u, v = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            inverse[i, j] = affine[k, u] * affine[n, v] - affine[k, v] * affine[n, u]
    determinant = 0.0
    for i in range(3):
        determinant += affine[0, i] * inverse[i, 0]
    inverse /= determinant
    return determinant
