"""Samples of two surfaces, their residuals under a warp, and the steps that make these smaller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slatprep.align.deform_solver import (
    OFFSET_PRIOR,
    PIXIEVERSE_WEIGHT,
    RIDGE,
    affine_step,
    lattice_step,
    linearise,
)
from slatprep.align.surface import Surface
from slatprep.align.warp import Similarity, Warp

Array = NDArray[np.float64]

BLOCK = 8.0
"""Edge, in voxels, of the blocks of space that are fitted and held out in turn."""

COARSEST = 32.0
"""Spacing of the first lattice in voxels; each further one has half of it."""

STIFFNESS = 200.0
"""Weight of the mean squared second derivative (1 / voxel^2) against that of a squared residual."""

SOLVER_STEPS = 6
"""Steps of conjugate gradients for each step of Gauss and Newton."""

_DAMPING = 1e-6


class Residuals:
    """Samples of two surfaces under a similarity, and their residuals under a warp of it."""

    def __init__(
        self, slat: Surface, pixie: Surface, pose: Similarity, samples: int, first: int = 0
    ) -> None:
        self.surface = slat
        self._slat, self._pixie = slat.subset(samples, first), pixie.subset(samples, first)
        self._pose = pose
        self._rotation = np.ascontiguousarray(pose.rotation)
        carried = pose.scale * self._pixie.points @ pose.rotation.T + pose.shift
        self._places = np.concatenate([self._slat.points, carried])
        count = len(self._places)
        self._bases = np.zeros(count, np.uint64)
        self._weights, self._vectors = np.zeros((count, 12)), np.zeros((count, 4))
        self._residuals = np.zeros(count)
        self._pixie_rows = len(self._slat.points)
        self.centre: Array = self._slat.points.mean(axis=0)
        box = slat.points.min(axis=0) - 1.0, slat.points.max(axis=0) + 1.0
        self._low, self._side = box[0], box[1] - box[0]

    def start(self) -> Warp:
        """Return the warp that leaves the similarity as it is."""
        return Warp(np.eye(3, 4), self._pose.offset)

    def all_samples(self) -> NDArray[np.intp]:
        """Return the rows of all samples."""
        return np.arange(len(self._places))

    def held_out(self) -> NDArray[np.bool_]:
        """Return which samples lie in the blocks that a trial does not see."""
        blocks = np.floor((self._places - self._low) / BLOCK).astype(np.intp)
        odd: NDArray[np.bool_] = blocks.sum(axis=1) % 2 == 1
        return odd

    def linearise(self, warp: Warp, tau: float) -> None:
        """Measure all residuals, weighted by the kernel of width `tau`, and their derivatives."""
        pose, n = self._pose, self._pixie_rows
        inverse = np.ascontiguousarray(np.linalg.inv(warp.affine[:, :3]))
        sides = (
            (self._slat, self._pixie, True, slice(0, n)),
            (self._pixie, self._slat, False, slice(n, None)),
        )
        for here, there, forward, rows in sides:
            linearise(
                here.points, here.values, there.distance, there.origin,
                self._places[rows], forward, warp.has_lattice,
                self._rotation, pose.shift, pose.scale, warp.offset, warp.affine, inverse,
                warp.coefficients, warp.origin, warp.spacing, tau,
                self._bases[rows], self._weights[rows], self._vectors[rows],
                self._residuals[rows],
            )  # fmt: skip

    def _linearise_weighted(self, warp: Warp, tau: float) -> None:
        self.linearise(warp, tau)
        self._vectors[self._pixie_rows :] *= PIXIEVERSE_WEIGHT**0.5
        self._residuals[self._pixie_rows :] *= PIXIEVERSE_WEIGHT**0.5

    def at(self, warp: Warp) -> tuple[Array, Array]:
        """Return the residuals in voxels of the SLAT's and of the PixieVerse samples."""
        self.linearise(warp, 1e6)
        n = self._pixie_rows
        return self._residuals[:n].copy(), self._residuals[n:].copy()

    def kernels(self, warp: Warp) -> Array:
        """Return 1 / (1 + r^2) of each sample."""
        kernels: Array = 1.0 / (1.0 + np.concatenate(self.at(warp)) ** 2)
        return kernels

    def fit_affine(self, warp: Warp, taus: Sequence[float], seen: NDArray[np.intp]) -> Warp:
        """Improve the affine part by one step for each of `taus`, on the samples `seen`."""
        step = np.zeros(13)
        for tau in taus:
            self._linearise_weighted(warp, tau)
            affine_step(
                self._places[seen], self._vectors[seen], self._residuals[seen],
                self.centre, RIDGE, warp.offset, OFFSET_PRIOR * len(seen), step,
            )  # fmt: skip
            change = step[:12].reshape(3, 4)
            affine = warp.affine + change
            affine[:, 3] -= change[:, :3] @ self.centre
            stretches = np.linalg.svd(affine[:, :3], compute_uv=False)
            if not (stretches[-1] > 0.5 and stretches[0] < 2.0):
                break  # A shape this flat or long is not one any more.
            warp = replace(warp, affine=affine, offset=warp.offset + float(step[12]))
        return warp

    def fit_lattice(self, warp: Warp, taus: Sequence[float], seen: NDArray[np.intp]) -> Warp:
        """Improve the coefficients by one step for each of `taus`, on the samples `seen`."""
        c = warp.coefficients.copy()
        strength = STIFFNESS * len(seen) / (c.size / 3) / warp.spacing**4
        for tau in taus:
            self._linearise_weighted(warp, tau)
            offset = lattice_step(
                self._bases[seen], self._weights[seen], self._vectors[seen],
                self._residuals[seen], c, strength, _DAMPING * len(seen),
                warp.offset, OFFSET_PRIOR * len(seen), SOLVER_STEPS,
            )  # fmt: skip
            warp = replace(warp, coefficients=c, offset=float(offset))
        return warp

    def with_lattice(self, warp: Warp) -> Warp:
        """Return the same warp with the coarsest lattice over the SLAT."""
        spans = np.maximum(np.ceil(self._side / COARSEST - 1e-9), 1.0).astype(int)
        origin = self._low - 0.5 * (spans * COARSEST - self._side)
        return replace(
            warp, origin=origin, spacing=COARSEST, coefficients=np.zeros((*(spans + 3), 3))
        )
