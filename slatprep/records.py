"""The typed records that travel between the stages.

Two source files become rows of the store through read, align, sample,
normalise and pack. Each stage takes the records of the one before it and
returns its own; none of these classes touches a disk. Classes that hold arrays
compare by identity.

Frames: the *PixieVerse frame* and the *SLAT frame* are both the unit cube
[-0.5, 0.5]^3 with voxel ``i`` centred at ``(i + 0.5) / 64 - 0.5`` on each axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import IO, Annotated, Any, Literal, Protocol, Self

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

RESOLUTION = 64
"""Voxels along each axis of both frames."""

MATERIAL_CLASSES = (
    "jelly",
    "metal",
    "sand",
    "visplas",
    "fluid",
    "snow",
    "stationary",
    "background",
)
"""PhysGaussian's material classes, by id."""

FEATS_MEAN = (-2.1688, -0.0043, -0.1335, -0.0842, -0.5271, 0.7239, -1.1414, 1.2039)
FEATS_STD = (2.3777, 2.3864, 2.1244, 2.1749, 2.6639, 2.3712, 2.6217, 2.6845)
"""Of each latent channel, as TRELLIS publishes them for ``slat_flow_img_dit_L_64l8p2_fp16``."""

BACKGROUND = 7
"""Material id of an empty voxel."""

UNANNOTATED = 255
"""Material id of an occupied voxel that carries no annotation (-1 in raw grids)."""

CLASS_COLOURS = {
    "jelly": "#5A9A5A",
    "metal": "#4327AC",
    "sand": "#F7AE38",
    "visplas": "#901A0A",
    "fluid": "#2E9FF5",
    "snow": "#C592C6",
    "stationary": "#544856",
    "background": "#EAEAEA",
}
"""Colour of each of PhysGaussian's material classes, by name.

They stay apart for people who do not tell red from green, or blue from green:
simulated after Machado, Oliveira and Fernandes ("A Physiologically-based Model
for Simulation of Color Vision Deficiency", IEEE TVCG 2009), any two of them
differ by more than 20 in CIELAB.
"""

UNANNOTATED_COLOUR = "#FFFFFF"
"""Colour of an occupied voxel without an annotation."""

MATERIAL_COLOURS = {
    **{index: CLASS_COLOURS[name] for index, name in enumerate(MATERIAL_CLASSES)},
    UNANNOTATED: UNANNOTATED_COLOUR,
}
"""The same by material id, as the store holds it."""

PROPERTY_COLUMNS = ("youngs_modulus", "density", "poissons_ratio")
"""Order of the property columns everywhere in slatprep; SI units are Pa, kg/m^3, none."""


@dataclass(frozen=True)
class InJson:
    """How pydantic reads an annotated field: by a core schema, and a function on its result."""

    schema: Any
    then: Any = None

    def __get_pydantic_core_schema__(self, source: object, handler: object) -> Any:
        """Return the schema; see pydantic's documentation of custom types."""
        if self.then is None:
            return self.schema
        function = {"type": "no-info", "function": self.then}
        return {"type": "function-after", "function": function, "schema": self.schema}


def _array(*shape: int | None) -> InJson:
    schema: dict[str, Any] = {"type": "float"}
    for size in reversed(shape):
        length = {"min_length": size or 0, "max_length": _MAX_SIDE if size is None else size}
        schema = {"type": "list", "items_schema": schema} | length

    def array(values: list[Any]) -> NDArray[np.float64]:
        made = np.array(values, dtype=np.float64)
        if made.ndim < len(shape) and made.size == 0:
            made = made.reshape([size or 0 for size in shape])
        if made.ndim != len(shape):
            raise ValueError("rows of different lengths")
        return made

    return InJson(schema, array)


_MAX_SIDE = 32


def _one_of(*words: str) -> InJson:
    return InJson({"type": "literal", "expected": list(words)})


def _null_is_nan(value: float | None) -> float:
    return float("nan") if value is None else value


Share = Annotated[float, Ge(0), Le(1)]
"""A share, 0 to 1."""

Count = Annotated[int, Ge(0)]
"""How many."""

Number = Annotated[float, InJson({"type": "nullable", "schema": {"type": "float"}}, _null_is_nan)]
"""A number that may be NaN, which is null in JSON."""

Digest = Annotated[str, InJson({"type": "str", "pattern": "^[0-9a-f]{64}$"})]
"""SHA-256 in hex."""

Transform = Annotated[NDArray[np.float64], _array(4, 4)]
"""Homogeneous, (4, 4): PixieVerse frame to SLAT frame."""

Rotation = Annotated[NDArray[np.float64], _array(3, 3)]
"""(3, 3), orthogonal."""

AffineMap = Annotated[NDArray[np.float64], _array(3, 4)]
"""(3, 4): x -> A x + b."""

Point = Annotated[NDArray[np.float64], _array(3)]
"""(3,), edges of the unit cube."""

Lattice = Annotated[NDArray[np.float64], _array(None, None, None, 3)]
"""(n0, n1, n2, 3): a vector at each point of a lattice of at most 32 points a side."""


class Engine(StrEnum):
    """What finds the transform."""

    FIELD = "field"
    OPEN3D = "open3d"
    SMALL_GICP = "small_gicp"


class Model(StrEnum):
    """Which maps are allowed: the scale fixed at one, free, and a deformation after it."""

    RIGID = "rigid"
    SIMILARITY = "similarity"
    AFFINE = "affine"
    DEFORMABLE = "deformable"


class Search(StrEnum):
    """The start orientations that were needed: 64 quarter turns, or all orientations."""

    EULER64 = "euler64"
    SO3 = "so3"


class Verdict(StrEnum):
    """What an alignment is worth, in one word."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    FAILED = "failed"


class Status(StrEnum):
    """What became of an asset in a build."""

    OK = "ok"
    FAILED = "failed"
    SKIPPED = "skipped"


class Place(Protocol):
    """Where a file or a folder lies: a `pathlib.Path`, or a URL as a `RemotePlace`.

    `slatprep.storage.place.place_of` makes one. This is all that both offer
    alike; for the rest, `slatprep.storage.place.storage_of` tells them apart.
    """

    @property
    def name(self) -> str:
        """Its last component."""

    @property
    def suffix(self) -> str:
        """The extension of its name, with the dot."""

    @property
    def parent(self) -> Self:
        """The folder that holds it."""

    def __hash__(self) -> int:
        """Equal places have the same."""

    def __truediv__(self, key: str, /) -> Self:
        """Return the place of this name below it."""

    def absolute(self) -> Self:
        """Return it independent of the working folder."""

    def exists(self) -> bool:
        """Whether there is a file or a folder."""

    def is_dir(self) -> bool:
        """Whether there is a folder."""

    def is_file(self) -> bool:
        """Whether there is a file."""

    def open(
        self, mode: str, *, encoding: str | None = None, newline: str | None = None
    ) -> IO[Any]:
        """Open a file; on an object store for reading only."""

    def read_bytes(self) -> bytes:
        """Read a file whole."""

    def read_text(self, encoding: str | None = None) -> str:
        """Read a file whole, as text."""


@dataclass(frozen=True)
class SourceFile:
    """A file that was read; ``path`` is relative to its source's root, with forward slashes."""

    role: Annotated[str, _one_of("grid", "mask", "bounds", "slat")]
    path: str
    size: Count
    sha256: Digest


@dataclass(frozen=True)
class SourceRoots:
    """The folders below which all files of the two sources lie."""

    pixieverse: Place
    slat: Place


@dataclass(frozen=True, slots=True)
class AssetPair:
    """Where the two sides of one row of the store lie; nothing has been read yet.

    Attributes
    ----------
    asset_id : str
        Unique id of the row: the object id, or ``<object_id>.<view>`` where
        one object has several SLATs.
    object_id : str
        PixieVerse id of the object.
    view : str
        The image or seed the SLAT was made from; empty where there is one only.
    category : str
        PixieVerse category; empty where unknown.
    roots : SourceRoots
        The roots below which the files must lie; one object for all pairs.
    grid, mask, bounds : Place or None
        PixieVerse files, absolute; ``grid`` is None where the partner is missing.
    slat : Place or None
        SLAT file, absolute; None where the partner is missing.
    slat_group : str
        Group inside an HDF5 file that holds many assets; empty otherwise.
    problem : str
        Why the pair cannot be used (missing partner, two files for one id);
        empty where all is well.
    """

    asset_id: str
    object_id: str
    view: str
    category: str
    roots: SourceRoots
    grid: Place | None
    mask: Place | None
    bounds: Place | None
    slat: Place | None
    slat_group: str = ""
    problem: str = ""


@dataclass(frozen=True, eq=False)
class MaterialField:
    """A PixieVerse field: what occupies the grid and what it is made of, in SI units.

    Attributes
    ----------
    occupancy : ndarray of bool, shape (64, 64, 64)
        Occupied voxels, axes x, y, z of the PixieVerse frame.
    voxels : ndarray of uint8, shape (K, 3)
        The annotated voxels (occupied, class 0..6), in C order of the grid.
    material : ndarray of uint8, shape (K,)
        Class of each annotated voxel, 0..6.
    properties : ndarray of float32, shape (K, 3)
        Young's modulus [Pa], density [kg/m^3] and Poisson's ratio of each.
    bounds : dict or None
        World bounds as ``clip_features.npz`` states them, JSON-ready.
    sources : tuple of SourceFile
        The files read.
    warnings : tuple of str
        What a person should know about this field.
    """

    occupancy: NDArray[np.bool_]
    voxels: NDArray[np.uint8]
    material: NDArray[np.uint8]
    properties: NDArray[np.float32]
    bounds: dict[str, object] | None = None
    sources: tuple[SourceFile, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class StructuredLatents:
    """A TRELLIS SLAT: occupied surface voxels and their latents.

    ``coords`` is (N, 3) uint8 in 0..63 in the order of the source file,
    ``feats`` is (N, 8) float32.
    """

    coords: NDArray[np.uint8]
    feats: NDArray[np.float32]
    sources: tuple[SourceFile, ...] = ()
    warnings: tuple[str, ...] = ()


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
    absolute change of log10 Young's modulus, log10 density and Poisson's
    ratio. All are 0 where nothing is tied.
    """

    material_share: Share
    property_change: tuple[Number, Number, Number]


@dataclass(frozen=True)
class Judgement:
    """What an alignment is worth; ``reasons`` say what kept it from being good.

    ``confidence`` is the calibrated probability that the placement is right,
    ``expected_accuracy`` the share of right labels to be expected among the
    valid ones; NaN in records of builds that did not tell.
    """

    ambiguity: Ambiguity
    verdict: Verdict
    reasons: tuple[str, ...] = ()
    confidence: Number = float("nan")
    expected_accuracy: Number = float("nan")


@dataclass(frozen=True, eq=False)
class Consensus:
    """The rotation (3, 3) that `agreeing` of `winners` assets without a tie have in common."""

    rotation: Rotation
    winners: Annotated[int, Ge(1)]
    agreeing: Annotated[int, Ge(1)]


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
    settled_by : Consensus or None
        The dataset's common rotation, where it chose among tied placements.
    deformation : Deformation or None
        What comes before the inverse of `transform` on the way from the SLAT
        frame to the PixieVerse frame; None where the model is ``rigid`` or ``similarity``.
    figures : FitFigures or None
        What the engine measured of its fit; None where it measures nothing.
    """

    transform: Transform
    engine: Engine
    model: Model
    search: Search
    quality: Quality
    candidates: tuple[Candidate, ...] = ()
    margin: Number = float("nan")
    placements: tuple[Placement, ...] = ()
    score: Number = float("nan")
    settled_by: Consensus | None = None
    deformation: Deformation | None = None
    figures: FitFigures | None = None


@dataclass(frozen=True, eq=False)
class Annotation:
    """Material and properties looked up at every SLAT voxel, in SI units.

    ``properties`` is (N, 3) float32 (Young's modulus [Pa], density [kg/m^3],
    Poisson's ratio), NaN where not valid; ``material`` (N,) uint8, 255 where
    not valid; ``valid`` (N,) bool; ``distance`` (N,) float32, in voxels of the
    PixieVerse frame, to the annotation used; ``place`` (N, 3) float32, where the
    voxel was looked up, in the PixieVerse frame; ``confidence`` (N,) float32, how
    likely the class is right, 0 where not valid, None until that is judged.
    """

    properties: NDArray[np.float32]
    material: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    distance: NDArray[np.float32]
    place: NDArray[np.float32]
    confidence: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class PropertyRange:
    """How one property is mapped to [-1, 1].

    ``lo`` and ``hi`` are in the mapped unit: log10 of the SI value where
    ``log10`` is true, the SI value itself otherwise.
    """

    name: Annotated[str, _one_of(*PROPERTY_COLUMNS)]
    log10: bool
    lo: float
    hi: float


@dataclass(frozen=True)
class Normalization:
    """The three property ranges, in the order of ``PROPERTY_COLUMNS``, and where they come from.

    ``source`` is ``dataset``, ``pixie`` or the name of a file.
    """

    ranges: tuple[PropertyRange, PropertyRange, PropertyRange]
    source: str


@dataclass(frozen=True, eq=False)
class Finished:
    """An asset that went through all stages; properties in SI units."""

    pair: AssetPair
    field: MaterialField
    latents: StructuredLatents
    alignment: Alignment
    annotation: Annotation
    judgement: Judgement


@dataclass(frozen=True)
class Failed:
    """An asset that cannot go in.

    ``reason`` says why in one line; ``traceback`` where, if slatprep itself is
    at fault.
    """

    pair: AssetPair
    status: Literal[Status.FAILED, Status.SKIPPED]
    reason: str
    traceback: str = ""
