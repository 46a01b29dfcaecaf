"""The default engine: align two filled voxel sets by their distance fields.

The method has six steps (docs/design/alignment.md has the equations):

1. Fill both voxel sets and measure the signed distance to their surfaces.
2. Start from each of the 24 distinct rotations, centroid on centroid and size
   on size. Take a few robust Gauss-Newton steps on 100 samples per side.
3. Polish the distinct survivors on more samples. If the best one fits poorly,
   search all orientations the same way.
4. Refine the remaining placements on 2,000 samples per side, choose the best,
   and list the ties.
5. Keep the scale at one if that fits about as well.
6. If a trial fit removes a tenth of the misfit in samples that it did not see,
   deform the best placement and its near ties: `slatprep.align.deform`.

If the field has a slab of ground that the SLAT lacks, the steps run again
without the slab: `slatprep.align.ground`. The steps are methods of `slatprep.align.pair.Pair`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.align.deform import CLEAN, Deformed
from slatprep.align.figures import measure_figures
from slatprep.align.finish import as_free, finish, rank_of
from slatprep.align.ground import (
    BETWEEN,
    GROUND_GAIN,
    LEAST_ABOVE,
    LIKELY_GAIN,
    RAISED,
    SEARCHED,
    TRIED,
    WIDE,
    WIDTH,
    find_layers,
    gain,
    raised,
    relative_width,
)
from slatprep.align.mirror import mirror_gain
from slatprep.align.pair import COARSE, DISTINCT, MOST_SURVIVORS, POLISH, TIE, Pair
from slatprep.align.pose import Pose, Similarity
from slatprep.align.quality import compare
from slatprep.align.search import of_scale_one, ranked, repeated, search_all
from slatprep.align.starts import candidates_of, distinct_starts
from slatprep.align.surface import surface_of, surfaces_of
from slatprep.align.warp import Warp
from slatprep.geometry.voxels import above
from slatprep.parameters import AlignParameters
from slatprep.records import (
    Alignment,
    Engine,
    FitFigures,
    Ground,
    MaterialField,
    Placement,
    Quality,
    Search,
    StructuredLatents,
)

POOR, FAIR, CLEAR = 0.8, 0.9, 0.1
"""All orientations are searched if the best score from the 24 starts is below `POOR`. They are also
searched if it is below `FAIR` and less than `CLEAR` above the next distinct placement's."""

HOPELESS = 0.1
"""Best score up to which the sides have no shape in common, even if deformed or without ground."""

WIDER_GAIN = 0.02
"""Rise of the score by which a placement from all orientations must beat the 24 starts."""

CLOSE = 0.02
"""Difference to the best score below which deformed placements tie; here scores are more
precise."""

CLEARLY = 2.5
"""Number of standard errors at which a placement that fits worse stops tying, however close it
scores. A placement that fits better ties whatever its score, if this was measured."""


BEATEN, BETTER, FINE = 2 * TIE, 0.25, 0.99
"""Leads at which another placement contradicts a stated frame: in score, and as a share of what the
score lacks of 1. True frames of real meshes are led by at most 0.11 of it. `FINE` is the score from
which a stated frame is right."""


class Candidates(NamedTuple):
    """Placements best first, the fits of the 24 starts, and poses of all orientations."""

    poses: list[Pose]
    fits: list[Pose]
    wide: list[Pose]
    halfway: list[Pose]


class Cut(NamedTuple):
    """What a search finds without a layer, its relative width, and the least rise of the score."""

    ground: Ground
    pair: Pair
    candidates: Candidates
    width: float
    least: float

    @property
    def rank(self) -> float:
        """The score after the search, and the weighted width."""
        return self.candidates.poses[0].score + WIDTH * self.width


def align(
    field: MaterialField, latents: StructuredLatents, parameters: AlignParameters
) -> Alignment:
    """Align by distance fields; see `slatprep.align.align`."""
    pair = Pair(*surfaces_of(field, latents), parameters)
    found = _alignment(pair, _search(pair))
    return _above_ground(field, pair, found) if HOPELESS < found.score < POOR else found


def _above_ground(field: MaterialField, pair: Pair, found: Alignment) -> Alignment:
    """Return the best alignment without a flat layer if that counts as ground, else `found`."""
    cuts = [cut for layer in find_layers(pair.pixie) for cut in _cuts(field, pair, found, layer)]
    best, most = found, -np.inf
    for cut in sorted(cuts, key=lambda cut: -cut.rank)[:TRIED]:
        without = replace(_alignment(cut.pair, cut.candidates), ground=cut.ground)
        rise = gain(without, found)
        rank = rise + WIDTH * cut.width
        # A placement that leads after the search may score less once it is finished.
        if without.score >= found.score and rise > cut.least and rank > most:
            best, most = without, rank
    return best


def _cuts(field: MaterialField, pair: Pair, found: Alignment, layer: Ground) -> list[Cut]:
    """Search without a layer, cut off at several heights; leave out what cannot be better."""
    own, searched, cuts = Pose(Similarity.of(found.transform)), [], []
    for by in (*RAISED, *BETWEEN):
        ground = raised(layer, by)
        solid = above(field.occupancy, ground)
        if np.count_nonzero(solid) < LEAST_ABOVE * np.count_nonzero(field.occupancy):
            continue
        there = Pair(pair.slat, surface_of(solid), pair.parameters)
        if by in RAISED:
            candidates = _search(there)
            searched.append(candidates)
        elif searched:
            candidates = _repolished(there, searched)
        else:
            continue
        width = relative_width(ground, field.occupancy, solid)
        another = pair.apart(candidates.poses[:1], own)[0] >= 2.0 * DISTINCT
        least = LIKELY_GAIN if another and width == WIDE else GROUND_GAIN
        if candidates.poses[0].score >= found.score + least - SEARCHED:
            cuts.append(Cut(ground, there, candidates, width, least))
    return cuts


def _search(pair: Pair) -> Candidates:
    starts = pair.starts((s.rotation for s in distinct_starts()), pair.size_ratio)
    fits = pair.refine(starts, COARSE)
    poses = pair.polish(fits)
    wide: list[Pose] = []
    halfway: list[Pose] = []
    if _is_poor(poses):
        refined, halfway = search_all(pair)
        wide = pair.polish(refined)
        if wide[0].score > poses[0].score + WIDER_GAIN:
            poses = pair.distinct([*poses, *wide])
    return Candidates(_with_repeated(pair, poses), fits, wide, halfway)


def _repolished(pair: Pair, searched: Sequence[Candidates]) -> Candidates:
    """Return the placements that searches of almost the same surfaces found, refined on these."""
    poses = pair.polish([pose for one in searched for pose in (*one.poses, *one.wide)])
    like = next((one for one in reversed(searched) if one.wide), searched[-1])
    wide = poses if like.wide else []
    return Candidates(_with_repeated(pair, poses), like.fits, wide, like.halfway)


def _with_repeated(pair: Pair, poses: list[Pose]) -> list[Pose]:
    if poses[0].score < POOR:
        return poses
    return pair.distinct([*poses, *repeated(pair, poses[0])])


def _alignment(pair: Pair, candidates: Candidates) -> Alignment:
    poses, fits, wide, halfway = candidates
    if wide and pair.may_deform and HOPELESS < poses[0].score < POOR:
        poses = ranked(pair, pair.distinct([*poses, *wide]), halfway)
    may_contest = pair.may_deform and poses[0].score < POOR
    reach, tie = (2 * TIE, CLOSE) if may_contest else (TIE, TIE)
    near = [pose for pose in poses if pose.merit > poses[0].merit - reach]
    tied, deformed = finish(pair, near, rough=poses[0].score < CLEAN)
    best = tied[0]
    # Near placements come as `finish` returns them: these scores are more reliable.
    others = pair.others(best, [*tied[1:], *(pose for pose in poses if pose not in near)])
    rivals = [pose.behind for pose in others if pose.merit > best.merit - reach]
    traded = of_scale_one(pair, best) if best.score >= POOR else []
    starts = zip(distinct_starts(), fits, strict=True)
    fitted = {start.index: (fit.fitness, fit.rmse) for start, fit in starts}
    transform = best.similarity.transform
    return Alignment(
        transform=transform,
        engine=Engine.FIELD,
        model=deformed.model,
        search=Search.SO3 if wide else Search.EULER64,
        quality=compare(pair.pixie.boundary, pair.slat.boundary, transform, pair.parameters.radius),
        candidates=candidates_of(fitted),
        # The next placement's score may come from fewer samples, and may then be higher.
        margin=max(best.merit - others[0].merit, 0.0) if others else 1.0,
        placements=tuple(
            Placement(pose.similarity.transform, pose.score, float(pair.apart([pose], best)[0]))
            for pose in [*others[:MOST_SURVIVORS], *traded]
            if pose in traded
            or pose.behind < 0.0
            or (pose.merit > best.merit - tie and not pose.behind >= CLEARLY)
        ),
        score=best.score,
        deformation=deformed.deformation,
        figures=_figures(pair, best, deformed, np.fmin.reduce(rivals, initial=nan)),
    )


def refined_at(
    alignment: Alignment,
    field: MaterialField,
    latents: StructuredLatents,
    parameters: AlignParameters,
) -> Alignment:
    """Finish an alignment's placement as `align` finishes the best one; see `settle.refit`."""
    pair = Pair(*surfaces_of(field, latents, alignment.ground), parameters)
    start = Pose(Similarity.of(alignment.transform))
    (best,), deformed = finish(pair, [start], rough=alignment.score < CLEAN)
    return replace(
        alignment,
        transform=best.similarity.transform,
        model=deformed.model,
        score=best.score,
        deformation=deformed.deformation,
        figures=_figures(pair, best, deformed),
    )


def fitted_near(
    alignment: Alignment,
    rotation: NDArray[np.float64],
    field: MaterialField,
    latents: StructuredLatents,
    parameters: AlignParameters,
) -> tuple[Placement, float]:
    """Fit a placement from a rotation (3, 3), without the alignment's ground.

    Return the placement, and by how much it ranks above the alignment once both are deformed.
    """
    pair = Pair(*surfaces_of(field, latents, alignment.ground), parameters)
    starts = [
        pose for scale in sorted({pair.size_ratio, 1.0}) for pose in pair.starts([rotation], scale)
    ]
    poses = pair.polish(pair.refine(starts, COARSE))
    (best, *_), deformed = finish(pair, poses[:1], rough=poses[0].score < CLEAN)
    own, figures = Similarity.of(alignment.transform), alignment.figures
    figures = figures or measure_figures(field, latents, alignment)
    # The comparison uses only figures and model; the warp is no longer known.
    fit = Deformed(own, alignment.model, alignment.deformation, figures, Warp.unbent(own))
    before, after = (rank_of(free.pose, free.figures) for free in as_free(pair, [fit, deformed]))
    return Placement(best.similarity.transform, best.score, 0.0), after - before


def lead_of_another(
    transform: NDArray[np.float64],
    quality: Quality,
    field: MaterialField,
    latents: StructuredLatents,
    parameters: AlignParameters,
) -> float:
    """Return by how much another placement clearly beats a given one in score; NaN if none does.

    `quality` is that of the given one.
    The given one may be off by `DISTINCT` at most, as it is polished. If it is off farther, the
    polished one is another placement, and beats it if it halves what the score lacks of 1. Others
    beat it by `BEATEN`, or by `BETTER`; from the score `FINE` on none is searched for. If one side
    alone has more than the other, it is not off, and only `BEATEN` counts.
    """
    pair = Pair(*surfaces_of(field, latents), parameters)
    given = Pose(Similarity.of(transform))
    less, more = sorted((1.0 - quality.fitness, 1.0 - quality.fitness_backward))
    better = BETTER if less > 0.5 * more else 1.0
    (own,) = pair.refine([given], POLISH)
    if pair.apart([own], given)[0] >= DISTINCT:
        near, (own,) = own, pair.refine([given], POLISH._replace(taus=()))
        if better < 1.0 and near.score > 0.5 * (1.0 + own.score):
            return near.score - own.score
    least = max(POOR, own.score + min(BEATEN, better * (1.0 - own.score)))
    others = pair.others(given, _search(pair).poses) if own.score < FINE else []
    return max((pose.score - own.score for pose in others if pose.score > least), default=nan)


def _figures(pair: Pair, best: Pose, deformed: Deformed, clear_by: float = nan) -> FitFigures:
    mirrored = mirror_gain(pair, best.similarity, poor=best.score < POOR)
    return replace(deformed.figures, mirrored=mirrored, clear_by=clear_by)


def _is_poor(poses: Sequence[Pose]) -> bool:
    score = poses[0].score
    unclear = len(poses) > 1 and score - poses[1].score < CLEAR
    return score < POOR or (score < FAIR and unclear)
