"""The picture of one alignment: before, after, labels and error from three directions."""

from __future__ import annotations

import textwrap
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from slatprep.inspect.check import AlignmentCheck
from slatprep.inspect.pictures import canvas
from slatprep.inspect.pictures.canvas import draw_image, draw_legend, new_figure, size_of, write
from slatprep.inspect.pictures.scene import (
    Deformed,
    Placed,
    Scene,
    class_colours,
    distance_colours,
    rgb,
    views,
)
from slatprep.inspect.pictures.side import draw_candidates, draw_figures, draw_histogram, side_of
from slatprep.inspect.pictures.voxels import Drawing, View, draw_voxels
from slatprep.records import MATERIAL_CLASSES, MATERIAL_COLOURS, Alignment

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 1800, 1140
"""Pixels of a picture of four columns."""

PANEL = 300
_LEFT, _TOP, _GAP = 48, 142, 14
_MOST_LINES = 10
"""Most lines of reasons in the column at the right."""

COLUMNS = (
    ("before", "PixieVerse classes, SLAT outlined"),
    ("after", "PixieVerse moved, SLAT outlined"),
    ("result", "SLAT voxels by class received"),
    ("error", "distance to PixieVerse, scale at right"),
)
"""Heading of each column of a picture, and what it shows."""

DEFORMED_COLUMNS = (
    COLUMNS[0],
    ("similarity", "PixieVerse moved, SLAT outlined"),
    ("deformed", "as the SLAT's voxels look it up"),
    ("displacement", "by the deformation, scale below"),
    *COLUMNS[2:],
)
"""The same for an alignment with a deformation."""

TIED_COLUMN = ("another", "placement that fits about as well")
"""Stands before the last two columns where placements are tied."""


def columns_of(scene: Scene) -> tuple[tuple[str, str], ...]:
    """Return the columns of an asset's picture."""
    columns = COLUMNS if scene.deformed is None else DEFORMED_COLUMNS
    tied = () if scene.tied is None else (TIED_COLUMN,)
    return (*columns[:-2], *tied, *columns[-2:])


def draw_alignment(
    scene: Scene,
    check: AlignmentCheck,
    title: str,
    subtitle: str,
    alignment: Alignment,
    finer: int = 1,
) -> Figure:
    """Draw an alignment as a figure of `WIDTH` x `HEIGHT` pixels, wider by its further columns.

    If other placements are tied, the best of them is shown as well. A pixel of the figure has
    `finer` pixels of a panel along each edge. The figure must be drawn and saved within
    `slatprep.inspect.pictures.canvas.STYLE`.
    """
    if alignment.open_placements:
        best = max(alignment.open_placements, key=lambda placement: placement.score)
        scene = replace(scene, tied=best.transform)
    further = len(columns_of(scene)) - len(COLUMNS)
    figure = new_figure(WIDTH + further * (PANEL + _GAP), HEIGHT)
    reasons = _head(figure, check, title, subtitle)
    _panels(figure, scene, finer)
    _legend(figure, scene)
    tops = [_TOP + row * (PANEL + _GAP) for row in range(3)]
    # Long reasons move the blocks below them down.
    figures = draw_figures(figure, check, scene, max(tops[0], reasons + 26))
    histogram = max(tops[1] + 12, figures + 44)
    draw_histogram(figure, scene, check.radius, histogram)
    draw_candidates(figure, alignment, max(tops[2] + 12, histogram + 290))
    return figure


def outlined(scene: Scene, view: View, *sets: Placed) -> list[NDArray[np.float64]]:
    """Draw voxel sets by class, each over the outlined SLAT, as pictures (n, n, 3) in 0..1.

    The SLAT is pale where the set does not cover it.
    """
    grey = np.broadcast_to(rgb(canvas.RULE), (len(scene.slat), 3))
    slat = draw_voxels(scene.slat, grey, np.eye(4), view, contrast=0.5)
    pale = 0.45 + 0.55 * slat.rgb
    line = _outline(slat)[..., None]
    pictures = []
    for voxels, material, transform in sets:
        field = draw_voxels(voxels, class_colours(material), transform, view)
        cover = field.cover[..., None]
        image = field.rgb * cover + pale * (1 - cover)
        pictures.append(image * (1 - line) + rgb(canvas.INK) * line)
    return pictures


def error_picture(scene: Scene, view: View) -> NDArray[np.float64]:
    """Draw the SLAT's surface coloured by each voxel's error, (n, n, 3) in 0..1."""
    colours = distance_colours(scene.error)
    return draw_voxels(scene.surface, colours, np.eye(4), view, contrast=0.35).rgb


def panels(scene: Scene, view: View) -> tuple[NDArray[np.float64], ...]:
    """Draw one row of a picture: `columns_of` it, each (n, n, 3) in 0..1."""
    field = scene.pixieverse, scene.pixieverse_material
    sets: list[Placed] = [(*field, np.eye(4)), (*field, scene.transform)]
    moved = []
    if scene.deformed is not None:
        sets.append(scene.placed)
        shares = scene.deformed.displacement
        colours = distance_colours(shares, displacement_scale(scene.deformed))
        moved.append(draw_voxels(scene.slat, colours, np.eye(4), view, contrast=0.35).rgb)
    result = draw_voxels(scene.slat, class_colours(scene.slat_material), np.eye(4), view)
    tied = [] if scene.tied is None else outlined(scene, view, (*field, scene.tied))
    shown = *outlined(scene, view, *sets), *moved, *tied
    return (*shown, result.rgb, error_picture(scene, view))


def displacement_scale(deformed: Deformed) -> float:
    """Return the end of the scale of displacements: the largest one, rounded up to a voxel."""
    return max(float(np.ceil(deformed.displacement.max())), 1.0)


def _outline(drawing: Drawing) -> NDArray[np.float64]:
    """Return the outline of a drawing, about two pixels wide."""
    cover = np.pad(drawing.cover, 2)
    n = len(drawing.cover)
    disc = [(1, 2), (2, 1), (2, 3), (3, 2), (2, 2), (1, 1), (1, 3), (3, 1), (3, 3)]
    shifted = np.stack([cover[y : y + n, x : x + n] for y, x in disc])
    return np.asarray(np.clip(shifted.max(axis=0) - shifted.min(axis=0), 0, 1))


def _panels(figure: Figure, scene: Scene, finer: int) -> None:
    for column, (name, meaning) in enumerate(columns_of(scene)):
        x = _LEFT + column * (PANEL + _GAP)
        write(figure, x, _TOP - 30, name, weight="bold", size=9)
        write(figure, x, _TOP - 10, meaning, color=canvas.MUTED, size=6.8)
    for row, view in enumerate(views(scene, finer * PANEL)):
        y = _TOP + row * (PANEL + _GAP)
        for column, image in enumerate(panels(scene, view)):
            draw_image(figure, _LEFT + column * (PANEL + _GAP), y, image, finer)
        _axes_triad(figure, view, _LEFT + 6, y + PANEL - 34)


def _axes_triad(figure: Figure, view: View, x: float, y: float) -> None:
    from matplotlib.lines import Line2D

    width, height = size_of(figure)
    for k, name in enumerate("xyz"):
        dx, dy = 20 * view.rotation[:2, k]
        line = [(x + 12) / width, (x + 12 + dx) / width], [1 - y / height, 1 - (y - dy) / height]
        figure.add_artist(Line2D(*line, color=canvas.MUTED, linewidth=0.8))
        write(
            figure, x + 12 + 1.45 * dx, y - 1.45 * dy, name, size=6, color=canvas.MUTED,
            ha="center", va="center_baseline",
        )  # fmt: skip


def _head(figure: Figure, check: AlignmentCheck, title: str, subtitle: str) -> int:
    """Write title, verdict and reasons; return the height of the last reason."""
    colour, bold = canvas.VERDICT_COLOURS[check.verdict], {"weight": "bold", "size": 13}
    write(figure, _LEFT, 50, title, **bold)
    write(figure, _LEFT, 76, subtitle, size=7.5, color=canvas.MUTED)
    write(figure, side_of(figure), 50, f"alignment {check.verdict}", color=colour, **bold)
    reasons = list(check.words)
    if not check.consistent:
        reasons.append("the store's figures do not all agree with its voxels")
    lines = [line for reason in reasons for line in textwrap.wrap(reason, 51)]
    if len(lines) > _MOST_LINES:
        lines = [*lines[: _MOST_LINES - 1], "and more: `slatprep check-alignment` prints all"]
    for number, line in enumerate(lines):
        write(figure, side_of(figure), 74 + 17 * number, line, size=7, color=canvas.MUTED)
    return 74 + 17 * (len(lines) - 1)


def _legend(figure: Figure, scene: Scene) -> None:
    y = _TOP + 3 * (PANEL + _GAP) + 12
    present = np.union1d(scene.pixieverse_material, scene.slat_material)
    share = np.bincount(scene.slat_material, minlength=256) / max(len(scene.slat_material), 1)
    if len(present) > len(MATERIAL_CLASSES):  # Perhaps not all find room: the largest do.
        present = present[np.argsort(-share[present], kind="stable")]
    names = [*scene.labels, *["no annotation"] * (256 - len(scene.labels))]
    entries = [(f"{names[k]}  {share[k]:.1%}", MATERIAL_COLOURS[int(k)]) for k in present]
    columns = 4 if scene.deformed is None else 3  # The fourth is above the scale.
    end = _LEFT + columns * (PANEL + _GAP) - _GAP
    words = "share of the SLAT voxels"
    draw_legend(figure, entries, (_LEFT, y, end - 190), edgecolor=canvas.MUTED, linewidth=0.5)
    write(figure, end, y, words, size=6.8, color=canvas.MUTED, ha="right")
    if scene.deformed is not None:
        _scale(figure, displacement_scale(scene.deformed), _LEFT + 3 * (PANEL + _GAP), y)


def _scale(figure: Figure, farthest: float, x: int, y: int) -> None:
    """Draw the colour scale of displacements, 0 to `farthest` voxels, below their column."""
    along = np.linspace(0.0, farthest, PANEL)
    bar = np.broadcast_to(distance_colours(along, farthest)[None], (10, PANEL, 3))
    draw_image(figure, x, y - 9, bar)
    ends = ((x, "0", "left"), (x + PANEL / 2, f"{farthest / 2:g}", "center"),
            (x + PANEL, f"{farthest:g} voxels", "right"))  # fmt: skip
    for at, words, ha in ends:
        write(figure, at, y + 17, words, size=6.8, color=canvas.MUTED, ha=ha)
