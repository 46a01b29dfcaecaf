"""Points of a PLY; each property is a column."""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError, SlatprepError
from slatprep.readers.files import refusing
from slatprep.records import Place

_HEADER_BYTES = 2**16


def ply_points(data: bytes, where: str | Place) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Return the vertices of a PLY, structured (N,), and the comments of its header.

    Vertices have at least numbers ``x``, ``y`` and ``z``. InputError if the file has none,
    SlatprepError if plyfile is not installed.
    """
    try:
        import plyfile
    except ImportError as error:
        raise SlatprepError(
            "reading a PLY needs the package plyfile; install it with "
            "`pip install 'slatprep[simulate]'`"
        ) from error
    expected = "a PLY of Gaussians or points"
    # plyfile sets aside what the header claims before it reads; no row takes less than a byte.
    header = data[:_HEADER_BYTES].partition(b"end_header")[0]
    for count in re.findall(rb"^element\s+\S+\s+(\d+)", header, re.MULTILINE):
        if len(count) > 18 or int(count) > len(data):
            raise InputError(where, "announces more rows than it has", expected)
    with refusing(where, "is no readable PLY with vertices", expected):
        try:
            read = plyfile.PlyData.read(io.BytesIO(data))
        except plyfile.PlyParseError as error:
            raise ValueError(str(error)) from None
        vertices: NDArray[Any] = np.asarray(read["vertex"].data)
    names = vertices.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(where, f"has vertices of {', '.join(names)}", "fields x, y and z")
    if any(vertices.dtype[axis].kind not in "fiu" for axis in "xyz"):
        raise InputError(where, "has x, y, z that are lists", "a number each")
    return vertices, tuple(read.comments)
