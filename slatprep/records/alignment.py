"""The map between the frames, how it was found, and what it is worth."""

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
from slatprep.records.tables import MAX_PROPERTIES
from slatprep.records.words import Engine, Model, Search, Verdict

MAX_CANDIDATES = 4096
"""Candidates and placements of one alignment; engines try a few hundred starts."""


@dataclass(frozen=True)
class Candidate:
    """One start orientation and how well it fitted.

    ``euler_degrees`` names the start where the protocol does (x, y, z turns);
    ``same_as`` is the index of the candidate with the same rotation that was
    computed in its stead, or None. Fitness is in 0..1, rmse in voxels.
    """

    index: Count
    euler_degrees: tuple[float, float, float] | None
    fitness: Number
    inlier_rmse: Number
    same_as: Count | None = None


@dataclass(frozen=True)
class Quality:
    """How well two voxel sets lie on each other under a transform.

    Forward is PixieVerse boundary to SLAT, backward SLAT to PixieVerse
    boundary. Fitness is the share of voxels with a partner within ``radius``,
    rmse the root mean square distance over those; distances in voxels of the
    SLAT frame.
    """

    fitness: Share
    inlier_rmse: float
    fitness_backward: Share
    inlier_rmse_backward: float
    overlap: Share
    radius: float


@dataclass(frozen=True, eq=False)
class Placement:
    """A distinct placement that fits about as well as the best one.

    ``displacement`` is the largest distance, in voxels, between a SLAT voxel's
    positions in the two.
    """

    transform: Transform
    score: Number
    displacement: Number


@dataclass(frozen=True)
class Ambiguity:
    """What distinct, about equally good placements mean for the supervision.

    ``material_share`` is the share of SLAT voxels whose class differs in any
    of them from the best placement's; ``property_change`` is the largest mean
    absolute change of each property, of log10 of those that are normalised so.
    All are 0 where nothing is tied.
    """

    material_share: Share
    property_change: Annotated[tuple[Number, ...], MinLen(1), MaxLen(MAX_PROPERTIES)]


@dataclass(frozen=True)
class Judgement:
    """What an alignment is worth; ``reasons`` say what kept it from being good.

    ``confidence`` is the calibrated probability that the placement is right,
    ``expected_accuracy`` the share of right labels to be expected among the
    valid ones; NaN in records of builds that did not tell. ``contradicted`` says
    that the latents of the asset contradict its labels, where the two were compared.
    """

    ambiguity: Ambiguity
    verdict: Verdict
    reasons: Annotated[tuple[str, ...], MaxLen(256)] = ()
    confidence: Number = float("nan")
    expected_accuracy: Number = float("nan")
    contradicted: bool = False


@dataclass(frozen=True, eq=False)
class Consensus:
    """The rotation (3, 3) that `agreeing` of `winners` assets without a tie have in common."""

    rotation: Rotation
    winners: Annotated[int, Ge(1)]
    agreeing: Annotated[int, Ge(1)]


@dataclass(frozen=True)
class LatentChoice:
    """What its latents say of an asset's tied placements.

    Attributes
    ----------
    probability : float
        That of the tied placements the one taken, or one with the same
        labels, is right.
    evidence : float
        Logarithm of how much likelier the latents are under its labels than
        under those of the next one, as if voxels were independent.
    voxels : int
        Voxels to which those two give different classes.
    witnesses, agreeing : int
        Other assets by which latents were tried, and those of them whose
        latents preferred their labels to wrong ones.
    """

    probability: Share
    evidence: float
    voxels: Count
    witnesses: Count
    agreeing: Count


@dataclass(frozen=True, eq=False)
class Deformation:
    """How a SLAT's shape differs from the PixieVerse object's, beyond a similarity.

    A point x of the SLAT frame belongs to ``affine @ (x, 1) + u(x)``, still in
    the SLAT frame, from where the inverse of the alignment's transform leads to
    the PixieVerse frame. u is a uniform cubic B-spline; lengths are in edges of
    the unit cube. All numbers are multiples of 2^-30, so that JSON holds them
    exactly.

    Attributes
    ----------
    affine : ndarray of float64, shape (3, 4)
        The smooth part of the map without bending.
    origin : ndarray of float64, shape (3,)
        Lower corner of the splines' domain; control point (1, 1, 1) lies there.
    spacing : float
        Distance of neighbouring control points.
    coefficients : ndarray of float64, shape (n0, n1, n2, 3)
        Displacements at the control points, at least 4 a side; (0, 0, 0, 3) where
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
                "a deformation has finite numbers: affine (3, 4), origin (3,), spacing above 0 "
                "and coefficients (n0, n1, n2, 3) with at least 4 a side or none; got affine "
                f"{self.affine.shape}, origin {self.origin.shape}, spacing {self.spacing}, "
                f"coefficients {shape}"
            )


@dataclass(frozen=True)
class FitFigures:
    """What the default engine measured of its own fit; material for a verdict.

    Scores are means of 1 / (1 + r^2), r the residual in voxels, over samples
    not used in the fit, 1 for a perfect fit; a score of 0.5 is an error of a
    voxel everywhere.

    Attributes
    ----------
    score_slat, score_pixieverse : float
        Score over the samples of either side, under the final map.
    score_similarity : float
        Mean of both sides' scores under the transform alone.
    evidence_affine, evidence_deformable : float
        Rise of the score, in blocks of space that a trial fit had not seen, by
        an affine map, and by a coarse deformation after it; NaN where no trial
        was needed.
    within : tuple of float
        Shares of the samples of both sides with a residual within 1, 2 and 3
        voxels, under the final map.
    offset : float
        Voxels by which the PixieVerse surface stands inside the SLAT's
        (negative: it is thicker).
    roughness : float
        Median absolute residual in voxels, under the final map.
    moved, moved_most : float
        Mean and largest displacement of the SLAT's surface by the deformation,
        in voxels; 0 without one.
    stretch : tuple of float
        Smallest and largest singular value of the affine part; 1 without one.
    bending : float
        Root mean square second derivative of the displacement over the
        lattice, in 1 / voxel; 0 without one.
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


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground that an annotated object stands on: what has no more than a height along a normal.

    Attributes
    ----------
    normal : ndarray of float64, shape (3,)
        Unit vector of the PixieVerse frame, from the ground to the object.
    height : float
        Of the ground's top along the normal, from the frame's centre, in edges of the unit cube.
    """

    normal: Point
    height: float


@dataclass(frozen=True, eq=False)
class Alignment:
    """The transform from the PixieVerse frame to the SLAT frame, and how it was found.

    Attributes
    ----------
    transform : ndarray of float64, shape (4, 4)
        Homogeneous, PixieVerse frame to SLAT frame (a column vector is
        multiplied from the left).
    engine : Engine
        The engine that found it.
    model : Model
        ``rigid``, ``similarity``, ``affine`` or ``deformable``.
    search : Search
        The starts that were needed.
    quality : Quality
        How well the two voxel sets lie on each other.
    candidates : tuple of Candidate
        Every start and its score.
    margin : float
        Distance in score from the best placement to the next distinct one.
    placements : tuple of Placement
        Distinct placements that fit about as well.
    score : float
        What the engine ranks placements by, 1 for a perfect fit; NaN where it
        ranks by fitness alone.
    settled_by : Consensus, LatentChoice or None
        The dataset's common rotation, where it moved the asset to another of its
        tied placements; what the latents say, where they chose among those.
    deformation : Deformation or None
        What comes before the inverse of `transform` on the way from the SLAT
        frame to the PixieVerse frame; None where the model is ``rigid`` or ``similarity``.
    figures : FitFigures or None
        What the engine measured of its fit; None where it measures nothing.
    ground : Ground or None
        What of the annotation was not compared with the SLAT; None where all was.
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
        """The placements that tie where neither consensus nor latents chose among them."""
        return self.placements if self.settled_by is None else ()
