"""Fit a deformation after a similarity, and keep it only if held-out samples support it.

A trial fit uses the samples of every other block of space. An affine map, and then a lattice, is
kept only if it raises the score in the blocks between. A smooth difference of shapes continues from
block to block; a field's roughness does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slatprep.align.figures import CHECK_SAMPLES, FIT_SAMPLES, fit_figures
from slatprep.align.pose import Similarity
from slatprep.align.residuals import Residuals
from slatprep.align.surface import Surface
from slatprep.align.warp import Warp, from_nearest, halved
from slatprep.geometry.frames import Array
from slatprep.parameters import AlignParameters
from slatprep.records import Deformation, FitFigures, Model

TRIAL_SAMPLES = 600
"""Samples per side of the trial; half of them are held out."""

AFFINE_TAUS = (4.0, 3.0, 3.0, 2.0, 2.0, 1.5, 1.5, 1.5)
TRIAL_TAUS = (2.5, 2.0, 2.0, 1.5)
LATTICE_TAUS = ((2.0, 1.5), (1.5, 1.5), (1.5, 1.5))
"""Width of the robust kernel, in voxels, at each step: of the affine map, of the coarsest lattice
in a trial, and of each lattice of the final fit."""

FITS_ANYWAY = 0.9
"""Score of a similarity at and above which no deformation is tried."""

CLEAN = 0.8
"""Smallest score of fields that are not rough; a trial then needs only half of its samples."""

LEAST_GAIN, GAIN_SHARE = 0.01, 0.1
"""A deformation must raise the score of unseen blocks by more than the first number plus the second
times the misfit."""


WELL, FAR, LACKING, LACKING_TAUS = 0.75, 3.0, 0.05, (1.0,) * 4
"""A part lacks if the similarity scores more than `WELL`, and the shares of the two sides' samples
that are off by more than `FAR` voxels differ by more than `LACKING`. The trial's kernels are narrow
then, or it would stretch the rest over that part."""


@dataclass(frozen=True)
class Trial:
    """A trial fit: a warp with an affine part only, a warp with a coarse lattice, and their scores.

    ``scores`` are those of the similarity, the affine and the bent warp on the samples that the
    trial did not see. ``whole`` is the score of the bent warp on all samples.
    """

    affine: Warp
    bent: Warp
    scores: tuple[float, float, float]
    whole: float


def try_out(slat: Surface, pixie: Surface, pose: Similarity, samples: int = TRIAL_SAMPLES) -> Trial:
    """Fit to the samples of every other block of space, and score on the other samples."""
    residuals = Residuals(slat, pixie, pose, samples)
    start = Warp.unbent(pose)
    unseen = residuals.held_out()
    seen = np.flatnonzero(~unseen)
    before = residuals.kernels(start)
    lacks = before.mean() > WELL and _lacks_a_part(*residuals.at(start))
    affine = residuals.fit_affine(start, LACKING_TAUS if lacks else AFFINE_TAUS, seen)
    between = residuals.kernels(affine)
    taus = LACKING_TAUS if lacks else TRIAL_TAUS
    bent = residuals.fit_lattice(residuals.with_lattice(affine), taus, seen)
    after = residuals.kernels(bent)
    unseen &= np.isfinite(after)
    scores = [float(k[unseen].mean()) if unseen.any() else 0.0 for k in (before, between, after)]
    return Trial(affine, bent, (scores[0], scores[1], scores[2]), float(after.mean()))


def _lacks_a_part(*sides: Array) -> bool:
    """Return whether far more of one side's samples are far off, by their residuals (N,)."""
    less, more = sorted(float((abs(side) > FAR).mean()) for side in sides)
    return more - less > LACKING


@dataclass(frozen=True)
class Deformed:
    """A similarity with its model, the deformation that was kept, and figures.

    ``warp`` is the deformation in the form in which it is fitted. If no deformation was kept,
    ``deformation`` is None and ``warp`` moves nothing.
    """

    pose: Similarity
    model: Model
    deformation: Deformation | None
    figures: FitFigures
    warp: Warp


def deform_if_earned(
    slat: Surface, pixie: Surface, pose: Similarity, model: Model, parameters: AlignParameters
) -> Deformed:
    """Add a deformation to a similarity if parameters and evidence allow it.

    `model` is the model without a deformation: rigid or similarity. If `parameters.model` is
    ``auto``, the evidence decides. If it is ``affine`` or ``deformable``, that is fitted in any
    case; otherwise nothing is fitted.
    """
    residuals = Residuals(slat, pixie, pose, CHECK_SAMPLES, first=FIT_SAMPLES)
    start = Warp.unbent(pose)
    before = float(residuals.kernels(start).mean())
    evidence = float("nan"), float("nan")
    wanted: str = parameters.model if parameters.model in ("affine", "deformable") else ""
    warp, kept = start, None
    if wanted or (parameters.model == "auto" and before < FITS_ANYWAY):
        # On smooth fields half of the samples are enough.
        trial = try_out(slat, pixie, pose, TRIAL_SAMPLES if before < CLEAN else TRIAL_SAMPLES // 2)
        evidence = trial.scores[1] - trial.scores[0], trial.scores[2] - trial.scores[1]
        wanted = wanted or earned(trial)
        # If the lattice bends too far or folds, an affine map may still be valid.
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
    """Return ``affine`` or ``deformable`` if the unseen blocks support it, else an empty string.

    The score must rise by more than `LEAST_GAIN` plus a tenth of the misfit. An affine map that
    achieves this is kept even if bending adds nothing.
    """
    before, affine, bent = trial.scores
    margin = LEAST_GAIN + GAIN_SHARE * (1.0 - before)
    if bent - before > margin and bent - affine > LEAST_GAIN:
        return "deformable"
    return "affine" if affine - before > margin else ""


def fit(slat: Surface, pixie: Surface, pose: Similarity, trial: Trial, model: str) -> Warp:
    """Fit an ``affine`` or ``deformable`` warp to samples of all blocks, from a trial's warp."""
    residuals = Residuals(slat, pixie, pose, FIT_SAMPLES)
    everything = np.arange(len(residuals.places))
    if model == "affine":
        return residuals.fit_affine(trial.affine, AFFINE_TAUS[-3:], everything)
    warp = trial.bent
    for level, taus in enumerate(LATTICE_TAUS):
        warp = residuals.fit_lattice(halved(warp) if level else warp, taus, everything)
    return warp
