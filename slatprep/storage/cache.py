"""A folder of the local disk for data of places on object stores.

It holds the work folders of builds to such places, copies of files that must be on a disk to be
read, and indexes and members of archives. All of it may be removed while nothing runs.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from pathlib import Path

import orjson

from slatprep.errors import StoreError
from slatprep.storage.files import file_digest
from slatprep.storage.remote import (
    RemotePlace,
    connected,
    get_objects,
    list_objects,
    multipart_options,
    stamp_of,
)
from slatprep.storage.versions import content_of, is_version, read_pointer

VARIABLE = "SLATPREP_CACHE"
"""Environment variable with the folder's path."""


SMALL_BYTES = 2**18
"""Largest size of a file whose digest is compared whenever a local copy is opened."""


def cache_folder() -> Path:
    """Return the folder: ``$SLATPREP_CACHE``, else ``slatprep`` in the user's own cache."""
    if named := os.environ.get(VARIABLE):
        return Path(named).expanduser().absolute()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "slatprep"


def folder_for(place: RemotePlace) -> Path:
    """Return the subfolder for a place, whose name identifies the place."""
    return cache_folder() / f"{place.name}-{short(str(place))}"


def cached_file(place: RemotePlace) -> Path:
    """Return a path of the local disk with an object's content.

    The copy is valid while the object has the same size, tag and time; only one copy is kept.
    OSError if the object cannot be read or the copy cannot be written.
    """
    with connected(place) as (system, name):
        entry = system.info(name)
    folder = folder_for(place)
    copy = folder / short(stamp_of(entry))
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


def copied_version(place: RemotePlace) -> Path:
    """Return the local copy of a store's version, after making it if needed.

    Versions never change, so a copy is made once, or again if somebody removed, cut or changed
    its files; bits that flip in large files are found when they are read.
    StoreError if the place is no version, differs from its pointer, or cannot be copied.
    """
    if not is_version(place):
        raise StoreError(
            f"{place}: lies there without versions, so a copy could not be told to be current; "
            "build it there with `slatprep build-store`, or copy it yourself"
        )
    store = place.parent.parent
    folder = folder_for(store) / place.name
    copy = folder / store.name
    sizes = _sizes_of(copy)
    if _is_whole(copy, sizes):
        return copy
    try:
        pointer = read_pointer(store)
        objects = list_objects(place)  # Names that lead out of a folder are not among them.
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as own:
            part = Path(own, "part")
            get_objects(place, part, objects)
            for name, entry in objects.items():
                if (part / name).stat().st_size != entry["size"]:
                    raise StoreError(f"{place / name}: changed while it was copied; run again")
            if pointer is not None and pointer.version == place.name and pointer.content:
                digests = {name: file_digest(part / name) for name in objects}
                if content_of(digests) != pointer.content:
                    raise StoreError(
                        f"{place}: the copy is not what was published there; run again, and if "
                        f"that does not help, `slatprep verify {store}` names what is damaged"
                    )
            if not _is_whole(copy, sizes):  # Another process may have been faster.
                shutil.rmtree(copy, ignore_errors=True)
                if copy.is_file():
                    copy.unlink()
                kept = {name: _kept_of(part / name) for name in objects}
                Path(own, "sizes").write_bytes(orjson.dumps(kept))
                Path(own, "sizes").replace(sizes)
                part.rename(copy)
    except OSError as error:
        raise StoreError(f"{place}: cannot be copied to {folder} ({error.strerror})") from None
    return copy


def _sizes_of(copy: Path) -> Path:
    """Return the file beside a copy that tells what the copy's files are."""
    return copy.with_name(f".{copy.name}.sizes")


def _is_whole(copy: Path, sizes: Path) -> bool:
    """Return whether a copy has all its files, by `_kept_of`."""
    try:
        known = orjson.loads(sizes.read_bytes())
        return bool(known) and all(_kept_of(copy / name) == own for name, own in known.items())
    except (OSError, ValueError, AttributeError):
        return False


def _kept_of(file: Path) -> int | str:
    """Return a file's size, or the digest of a small file, such as all metadata."""
    size = file.stat().st_size
    return size if size > SMALL_BYTES else file_digest(file)


def what_to_do(store: str) -> str:
    """Return advice for a damaged store, which may be a copy that `copied_version` made."""
    if _sizes_of(Path(store)).exists():
        return f"Remove {store}, a copy, and open the store again"
    return "Copy the store again, or build it"
