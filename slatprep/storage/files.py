"""The files below a folder, and their digests."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

from slatprep.storage.remote import RemotePath, list_objects


def list_files(path: Path) -> Iterator[str]:
    """Yield the name of every file below a folder, with forward slashes, sorted by folder.

    Links are listed, and not followed.
    """
    if isinstance(path, RemotePath):
        yield from list_objects(path)
        return
    for folder, folders, files in os.walk(path):
        folders.sort()
        relative = Path(folder).relative_to(path)
        links = [name for name in folders if (Path(folder) / name).is_symlink()]
        for name in sorted([*files, *links]):
            yield (relative / name).as_posix()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
