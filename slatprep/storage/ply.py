"""Points as PLY: a header, and the rows as they lie in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

_TYPES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}


def write_ply(path: Path, rows: NDArray[Any], *comments: str) -> None:
    """Write the rows (N,) of a structured array as points, binary little-endian."""
    fields = rows.dtype
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(rows)}",
        *(f"property {_TYPES[fields[name].str[1:]]} {name}" for name in fields.names or ()),
        "end_header\n",
    ]
    path.write_bytes("\n".join(lines).encode("ascii") + rows.tobytes())
