"""Reading the sources: names give the pairs, then each side is read and checked."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.geometry.frames import split_transform
from slatprep.parameters import SampleParameters
from slatprep.readers.adapters import latent_adapter, made_by, source_adapter
from slatprep.readers.contents import contents_of
from slatprep.readers.files import ArraySpec, load_source, npy_array, refusing, require_complete
from slatprep.readers.pairing import discover
from slatprep.readers.slat import read_slat
from slatprep.readers.slat_files import SlatFile, discover_slats
from slatprep.readers.values import require_plausible
from slatprep.records import AssetPair, MaterialField, Place, SourceFile, StructuredLatents

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
        roots, where = pair.roots, pair.grid or pair.roots.pixieverse
        values, classes = field.properties.copy(), field.material if field.classified else None
        held = values, classes, field.table, roots.contents.classes
        told = require_plausible(where, *held, roots)
        field = replace(field, properties=values, warnings=(*field.warnings, *told))
    if pair.transform is not None:
        frame, source = _read_transform(pair.transform, pair.roots.pixieverse)
        field = replace(field, frame=frame, sources=(*field.sources, source))
    return replace(field, sources=pair.roots.numbered(field.sources))


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


_MATRIX = ArraySpec(shapes=((4, 4),), kinds="fiu")
_EXPECTED = "a 4x4 matrix, source frame to SLAT frame, as numpy.save writes it or as JSON"

_FAR = 100.0
"""Both sides lie in unit cubes: what is scaled or shifted by more is a mistake."""


def _read_transform(path: Place, root: Place) -> tuple[NDArray[np.float64], SourceFile]:
    """Read a (4, 4) similarity from a JSON list of rows or an npy file below `root`.

    It takes points of the source's unit cube to the SLAT's. The file is returned as a source of
    role ``transform``. InputError if the matrix is not a similarity.
    """
    data, source = load_source(path, root, "transform")
    if path.suffix.lower() == ".json":
        with refusing(path, "holds no matrix", _EXPECTED):
            matrix = np.array(json.loads(data), dtype=np.float64)
    else:
        matrix = npy_array(data, path, _MATRIX).astype(np.float64)
    try:
        _, shift, scale = split_transform(matrix)
        if not (1 / _FAR < scale < _FAR and np.abs(shift).max() < _FAR):
            raise ValueError(f"scale {scale:g} and shift {shift.tolist()} lead out of a unit cube")
        if (matrix[3] != (0, 0, 0, 1)).any():
            raise ValueError(f"the last row must be 0, 0, 0, 1, got {matrix[3].tolist()}")
    except ValueError as error:
        raise InputError(path, str(error), _EXPECTED) from None
    return matrix, source
