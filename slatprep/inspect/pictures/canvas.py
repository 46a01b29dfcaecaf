"""What the pictures of alignments are drawn on: a figure whose places are counted in pixels."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

from slatprep.inspect.pictures import palette

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 150

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
    "svg.hashsalt": "slatprep",  # else names within a file are drawn at random
    "pdf.fonttype": 42,
}
"""How matplotlib draws here."""


FORMATS: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
"""The formats of a picture, with what is left out so that the same picture has the same bytes."""


def in_format(figure: Figure, kind: str = "png") -> bytes:
    """Return a figure as a file of one of `FORMATS` that holds nothing but the picture."""
    buffer = BytesIO()
    figure.savefig(buffer, format=kind, dpi=figure.dpi, metadata=FORMATS[kind])
    return buffer.getvalue()


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of so many pixels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def size_of(figure: Figure) -> tuple[float, float]:
    """Return width and height in pixels."""
    return figure.get_figwidth() * DPI, figure.get_figheight() * DPI


def write(figure: Figure, x: float, y: float, words: str, **style: Any) -> None:
    """Write at a pixel of the figure, counted from its upper left corner."""
    width, height = size_of(figure)
    # A stranger's name with a $ in it is no formula.
    figure.text(x / width, 1 - y / height, words, parse_math=False, **style)
