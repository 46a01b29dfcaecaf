"""Reading the sources: names give the pairs, then each side is read and checked."""

from __future__ import annotations

from dataclasses import replace

from slatprep.parameters import SampleParameters
from slatprep.readers.adapters import latent_adapter, made_by, source_adapter
from slatprep.readers.contents import contents_of
from slatprep.readers.files import require_complete
from slatprep.readers.pairing import discover
from slatprep.readers.slat import read_slat
from slatprep.readers.slat_files import SlatFile, discover_slats
from slatprep.readers.transforms import read_transform
from slatprep.readers.values import in_si, require_plausible
from slatprep.records import AssetPair, MaterialField, StructuredLatents

__all__ = [
    "SlatFile",
    "contents_of",
    "discover",
    "discover_slats",
    "read_field",
    "read_latents",
    "read_slat",
]


def read_field(
    pair: AssetPair, max_unphysical: float = SampleParameters.max_unphysical
) -> MaterialField:
    """Read the annotated side of a pair by the adapter of its source.

    Parameters
    ----------
    pair : AssetPair
        A pair without a problem.
    max_unphysical : float
        See `slatprep.parameters.SampleParameters`.

    Returns
    -------
    MaterialField
        Occupancy, and class and SI properties of the annotated voxels.
        `slatprep.readers.pixieverse.read_grid` says what counts as annotated in PixieVerse.

    Raises
    ------
    InputError
        If a file cannot be used; the message names file, value and voxel.
    """
    field = source_adapter(pair.roots.adapter).read(pair, max_unphysical)
    if made_by("slatprep.sources", pair.roots.adapter):
        field = _held_against(field, pair)
    if pair.transform is not None:
        frame, source = read_transform(pair.transform, pair.roots.pixieverse)
        field = replace(field, frame=frame, sources=(*field.sources, source))
    return replace(field, sources=pair.roots.numbered(field.sources))


def _held_against(field: MaterialField, pair: AssetPair) -> MaterialField:
    """Return a field of another package's adapter, in SI units, held against materials."""
    roots, where = pair.roots, pair.grid or pair.roots.pixieverse
    classes = field.material if field.classified else None
    values = in_si(field.properties.copy(), field.table, roots.units)
    told = require_plausible(where, values, classes, field.table, roots.contents.classes, roots)
    return replace(field, properties=values, warnings=(*field.warnings, *told))


def read_latents(pair: AssetPair) -> StructuredLatents:
    """Read the SLAT side of a pair by the adapter of its encoder.

    Parameters
    ----------
    pair : AssetPair
        A pair without a problem.

    Returns
    -------
    StructuredLatents
        Coordinates and latents in the order of the file; see `slatprep.readers.slat.read_slat`.

    Raises
    ------
    InputError
        If the file cannot be used; the message names file, value and row.
    """
    _, path = require_complete(pair)
    space = pair.roots.contents.latents
    adapter = latent_adapter(space.encoder)
    read = read_slat if adapter is None else adapter.read
    return read(path, pair.roots.slat, pair.slat_group, space)
