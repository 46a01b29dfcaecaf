"""The map between the frames: a similarity, and a deformation if one was earned.

The map from the SLAT frame to the PixieVerse frame is explicit, as the lookup uses it: deform, then
apply the inverse of the transform. The map back solves for the point by Newton's method. The
compiled part is imported only to bend points, as Numba takes as long to load as everything else
that reads a store.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.geometry.frames import apply_transform, invert_transform, voxel_centres
from slatprep.records import RESOLUTION, Alignment, Deformation

GRAIN = 2.0**-30
"""Step of all numbers of a deformation: exact in JSON, and 6e-8 voxel as a length."""

LEAST_STRETCH, MOST_STRETCH = 0.6, 1.6
"""Limits of the singular values of an affine part."""

_NEWTON_STEPS = 30
_CLOSE = 1e-9  # edges of the unit cube
_SHRINK, _SHRINKS = 0.8, 20


@dataclass(frozen=True)
class PlaceMap:
    """The map between the PixieVerse frame and the SLAT frame, both ways.

    ``transform`` (4, 4) is a similarity from the PixieVerse frame to the SLAT frame.
    ``deformation`` is None if the similarity is the whole map.
    """

    transform: NDArray[np.float64]
    deformation: Deformation | None = None

    def to_pixieverse(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points (N, 3) of the SLAT frame to the PixieVerse frame."""
        points = _points(points)
        if self.deformation is not None:
            points = deform(self.deformation, points)
        return apply_transform(invert_transform(self.transform), points)

    def to_slat(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map points (N, 3) of the PixieVerse frame to the SLAT frame."""
        carried = apply_transform(self.transform, _points(points))
        if self.deformation is None:
            return carried
        return undeform(self.deformation, carried)

    def volume_ratios(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return by how much small volumes at points (N, 3) of the SLAT frame are larger there.

        The ratio (N,) is that of a volume in the SLAT frame to the same in the PixieVerse frame.
        """
        points = _points(points)
        own = abs(float(np.linalg.det(self.transform[:3, :3])))
        if self.deformation is None:
            return np.full(len(points), own)
        return np.asarray(own / abs(np.linalg.det(jacobian(self.deformation, points))))

    def places(
        self, coords: NDArray[np.integer], resolution: int = RESOLUTION
    ) -> NDArray[np.float64]:
        """Return the PixieVerse positions (N, 3) of SLAT voxels in a grid of `resolution`."""
        return self.to_pixieverse(voxel_centres(coords, resolution))


def _points(points: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points have shape {array.shape}; expected (N, 3)")
    return array


def map_of(alignment: Alignment) -> PlaceMap:
    """Return the map between the frames that an alignment describes.

    Parameters
    ----------
    alignment : Alignment
        An alignment from `slatprep.align_voxels` or from a record.

    Returns
    -------
    PlaceMap
        The map of its transform and, if it has one, its deformation.
    """
    return PlaceMap(alignment.transform, alignment.deformation)


def deform(deformation: Deformation, points: ArrayLike) -> NDArray[np.float64]:
    """Apply a deformation to points (N, 3) of the SLAT frame.

    Outside the splines' domain, the displacement of the domain's nearest point is
    added to the affine part.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    affine = deformation.affine
    moved: NDArray[np.float64] = points @ affine[:, :3].T + affine[:, 3]
    if deformation.coefficients.size:
        from slatprep.geometry.bspline import displacements

        added = np.empty_like(points)
        displacements(
            points, deformation.origin, deformation.spacing, deformation.coefficients, added
        )
        moved += added
    return moved


def jacobian(deformation: Deformation, points: ArrayLike) -> NDArray[np.float64]:
    """Return the derivative (N, 3, 3) of a deformation at points (N, 3) of the SLAT frame."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    slopes = np.zeros((len(points), 3, 3))
    if deformation.coefficients.size:
        from slatprep.geometry.bspline import jacobians

        jacobians(points, deformation.origin, deformation.spacing, deformation.coefficients, slopes)
    slopes += deformation.affine[:, :3]
    return slopes


def undeform(deformation: Deformation, points: ArrayLike) -> NDArray[np.float64]:
    """Return the points (N, 3) that `deform` maps to `points`, if the deformation does not fold.

    The error is at most 1e-9 of the cube's edge. If Newton's method does not settle within 30
    steps, the closest points found are returned. This is possible only outside the splines' domain,
    where the derivative jumps.
    """
    target = np.asarray(points, dtype=np.float64)
    affine = deformation.affine
    trial = (target - affine[:, 3]) @ np.linalg.inv(affine[:, :3]).T
    if not deformation.coefficients.size:
        return np.asarray(trial)
    found, best, open_ones = trial.copy(), np.full(len(target), np.inf), np.arange(len(target))
    for _ in range(_NEWTON_STEPS):
        error = deform(deformation, trial) - target[open_ones]
        length = np.linalg.norm(error, axis=1)
        better = length < best[open_ones]
        best[open_ones[better]] = length[better]
        found[open_ones[better]] = trial[better]
        left = length > _CLOSE
        if not left.any():
            break
        open_ones, trial = open_ones[left], trial[left]
        slopes = jacobian(deformation, trial)
        trial = trial - np.linalg.solve(slopes, error[left][..., None])[..., 0]
    return found


def make_deformation(
    affine: ArrayLike,
    origin: ArrayLike,
    spacing: float,
    coefficients: ArrayLike,
    points: ArrayLike,
    max_displacement: float,
) -> Deformation | None:
    """Make a deformation that is bounded and does not fold, rounded to `GRAIN`.

    Arguments are those of `Deformation`; `points` (N, 3) are the SLAT's. Neither the affine part
    nor the bending moves a point farther than `max_displacement` (voxels). Coefficients are
    shortened to it, as a spline lies in the convex hull of its coefficients. Bending is shrunk
    until `is_proper` holds. Return None if the affine part stretches or moves too far, or if no
    shrinking helps.
    """
    made = Deformation(
        _rounded(affine), _rounded(origin), float(_rounded(spacing)), _rounded(coefficients)
    )
    matrix = made.affine[:, :3]
    most, _, least = np.linalg.svd(matrix, compute_uv=False)
    if np.linalg.det(matrix) <= 0 or not (least >= LEAST_STRETCH and most <= MOST_STRETCH):
        return None
    limit = max_displacement / RESOLUTION
    points = np.asarray(points, dtype=np.float64)
    moved = points @ matrix.T + made.affine[:, 3] - points
    if np.linalg.norm(moved, axis=1).max() > limit:
        return None
    if not made.coefficients.size:
        return made
    length = np.linalg.norm(made.coefficients, axis=-1, keepdims=True)
    # Slightly less, so that rounding does not exceed the bound.
    shorter = np.minimum(1.0, (1.0 - 1e-6) * limit / np.maximum(length, 1e-12))
    made = replace(made, coefficients=_rounded(made.coefficients * shorter))
    for _ in range(_SHRINKS):
        if is_proper(made):
            return made
        made = replace(made, coefficients=_rounded(_SHRINK * made.coefficients))
    return None


def is_proper(deformation: Deformation) -> bool:
    """Return whether a deformation certainly does not fold anywhere in the splines' domain.

    On a grid of two or four points per span, 2 det / |J|^2 (Frobenius) is a lower bound of the
    derivative's smallest singular value. Between grid points it falls by at most the distance times
    the largest second derivative, which the second differences of the coefficients bound.
    """
    c, spacing = deformation.coefficients, deformation.spacing
    if not c.size:
        return bool(np.linalg.det(deformation.affine[:, :3]) > 0)
    fall = _second_derivative(c, np.max) / spacing**2 * np.sqrt(3.0) / 2.0 * spacing
    return any(_least_stretch(deformation, steps) > fall / steps for steps in (2, 4))


def _least_stretch(deformation: Deformation, steps: int) -> float:
    """Return the minimum of 2 det / |J|^2 over a grid of `steps` points per span."""
    control = np.moveaxis(deformation.coefficients / deformation.spacing, -1, 0)
    (x, dx), (y, dy), (z, dz) = (_splines(count, steps) for count in control.shape[1:])
    # Shared products of matrices take a tenth of the time of three calls of einsum.
    level, steep = control @ z, control @ dz
    parts = (dx, y.T @ level), (x, dy.T @ level), (x, y.T @ steep)
    columns = deformation.affine[:, :3].T[..., None, None, None]
    a, b, c = (
        np.moveaxis(np.tensordot(along, rest, (0, 1)), 1, 0) + column
        for (along, rest), column in zip(parts, columns, strict=True)
    )  # the derivatives along each axis
    turns = (0, 1, 2), (1, 2, 0), (2, 0, 1)
    determinant = sum(a[i] * (b[j] * c[k] - b[k] * c[j]) for i, j, k in turns)
    return float((2.0 * determinant / (a**2 + b**2 + c**2).sum(axis=0)).min())


@lru_cache(maxsize=256)
def _splines(count: int, steps: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return values and derivatives (count, points) of an axis's splines, per span."""
    from scipy.interpolate import BSpline

    at = np.arange(steps * (count - 3) + 1) / steps
    spline = BSpline(np.arange(-3.0, count + 1.0), np.eye(count), 3)
    return spline(at).T, spline.derivative()(at).T


def bending_of(deformation: Deformation) -> float:
    """Return the rms second derivative of the displacement over the lattice, in 1 / voxel."""
    return _second_derivative(deformation.coefficients, np.mean) / (
        deformation.spacing**2 * RESOLUTION
    )


def _second_derivative(
    coefficients: NDArray[np.float64], over: Callable[[NDArray[np.float64]], np.floating[Any]]
) -> float:
    """Return the Frobenius norm [1 / spacing^2] of second differences, reduced by `over`."""
    squares = 0.0
    for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2)):
        second = np.diff(np.diff(coefficients, axis=a), axis=b)
        squares += (1.0 if a == b else 2.0) * float(over((second**2).sum(axis=-1)))
    return float(np.sqrt(squares))


def _rounded(values: ArrayLike) -> NDArray[np.float64]:
    rounded: NDArray[np.float64] = np.round(np.asarray(values, dtype=np.float64) / GRAIN) * GRAIN
    # JSON writes -0.0 and 0.0 differently; the sum is never -0.0.
    return rounded + 0.0
