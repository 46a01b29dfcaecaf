"""Samples of two surfaces, their residuals under a warp, and the steps that reduce them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from slatprep.align.deform_solver import (
    OFFSET_PRIOR,
    PIXIEVERSE_WEIGHT,
    Lines,
    lattice_step,
    linearise,
)
from slatprep.align.pose import Poses, Similarity
from slatprep.align.stretch import stretch
from slatprep.align.surface import Samples, Surface, normals_of
from slatprep.align.warp import Warp
from slatprep.geometry.frames import Array

BLOCK = 8.0
"""Edge, in voxels, of the blocks of space that are fitted and held out in turn."""

COARSEST = 32.0
"""Spacing of the first lattice in voxels; each further lattice has half the spacing."""

STIFFNESS = 200.0
"""Weight of the mean squared second derivative (1 / voxel^2) against that of a squared residual."""

SOLVER_STEPS = 6
"""Steps of conjugate gradients for each Gauss-Newton step."""

_DAMPING = 1e-6


class Residuals:
    """Samples of two surfaces under a similarity, and their residuals under a warp of it."""

    def __init__(
        self, slat: Surface, pixie: Surface, pose: Similarity, samples: int, first: int = 0
    ) -> None:
        self.surface = slat
        here, there = slat.subset(samples, first), pixie.subset(samples, first)
        self._slat, self._pixie = here.samples, there.samples
        self._pose = pose._replace(rotation=np.ascontiguousarray(pose.rotation))
        carried = pose.scale * there.points @ pose.rotation.T + pose.shift
        self._lines = Lines.at(np.concatenate([here.points, carried]))
        self._pixie_rows = len(here.points)

    def held_out(self) -> NDArray[np.bool_]:
        """Return whether each sample lies in a block that a trial does not see.

        It sees every block if the others have no sample of one of the sides.
        """
        low = self.surface.points.min(axis=0) - 1.0
        blocks = np.floor((self._lines.places - low) / BLOCK).astype(np.intp)
        held = np.asarray(blocks.sum(axis=1) % 2 == 1)
        n = self._pixie_rows
        return held & ~(held[:n].all() or held[n:].all())

    def linearise(self, warp: Warp, tau: float) -> None:
        """Measure all residuals, weighted by the kernel of width `tau`, and their derivatives."""
        n = self._pixie_rows
        here, back = self._lines.rows(slice(0, n)), self._lines.rows(slice(n, None))
        linearise(self._slat, self._pixie, self._pose, warp, here, True, tau)
        linearise(self._pixie, self._slat, self._pose, warp, back, False, tau)

    def at(self, warp: Warp) -> tuple[Array, Array]:
        """Return the residuals in voxels of the SLAT's and of the PixieVerse samples."""
        self.linearise(warp, 1e6)
        n = self._pixie_rows
        return self._lines.residuals[:n].copy(), self._lines.residuals[n:].copy()

    @property
    def places(self) -> Array:
        """Positions (N, 3) of the samples of both sides in the SLAT frame, as last measured."""
        return self._lines.places

    def normals(self) -> Array:
        """Return the samples' unit normals (N, 3) on their own surfaces, in the SLAT frame."""
        there = normals_of(self._pixie) @ self._pose.rotation.T
        return np.concatenate([normals_of(self._slat), there])

    def kernels(self, warp: Warp) -> Array:
        """Return 1 / (1 + r^2) of each sample."""
        return 1.0 / (1.0 + np.concatenate(self.at(warp)) ** 2)

    def fit_affine(self, warp: Warp, taus: Sequence[float], seen: NDArray[np.intp]) -> Warp:
        """Improve the affine part by one step for each of `taus`, on the samples `seen`."""
        n = self._pixie_rows
        slat, pixie = _some(self._slat, seen[seen < n]), _some(self._pixie, seen[seen >= n] - n)
        poses = Poses.of([self._pose._replace(offset=warp.offset)])
        affines = warp.affine[None].copy()
        stretch(slat, pixie, poses, affines, np.array(taus))
        return warp._replace(affine=affines[0], offset=float(poses.offsets[0]))

    def fit_lattice(self, warp: Warp, taus: Sequence[float], seen: NDArray[np.intp]) -> Warp:
        """Improve the coefficients by one step for each of `taus`, on the samples `seen`."""
        c = warp.coefficients.copy()
        strength = STIFFNESS * len(seen) / (c.size / 3) / warp.spacing**4
        for tau in taus:
            self.linearise(warp, tau)
            self._lines.vectors[self._pixie_rows :] *= PIXIEVERSE_WEIGHT**0.5
            self._lines.residuals[self._pixie_rows :] *= PIXIEVERSE_WEIGHT**0.5
            offset = lattice_step(
                self._lines.rows(seen), c, warp.offset, strength,
                _DAMPING * len(seen), OFFSET_PRIOR * len(seen), SOLVER_STEPS,
            )  # fmt: skip
            warp = warp._replace(coefficients=c, offset=float(offset))
        return warp

    def with_lattice(self, warp: Warp) -> Warp:
        """Return the same warp with the coarsest lattice over the SLAT."""
        low = self.surface.points.min(axis=0) - 1.0
        side = self.surface.points.max(axis=0) + 1.0 - low
        spans = np.maximum(np.ceil(side / COARSEST - 1e-9), 1.0).astype(int)
        origin = low - 0.5 * (spans * COARSEST - side)
        coefficients = np.zeros((*(spans + 3), 3))
        return warp._replace(origin=origin, spacing=COARSEST, coefficients=coefficients)


def _some(samples: Samples, chosen: NDArray[np.intp]) -> Samples:
    return samples._replace(
        columns=samples.columns.take(chosen, axis=1), values=samples.values[chosen]
    )
