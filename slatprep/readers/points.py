"""Points of a PLY; each property is a column."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import InputError, needing
from slatprep.readers.files import refusing
from slatprep.records import Place

_HEADER_BYTES = 2**18
"""Largest header, in bytes; the header of a PLY of Gaussians has some 2,000."""

_SLOW_VALUES, _SLOW_BYTES, _LINE_BYTES = 1_000_000, 48 * 2**20, 2**16
"""Most values, bytes, and bytes in a line of a PLY of text or with lists: plyfile reads such a PLY
value by value, 1 µs each."""

_AXES = ("x", "y", "z")


def ply_points(data: bytes, where: str | Place) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Return the vertices of a PLY, structured (N,), and the comments of its header.

    Vertices have at least numbers ``x``, ``y`` and ``z``. InputError if the file has none,
    ConfigError if plyfile is not installed.
    """
    with needing("reading a PLY needs", "simulate"):
        import plyfile

    def read(ply: bytes) -> Any:
        try:
            return plyfile.PlyData.read(io.BytesIO(ply))
        except plyfile.PlyParseError as error:
            raise ValueError(str(error)) from None

    with refusing(where, "is no readable PLY with vertices", "a PLY of Gaussians or points"):
        header, start, counts = _header(data)
        if max(counts, default=0) > len(data) - start:
            raise ValueError("announces more rows than it has")
        # The counts are set to 0: plyfile reserves memory for what a header claims.
        described = read(_with_counts(header, [0] * len(counts)))
        names = [element.name for element in described.elements]
        if "vertex" not in names:
            raise ValueError(f"its elements are {', '.join(names) or 'none'}")
        last = names.index("vertex")
        fields = described.elements[last].dtype(described.byte_order)
        if not set(_AXES) <= set(fields.names or ()):
            there = ", ".join(fields.names)
            raise InputError(where, f"has vertices of {there}", "fields x, y and z")
        if any(fields[axis].kind not in "fiu" for axis in _AXES):
            raise InputError(where, "has x, y, z that are lists", "a number each")
        if len(names) != len(counts):
            raise ValueError("its elements cannot be counted")
        least = slow = 0
        for number, (element, rows) in enumerate(zip(described.elements, counts, strict=True)):
            sizes, lists = _sizes(element.properties)
            least += rows * (2 * len(sizes) if described.text else sum(sizes))
            slow += rows * len(sizes) * (number <= last and (described.text or lists))
        if least - 1 > len(data) - start:  # the end of the last line may be missing
            raise ValueError("announces more rows than it has")
        if not slow:
            for element, rows in zip(described.elements[:last], counts, strict=False):
                start += rows * element.dtype(described.byte_order).itemsize
            return np.frombuffer(data, fields, counts[last], start), tuple(described.comments)
        if slow > _SLOW_VALUES or len(data) - start > _SLOW_BYTES:
            raise ValueError(
                f"it has {slow:,} values of text or with lists in {len(data) - start:,} bytes, and "
                f"at most {_SLOW_VALUES:,} in {_SLOW_BYTES:,} are read; write it in binary, "
                "without lists"
            )
        if described.text and re.compile(rb"[^\r\n]{%d}" % _LINE_BYTES).search(data, start):
            raise ValueError(f"it has a line of {_LINE_BYTES:,} bytes and more")
        kept = read(_with_counts(header, counts[: last + 1]) + data[start:])
        return np.asarray(kept["vertex"].data), tuple(kept.comments)


def _header(data: bytes) -> tuple[list[bytes], int, list[int]]:
    """Return the lines of a header, where it ends, and the rows of each element."""
    match = re.match(rb"ply(\r\n|\n|\r)(?s:.*?)\1end_header\1", data[:_HEADER_BYTES])
    if match is None:
        raise ValueError(f"its header does not end in the first {_HEADER_BYTES:,} bytes")
    lines = [line + match[1] for line in match[0].split(match[1])[:-1]]
    # plyfile, too, parses them by int, which takes a sign and underscores.
    counts = [int(line.split()[2]) for line in lines if line.startswith(b"element ")]
    if min(counts, default=0) < 0:
        raise ValueError("announces rows below 0")
    return lines, match.end(), counts


def _with_counts(lines: list[bytes], counts: list[int]) -> bytes:
    """Return a header with its first elements, one for each of `counts`, with that many rows."""
    kept: list[bytes] = []
    left = iter(counts)
    for line in lines[:-1]:
        if line.startswith(b"element "):
            if (rows := next(left, None)) is None:
                break
            line = b" ".join([*line.split()[:2], b"%d" % rows, *line.split()[3:]])
            line += lines[0].removeprefix(b"ply")
        kept.append(line)
    return b"".join([*kept, lines[-1]])


def _sizes(properties: Sequence[Any]) -> tuple[list[int], bool]:
    """Return the fewest bytes of each value of a row in a binary PLY, and whether any is a list."""
    lists = [hasattr(one, "len_dtype") for one in properties]
    kinds = [getattr(one, "len_dtype", one.val_dtype) for one in properties]
    return [np.dtype(kind).itemsize for kind in kinds], any(lists)
