"""Draw one alignment: before, after, labels and error from three directions.

The column at the right has figures, a histogram of errors, and the starts of the search.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from slatprep.align.consensus import degrees_between
from slatprep.align.starts import euler_starts
from slatprep.geometry.frames import split_transform
from slatprep.inspect.check import AlignmentCheck
from slatprep.inspect.pictures import canvas
from slatprep.inspect.pictures.scene import (
    FARTHEST,
    Placed,
    Scene,
    class_colours,
    distance_colours,
    rgb,
    views,
)
from slatprep.inspect.pictures.voxels import Drawing, View, draw_voxels
from slatprep.records import (
    MATERIAL_CLASSES,
    MATERIAL_COLOURS,
    RESOLUTION,
    Alignment,
    Candidate,
    Search,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 1800, 1140
"""Width and height, in pixels, of a picture with four columns."""

PANEL = 300
_LEFT, _TOP, _GAP = 48, 142, 14
_MOST_LINES = 10
"""Largest number of lines of reasons in the column at the right."""

COLUMNS = {
    "before": "PixieVerse classes, SLAT outlined",
    "after": "PixieVerse moved, SLAT outlined",
    "similarity": "PixieVerse moved, SLAT outlined",
    "deformed": "as the SLAT's voxels look it up",
    "displacement": "by the deformation, scale below",
    "another": "placement that fits about as well",
    "result": "SLAT voxels by class received",
    "error": "distance to PixieVerse, scale at right",
}
"""Note below the heading of each possible column, by heading, from left to right."""


_SIDE_WIDTH, _SIDE_MARGIN = 402, 48
"""Width of the column at the right, and of the margin beside it, in pixels."""

_SHOWN = ("confidence", "expected_accuracy", "fitness", "inlier_rmse", "fitness_backward",
          "inlier_rmse_backward", "overlap", "valid_share", "ambiguity", "margin")  # fmt: skip
"""Names of the check's figures that a picture shows."""

_LINE = 21


def draw_alignment(
    scene: Scene,
    check: AlignmentCheck,
    title: str,
    subtitle: str,
    alignment: Alignment,
    finer: int = 1,
) -> Figure:
    """Draw an alignment as a figure of `WIDTH` x `HEIGHT` pixels; columns beyond four widen it.

    Panels have `finer` pixels per pixel of the figure along each edge. The figure must be drawn
    and saved within `slatprep.inspect.pictures.canvas.styled`.
    """
    if alignment.open_placements:
        best = max(alignment.open_placements, key=lambda placement: placement.score)
        scene = replace(scene, tied=best.transform)
    rows = [(view, panels(scene, view)) for view in views(scene, finer * PANEL)]
    width = WIDTH + (len(rows[0][1]) - 4) * (PANEL + _GAP)
    figure = canvas.new_figure(width, HEIGHT)
    left = width - _SIDE_MARGIN - _SIDE_WIDTH
    reasons = _head(figure, check, title, subtitle, left)
    _panels(figure, rows, finer)
    _legend(figure, scene)
    tops = [_TOP + row * (PANEL + _GAP) for row in range(3)]
    # Long reasons move the blocks below them down.
    last = _figures(figure, check, scene, left, max(tops[0], reasons + 26))
    errors = max(tops[1] + 12, last + 44)
    _histogram(figure, scene, check.radius, left, errors)
    _candidates(figure, alignment, left, max(tops[2] + 12, errors + 290))
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


def panels(scene: Scene, view: View) -> dict[str, NDArray[np.float64]]:
    """Draw one row of panels (n, n, 3) in 0..1, by the `COLUMNS` that the picture has."""
    sets = {"before": scene.before, "after": scene.after}
    if scene.deformed is not None:
        sets = {"before": scene.before, "similarity": scene.after, "deformed": scene.deformed}
    if scene.tied is not None:
        sets["another"] = scene.before._replace(transform=scene.tied)
    drawn = dict(zip(sets, outlined(scene, view, *sets.values()), strict=True))
    if scene.deformed is not None:
        colours = distance_colours(scene.displacement, scene.displacement_scale)
        moved = draw_voxels(scene.slat, colours, np.eye(4), view, contrast=0.35)
        drawn["displacement"] = moved.rgb
    result = draw_voxels(scene.slat, class_colours(scene.slat_material), np.eye(4), view)
    drawn |= {"result": result.rgb, "error": error_picture(scene, view)}
    return {name: drawn[name] for name in COLUMNS if name in drawn}


def _outline(drawing: Drawing) -> NDArray[np.float64]:
    """Return the outline of a drawing, about two pixels wide."""
    from scipy.ndimage import maximum_filter, minimum_filter

    most, least = (f(drawing.cover, 3, mode="constant") for f in (maximum_filter, minimum_filter))
    return np.asarray(most - least)


def _panels(
    figure: Figure, rows: list[tuple[View, dict[str, NDArray[np.float64]]]], finer: int
) -> None:
    for row, (view, images) in enumerate(rows):
        y = _TOP + row * (PANEL + _GAP)
        for column, (name, image) in enumerate(images.items()):
            x = _LEFT + column * (PANEL + _GAP)
            canvas.draw_image(figure, x, y, image, finer)
            if row == 0:
                canvas.write(figure, x, y - 30, name, weight="bold", size=9)
                canvas.note(figure, x, y - 10, COLUMNS[name], 6.8)
        _axes_triad(figure, view, _LEFT + 6, y + PANEL - 34)


def _axes_triad(figure: Figure, view: View, x: float, y: float) -> None:
    for k, name in enumerate("xyz"):
        dx, dy = 20 * view.rotation[:2, k]
        canvas.draw_line(figure, x + 12, y, (x + 12 + dx, y - dy), canvas.MUTED)
        at = x + 12 + 1.45 * dx, y - 1.45 * dy
        canvas.note(figure, *at, name, 6, ha="center", va="center_baseline")


def _head(figure: Figure, check: AlignmentCheck, title: str, subtitle: str, left: float) -> int:
    """Write title, verdict and reasons; return y of the last reason, in pixels from the top."""
    colour, bold = canvas.VERDICT_COLOURS[check.verdict], {"weight": "bold", "size": 13}
    canvas.write(figure, _LEFT, 50, title, **bold)
    canvas.note(figure, _LEFT, 76, subtitle, 7.5)
    canvas.write(figure, left, 50, f"alignment {check.verdict}", color=colour, **bold)
    reasons = [*check.words, *(f"unusual: {words}" for words in check.unusual)]
    if not check.consistent:
        reasons.append("the store's figures do not all agree with its voxels")
    lines = [line for reason in reasons for line in textwrap.wrap(reason, 51)]
    if len(lines) > _MOST_LINES:
        lines = [*lines[: _MOST_LINES - 1], "and more: `slatprep check-alignment` prints all"]
    for number, line in enumerate(lines):
        canvas.note(figure, left, 74 + 17 * number, line)
    return 74 + 17 * (len(lines) - 1)


def _legend(figure: Figure, scene: Scene) -> None:
    y = _TOP + 3 * (PANEL + _GAP) + 12
    present = np.union1d(scene.before.material, scene.slat_material)
    share = np.bincount(scene.slat_material, minlength=256) / max(len(scene.slat_material), 1)
    if len(present) > len(MATERIAL_CLASSES):  # Not all may fit: the largest come first.
        present = present[np.argsort(-share[present], kind="stable")]
    names = [*scene.labels, *["not valid"] * (256 - len(scene.labels))]
    entries = [(f"{names[k]}  {share[k]:.1%}", MATERIAL_COLOURS[int(k)]) for k in present]
    columns = 4 if scene.deformed is None else 3  # The scale takes the place below the fourth.
    canvas.note(figure, _LEFT, y, "share of the SLAT voxels:", 6.8)
    box = _LEFT + 190, y, _LEFT + columns * (PANEL + _GAP) - _GAP
    canvas.draw_legend(figure, entries, box, edgecolor=canvas.MUTED, linewidth=0.5)
    if scene.deformed is not None:
        _scale(figure, scene.displacement_scale, _LEFT + 3 * (PANEL + _GAP), y)


def _scale(figure: Figure, farthest: float, x: int, y: int) -> None:
    """Draw the colour scale of displacements, 0 to `farthest` voxels, below their column."""
    along = np.linspace(0.0, farthest, PANEL)
    bar = np.broadcast_to(distance_colours(along, farthest)[None], (10, PANEL, 3))
    canvas.draw_image(figure, x, y - 9, bar)
    words = ("0", f"{farthest / 2:g}", f"{farthest:g} voxels")
    for k, ha in enumerate(("left", "center", "right")):
        canvas.note(figure, x + k * PANEL / 2, y + 17, words[k], 6.8, ha=ha)


def _figures(figure: Figure, check: AlignmentCheck, scene: Scene, left: float, y: float) -> float:
    """Write figures, thresholds and the extent of the map; return y of the last line, in pixels."""
    columns = (left, left + 312, left + _SIDE_WIDTH)
    for x, name in zip(columns, ("figure", "value", "good"), strict=True):
        canvas.note(figure, x, y, name, 6.8, ha="left" if x == left else "right")
    canvas.draw_line(figure, left, y + 7, (left + _SIDE_WIDTH, y + 7), canvas.RULE)
    rows = [one for name in _SHOWN for one in check.figures if one.name == name]
    for number, one in enumerate(rows):
        line = y + 30 + _LINE * number
        worse = one.passes is False
        colour = canvas.VERDICT_COLOURS["failed"] if worse else canvas.INK
        unit = " [voxel]" if one.name.startswith("inlier_rmse") else ""
        canvas.write(figure, columns[0], line, f"{one.name}{unit}", size=7.5)
        # As the table has it; adding 0 turns -0 into 0.
        form = ".1e" if 0 < abs(one.value) < 5e-4 else ".3f"
        value = "-" if np.isnan(one.value) else f"{one.value + 0.0:{form}}"
        canvas.write(figure, columns[1], line, value, size=7.5, ha="right", color=colour)
        limit = one.threshold_text.replace(">=", "\u2265").replace("<=", "\u2264")
        canvas.note(figure, columns[2] - 26, line, limit, 7.5, ha="right")
        if one.passes is not None:
            mark = "\u2717" if worse else "\u2713"
            good = canvas.VERDICT_COLOURS["failed" if worse else "good"]
            canvas.write(figure, columns[2], line, mark, size=7.5, ha="right", color=good)
    rotation, shift, scale = split_transform(check.transform)
    angle = degrees_between(rotation, np.eye(3))
    moved = np.linalg.norm(shift) * RESOLUTION
    words = f"turned {angle:.1f}°, shifted {moved:.2f} voxel, scaled {scale:.3f}"
    line = y + 36 + _LINE * len(rows)
    canvas.note(figure, left, line, words)
    if scene.deformed is not None:
        apart = scene.displacement
        words = f"deformed by {apart.mean():.2f} voxel in the mean, {apart.max():.2f} at most"
        line += 17
        canvas.note(figure, left, line, words)
    return line


def _histogram(figure: Figure, scene: Scene, radius: float, left: float, y: float) -> None:
    """Draw the histogram of errors as bars, and that of the errors before as a line."""
    share = float((scene.error <= radius).mean())
    heading, before = "error per SLAT surface voxel", "before"
    if scene.deformed is not None:
        heading, before = "error per voxel after the deformation", "before it"
    words = (
        f"median {np.median(scene.error):.2f} voxel, {share:.1%} within {radius:g}; line: {before}"
    )
    axes = _plot(figure, left, y, heading, words)
    edges = np.linspace(0, FARTHEST, 31)
    middles = (edges[:-1] + edges[1:]) / 2
    shares = [
        np.histogram(np.minimum(error, FARTHEST - 1e-9), edges)[0] / len(error)
        for error in (scene.error, scene.error_before)
    ]
    axes.bar(middles, shares[0], width=edges[1] * 0.92, color=distance_colours(middles).tolist(),
             edgecolor=canvas.MUTED, linewidth=0.3)  # fmt: skip
    axes.stairs(shares[1], edges, color=canvas.MUTED, linewidth=0.8)
    axes.set_ylim(0, 1.15 * max(share.max() for share in shares))
    axes.axvline(radius, color=canvas.INK, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.set_xlim(0, FARTHEST)
    axes.set_xticks(range(int(FARTHEST) + 1), ["0", "1 voxel", "2", f"\u2265 {FARTHEST:g}"])
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
    axes.locator_params(axis="y", nbins=3)


def _candidates(figure: Figure, alignment: Alignment, left: float, y: float) -> None:
    """Draw the coarse fitness of each distinct start, the best first."""
    candidates, heading = alignment.candidates, "starts of the search"
    if not candidates:
        _heading(figure, left, y, heading, "none are recorded")
        return
    own = sorted((c for c in candidates if c.same_as is None), key=lambda c: (-c.fitness, c.index))
    words = f"{len(own)} distinct of {len(candidates)}, by coarse fitness"
    axes = _plot(figure, left, y, heading, words)
    wide = alignment.search is Search.SO3
    taken = None if wide else _nearest_start(alignment, own)
    colours = [canvas.ACCENT if k == taken else canvas.RULE for k in range(len(own))]
    axes.bar(range(len(own)), [c.fitness for c in own], width=0.78, color=colours)
    axes.set_xlim(-0.8, max(len(own), 2) - 0.2)
    axes.set_ylim(0, 1)
    axes.set_yticks([0, 0.5, 1])
    if wide:
        name = "quarter turns fit poorly, so all orientations"
        name += "\nwere searched: look whether the result fits"
        axes.set_xticks([-0.4], [name], ha="left")
    elif taken is not None:
        angles = own[taken].euler_degrees or ()
        name = "nearest start: " + ", ".join(f"{angle:g}°" for angle in angles)
        axes.set_xticks([taken], [name], ha="left" if taken < len(own) / 2 else "right")
    else:
        axes.set_xticks([])


def _nearest_start(alignment: Alignment, starts: Sequence[Candidate]) -> int | None:
    """Return which start is nearest to the alignment's rotation; it need not fit best.

    Other placements may fit about as well, and consensus or latents may choose one. None if the
    starts have no angles.
    """
    rotation = split_transform(alignment.transform)[0]
    named = {one.index: one.rotation for one in euler_starts()}
    apart = [
        math.inf if one.euler_degrees is None else degrees_between(named[one.index], rotation)
        for one in starts
    ]
    nearest = int(np.argmin(apart))
    return nearest if math.isfinite(apart[nearest]) else None


def _heading(figure: Figure, left: float, y: float, heading: str, words: str) -> None:
    canvas.write(figure, left, y, heading, weight="bold", size=8.5)
    canvas.note(figure, left, y + 20, words)


def _plot(figure: Figure, left: float, y: float, heading: str, words: str) -> Axes:
    """Write a heading in the column at the right; return axes below it."""
    _heading(figure, left, y, heading, words)
    axes = canvas.add_axes(figure, left + 40, y + 36, _SIDE_WIDTH - 40, 190)
    axes.tick_params(length=2.5, width=0.6)
    for spine in axes.spines.values():
        spine.set_linewidth(0.6)
    return axes
