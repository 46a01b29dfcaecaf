"""Affine fits of many poses at once; compiled.

Residuals and weights are those of `slatprep.align.deform_solver`, without its lattice.
"""

from __future__ import annotations

import math

import numpy as np

from slatprep.align.deform_solver import OFFSET_PRIOR, PIXIEVERSE_WEIGHT
from slatprep.align.equations import (
    AFFINE,
    Link,
    accumulate,
    centre_of,
    fit_of,
    invert,
    matrix_and_rhs,
    new_equations,
    solve_linear,
)
from slatprep.geometry.kernel import kernel

RIDGE = 1e-4

_LEAST, _MOST = 0.2, 5.0
"""Limits of the map's determinant, beyond which the shape is no longer recognisable."""


@kernel()
def _links(rotation, shift, scale, offset, affine, inverse):  # type: ignore[no-untyped-def]
    """Return the `Link` of the SLAT samples, and that of the PixieVerse samples."""
    there, here, turn = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    away, back = np.zeros(3), np.zeros(3)
    for i in range(3):
        for j in range(3):
            away[i] += rotation[j, i] * (affine[j, 3] - shift[j]) / scale
            back[i] += inverse[i, j] * (shift[j] - affine[j, 3])
            turn[i, j] = -inverse[j, i]
            for k in range(3):
                there[i, j] += rotation[k, i] * affine[k, j] / scale
                here[i, j] += inverse[i, k] * scale * rotation[k, j]
    forward = Link(there, away, rotation, scale, offset, True)
    return forward, Link(here, back, turn, scale, offset, False)


@kernel()
def stretch(slat, pixie, poses, affines, taus):  # type: ignore[no-untyped-def]
    """Fit an affine map (3, 4), applied before each of `Poses`, by a step for each of `taus`.

    Both sides are `Samples`, and `taus` are in voxels. Write the maps to `affines` and the offsets
    to `poses`. Return each pose's mean kernel at tau = 1 voxel, with equal weight for both sides.
    If a step takes the determinant beyond its limits, undo it, stop, and set the score to 0.
    """
    n_slat, n_pixie = len(slat.values), len(pixie.values)
    equations, normal, rhs = new_equations(), np.zeros((AFFINE, AFFINE)), np.zeros(AFFINE)
    step, inverse, centre = np.zeros(AFFINE), np.zeros((3, 3)), centre_of(slat)
    scores = np.zeros(len(poses.scales))
    for pose in range(len(poses.scales)):
        rotation, shift, scale = poses.rotations[pose], poses.shifts[pose], poses.scales[pose]
        affine, before = affines[pose], affines[pose].copy()
        offset = poses.offsets[pose]
        for step_number in range(len(taus) + 1):
            sound = _LEAST < invert(affine, inverse) < _MOST
            if not (sound and math.isfinite(poses.offsets[pose])):
                affine[:] = before
                poses.offsets[pose] = offset
                break
            offset = poses.offsets[pose]
            forward, backward = _links(rotation, shift, scale, offset, affine, inverse)
            if step_number == len(taus):
                ours = fit_of(slat, pixie, forward, equations)[0] / n_slat
                theirs = fit_of(pixie, slat, backward, equations)[0] / n_pixie
                scores[pose] = 0.5 * (ours + theirs)
                break
            before[:] = affine
            tau, count = taus[step_number], n_slat + n_pixie
            equations.products[:] = 0.0
            accumulate(slat, pixie, forward, centre, tau, 1.0, AFFINE, equations)
            accumulate(pixie, slat, backward, centre, tau, PIXIEVERSE_WEIGHT, AFFINE, equations)
            matrix_and_rhs(equations.products, AFFINE, normal, rhs)
            normal[12, 12] += OFFSET_PRIOR * count
            rhs[12] -= OFFSET_PRIOR * count * offset
            for i in range(AFFINE):
                normal[i, i] += RIDGE * normal[i, i] + 1e-9 * count
            solve_linear(normal, rhs, step)
            for i in range(3):
                for j in range(3):
                    affine[i, j] += step[4 * i + j]
                    affine[i, 3] -= step[4 * i + j] * centre[j]
                affine[i, 3] += step[4 * i + 3]
            poses.offsets[pose] += step[12]
    return scores
