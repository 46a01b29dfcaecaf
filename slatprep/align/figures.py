"""Measure the figures of a fit, on which the verdict rests, from its residuals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slatprep.align.agreement import agreement_of, shares_within
from slatprep.align.pose import Similarity
from slatprep.align.residuals import Residuals
from slatprep.align.surface import surfaces_of
from slatprep.align.warp import Warp
from slatprep.geometry.deformation import bending_of, deform
from slatprep.geometry.frames import VOXEL_SIZE
from slatprep.records import Alignment, Deformation, FitFigures, MaterialField, StructuredLatents

FIT_SAMPLES = 1_200
"""Samples per side of the final fit."""

CHECK_SAMPLES = 500
"""Samples per side from which the figures are measured; none of them is used in the fit."""

_MOST_OFFSET = 2.0


def measure_figures(
    field: MaterialField, latents: StructuredLatents, alignment: Alignment
) -> FitFigures:
    """Measure the default engine's figures at a placement of any engine.

    A deformation of the alignment is ignored. The offset is the median of the residuals, limited to
    2 voxels.
    """
    sides, pose = surfaces_of(field, latents, alignment.ground), Similarity.of(alignment.transform)
    residuals = Residuals(*sides, pose, CHECK_SAMPLES, first=FIT_SAMPLES)
    warp = Warp.unbent(pose)
    here, back = residuals.at(warp)
    # The two sides' residuals have the offset with opposite signs.
    offset = float(np.median(np.concatenate([here, -back])))
    warp = warp._replace(offset=float(np.clip(offset, -_MOST_OFFSET, _MOST_OFFSET)))
    return fit_figures(residuals, warp)


def fit_figures(
    residuals: Residuals,
    warp: Warp,
    before: float | None = None,
    evidence: tuple[float, float] = (math.nan, math.nan),
    kept: Deformation | None = None,
) -> FitFigures:
    """Measure a fit on samples that it did not use.

    `before` is the score of the similarity (by default that of `warp`). `evidence` are the rises of
    the score by an affine map and by bending in a trial. `kept` is the deformation in `warp`.
    """
    here, back = residuals.at(warp)
    both = np.abs(np.concatenate([here, back]))
    slat, pixieverse = (float((1.0 / (1.0 + side**2)).mean()) for side in (here, back))
    figures = FitFigures(
        score_slat=slat,
        score_pixieverse=pixieverse,
        score_similarity=0.5 * (slat + pixieverse) if before is None else before,
        evidence_affine=evidence[0],
        evidence_deformable=evidence[1],
        within=shares_within(both, 1.0, 2.0, 3.0),
        offset=warp.offset,
        roughness=float(np.median(both)),
        agreement=agreement_of(here, back, residuals.normals(), residuals.places),
    )
    if kept is None:
        return figures
    points = residuals.surface.subset(FIT_SAMPLES).points * VOXEL_SIZE
    moved = np.linalg.norm(deform(kept, points) - points, axis=1) / VOXEL_SIZE
    stretches = np.linalg.svd(kept.affine[:, :3], compute_uv=False)
    return replace(
        figures,
        moved=float(moved.mean()),
        moved_most=float(moved.max()),
        stretch=(float(stretches[-1]), float(stretches[0])),
        bending=bending_of(kept) if kept.coefficients.size else 0.0,
    )
