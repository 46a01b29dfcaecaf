"""Reading the sources: pairs are found by name, then each side is read and checked."""

from slatprep.readers.pairing import discover
from slatprep.readers.pixieverse import read_field
from slatprep.readers.slat import read_latents

__all__ = ["discover", "read_field", "read_latents"]
