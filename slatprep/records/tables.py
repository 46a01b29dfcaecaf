"""Names and constants that all records share, and the contents of a dataset.

Names are those of classes, colours, engines and verdicts. The contents are properties, classes and
latents.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from colorsys import hls_to_rgb
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, TypeVar

import numpy as np
from annotated_types import Ge, Le, MaxLen
from numpy.typing import NDArray

from slatprep.records.json_types import InJson

RESOLUTION = 64
"""Voxels along each axis of both frames."""

MAX_NAME_BYTES = 1024
"""Most bytes of an id, view, category or file name in UTF-8."""

FEATS_MEAN = (
    -2.1687545776367188, -0.004347046371549368, -0.13352349400520325, -0.08418072760105133,
    -0.5271206498146057, 0.7238689064979553, -1.1414450407028198, 1.2039363384246826,
)  # fmt: skip

FEATS_STD = (
    2.377650737762451, 2.386378288269043, 2.124418020248413, 2.1748552322387695,
    2.663944721221924, 2.371192216873169, 2.6217446327209473, 2.684523105621338,
)  # fmt: skip
"""Mean and deviation per channel that TRELLIS publishes for ``slat_flow_img_dit_L_64l8p2_fp16``."""

BACKGROUND = 7
"""Material id of an empty voxel, unless a store has more classes than this number."""

MANY_BACKGROUND = 254
"""Material id of an empty voxel in a store with more classes; also the most classes."""

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
"""Colour of each of PhysGaussian's material classes, by name, in the order of their ids.

People who do not tell red from green, or blue from green, can tell them apart. Simulated after
Machado, Oliveira and Fernandes ("A Physiologically-based Model for Simulation of Color Vision
Deficiency", IEEE TVCG 2009), any two colours differ by more than 20 in CIELAB.
"""

MATERIAL_CLASSES = tuple(CLASS_COLOURS)
"""PhysGaussian's material classes, by id."""

UNANNOTATED_COLOUR = "#FFFFFF"
"""Colour of an occupied voxel without an annotation."""


INK, MUTED = "#1F2328", "#6B7280"
"""Colours of pictures: text and data, and everything secondary."""

PICTURE_FORMATS: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
"""Formats of a picture, with the metadata to omit so that its bytes do not vary."""

SVG_SALT = "slatprep"
"""Matplotlib's ``svg.hashsalt``, without which ids within an SVG are random."""


def _colour_beyond(index: int) -> str:
    """Return a colour for a class beyond PhysGaussian's, unlike the colours of lower ids."""
    # Steps of the golden ratio cover all hues and never repeat one.
    hue, lightness = index * 0.618034 % 1.0, (0.35, 0.5, 0.65)[index % 3]
    return "#" + "".join(f"{round(255 * c):02X}" for c in hls_to_rgb(hue, lightness, 0.6))


MATERIAL_COLOURS = {
    **{index: CLASS_COLOURS[name] for index, name in enumerate(MATERIAL_CLASSES)},
    **{index: _colour_beyond(index) for index in range(len(MATERIAL_CLASSES), MANY_BACKGROUND)},
    UNANNOTATED: UNANNOTATED_COLOUR,
}
"""Colour by material id, as the store holds it; ids from 8 on occur if there are more classes."""

COLOURS = np.zeros((256, 3), dtype=np.uint8)
"""Red, green and blue of every material id."""
for _material, _colour in MATERIAL_COLOURS.items():
    COLOURS[_material] = tuple(bytes.fromhex(_colour[1:]))

_Word = TypeVar("_Word")


def words_of(given: str | Iterable[_Word] | None) -> tuple[str | _Word, ...]:
    """Return words as a tuple; a text is a single word, and None is none."""
    if given is None:
        return ()
    return (given,) if isinstance(given, str) else tuple(given)


class Engine(StrEnum):
    """The method that finds the transform."""

    FIELD = "field"
    OPEN3D = "open3d"
    SMALL_GICP = "small_gicp"
    KNOWN = "known"


class Model(StrEnum):
    """The allowed maps: fixed scale, free scale, affine, or with a deformation."""

    RIGID = "rigid"
    SIMILARITY = "similarity"
    AFFINE = "affine"
    DEFORMABLE = "deformable"


class Search(StrEnum):
    """The start orientations that were needed: 64 quarter turns, all orientations, or none."""

    EULER64 = "euler64"
    SO3 = "so3"
    NONE = "none"


class Verdict(StrEnum):
    """The quality of an alignment, in one word."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    FAILED = "failed"


USABLE = (Verdict.GOOD, Verdict.DOUBTFUL)
"""Verdicts of assets that trainings and exports take by default."""


class Status(StrEnum):
    """The result of an asset in a build."""

    OK = "ok"
    FAILED = "failed"
    SKIPPED = "skipped"


MAX_PROPERTIES, MAX_CHANNELS = 32, 256
"""Most columns of properties, and most channels of latents, of a store."""

MAX_LATENT_RESOLUTION = 256
"""Most voxels along each axis of a grid of latents: coordinates are bytes."""

PropertyName = Annotated[str, InJson({"type": "str", "pattern": r"^[a-z][a-z0-9_]{0,63}$"})]
"""Name of a property: lower-case letters, digits and ``_``, a letter first."""

CLASS_NAME = re.compile(r"[a-z][a-z0-9_ -]{0,63}")
ClassName = Annotated[str, InJson({"type": "str", "pattern": f"^{CLASS_NAME.pattern}$"})]
"""Name of a class: like a property's name, also with blanks and ``-``."""

_TITLES = {"youngs_modulus": "Young's modulus", "poissons_ratio": "Poisson's ratio"}
"""Names in plain English, if they are not the column's name with blanks."""


@dataclass(frozen=True)
class Property:
    """A property of a material.

    Attributes
    ----------
    name : str
        Its name, as a column of every table.
    unit : str
        SI unit of its values; ``1`` if it has none.
    log10 : bool
        Whether its log10 is normalised, so that values must be above 0, or the value itself.
    least, most : float
        Values that a material can have, ends included. Readers of sources need them; a store
        does not keep them.
    """

    name: PropertyName
    unit: str
    log10: bool
    least: float = field(default=-np.inf, compare=False)
    most: float = field(default=np.inf, compare=False)

    def physical(self, values: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return which values (K,) a material can have."""
        fine: NDArray[np.bool_] = np.isfinite(values)
        if self.log10:
            fine &= values > 0
        return fine & (values >= self.least) & (values <= self.most)

    @property
    def title(self) -> str:
        """Its name in plain English, for figures and sentences."""
        return _TITLES.get(self.name, self.name.replace("_", " "))

    @property
    def sign(self) -> str:
        """Its unit as figures show it; empty if it has none."""
        return "" if self.unit == "1" else self.unit.replace("^2", "²").replace("^3", "³")

    @property
    def allowed(self) -> str:
        """Its allowed values, in words."""
        bounds = f" in [{self.least:g}, {self.most:g}]" if np.isfinite(self.most) else ""
        above = " above 0" if self.log10 else ""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"a finite {self.title}{above}{bounds}{unit}"


PROPERTIES = (
    Property("youngs_modulus", "Pa", True),
    Property("density", "kg/m^3", True),
    Property("poissons_ratio", "1", False, 0.0, 0.5),
)
"""The three properties that PixieVerse annotates."""

PROPERTY_COLUMNS = tuple(one.name for one in PROPERTIES)
"""Their names, in the order of the columns of slatprep's tables."""


@dataclass(frozen=True)
class LatentMoments:
    """Mean and standard deviation of each channel of some latents, as stored."""

    mean: Annotated[tuple[float, ...], MaxLen(MAX_CHANNELS)]
    std: Annotated[tuple[float, ...], MaxLen(MAX_CHANNELS)]


@dataclass(frozen=True)
class LatentSpace:
    """The origin of latents, and the numbers that standardise them.

    Attributes
    ----------
    encoder : str
        The encoder: ``trellis``, or the user's name for another.
    channels : int
        Numbers per voxel.
    resolution : int
        Voxels along each axis of its grid.
    mean, std : tuple of float
        Moments of each channel before standardisation. If they are empty, as unpublished, a build
        measures its dataset's.
    standardised : bool
        Whether the latents, as stored, are standardised already.
    """

    encoder: str
    channels: Annotated[int, Ge(1), Le(MAX_CHANNELS)]
    resolution: Annotated[int, Ge(2), Le(MAX_LATENT_RESOLUTION)]
    mean: tuple[float, ...] = ()
    std: tuple[float, ...] = ()
    standardised: bool = False

    def __post_init__(self) -> None:
        counts = {len(self.mean), len(self.std)}
        if counts not in ({0}, {self.channels}) or not all(s > 0 for s in self.std):
            raise ValueError(f"a mean and a std above 0 for each of {self.channels} channels")

    @property
    def beside_voxels(self) -> dict[str, NDArray[np.int64]]:
        """Entries of an npz beside its voxels: their ``resolution``, unless it is the frames'."""
        return {} if self.resolution == RESOLUTION else {"resolution": np.array(self.resolution)}

    def standardise(self, feats: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return latents (N, channels) standardised; unchanged if they are already."""
        if self.standardised:
            return feats
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        return np.asarray((feats - mean) / std)

    def as_encoded(self, feats: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return latents (N, channels) as the encoder gives them, if its moments are known."""
        if not self.standardised or not self.mean:
            return feats
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        return np.asarray(feats * std + mean)


TRELLIS = LatentSpace("trellis", 8, RESOLUTION, FEATS_MEAN, FEATS_STD)
"""TRELLIS's structured latents; SAM 3D Objects has the same."""


def labels_of(classes: tuple[str, ...]) -> tuple[str, ...]:
    """Return the classes that a voxel may have, by id: for PhysGaussian's, all but the background.

    ValueError if a store cannot hold so many, their names are not unique, or one is background.
    """
    if classes == MATERIAL_CLASSES:
        return classes[:BACKGROUND]
    if len({*classes, "background"}) != len(classes) + 1:
        raise ValueError("classes must have a name each, none of them background")
    if len(classes) > MANY_BACKGROUND:
        raise ValueError(f"there are {len(classes)} classes, and at most {MANY_BACKGROUND} can be")
    return classes


@dataclass(frozen=True)
class Contents:
    """Contents of a dataset; without classes, every annotated voxel is of class 0."""

    properties: tuple[Property, ...] = PROPERTIES
    classes: tuple[str, ...] = MATERIAL_CLASSES
    latents: LatentSpace = TRELLIS

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of the classes that the arrays have, by id."""
        return labels_of(self.classes) or ("annotated",)

    @property
    def background(self) -> int:
        """Material id of an empty cell of the grid."""
        return BACKGROUND if len(self.labels) <= BACKGROUND else MANY_BACKGROUND

    @property
    def beside_labels(self) -> dict[str, NDArray[np.str_]]:
        """Entries of an npz beside its labels: their ``columns`` and, if any, ``classes``."""
        columns = {"columns": np.array([one.name for one in self.properties])}
        return columns | ({"classes": np.array(self.labels)} if self.classes else {})

    @property
    def n_labels(self) -> int:
        """The number of ids that voxels may have, all below the background's."""
        return max(len(self.labels), BACKGROUND)

    @property
    def n_classes(self) -> int:
        """The number of classes that a decoder scores; 1 without classes."""
        return max(len(self.classes), 1)


PIXIEVERSE = Contents()
"""PixieVerse with TRELLIS, the default everywhere."""
