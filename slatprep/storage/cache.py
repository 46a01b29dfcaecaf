"""A folder of the local disk for data of places on object stores.

It holds the work folders of builds to such places, and copies of files that must be on a disk to be
read. All of it may be removed while nothing runs.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

from slatprep.storage.remote import RemotePlace, connected, multipart_options

VARIABLE = "SLATPREP_CACHE"
"""Environment variable with the folder's path."""


def cache_folder() -> Path:
    """Return the folder: ``$SLATPREP_CACHE``, else ``slatprep`` in the user's own cache."""
    named = os.environ.get(VARIABLE)
    if named:
        return Path(named).expanduser().absolute()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "slatprep"


def folder_for(place: RemotePlace) -> Path:
    """Return the subfolder for a place, whose name identifies the place."""
    return cache_folder() / f"{place.name}-{short(str(place))}"


def cached_file(place: RemotePlace) -> Path:
    """Return a path of the local disk with an object's content.

    The copy is valid while the object has the same size, tag and time; only one copy is kept.
    OSError if the object cannot be read or the disk refuses.
    """
    with connected(place) as (system, name):
        entry = system.info(name)
    state = [str(entry.get(key)) for key in ("size", "ETag", "etag", "LastModified", "mtime")]
    folder = folder_for(place)
    copy = folder / short(" ".join(state))
    if copy.exists():
        return copy
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as own:
        part = Path(own, "part")
        with connected(place) as (system, name):
            system.get_file(name, str(part), **multipart_options(system))
        part.replace(copy)
    for older in folder.iterdir():
        if older != copy and older.is_file():
            older.unlink(missing_ok=True)
    return copy


def short(text: str) -> str:
    """Return a short digest of a text, for names."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]
