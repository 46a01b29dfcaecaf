"""The colours of every picture: material classes, verdicts, and a scale for distances.

The class colours stay apart for people who do not tell red from green, or
blue from green: simulated after Machado, Oliveira and Fernandes ("A
Physiologically-based Model for Simulation of Color Vision Deficiency", IEEE
TVCG 2009), any two of them differ by more than 20 in CIELAB.
"""

from __future__ import annotations

from slatprep.records import MATERIAL_CLASSES, UNANNOTATED

CLASS_COLOURS = {
    "jelly": "#5A9A5A",
    "metal": "#4327AC",
    "sand": "#F7AE38",
    "visplas": "#901A0A",
    "fluid": "#2E9FF5",
    "snow": "#C592C6",
    "stationary": "#544856",
    "background": "#EAEAEA",
}
"""Colour of each of PhysGaussian's material classes, by name."""

UNANNOTATED_COLOUR = "#FFFFFF"
"""Colour of an occupied voxel without an annotation."""

MATERIAL_COLOURS = {
    **{index: CLASS_COLOURS[name] for index, name in enumerate(MATERIAL_CLASSES)},
    UNANNOTATED: UNANNOTATED_COLOUR,
}
"""The same by material id, as the store holds it."""

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
