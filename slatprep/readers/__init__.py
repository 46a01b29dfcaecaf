"""Reading the sources: pairs are found by name, then each side is read and checked."""

from slatprep.readers.pairing import discover
from slatprep.readers.pixieverse import read_field
from slatprep.readers.slat import read_latents, read_slat
from slatprep.readers.slat_files import SlatFile, discover_slats

__all__ = [
    "SlatFile",
    "discover",
    "discover_slats",
    "read_field",
    "read_latents",
    "read_slat",
]
