"""Deformation that must be earned: an affine map, then a lattice, after a similarity.

A trial fit sees the samples of every other block of space, and each further
freedom is kept only if it raises the score in the blocks between. A smooth
difference of shapes continues from block to block; a field's roughness does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

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
from slatprep.align.deformation import bending_of, deform
from slatprep.align.surface import Surface
from slatprep.align.warp import Similarity, Warp, from_nearest, halved
from slatprep.geometry.frames import VOXEL_SIZE
from slatprep.parameters import AlignParameters
from slatprep.records import Deformation, FitFigures, Model

Array = NDArray[np.float64]

TRIAL_SAMPLES, FIT_SAMPLES = 600, 1_200
"""Samples a side of the trial (half of them are held out) and of the fit that is kept."""

BLOCK = 8.0
"""Edge, in voxels, of the blocks of space that are fitted and held out in turn."""

COARSEST = 32.0
"""Spacing of the first lattice in voxels; each further one has half of it."""

AFFINE_TAUS = (4.0, 3.0, 3.0, 2.0, 2.0, 1.5, 1.5, 1.5)
TRIAL_TAUS = (2.5, 2.0, 2.0, 1.5)
LATTICE_TAUS = ((2.0, 1.5), (1.5, 1.5), (1.5, 1.5))
"""Width of the robust kernel, in voxels, at each step: affine, then the coarsest lattice of a
trial, then lattice by lattice."""

STIFFNESS = 200.0
"""Weight of the mean squared second derivative (1 / voxel^2) against that of a squared residual."""

CHECK_SAMPLES = 500
"""Samples a side, none of them used in the fit, from which its figures are taken."""

FITS_ANYWAY = 0.9
"""A similarity that scores this much leaves too little to ask for a deformation."""

CLEAN = 0.8
"""From this score on the fields are not rough, and half of a trial's samples will do."""

LEAST_GAIN, GAIN_SHARE = 0.01, 0.1
"""A deformation is kept that raises the score of unseen blocks by so much and by this share of
the misfit."""

SOLVER_STEPS = 6
"""Steps of conjugate gradients for each step of Gauss and Newton."""

_DAMPING = 1e-6


class Pairing:
    """Samples of two surfaces under a similarity, and their residuals under a warp of it."""

    def __init__(
        self, slat: Surface, pixie: Surface, pose: Similarity, samples: int, first: int = 0
    ) -> None:
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

    def residuals(self, warp: Warp) -> tuple[Array, Array]:
        """Return the residuals in voxels of the SLAT's and of the PixieVerse samples."""
        self.linearise(warp, 1e6)
        n = self._pixie_rows
        return self._residuals[:n].copy(), self._residuals[n:].copy()

    def kernels(self, warp: Warp) -> Array:
        """Return 1 / (1 + r^2) of each sample."""
        kernels: Array = 1.0 / (1.0 + np.concatenate(self.residuals(warp)) ** 2)
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


@dataclass(frozen=True)
class Trial:
    """A trial fit: warps with an affine part only and with a coarse lattice, and their scores.

    ``scores`` are of the similarity, the affine and the bent warp on the
    samples that the trial did not see; ``whole`` is the bent one's on all.
    """

    affine: Warp
    bent: Warp
    scores: tuple[float, float, float]
    whole: float


def try_out(slat: Surface, pixie: Surface, pose: Similarity, samples: int = TRIAL_SAMPLES) -> Trial:
    """Fit on the samples of every other block, and score on the others."""
    pairing = Pairing(slat, pixie, pose, samples)
    start = pairing.start()
    unseen = pairing.held_out()
    seen = np.flatnonzero(~unseen)
    before = pairing.kernels(start)
    affine = pairing.fit_affine(start, AFFINE_TAUS, seen)
    between = pairing.kernels(affine)
    bent = pairing.fit_lattice(pairing.with_lattice(affine), TRIAL_TAUS, seen)
    after = pairing.kernels(bent)
    unseen &= np.isfinite(after)
    scores = [float(k[unseen].mean()) if unseen.any() else 0.0 for k in (before, between, after)]
    return Trial(affine, bent, (scores[0], scores[1], scores[2]), float(after.mean()))


@dataclass(frozen=True)
class Deformed:
    """What came of it: the similarity, the model, the deformation (None without) and figures."""

    pose: Similarity
    model: Model
    deformation: Deformation | None
    figures: FitFigures

    def moved(self, points: Array) -> Array:
        """Return points (N, 3) of the SLAT frame, in voxels, as the deformation moves them."""
        if self.deformation is None:
            return points
        return deform(self.deformation, points * VOXEL_SIZE) / VOXEL_SIZE


def deform_if_earned(
    slat: Surface, pixie: Surface, pose: Similarity, model: Model, parameters: AlignParameters
) -> Deformed:
    """Deform a similarity as far as the parameters allow and the evidence asks.

    Parameters
    ----------
    slat, pixie : Surface
        The two sides.
    pose : Similarity
        The placement.
    model : str
        ``rigid`` or ``similarity``, as the placement is.
    parameters : AlignParameters
        `model` ``auto`` lets the evidence decide, ``affine`` and ``deformable``
        fit that without asking, the others nothing; `max_displacement` bounds it.

    Returns
    -------
    Deformed
        The model kept, the deformation, and the figures of the fit.
    """
    pairing = Pairing(slat, pixie, pose, CHECK_SAMPLES, first=FIT_SAMPLES)
    start = pairing.start()
    before = float(pairing.kernels(start).mean())
    evidence = float("nan"), float("nan")
    wanted: str = parameters.model if parameters.model in ("affine", "deformable") else ""
    warp, kept = start, None
    if wanted or (parameters.model == "auto" and before < FITS_ANYWAY):
        # Clean sides speak clearly: half of the samples say as much.
        trial = try_out(slat, pixie, pose, TRIAL_SAMPLES if before < CLEAN else TRIAL_SAMPLES // 2)
        evidence = trial.scores[1] - trial.scores[0], trial.scores[2] - trial.scores[1]
        wanted = wanted or earned(trial)
        # What bends too far or folds may still be stretched.
        for tried in {"": (), "affine": ("affine",)}.get(wanted, ("deformable", "affine")):
            warp, nearest = fit(slat, pixie, pose, trial, tried), pose
            kept = warp.record(slat.points, parameters.max_displacement)
            if kept is None:
                points = slat.subset(FIT_SAMPLES).points
                nearest, warp = from_nearest(pose, warp, points, parameters.scale_bounds)
                kept = warp.record(slat.points, parameters.max_displacement)
            if kept is not None:
                model, warp = Model(tried), replace(warp, **_in_voxels(kept))
                if nearest is not pose:
                    pose = nearest
                    pairing = Pairing(slat, pixie, pose, CHECK_SAMPLES, first=FIT_SAMPLES)
                break
            warp = start
    return Deformed(pose, model, kept, _figures(pairing, warp, before, evidence, kept, slat))


def earned(trial: Trial) -> str:
    """Return ``affine`` or ``deformable`` where the unseen blocks ask for it; else nothing.

    What is asked for is a tenth of the misfit. An affine map that took that
    away is kept also where bending it adds nothing.
    """
    before, affine, bent = trial.scores
    margin = LEAST_GAIN + GAIN_SHARE * (1.0 - before)
    if bent - before > margin and bent - affine > LEAST_GAIN:
        return "deformable"
    return "affine" if affine - before > margin else ""


def fit(slat: Surface, pixie: Surface, pose: Similarity, trial: Trial, model: str) -> Warp:
    """Fit an ``affine`` or ``deformable`` warp on all samples, from where a trial ended."""
    pairing = Pairing(slat, pixie, pose, FIT_SAMPLES)
    everything = pairing.all_samples()
    if model == "affine":
        return pairing.fit_affine(trial.affine, AFFINE_TAUS[-3:], everything)
    warp = trial.bent
    for level, taus in enumerate(LATTICE_TAUS):
        warp = pairing.fit_lattice(halved(warp) if level else warp, taus, everything)
    return warp


def _in_voxels(kept: Deformation) -> dict[str, Any]:
    """Return a record's numbers in the units of a `Warp`."""
    affine = kept.affine.copy()
    affine[:, 3] /= VOXEL_SIZE
    if not kept.coefficients.size:
        return {"affine": affine}
    return {"affine": affine, "coefficients": kept.coefficients / VOXEL_SIZE}


def _figures(
    pairing: Pairing,
    warp: Warp,
    before: float,
    evidence: tuple[float, float],
    kept: Deformation | None,
    slat: Surface,
) -> FitFigures:
    here, back = pairing.residuals(warp)
    both = np.abs(np.concatenate([here, back]))
    figures = FitFigures(
        score_slat=float((1.0 / (1.0 + here**2)).mean()),
        score_pixieverse=float((1.0 / (1.0 + back**2)).mean()),
        score_similarity=before,
        evidence_affine=evidence[0],
        evidence_deformable=evidence[1],
        within=(
            float((both <= 1.0).mean()),
            float((both <= 2.0).mean()),
            float((both <= 3.0).mean()),
        ),
        offset=warp.offset,
        roughness=float(np.median(both)),
    )
    if kept is None:
        return figures
    points = slat.subset(FIT_SAMPLES).points * VOXEL_SIZE
    moved = np.linalg.norm(deform(kept, points) - points, axis=1) / VOXEL_SIZE
    stretches = np.linalg.svd(kept.affine[:, :3], compute_uv=False)
    return replace(
        figures,
        moved=float(moved.mean()),
        moved_most=float(moved.max()),
        stretch=(float(stretches[-1]), float(stretches[0])),
        bending=bending_of(kept) if kept.coefficients.size else 0.0,
    )
