"""Deformation that must be earned: an affine map, then a lattice, after a similarity.

A trial fit sees the samples of every other block of space, and each further
freedom is kept only if it raises the score in the blocks between. A smooth
difference of shapes continues from block to block; a field's roughness does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slatprep.align.figures import CHECK_SAMPLES, FIT_SAMPLES, fit_figures
from slatprep.align.pose import Similarity
from slatprep.align.residuals import Residuals
from slatprep.align.surface import Surface
from slatprep.align.warp import Warp, from_nearest, halved
from slatprep.parameters import AlignParameters
from slatprep.records import Deformation, FitFigures, Model

TRIAL_SAMPLES = 600
"""Samples a side of the trial; half of them are held out."""

AFFINE_TAUS = (4.0, 3.0, 3.0, 2.0, 2.0, 1.5, 1.5, 1.5)
TRIAL_TAUS = (2.5, 2.0, 2.0, 1.5)
LATTICE_TAUS = ((2.0, 1.5), (1.5, 1.5), (1.5, 1.5))
"""Width of the robust kernel, in voxels, at each step: affine, then the coarsest lattice of a
trial, then lattice by lattice."""

FITS_ANYWAY = 0.9
"""A similarity that scores this much leaves too little to ask for a deformation."""

CLEAN = 0.8
"""From this score on the fields are not rough, and half of a trial's samples will do."""

LEAST_GAIN, GAIN_SHARE = 0.01, 0.1
"""A deformation is kept that raises the score of unseen blocks by so much and by this share of
the misfit."""


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
    residuals = Residuals(slat, pixie, pose, samples)
    start = Warp.unbent(pose)
    unseen = residuals.held_out()
    seen = np.flatnonzero(~unseen)
    before = residuals.kernels(start)
    affine = residuals.fit_affine(start, AFFINE_TAUS, seen)
    between = residuals.kernels(affine)
    bent = residuals.fit_lattice(residuals.with_lattice(affine), TRIAL_TAUS, seen)
    after = residuals.kernels(bent)
    unseen &= np.isfinite(after)
    scores = [float(k[unseen].mean()) if unseen.any() else 0.0 for k in (before, between, after)]
    return Trial(affine, bent, (scores[0], scores[1], scores[2]), float(after.mean()))


@dataclass(frozen=True)
class Deformed:
    """What came of it: the similarity, the model, the deformation (None without) and figures.

    ``warp`` is the deformation as it is fitted, and leaves all where it is without one.
    """

    pose: Similarity
    model: Model
    deformation: Deformation | None
    figures: FitFigures
    warp: Warp


def deform_if_earned(
    slat: Surface, pixie: Surface, pose: Similarity, model: Model, parameters: AlignParameters
) -> Deformed:
    """Deform a similarity as far as the parameters allow and the evidence asks.

    `model` says whether its scale is one. Of the parameters, the model ``auto`` lets the evidence
    decide, ``affine`` and ``deformable`` fit that without asking, the others nothing.
    """
    residuals = Residuals(slat, pixie, pose, CHECK_SAMPLES, first=FIT_SAMPLES)
    start = Warp.unbent(pose)
    before = float(residuals.kernels(start).mean())
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
                model, warp = Model(tried), warp.as_recorded(kept)
                if nearest is not pose:
                    pose = nearest
                    residuals = Residuals(slat, pixie, pose, CHECK_SAMPLES, first=FIT_SAMPLES)
                break
            warp = start
    figures = fit_figures(residuals, warp, before, evidence, kept)
    return Deformed(pose, model, kept, figures, warp)


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
    residuals = Residuals(slat, pixie, pose, FIT_SAMPLES)
    everything = np.arange(len(residuals.places))
    if model == "affine":
        return residuals.fit_affine(trial.affine, AFFINE_TAUS[-3:], everything)
    warp = trial.bent
    for level, taus in enumerate(LATTICE_TAUS):
        warp = residuals.fit_lattice(halved(warp) if level else warp, taus, everything)
    return warp
