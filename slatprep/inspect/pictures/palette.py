"""Colours of verdicts, distances and text in all pictures."""

from __future__ import annotations

VERDICT_COLOURS = {"good": "#1B7F4B", "doubtful": "#B26A00", "failed": "#B3261E"}
"""Colour of each verdict, which is always written out too."""

ACCENT = "#2E9FF5"
INK = "#1F2328"
MUTED = "#6B7280"
RULE = "#D5D9DE"
PAPER = "#FFFFFF"
"""Highlight, text, secondary text, lines and background."""

DISTANCE_COLOURS = ("#EEF1F4", "#F3BDB6", "#DD6472", "#931D52", "#2B0A3D")
"""Distances from 0 to the end of the scale, in even steps of lightness."""
