"""slatprep: physics supervision for structured latents that one can trust."""

__version__ = "0.1.0"
