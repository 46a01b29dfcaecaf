"""Trilinear values and gradients of a distance field; for the compiled loops of the solvers."""

from __future__ import annotations

import math

import numpy as np

from slatprep.geometry.kernel import kernel


@kernel(inline="always", error_model="numpy")
def trilinear(f000, f001, f010, f011, f100, f101, f110, f111, u, v, w):  # type: ignore[no-untyped-def]
    """Value and gradient at (u, v, w) in a cell, from its corners."""
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
    value, gx, gy, gz = trilinear(f000, f001, f010, f011, f100, f101, f110, f111, u, v, w)
    ox, oy, oz = x - cx, y - cy, z - cz
    outside = ox * ox + oy * oy + oz * oz
    if outside > 1e-8:
        outside = math.sqrt(outside)
        value += outside
        gx, gy, gz = ox / outside, oy / outside, oz / outside
    return value, gx, gy, gz
