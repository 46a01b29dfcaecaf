"""Files of arrays, each array with a checksum, in a third of npz's time; and points as PLY.

A file of arrays has a mark, the header's length and its CRC32C, the header as JSON, then the
arrays in C order.
"""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.storage.chunks import crc32c

_START = struct.Struct("<8sII")
_MARK = b"SLATARR1"
_TYPES = re.compile(r"\|b1|\|[iu]1|[<>][iuf][248]|[<>]U[1-9]\d{0,6}")
_MOST_AXES, _MOST_BYTES = 8, 2**40


def write_arrays(file: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays of numbers, bool or text by name; OSError if they cannot be written."""
    entries, parts, at = {}, [], 0
    for name, array in arrays.items():
        data = np.asarray(array, order="C").reshape(-1).view(np.uint8)
        entries[name] = (array.dtype.str, array.shape, at, crc32c(data))
        parts.append(data)
        at += data.nbytes
    header = np.frombuffer(orjson.dumps(entries), np.uint8)
    file.write(_START.pack(_MARK, len(header), crc32c(header)))
    file.writelines([header.data, *(part.data for part in parts)])


class ArrayFile(Mapping[str, NDArray[Any]]):
    """The arrays of a file that `write_arrays` wrote; each access reads from the file anew.

    The file must allow random access. StoreError if it is no file of arrays or its header is
    damaged, and on access if the array is damaged.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        start = file.read(_START.size)
        mark, length, checksum = _START.unpack(start.ljust(_START.size))
        header = file.read(length) if mark == _MARK else b""
        if mark != _MARK or crc32c(np.frombuffer(header, np.uint8)) != checksum:
            raise StoreError("the file of arrays is damaged, or no such file")
        self._first = file.tell()
        self._entries = _entries_in(header, file.seek(0, os.SEEK_END) - self._first)

    def __getitem__(self, name: str) -> NDArray[Any]:
        dtype, shape, at, checksum = self._entries[name]
        data = np.empty(math.prod(shape) * np.dtype(dtype).itemsize, np.uint8)
        self._file.seek(self._first + at)
        if self._file.readinto(data.data) != data.nbytes or crc32c(data) != checksum:  # type: ignore[attr-defined]
            raise StoreError(f"the array {name!r} is damaged")
        return np.asarray(data.view(dtype).reshape(shape))

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


def _entries_in(header: bytes, size: int) -> dict[str, Any]:
    """Return the header's entry of each array; StoreError unless all fit into `size` bytes."""
    try:
        entries = orjson.loads(header)
    except ValueError:
        entries = None
    if not isinstance(entries, dict) or not all(_lies_in(size, one) for one in entries.values()):
        raise StoreError("the file of arrays is damaged: its header does not tell what it holds")
    return entries


def _lies_in(size: int, entry: Any) -> bool:
    """Return whether an entry describes an array of numbers, bool or text within `size` bytes."""
    match entry:
        case [str(dtype), list(shape), int(at), int()] if _TYPES.fullmatch(dtype):
            lengths = [length for length in shape if isinstance(length, int) and length >= 0]
            item = np.dtype(dtype).itemsize
            # Even an array without elements may have a length that numpy refuses.
            fits = item * math.prod(length or 1 for length in lengths) <= _MOST_BYTES
            whole = len(lengths) == len(shape) <= _MOST_AXES
            return whole and fits and 0 <= at <= size - item * math.prod(lengths)
    return False


_PLY_TYPES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}


def write_ply(path: Path, rows: NDArray[Any], *comments: str) -> None:
    """Write the rows (N,) of a structured array as points, binary little-endian."""
    fields = rows.dtype
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(rows)}",
        *(f"property {_PLY_TYPES[fields[name].str[1:]]} {name}" for name in fields.names or ()),
        "end_header\n",
    ]
    path.write_bytes("\n".join(lines).encode("ascii") + rows.tobytes())
