"""What lies below a directory, to compare it with what lay there before."""

from __future__ import annotations

import hashlib
from pathlib import Path


def tree(directory: Path | None) -> dict[str, str]:
    """Return the hash of every file below a directory."""
    assert directory is not None
    return {
        path.relative_to(directory).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in directory.rglob("*")
        if path.is_file()
    }
