"""Colours of the figures: text and data, and what they are compared with."""

INK, MUTED = "#1F2328", "#6B7280"
