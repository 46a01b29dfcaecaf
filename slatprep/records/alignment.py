"""Records of the map between the frames, how it was found, and its quality."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Ge, MaxLen, MinLen

from slatprep.records.json_types import (
    AffineMap,
    Count,
    Lattice,
    Number,
    Point,
    Rotation,
    Share,
    Transform,
)
from slatprep.records.tables import MAX_PROPERTIES, Engine, Model, Search, Verdict

MAX_CANDIDATES = 4096
"""Most candidates, and most placements, of one alignment; engines try a few hundred starts."""

MIRRORED = 0.025
"""Rise of the score by mirroring one side, above which it is a mirror image of the other.

The largest rise of objects that are not mirrored was 0.015, on real meshes of all levels.
"""


@dataclass(frozen=True)
class Candidate:
    """A start orientation and how well it fitted.

    ``euler_degrees`` are the turns about x, y and z by which the protocol names the start, or None
    if it does not. ``same_as`` is the index of the candidate with the same rotation whose result
    it shares, or None. Fitness is in 0..1, rmse in voxels.
    """

    index: Count
    euler_degrees: tuple[float, float, float] | None
    fitness: Number
    inlier_rmse: Number
    same_as: Count | None = None


@dataclass(frozen=True)
class Quality:
    """How well the outer boundaries of two filled voxel sets fit under a transform.

    Forward is PixieVerse to SLAT, backward the reverse. Fitness is the share of voxels
    with a partner within ``radius``, rmse the root mean square distance of these voxels. Distances
    are in voxels of the SLAT frame.
    """

    fitness: Share
    inlier_rmse: float
    fitness_backward: Share
    inlier_rmse_backward: float
    overlap: Share
    radius: float


@dataclass(frozen=True, eq=False)
class Placement:
    """A distinct placement that fits about as well as the best one, or all of it but a part.

    ``displacement`` is the largest distance [voxel] between a SLAT voxel's positions in this
    placement and in the best one.
    """

    transform: Transform
    score: Number
    displacement: Number


@dataclass(frozen=True)
class Ambiguity:
    """The effect of distinct, about equally good placements on the supervision.

    ``material_share`` is the share of SLAT voxels whose class or properties in any tied placement
    differ from those in the best, as `slatprep.judge.ambiguity.compare_labels` says.
    ``property_change`` is the largest mean absolute change of each property, in log10 if the
    property is normalised in log10. All are 0 without ties.
    """

    material_share: Share
    property_change: Annotated[tuple[Number, ...], MinLen(1), MaxLen(MAX_PROPERTIES)]


@dataclass(frozen=True)
class Judgement:
    """The quality of an alignment in words and figures; ``reasons`` say why it is not good.

    ``same_object`` is the calibrated probability that both sides show the same object.
    ``right_placement`` is the probability that the placement is right if they do, and
    ``confidence`` is the product. ``evidence`` are the figures behind them,
    `slatprep.judge.evidence.FIGURES`. ``expected_accuracy`` is the expected share of right labels
    among the valid ones. All four are NaN in records of builds that did not measure them.
    ``contradicted`` says that the asset's latents were compared with its labels and contradict
    them.
    """

    ambiguity: Ambiguity
    verdict: Verdict
    reasons: Annotated[tuple[str, ...], MaxLen(256)] = ()
    confidence: Number = float("nan")
    expected_accuracy: Number = float("nan")
    contradicted: bool = False
    same_object: Number = float("nan")
    right_placement: Number = float("nan")
    evidence: Annotated[tuple[Number, ...], MaxLen(256)] = ()


@dataclass(frozen=True, eq=False)
class Consensus:
    """The rotation (3, 3) that `agreeing` of `winners` objects without a tie have in common.

    An object whose assets are turned in several ways counts once for each of them.
    `others` counts those at each quarter turn but that, in the order of `distinct_starts`.
    `probability` is the probability that it is right for the asset that takes it by consensus.
    """

    rotation: Rotation
    winners: Annotated[int, Ge(1)]
    agreeing: Annotated[int, Ge(1)]
    others: Annotated[tuple[Count, ...], MinLen(24), MaxLen(24)] = (0,) * 24
    probability: Number = float("nan")


@dataclass(frozen=True)
class LatentChoice:
    """The choice that an asset's latents make among its tied placements.

    Attributes
    ----------
    probability : float
        Probability that the placement taken, or a tied one with the same labels, is the right
        one.
    evidence : float
        Log-likelihood ratio of the latents between its labels and the next placement's. Voxels
        are treated as independent.
    voxels : int
        Number of voxels to which these two placements give different labels.
    witnesses, agreeing : int
        Number of other objects whose assets tested the latents, and of those among them whose
        latents preferred their own labels to wrong ones.
    """

    probability: Share
    evidence: float
    voxels: Count
    witnesses: Count
    agreeing: Count


@dataclass(frozen=True, eq=False)
class Deformation:
    """The difference between a SLAT's shape and the PixieVerse object's, beyond a similarity.

    A point x of the SLAT frame is mapped to ``affine @ (x, 1) + u(x)``, still in the SLAT frame.
    The inverse of the alignment's transform then maps it to the PixieVerse frame. u is a uniform
    cubic B-spline; lengths are in edges of the unit cube. All numbers are multiples of 2^-30,
    which JSON holds exactly.

    Attributes
    ----------
    affine : ndarray of float64, shape (3, 4)
        The affine part of the map.
    origin : ndarray of float64, shape (3,)
        Lower corner of the splines' domain; control point (1, 1, 1) lies there.
    spacing : float
        Distance of neighbouring control points.
    coefficients : ndarray of float64, shape (n0, n1, n2, 3)
        Displacements at the control points, at least 4 a side; (0, 0, 0, 3) if
        the map is affine.

    Raises
    ------
    ValueError
        If the numbers do not have these shapes, or are not finite.
    """

    affine: AffineMap
    origin: Point
    spacing: float
    coefficients: Lattice

    def __post_init__(self) -> None:
        shape = self.coefficients.shape
        numbers = (self.affine, self.origin, self.coefficients, np.array(self.spacing))
        if (
            self.affine.shape != (3, 4)
            or self.origin.shape != (3,)
            or len(shape) != 4
            or shape[3] != 3
            or (self.coefficients.size and min(shape[:3]) < 4)
            or not all(np.isfinite(n).all() for n in numbers)
            or not self.spacing > 0
        ):
            raise ValueError(
                "a deformation has finite numbers: affine (3, 4), origin (3,), spacing above 0, "
                "and coefficients (n0, n1, n2, 3), at least 4 a side or none. Got affine "
                f"{self.affine.shape}, origin {self.origin.shape}, spacing {self.spacing}, "
                f"coefficients {shape}"
            )


@dataclass(frozen=True)
class Agreement:
    """How evenly the two surfaces lie on each other, under the final map; lengths in voxels.

    Attributes
    ----------
    directions_near, directions_middle : float
        Distance within which 30 % and 50 % of the samples lie, measured for each direction of
        their normals (26 of a cube): mean over directions.
    directions_worst : float
        Distance for 30 % of the samples, in the second-worst direction.
    blocks_near, blocks_middle, blocks_far : float
        Share of the samples in blocks of 8 voxels whose median is within 0.5, 1 and 1.5 voxels.
    within_slat, within_pixieverse : tuple of float
        Shares of either side's samples within 0.5, 1 and 1.5 voxels.
    """

    directions_near: float
    directions_middle: float
    directions_worst: float
    blocks_near: Share
    blocks_middle: Share
    blocks_far: Share
    within_slat: tuple[Share, Share, Share]
    within_pixieverse: tuple[Share, Share, Share]


@dataclass(frozen=True)
class FitFigures:
    """Measurements of the default engine about its own fit, which the verdict uses.

    Scores are means of 1 / (1 + r^2), r the residual in voxels, over samples
    not used in the fit. A perfect fit has 1; an error of a voxel everywhere gives 0.5.

    Attributes
    ----------
    score_slat, score_pixieverse : float
        Score over the samples of either side, under the final map.
    score_similarity : float
        Score over the samples of both sides together under the transform alone; the mean of both
        sides' scores if another engine found the transform.
    evidence_affine, evidence_deformable : float
        Rise of the score by an affine map, and by a coarse deformation after it, in blocks of
        space that were not used in a trial fit; NaN if no trial was needed.
    within : tuple of float
        Shares of the samples of both sides with a residual within 1, 2 and 3
        voxels, under the final map.
    offset : float
        Depth [voxel] of the PixieVerse surface inside the SLAT's; negative if it lies outside.
    roughness : float
        Median absolute residual [voxel] under the final map.
    moved, moved_most : float
        Mean and largest displacement [voxel] of the SLAT's surface by the deformation; 0
        without one.
    stretch : tuple of float
        Smallest and largest singular value of the affine part; 1 without one.
    bending : float
        Root mean square second derivative of the displacement over the
        lattice [1 / voxel]; 0 without one.
    mirrored : float
        Rise of the score by mirroring one side: above 0.025 the annotation is a mirror image of
        its object. NaN if the fit is too good for that, or if another engine found the transform.
    clear_by : float
        Smallest lead, in standard errors on the same samples, over any placement that scores less
        than 0.03 below it (0.06 if it is contested). NaN if there is none, or if another engine
        found the transform.
    agreement : Agreement or None
        How evenly the surfaces lie on each other; None if it was not measured.
    """

    score_slat: float
    score_pixieverse: float
    score_similarity: float
    evidence_affine: Number
    evidence_deformable: Number
    within: tuple[float, float, float]
    offset: float
    roughness: float
    moved: float = 0.0
    moved_most: float = 0.0
    stretch: tuple[float, float] = (1.0, 1.0)
    bending: float = 0.0
    mirrored: Number = float("nan")
    clear_by: Number = float("nan")
    agreement: Agreement | None = None


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground under an annotated object: everything up to a height along a normal.

    Attributes
    ----------
    normal : ndarray of float64, shape (3,)
        Unit vector of the PixieVerse frame, from the ground to the object.
    height : float
        Height of the ground's top along the normal, from the frame's centre, in edges of the
        unit cube.
    """

    normal: Point
    height: float


@dataclass(frozen=True, eq=False)
class Alignment:
    """The transform from the PixieVerse frame to the SLAT frame, and how it was found.

    Attributes
    ----------
    transform : ndarray of float64, shape (4, 4)
        Homogeneous, PixieVerse frame to SLAT frame, for column vectors.
    engine : Engine
        The engine that found it.
    model : Model
        ``rigid``, ``similarity``, ``affine`` or ``deformable``.
    search : Search
        The starts that were needed.
    quality : Quality
        How well the two voxel sets fit.
    candidates : tuple of Candidate
        Every start and its score.
    margin : float
        Distance in score from the best placement to the next distinct one.
    placements : tuple of Placement
        Distinct placements that fit about as well, or would but for a missing part.
    score : float
        The engine's rank of placements, 1 for a perfect fit; NaN if it ranks by fitness alone.
    settled_by : Consensus, LatentChoice or None
        The dataset's common rotation or the latents, if either chose among tied placements, with
        the probability of the choice.
    deformation : Deformation or None
        Map that is applied to points of the SLAT frame before the inverse of `transform`; None if
        the model is ``rigid`` or ``similarity``.
    figures : FitFigures or None
        Measurements of the engine about its fit, if it made any.
    ground : Ground or None
        The part of the annotation that was not compared with the SLAT, if any.
    """

    transform: Transform
    engine: Engine
    model: Model
    search: Search
    quality: Quality
    candidates: Annotated[tuple[Candidate, ...], MaxLen(MAX_CANDIDATES)] = ()
    margin: Number = float("nan")
    placements: Annotated[tuple[Placement, ...], MaxLen(MAX_CANDIDATES)] = ()
    score: Number = float("nan")
    settled_by: Consensus | LatentChoice | None = None
    deformation: Deformation | None = None
    figures: FitFigures | None = None
    ground: Ground | None = None

    @property
    def open_placements(self) -> tuple[Placement, ...]:
        """The tied placements if neither consensus nor latents chose among them."""
        return self.placements if self.settled_by is None else ()
