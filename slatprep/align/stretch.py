"""Affine fits of many poses at once; the compiled loop of the search among shapes that differ.

Squashed by a quarter, an apple fits itself better lying on its side. What tells
the right pose is how well it fits once it may be stretched, and that is asked of
all poses that a search came to, not of those alone that fit as similarities.
"""

from __future__ import annotations

import numpy as np

from slatprep.align.deform_solver import affine_step, linearise
from slatprep.geometry.kernel import kernel

_RIDGE, _OFFSET_PRIOR = 1e-4, 0.01
_PIXIEVERSE_WEIGHT = 0.5
_LEAST, _MOST = 0.5, 2.0


@kernel()
def stretch(  # type: ignore[no-untyped-def]
    slat_points, slat_values, slat_field, slat_origin,
    pixie_points, pixie_values, pixie_field, pixie_origin,
    rotations, shifts, scales, offsets, affines, taus,
):  # fmt: skip
    """Fit an affine map (see `deform_solver`) of each pose, in place; return the scores."""
    here, back = slat_points.shape[0], pixie_points.shape[0]
    count = here + back
    places, vectors = np.zeros((count, 3)), np.zeros((count, 4))
    residuals, weights = np.zeros(count), np.zeros((count, 12))
    bases = np.zeros(count, np.uint64)
    coefficients, origin = np.zeros((4, 4, 4, 3)), np.zeros(3)
    centre, step = np.zeros(3), np.zeros(13)
    for m in range(here):
        centre += slat_points[m]
    centre /= here
    root = np.sqrt(_PIXIEVERSE_WEIGHT)
    scores = np.zeros(len(scales))
    for pose in range(len(scales)):
        rotation, shift, scale = rotations[pose], shifts[pose], scales[pose]
        affine, offset = affines[pose], offsets[pose]
        inverse = np.linalg.inv(affine[:, :3])
        for m in range(here):
            places[m] = slat_points[m]
        for m in range(back):
            for axis in range(3):
                places[here + m, axis] = shift[axis]
                for k in range(3):
                    places[here + m, axis] += scale * rotation[axis, k] * pixie_points[m, k]
        for turn in range(len(taus) + 1):
            last = turn == len(taus)
            tau = 1.0 if last else taus[turn]
            score = linearise(
                slat_points, slat_values, pixie_field, pixie_origin, places[:here], True, False,
                rotation, shift, scale, offset, affine, inverse, coefficients, origin, 1e6, tau,
                bases[:here], weights[:here], vectors[:here], residuals[:here],
            )  # fmt: skip
            score += linearise(
                pixie_points, pixie_values, slat_field, slat_origin, places[here:], False, False,
                rotation, shift, scale, offset, affine, inverse, coefficients, origin, 1e6, tau,
                bases[here:], weights[here:], vectors[here:], residuals[here:],
            )  # fmt: skip
            if last:
                scores[pose] = 0.5 * score
                break
            vectors[here:] *= root
            residuals[here:] *= root
            affine_step(
                places, vectors, residuals, centre, _RIDGE, offset, _OFFSET_PRIOR * count, step
            )
            fresh = affine.copy()
            for i in range(3):
                for j in range(3):
                    fresh[i, j] += step[4 * i + j]
                    fresh[i, 3] -= step[4 * i + j] * centre[j]
                fresh[i, 3] += step[4 * i + 3]
            stretches = np.linalg.svd(fresh[:, :3])[1]
            if not (stretches[2] > _LEAST and stretches[0] < _MOST):
                scores[pose] = 0.0
                break
            affine[:] = fresh
            inverse = np.linalg.inv(affine[:, :3])
            offset += step[12]
        offsets[pose] = offset
    return scores
