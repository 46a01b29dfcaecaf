"""The colours of every picture beside those of the classes: verdicts, distances, text."""

from __future__ import annotations

VERDICT_COLOURS = {"good": "#1B7F4B", "doubtful": "#B26A00", "failed": "#B3261E"}
"""Colour of each verdict; every verdict is also written out, as colour alone is no sign."""

ACCENT = "#2E9FF5"
INK = "#1F2328"
MUTED = "#6B7280"
RULE = "#D5D9DE"
PAPER = "#FFFFFF"
"""Highlight, text, secondary text, lines and ground."""

DISTANCE_COLOURS = ("#EEF1F4", "#F3BDB6", "#DD6472", "#931D52", "#2B0A3D")
"""Distances from none to the end of the scale: even steps, each darker than the last."""
