"""Align by Coherent Point Drift of the package pycpd, affine and deformable, as a baseline.

The method is that of A. Myronenko and X. Song, "Point Set Registration:
Coherent Point Drift", IEEE TPAMI 32(12), 2010, with their weights. It finds no
orientation by itself, so it runs from the 24 start rotations that every engine
has, affinely and on thinned clouds. The best result is refined with more points.
The SLAT is the cloud that drifts, because its voxels are looked up.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from slatprep.align.starts import distinct_starts
from slatprep.align.surface import even_choice
from slatprep.geometry.frames import VOXEL_SIZE, voxel_centres
from slatprep.geometry.voxels import boundary, occupancy_of, outer_boundary, voxels_of
from slatprep.records import MaterialField, StructuredLatents

Array = NDArray[np.float64]

START_POINTS, START_STEPS = 250, 30
FINAL_POINTS, FINAL_STEPS = 1_000, 60
"""Points of each side, and iterations at most, from the starts and at the end."""

OUTLIERS, WIDTH, STIFFNESS = 0.1, 2.0, 3.0
"""The method's w, beta and lambda, as in the paper; clouds have unit variance as there."""


def cpd_places(field: MaterialField, latents: StructuredLatents, deformable: bool) -> Array:
    """Say where SLAT voxels lie in the PixieVerse frame, by Coherent Point Drift.

    Parameters
    ----------
    field, latents : MaterialField, StructuredLatents
        The two sides; only their geometry is used.
    deformable : bool
        Whether the affine map is followed by a non-rigid one.

    Returns
    -------
    ndarray of float64, shape (N, 3)
        Places of the SLAT's voxels, in the unit cube of the PixieVerse frame.
    """
    from pycpd import AffineRegistration, DeformableRegistration

    pixie = _Cloud(voxel_centres(voxels_of(boundary(field.occupancy))))
    slat = _Cloud(voxel_centres(outer_boundary(occupancy_of(latents.coords, latents.resolution))))

    def affine(points: int, steps: int, start: Array) -> tuple[Array, Array]:
        drift: Any = AffineRegistration(
            X=pixie.thinned(points), Y=slat.thinned(points) @ start, w=OUTLIERS,
            max_iterations=steps,
        )  # fmt: skip
        drift.register()
        # Points are rows: y @ start @ B + t.
        return start @ drift.B, drift.t.reshape(1, 3)

    tree = cKDTree(pixie.points)
    seen = slat.thinned(START_POINTS)

    def misfit(found: tuple[Array, Array]) -> float:
        moved = seen @ found[0] + found[1]
        there, _ = tree.query(moved)
        back, _ = cKDTree(moved).query(pixie.thinned(START_POINTS))
        return float(there.mean() + back.mean())

    # Rows times R take the SLAT by the inverse of the start, which leads to it.
    starts = (affine(START_POINTS, START_STEPS, start.rotation) for start in distinct_starts())
    best = min(starts, key=misfit)
    linear, shift = affine(FINAL_POINTS, FINAL_STEPS, best[0])
    places = slat.unit(latents.centres) @ linear + shift
    if deformable:
        source = slat.thinned(FINAL_POINTS) @ linear + shift
        drift: Any = DeformableRegistration(
            X=pixie.thinned(FINAL_POINTS), Y=source, alpha=STIFFNESS, beta=WIDTH, w=OUTLIERS,
            max_iterations=FINAL_STEPS,
        )  # fmt: skip
        drift.register()
        square = cdist(places, source, "sqeuclidean")
        places = places + np.exp(-square / (2.0 * WIDTH**2)) @ drift.W
    return pixie.back(places)


class _Cloud:
    """Points of the unit cube, brought to mean 0 and variance 1."""

    def __init__(self, points: Array) -> None:
        self._mean = points.mean(axis=0)
        self._spread = max(float(np.sqrt(points.var(axis=0).mean())), VOXEL_SIZE)
        self.points = self.unit(points)

    def unit(self, points: Array) -> Array:
        brought: Array = (points - self._mean) / self._spread
        return brought

    def back(self, points: Array) -> Array:
        brought: Array = points * self._spread + self._mean
        return brought

    def thinned(self, count: int) -> Array:
        """Return at most so many points, evenly chosen."""
        return self.points[np.unique(even_choice(len(self.points), count))]
