"""Colours of the figures: text and data, and references."""

INK, MUTED = "#1F2328", "#6B7280"
