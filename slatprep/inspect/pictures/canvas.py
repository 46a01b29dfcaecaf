"""Draw figures by positions in pixels; colours, style and formats of all pictures."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import printable
from slatprep.records import INK as INK
from slatprep.records import MUTED as MUTED
from slatprep.records import PICTURE_FORMATS, SVG_SALT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VERDICT_COLOURS = {"good": "#1B7F4B", "doubtful": "#B26A00", "failed": "#B3261E"}
"""Colour of each verdict; pictures also write the verdict as text."""

ACCENT = "#2E9FF5"
RULE = "#D5D9DE"
PAPER = "#FFFFFF"
"""Colours of highlights, lines and the background."""

DISTANCE_COLOURS = ("#EEF1F4", "#F3BDB6", "#DD6472", "#931D52", "#2B0A3D")
"""Colours of distances from 0 to the end of the scale, in even steps of lightness."""

DPI = 150

MOST_NAMES = 16
"""Largest number of names in a legend: more colours cannot be told apart."""

STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "text.color": INK,
    "axes.edgecolor": RULE,
    "axes.labelcolor": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": RULE,
    "ytick.color": RULE,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "figure.facecolor": PAPER,
    "svg.hashsalt": SVG_SALT,
    "pdf.fonttype": 42,
}
"""Settings of matplotlib."""


def styled() -> AbstractContextManager[None]:
    """Set matplotlib's style to `STYLE`, regardless of the user's matplotlibrc."""
    import matplotlib.style

    return matplotlib.style.context(["default", STYLE])


def in_format(figure: Figure, kind: str = "png") -> bytes:
    """Return a figure as the bytes of a file in one of `PICTURE_FORMATS`."""
    buffer = BytesIO()
    with warnings.catch_warnings():
        # A name may have letters that the font lacks; a box stands for each.
        warnings.filterwarnings("ignore", "Glyph", UserWarning)
        figure.savefig(buffer, format=kind, dpi=figure.dpi, metadata=PICTURE_FORMATS[kind])
    return buffer.getvalue()


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure whose size is given in pixels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def size_of(figure: Figure) -> tuple[float, float]:
    """Return a figure's width and height in pixels."""
    return figure.get_figwidth() * DPI, figure.get_figheight() * DPI


def write(figure: Figure, x: float, y: float, words: str, **style: Any) -> None:
    """Write text at a pixel, counted from the figure's upper left corner."""
    width, height = size_of(figure)
    # Names may contain $, which matplotlib would read as the start of a formula.
    figure.text(x / width, 1 - y / height, words, parse_math=False, **style)


def note(figure: Figure, x: float, y: float, words: str, size: float = 7.0, **style: Any) -> None:
    """Write small text in the secondary colour."""
    write(figure, x, y, words, size=size, color=MUTED, **style)


def draw_image(figure: Figure, x: int, y: int, image: NDArray[np.float64], finer: int = 1) -> None:
    """Draw an image (rows, columns, 3) in 0..1 at a pixel, with `finer` image pixels per pixel."""
    pixels = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
    tall, wide = (side / finer for side in image.shape[:2])
    if finer == 1:
        below = round(size_of(figure)[1] - y - tall)
        figure.figimage(pixels, xo=x, yo=below, origin="upper")
        return
    axes = add_axes(figure, x, y, wide, tall)
    axes.imshow(pixels, interpolation="none")
    axes.set_axis_off()


def add_axes(figure: Figure, x: float, y: float, wide: float, tall: float) -> Axes:
    """Return axes with their upper left corner at a pixel; width and height are in pixels."""
    width, height = size_of(figure)
    return figure.add_axes((x / width, 1 - (y + tall) / height, wide / width, tall / height))


def draw_line(figure: Figure, x: float, y: float, end: tuple[float, float], colour: str) -> None:
    """Draw a line from one pixel to another."""
    from matplotlib.lines import Line2D

    width, height = size_of(figure)
    places = [x / width, end[0] / width], [1 - y / height, 1 - end[1] / height]
    figure.add_artist(Line2D(*places, color=colour, linewidth=0.8))


def cut(words: str, most: int) -> str:
    """Return words on one line, cut to `most` characters."""
    words = printable(" ".join(words.split()))
    return words if len(words) <= most else f"{words[: most - 1]}…"


def draw_legend(
    figure: Figure,
    entries: Sequence[tuple[str, str]],
    box: tuple[float, float, float],
    **style: Any,
) -> None:
    """Write names beside squares of their colours, from left to right, in two rows at most.

    `entries` are names and colours. If entries exceed the space or `MOST_NAMES`, the number of
    omitted ones follows the last. `box` is left edge, first baseline and right edge in pixels; a
    row is 20 pixels high. `style` goes to `matplotlib.patches.Rectangle`.
    """
    from matplotlib.patches import Rectangle

    width, height = size_of(figure)
    left, y, right = box
    x, last = left, y + 20
    for number, (name, colour) in enumerate(entries):
        wide = 20 + 9.2 * len(name)
        if x > left and x + wide > right and y < last:
            x, y = left, y + 20
        more = f"and {len(entries) - number} more"
        after = 28 + 9.2 * len(more) if number + 1 < len(entries) and y == last else 0.0
        if number == MOST_NAMES or (x > left and x + wide + after > right):
            note(figure, x, y, more, 7.5)
            return
        place = x / width, 1 - (y + 1) / height
        square = Rectangle(place, 13 / width, 13 / height, facecolor=colour, **style)
        figure.add_artist(square)
        write(figure, x + 20, y, name, size=7.5)
        x += wide + 28
