"""Known transforms: a matrix in a file, for one asset or for all."""

from __future__ import annotations

import json

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError
from slatprep.geometry.frames import split_transform
from slatprep.readers.files import ArraySpec, load_source, npy_array, refusing
from slatprep.records import Place, SourceFile

_MATRIX = ArraySpec(shapes=((4, 4),), kinds="fiu")
_EXPECTED = "a 4x4 matrix, source frame to SLAT frame, as numpy.save writes it or as JSON"

_FAR = 100.0
"""Both sides lie in unit cubes: what is scaled or shifted by more is a mistake."""


def read_transform(path: Place, root: Place) -> tuple[NDArray[np.float64], SourceFile]:
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
