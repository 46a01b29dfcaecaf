"""The picture of one alignment: before, after, labels and error from three directions."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slatprep.geometry.frames import split_transform
from slatprep.inspect.check import AlignmentCheck
from slatprep.inspect.pictures import palette
from slatprep.inspect.pictures.scene import (
    FARTHEST,
    Scene,
    class_colours,
    distance_colours,
    rgb,
    views,
)
from slatprep.inspect.pictures.voxels import Drawing, View, draw_voxels
from slatprep.records import MATERIAL_CLASSES, MATERIAL_COLOURS, RESOLUTION, UNANNOTATED, Candidate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 1800, 1140
"""Pixels of a picture."""

DPI = 150
PANEL = 300
_LEFT, _TOP, _GAP = 48, 142, 14
_SIDE = 1350
_SIDE_WIDTH = WIDTH - _SIDE - 48

COLUMNS = (
    ("before", "PixieVerse classes, SLAT outlined"),
    ("after", "PixieVerse moved, SLAT outlined"),
    ("result", "SLAT voxels by class received"),
    ("error", "distance to PixieVerse, scale at right"),
)
"""Heading of each column of a picture, and what it shows."""


def draw_alignment(
    scene: Scene,
    check: AlignmentCheck,
    title: str,
    subtitle: str,
    candidates: Sequence[Candidate] | str,
) -> bytes:
    """Draw an alignment as a PNG.

    Parameters
    ----------
    scene : Scene
        From `slatprep.inspect.pictures.scene.scene_of`.
    check : AlignmentCheck
        Its verdict and figures.
    title, subtitle : str
        What the asset is.
    candidates : sequence of Candidate, or str
        The starts and their scores; in their place, why they are not known.

    Returns
    -------
    bytes
        A PNG of `WIDTH` x `HEIGHT` pixels; the same for the same arguments.
    """
    import matplotlib.style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # A user's matplotlibrc must not change the picture.
    with matplotlib.style.context(["default", STYLE]):
        figure = Figure(figsize=(WIDTH / DPI, HEIGHT / DPI), dpi=DPI)
        FigureCanvasAgg(figure)
        _head(figure, check, title, subtitle)
        _panels(figure, scene)
        _legend(figure, scene)
        tops = [_TOP + row * (PANEL + _GAP) for row in range(3)]
        _figures(figure, check, tops[0])
        _histogram(figure, scene, check.radius, tops[1] + 12)
        _candidates(figure, candidates, tops[2] + 12)
        return png_of(figure)


STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "text.color": palette.INK,
    "axes.edgecolor": palette.RULE,
    "axes.labelcolor": palette.MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": palette.RULE,
    "ytick.color": palette.RULE,
    "xtick.labelcolor": palette.MUTED,
    "ytick.labelcolor": palette.MUTED,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "figure.facecolor": palette.PAPER,
}
"""How matplotlib draws here."""


def png_of(figure: Figure) -> bytes:
    """Return a figure as a PNG that holds nothing but the picture."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=figure.dpi, metadata={"Software": None})
    return buffer.getvalue()


def outlined(scene: Scene, view: View, *transforms: ArrayLike) -> list[NDArray[np.float64]]:
    """Draw the PixieVerse set by class where each transform puts it, over the outlined SLAT.

    Returns
    -------
    list of ndarray of float64, shape (n, n, 3)
        A picture in 0..1 a transform; the SLAT is pale where nothing covers it.
    """
    grey = np.broadcast_to(rgb(palette.RULE), (len(scene.slat), 3))
    slat = draw_voxels(scene.slat, grey, np.eye(4), view, contrast=0.5)
    pale = 0.45 + 0.55 * slat.rgb
    line = _outline(slat)[..., None]
    colours = class_colours(scene.pixieverse_material)
    pictures = []
    for transform in transforms:
        field = draw_voxels(scene.pixieverse, colours, transform, view)
        cover = field.cover[..., None]
        image = field.rgb * cover + pale * (1 - cover)
        pictures.append(image * (1 - line) + rgb(palette.INK) * line)
    return pictures


def error_picture(scene: Scene, view: View) -> NDArray[np.float64]:
    """Draw the SLAT's surface by the error of each voxel, nearly unshaded, (n, n, 3) in 0..1."""
    colours = distance_colours(scene.error)
    return draw_voxels(scene.surface, colours, np.eye(4), view, contrast=0.35).rgb


def panels(scene: Scene, view: View) -> tuple[NDArray[np.float64], ...]:
    """Draw one direction: before, after, result and error, each (n, n, 3) in 0..1."""
    result = draw_voxels(scene.slat, class_colours(scene.slat_material), np.eye(4), view)
    return (
        *outlined(scene, view, np.eye(4), scene.transform),
        result.rgb,
        error_picture(scene, view),
    )


def _outline(drawing: Drawing) -> NDArray[np.float64]:
    """Return a line of about two pixels along the edge of what a drawing covers."""
    cover = np.pad(drawing.cover, 2)
    n = len(drawing.cover)
    disc = [(1, 2), (2, 1), (2, 3), (3, 2), (2, 2), (1, 1), (1, 3), (3, 1), (3, 3)]
    shifted = np.stack([cover[y : y + n, x : x + n] for y, x in disc])
    line: NDArray[np.float64] = np.clip(shifted.max(axis=0) - shifted.min(axis=0), 0, 1)
    return line


def _panels(figure: Figure, scene: Scene) -> None:
    for column, (name, meaning) in enumerate(COLUMNS):
        x = _LEFT + column * (PANEL + _GAP)
        _text(figure, x, _TOP - 30, name, weight="bold", size=9)
        _text(figure, x, _TOP - 10, meaning, color=palette.MUTED, size=6.8)
    for row, view in enumerate(views(scene, PANEL)):
        y = _TOP + row * (PANEL + _GAP)
        for column, image in enumerate(panels(scene, view)):
            x = _LEFT + column * (PANEL + _GAP)
            pixels = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
            figure.figimage(pixels, xo=x, yo=HEIGHT - y - PANEL, origin="upper")
        _axes_triad(figure, view, _LEFT + 6, y + PANEL - 34)


def _axes_triad(figure: Figure, view: View, x: float, y: float) -> None:
    from matplotlib.lines import Line2D

    for k, name in enumerate("xyz"):
        dx, dy = 20 * view.rotation[:2, k]
        line = [(x + 12) / WIDTH, (x + 12 + dx) / WIDTH], [1 - y / HEIGHT, 1 - (y - dy) / HEIGHT]
        figure.add_artist(Line2D(*line, color=palette.MUTED, linewidth=0.8))
        _text(
            figure, x + 12 + 1.45 * dx, y - 1.45 * dy, name, size=6, color=palette.MUTED,
            ha="center", va="center_baseline",
        )  # fmt: skip


def _head(figure: Figure, check: AlignmentCheck, title: str, subtitle: str) -> None:
    _text(figure, _LEFT, 50, title, weight="bold", size=13)
    _text(figure, _LEFT, 76, subtitle, size=7.5, color=palette.MUTED)
    colour = palette.VERDICT_COLOURS[check.verdict]
    _text(figure, _SIDE, 50, f"alignment {check.verdict}", weight="bold", size=13, color=colour)
    reasons = list(check.words)
    if not check.consistent:
        reasons.append("the store's figures do not all agree with its voxels")
    lines = [line for reason in reasons for line in textwrap.wrap(reason, 52)]
    if len(lines) > 3:
        lines = [*lines[:2], f"{lines[2]} ..."]
    for number, line in enumerate(lines):
        _text(figure, _SIDE, 74 + 17 * number, line, size=7, color=palette.MUTED)


def _legend(figure: Figure, scene: Scene) -> None:
    from matplotlib.patches import Rectangle

    y = _TOP + 3 * (PANEL + _GAP) + 12
    present = np.union1d(scene.pixieverse_material, scene.slat_material)
    share = np.bincount(scene.slat_material, minlength=256) / max(len(scene.slat_material), 1)
    x = float(_LEFT)
    for index in present:
        name = "no annotation" if index == UNANNOTATED else MATERIAL_CLASSES[index]
        box = Rectangle(
            (x / WIDTH, 1 - (y + 1) / HEIGHT), 13 / WIDTH, 13 / HEIGHT,
            facecolor=MATERIAL_COLOURS[int(index)], edgecolor=palette.MUTED, linewidth=0.5,
        )  # fmt: skip
        figure.add_artist(box)
        label = f"{name}  {share[index]:.1%}"
        _text(figure, x + 20, y, label, size=7.5)
        x += 20 + 9.2 * len(label) + 28
    _text(
        figure, _LEFT + 4 * PANEL + 3 * _GAP, y, "share of the SLAT voxels", size=6.8,
        color=palette.MUTED, ha="right",
    )  # fmt: skip


def _figures(figure: Figure, check: AlignmentCheck, y: float) -> None:
    columns = (_SIDE, _SIDE + 275, _SIDE + _SIDE_WIDTH)
    for x, name, ha in zip(columns, ("figure", "value", "good"), ("left", "right", "right"),
                           strict=True):  # fmt: skip
        _text(figure, x, y, name, size=6.8, color=palette.MUTED, ha=ha)
    _rule(figure, y + 7)
    rows = [figure for figure in check.figures if figure.name in SHOWN]
    for number, one in enumerate(rows):
        line = y + 30 + 24 * number
        worse = one.passes is False
        colour = palette.VERDICT_COLOURS["failed"] if worse else palette.INK
        _text(figure, columns[0], line, one.name, size=7.5)
        # Adding zero takes the sign from a rounded -0.
        value = f"{round(one.value, 3) + 0.0:.3f}"
        _text(figure, columns[1], line, value, size=7.5, ha="right", color=colour)
        limit = one.threshold_text.replace(">=", "\u2265").replace("<=", "\u2264")
        _text(figure, columns[2] - 26, line, limit, size=7.5, ha="right", color=palette.MUTED)
        if one.passes is not None:
            mark = "\u2717" if worse else "\u2713"
            good = palette.VERDICT_COLOURS["failed" if worse else "good"]
            _text(figure, columns[2], line, mark, size=7.5, ha="right", color=good)
    rotation, shift, scale = split_transform(check.transform)
    angle = np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))
    moved = np.linalg.norm(shift) * RESOLUTION
    words = f"turned {angle:.1f}°, shifted {moved:.2f} voxel, scaled {scale:.3f}"
    _text(figure, _SIDE, y + 40 + 24 * len(rows), words, size=7, color=palette.MUTED)


SHOWN = (
    "fitness",
    "inlier_rmse",
    "fitness_backward",
    "inlier_rmse_backward",
    "overlap",
    "valid_share",
    "ambiguity",
    "margin",
)
"""The figures of a check that a picture shows, named as the store names them."""


def _histogram(figure: Figure, scene: Scene, radius: float, y: float) -> None:
    _text(figure, _SIDE, y, "error per SLAT surface voxel", weight="bold", size=8.5)
    share = float((scene.error <= radius).mean())
    words = f"median {np.median(scene.error):.2f} voxel; {share:.1%} within {radius:g}"
    _text(figure, _SIDE, y + 20, words, size=7, color=palette.MUTED)
    axes = _axes(figure, y + 36, 190)
    edges = np.linspace(0, FARTHEST, 31)
    middles = (edges[:-1] + edges[1:]) / 2
    shares = [
        np.histogram(np.minimum(error, FARTHEST - 1e-9), edges)[0] / len(error)
        for error in (scene.error, scene.error_before)
    ]
    axes.bar(middles, shares[0], width=edges[1] * 0.92, color=distance_colours(middles).tolist(),
             edgecolor=palette.MUTED, linewidth=0.3)  # fmt: skip
    axes.stairs(shares[1], edges, color=palette.MUTED, linewidth=0.8)
    top = max(shares[0].max(), 0.02)
    if shares[1].max() > 1.15 * top:
        axes.set_ylim(0, 1.15 * top)
    axes.axvline(radius, color=palette.INK, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.set_xlim(0, FARTHEST)
    axes.set_xticks(range(int(FARTHEST) + 1), ["0", "1 voxel", "2", f"\u2265 {FARTHEST:g}"])
    axes.text(0.95, 0.93, "line: before alignment", transform=axes.transAxes, ha="right",
              fontsize=6.5, color=palette.MUTED)  # fmt: skip
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
    axes.locator_params(axis="y", nbins=3)


def _candidates(figure: Figure, candidates: Sequence[Candidate] | str, y: float) -> None:
    _text(figure, _SIDE, y, "starts of the search", weight="bold", size=8.5)
    if isinstance(candidates, str):
        for number, line in enumerate(textwrap.wrap(candidates, 56)):
            _text(figure, _SIDE, y + 20 + 17 * number, line, size=7, color=palette.MUTED)
        return
    own = sorted((c for c in candidates if c.same_as is None), key=lambda c: (-c.fitness, c.index))
    words = f"{len(own)} different of {len(candidates)}, by coarse fitness; some end alike"
    _text(figure, _SIDE, y + 20, words, size=7, color=palette.MUTED)
    axes = _axes(figure, y + 36, 190)
    colours = [palette.ACCENT] + [palette.RULE] * (len(own) - 1)
    axes.bar(range(len(own)), [c.fitness for c in own], width=0.78, color=colours)
    axes.set_xlim(-0.8, max(len(own), 2) - 0.2)
    axes.set_ylim(0, 1)
    axes.set_yticks([0, 0.5, 1])
    best = own[0]
    if best.euler_degrees is not None:
        name = "start at " + ", ".join(f"{angle:g}°" for angle in best.euler_degrees)
        axes.set_xticks([0], [name], ha="left")
    else:
        axes.set_xticks([])


def _axes(figure: Figure, y: float, height: float) -> Axes:
    left = _SIDE + 40
    box = (left / WIDTH, 1 - (y + height) / HEIGHT, (_SIDE_WIDTH - 40) / WIDTH, height / HEIGHT)
    axes = figure.add_axes(box)
    axes.tick_params(length=2.5, width=0.6)
    for spine in axes.spines.values():
        spine.set_linewidth(0.6)
    return axes


def _rule(figure: Figure, y: float) -> None:
    from matplotlib.lines import Line2D

    ends = [_SIDE / WIDTH, (_SIDE + _SIDE_WIDTH) / WIDTH]
    figure.add_artist(Line2D(ends, [1 - y / HEIGHT] * 2, color=palette.RULE, linewidth=0.8))


def _text(figure: Figure, x: float, y: float, words: str, **style: Any) -> None:
    """Write at a pixel of the picture, counted from its upper left corner."""
    figure.text(x / WIDTH, 1 - y / HEIGHT, words, **style)
