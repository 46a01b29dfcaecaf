"""The column beside the panels of a picture: figures, histogram of errors, starts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slatprep.geometry.frames import split_transform
from slatprep.inspect.check import AlignmentCheck
from slatprep.inspect.pictures import canvas
from slatprep.inspect.pictures.canvas import size_of, write
from slatprep.inspect.pictures.scene import FARTHEST, Scene, distance_colours
from slatprep.records import RESOLUTION, Alignment, Search

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIDE_WIDTH, SIDE_MARGIN = 402, 48
"""Width of the column, and of the margin at its right, in pixels."""

SHOWN = {
    "confidence": "confidence",
    "expected_accuracy": "labels expected right",
    "fitness": "fitness, PixieVerse to SLAT",
    "inlier_rmse": "inlier rmse [voxel]",
    "fitness_backward": "fitness, SLAT to PixieVerse",
    "inlier_rmse_backward": "inlier rmse [voxel]",
    "overlap": "overlap",
    "valid_share": "valid share",
    "ambiguity": "class ambiguous",
    "margin": "margin",
}
"""The figures of a check on a picture: their names in the store, and what the picture says."""

_LINE = 21


def side_of(figure: Figure) -> float:
    """Return the left edge of the column in pixels."""
    return size_of(figure)[0] - SIDE_MARGIN - SIDE_WIDTH


def draw_figures(figure: Figure, check: AlignmentCheck, scene: Scene, y: float) -> float:
    """Write figures, thresholds and the size of the map; return the height of the last line."""
    left = side_of(figure)
    columns = (left, left + 275, left + SIDE_WIDTH)
    for x, name, ha in zip(columns, ("figure", "value", "good"), ("left", "right", "right"),
                           strict=True):  # fmt: skip
        write(figure, x, y, name, size=6.8, color=canvas.MUTED, ha=ha)
    _rule(figure, y + 7)
    rows = [one for name in SHOWN for one in check.figures if one.name == name]
    for number, one in enumerate(rows):
        line = y + 30 + _LINE * number
        worse = one.passes is False
        colour = canvas.VERDICT_COLOURS["failed"] if worse else canvas.INK
        write(figure, columns[0], line, SHOWN[one.name], size=7.5)
        # Adding 0 turns a rounded -0 into 0.
        value = "-" if np.isnan(one.value) else f"{round(one.value, 3) + 0.0:.3f}"
        write(figure, columns[1], line, value, size=7.5, ha="right", color=colour)
        limit = one.threshold_text.replace(">=", "\u2265").replace("<=", "\u2264")
        write(figure, columns[2] - 26, line, limit, size=7.5, ha="right", color=canvas.MUTED)
        if one.passes is not None:
            mark = "\u2717" if worse else "\u2713"
            good = canvas.VERDICT_COLOURS["failed" if worse else "good"]
            write(figure, columns[2], line, mark, size=7.5, ha="right", color=good)
    rotation, shift, scale = split_transform(check.transform)
    angle = np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))
    moved = np.linalg.norm(shift) * RESOLUTION
    words = f"turned {angle:.1f}°, shifted {moved:.2f} voxel, scaled {scale:.3f}"
    line = y + 36 + _LINE * len(rows)
    write(figure, left, line, words, size=7, color=canvas.MUTED)
    if scene.deformed is not None:
        apart = scene.deformed.displacement
        words = f"deformed by {apart.mean():.2f} voxel in the mean, {apart.max():.2f} at most"
        line += 17
        write(figure, left, line, words, size=7, color=canvas.MUTED)
    return line


def draw_histogram(figure: Figure, scene: Scene, radius: float, y: float) -> None:
    """Draw the histogram of errors, and as a line that of the errors before."""
    write(figure, side_of(figure), y, "error per SLAT surface voxel", weight="bold", size=8.5)
    share = float((scene.error <= radius).mean())
    before = "before" if scene.deformed is None else "undeformed"
    words = (
        f"median {np.median(scene.error):.2f} voxel, {share:.1%} within {radius:g}; line: {before}"
    )
    write(figure, side_of(figure), y + 20, words, size=7, color=canvas.MUTED)
    axes = _axes(figure, y + 36, 190)
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


def draw_candidates(figure: Figure, alignment: Alignment, y: float) -> None:
    """Draw the coarse fitness of each distinct start, the best first."""
    candidates = alignment.candidates
    write(figure, side_of(figure), y, "starts of the search", weight="bold", size=8.5)
    if not candidates:
        words = "none are recorded"
        write(figure, side_of(figure), y + 20, words, size=7, color=canvas.MUTED)
        return
    own = sorted((c for c in candidates if c.same_as is None), key=lambda c: (-c.fitness, c.index))
    words = f"{len(own)} distinct of {len(candidates)}, by coarse fitness"
    write(figure, side_of(figure), y + 20, words, size=7, color=canvas.MUTED)
    axes = _axes(figure, y + 36, 190)
    wide = alignment.search is Search.SO3
    colours = [canvas.RULE if wide else canvas.ACCENT] + [canvas.RULE] * (len(own) - 1)
    axes.bar(range(len(own)), [c.fitness for c in own], width=0.78, color=colours)
    axes.set_xlim(-0.8, max(len(own), 2) - 0.2)
    axes.set_ylim(0, 1)
    axes.set_yticks([0, 0.5, 1])
    best = own[0]
    if wide:
        name = "these fit poorly: all orientations were searched"
        axes.set_xticks([-0.4], [name], ha="left")
    elif best.euler_degrees is not None:
        name = "start at " + ", ".join(f"{angle:g}°" for angle in best.euler_degrees)
        axes.set_xticks([0], [name], ha="left")
    else:
        axes.set_xticks([])


def _axes(figure: Figure, y: float, height: float) -> Axes:
    width, whole = size_of(figure)
    left = side_of(figure) + 40
    box = (left / width, 1 - (y + height) / whole, (SIDE_WIDTH - 40) / width, height / whole)
    axes = figure.add_axes(box)
    axes.tick_params(length=2.5, width=0.6)
    for spine in axes.spines.values():
        spine.set_linewidth(0.6)
    return axes


def _rule(figure: Figure, y: float) -> None:
    from matplotlib.lines import Line2D

    width, height = size_of(figure)
    ends = [side_of(figure) / width, (side_of(figure) + SIDE_WIDTH) / width]
    figure.add_artist(Line2D(ends, [1 - y / height] * 2, color=canvas.RULE, linewidth=0.8))
