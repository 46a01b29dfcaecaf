"""The words and constants that all records share: classes, colours, engines, verdicts."""

from __future__ import annotations

from collections.abc import Collection
from colorsys import hls_to_rgb
from enum import StrEnum

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

They stay apart for people who do not tell red from green, or blue from green:
simulated after Machado, Oliveira and Fernandes ("A Physiologically-based Model
for Simulation of Color Vision Deficiency", IEEE TVCG 2009), any two of them
differ by more than 20 in CIELAB.
"""


MATERIAL_CLASSES = tuple(CLASS_COLOURS)
"""PhysGaussian's material classes, by id."""


UNANNOTATED_COLOUR = "#FFFFFF"
"""Colour of an occupied voxel without an annotation."""


def _colour_beyond(index: int) -> str:
    """Return a colour for a class beyond PhysGaussian's, unlike those before it."""
    # Steps of the golden ratio cover all hues and never repeat one.
    hue, lightness = index * 0.618034 % 1.0, (0.35, 0.5, 0.65)[index % 3]
    return "#" + "".join(f"{round(255 * c):02X}" for c in hls_to_rgb(hue, lightness, 0.6))


MATERIAL_COLOURS = {
    **{index: CLASS_COLOURS[name] for index, name in enumerate(MATERIAL_CLASSES)},
    **{index: _colour_beyond(index) for index in range(len(MATERIAL_CLASSES), MANY_BACKGROUND)},
    UNANNOTATED: UNANNOTATED_COLOUR,
}
"""The same by material id, as the store holds it; of more classes, the others' from 8 on."""


def words_of(given: Collection[str]) -> Collection[str]:
    """Return words of which one alone may be given as a text."""
    return (given,) if isinstance(given, str) else given


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
"""Verdicts of assets that go into trainings and exports unless others are asked for."""


class Status(StrEnum):
    """The result of an asset in a build."""

    OK = "ok"
    FAILED = "failed"
    SKIPPED = "skipped"
