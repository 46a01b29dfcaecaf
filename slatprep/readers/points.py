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

_HEADER_BYTES = 2**18
"""Bytes that a header may have; one of Gaussians has some 2,000."""

_SLOW_ROWS = 200_000
"""Rows of text, or with lists, that a PLY may have."""

_SIZES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2,
    "uint16": 2, "int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4,
    "double": 8, "float64": 8,
}  # fmt: skip
"""Bytes of a number by the name of its type."""


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
    with refusing(where, "is no readable PLY with vertices", expected):
        try:
            read = plyfile.PlyData.read(io.BytesIO(_up_to_vertices(data)))
        except plyfile.PlyParseError as error:
            raise ValueError(str(error)) from None
        vertices: NDArray[Any] = np.asarray(read["vertex"].data)
    names = vertices.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(where, f"has vertices of {', '.join(names)}", "fields x, y and z")
    if any(vertices.dtype[axis].kind not in "fiu" for axis in "xyz"):
        raise InputError(where, "has x, y, z that are lists", "a number each")
    return vertices, tuple(read.comments)


def _up_to_vertices(data: bytes) -> bytes:
    """Return a PLY without the elements behind its vertices; ValueError if it claims too much.

    plyfile reserves memory for what a header claims. It reads texts and lists row by row, 10 µs
    each. So counts are compared with the bytes of the file, and such rows are limited.
    """
    head = data[:_HEADER_BYTES]
    match = re.match(rb"(ply(\r\n|\n|\r).*?)(end_header\2)", head, re.DOTALL)
    if match is None:
        raise ValueError(f"its header does not end in the first {_HEADER_BYTES:,} bytes")
    body = data[match.end() :]
    kept: list[bytes] = []
    name, rows, least, slow, is_text, behind = "", 0, 0, 0, False, False
    for line in match[1].splitlines(keepends=True):
        words = line.decode("ascii", "replace").split()
        if words[:1] == ["element"] and len(words) == 3:
            behind = behind or name == "vertex"
            # int, as plyfile: a sign and underscores count.
            name, rows = words[1], int(words[2])
            if not 0 <= rows <= len(body):
                raise ValueError("announces more rows than it has")
            slow += rows * (is_text and not behind)
        elif words[:1] == ["property"]:
            is_list = words[1:2] == ["list"]
            slow += rows * (is_list and not (is_text or behind))
            least += rows * (2 if is_text else _SIZES[words[2 if is_list else 1]])
        elif words[:1] == ["format"]:
            is_text = words[1] == "ascii"
        if not behind:
            kept.append(line)
    if least > len(body) + 1:
        raise ValueError("announces more rows than it has")
    if slow > _SLOW_ROWS:
        raise ValueError(
            f"it has {slow:,} rows of text or lists, and at most {_SLOW_ROWS:,} are read; write "
            "it in binary, without lists"
        )
    return b"".join(kept) + match[3] + body
