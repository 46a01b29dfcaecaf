"""Figures with positions in pixels, and the style and formats of all pictures."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any

from slatprep.inspect.pictures import palette

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 150

MOST_NAMES = 16
"""Most names of a legend: more colours cannot be told apart."""

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
    "svg.hashsalt": "slatprep",  # Otherwise ids within a file are random.
    "pdf.fonttype": 42,
}
"""Settings of matplotlib."""


FORMATS: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
"""Formats of a picture, with the metadata to leave out so that its bytes do not vary."""


def in_format(figure: Figure, kind: str = "png") -> bytes:
    """Return a figure as the bytes of a file in one of `FORMATS`."""
    buffer = BytesIO()
    figure.savefig(buffer, format=kind, dpi=figure.dpi, metadata=FORMATS[kind])
    return buffer.getvalue()


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in pixels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def size_of(figure: Figure) -> tuple[float, float]:
    """Return width and height in pixels."""
    return figure.get_figwidth() * DPI, figure.get_figheight() * DPI


def write(figure: Figure, x: float, y: float, words: str, **style: Any) -> None:
    """Write text at a pixel of the figure, from its upper left corner."""
    width, height = size_of(figure)
    # Names may contain $, which would begin a formula.
    figure.text(x / width, 1 - y / height, words, parse_math=False, **style)


def draw_legend(
    figure: Figure,
    entries: Sequence[tuple[str, str]],
    box: tuple[float, float, float],
    rows: int = 2,
    **style: Any,
) -> None:
    """Write names beside squares of their colours, from left to right, in at most so many rows.

    `entries` are names and colours. The number of entries beyond the room or `MOST_NAMES` follows
    the last one. `box` is left edge, first baseline and right edge in pixels; a row takes 20.
    `style` goes to `matplotlib.patches.Rectangle`.
    """
    from matplotlib.patches import Rectangle

    width, height = size_of(figure)
    left, y, right = box
    x, last = left, y + 20 * (rows - 1)
    for number, (name, colour) in enumerate(entries):
        wide = 20 + 9.2 * len(name)
        if x > left and x + wide > right and y < last:
            x, y = left, y + 20
        more = f"and {len(entries) - number} more"
        after = 28 + 9.2 * len(more) if number + 1 < len(entries) and y == last else 0.0
        if number == MOST_NAMES or (x > left and x + wide + after > right):
            write(figure, x, y, more, size=7.5, color=palette.MUTED)
            return
        place = x / width, 1 - (y + 1) / height
        square = Rectangle(place, 13 / width, 13 / height, facecolor=colour, **style)
        figure.add_artist(square)
        write(figure, x + 20, y, name, size=7.5)
        x += wide + 28
