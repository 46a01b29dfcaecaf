"""Figures with positions in pixels, and the style and formats of all pictures."""

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
