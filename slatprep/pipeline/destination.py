"""Where a store and its records go, and whether anything else is there.

A store and its records are replaced in one step, because the records are an array of the store. The
files beside it are made from them. No file of another origin is ever overwritten.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from slatprep.errors import ConfigError, SlatprepError, StoreError, in_unicode
from slatprep.records import Normalization, Place
from slatprep.storage.atomic import replace_directory
from slatprep.storage.faults import reached
from slatprep.storage.place import place_of, storage_of
from slatprep.storage.upload import PublishedState, Staged, Upload, published_state, upload_store
from slatprep.store.reader import Store, is_store, open_store, require_beside, require_outside
from slatprep.store.records import ASSETS, BUILD, ERRORS, build_in, manifests_of, stale_files

_MARKS = {
    BUILD: b'"slatprep-build-record"',
    ASSETS: b'"slatprep-asset-record"',
    ERRORS: b'"refitted"',
}
"""Text near the beginning of each file beside a store, which identifies the file."""

_HEAD_BYTES = 4096


class Destination:
    """Destination of a store and its records.

    `out` is the store as its user names it, and `store` its real place, behind a link. `manifests`
    is the folder of its records, if not beside it. `removed` are those of an existing store's
    assets that the new store lacks, and `ranges` its ranges, if they are known, by words for it.
    `if_stopped` has what a stop says once the new store is put in place; it is empty before that.
    ConfigError if there is something other than a store, or it lies in another store. StoreError if
    the folder holds files of other origin or the records of another store.
    """

    def __init__(self, out: str | Place, manifests: str | Place | None = None) -> None:
        self.out = place_of(out)
        if str(self.out) != in_unicode(str(self.out)):
            raise StoreError(f"{self.out}: is no UTF-8; expected a name that records can hold")
        self._manifests = None if manifests is None else storage_of(place_of(manifests)).local
        if manifests is not None and self._manifests is None:
            raise StoreError(f"{manifests}: expected a local folder for the records")
        path, self._remote = storage_of(self.out).local, storage_of(self.out).remote
        self.store: Place = self.out if path is None else _replaceable(path)
        folder = self._manifests
        if folder is None and path is not None:
            require_beside(folder := Path(str(manifests_of(path))))
        if folder is not None:
            real = storage_of(self.store).local
            _require_records(folder, real)
            if real is not None:
                _require_own(folder, real)
        self._before: PublishedState | None = None
        self._upload: Upload | None = None
        self.if_stopped: list[str] = []
        self.removed: list[str] = []
        self.ranges: dict[str, Normalization] = {}

    def look(self) -> None:
        """Read what is published on an object store; StoreError if no store may be there."""
        if self._remote is not None:
            self._before = published_state(self._remote)

    def replace(self, new: Path, ids: Iterable[str], staged: Staged | None = None) -> None:
        """Put a finished store with these ids in place; on an object store, do not publish it yet.

        `staged` are its files that are on the object store already.
        """
        self.if_stopped.append(f"{self.out} is the old store or the new one, whole; run it again")
        self.removed, self.ranges = self.lost(ids, "was")
        if self._before is not None:
            self._upload = upload_store(new, self._before, staged)
        elif (path := storage_of(self.store).local) is not None:
            replace_directory(new, path)
        reached("store replaced", str(self.store))

    def lost(self, ids: Iterable[str], verb: str) -> tuple[list[str], dict[str, Normalization]]:
        """Return ids of the existing store not among `ids`, sorted; its ranges for `moved_ranges`.

        `verb` says in words when it lies there.
        """
        with suppress(StoreError):  # There is no store, or its ids cannot be read.
            there = open_store(self.store)
            ranges = {f"the store that {verb} there": there.normalization}
            return sorted(set(there.ids).difference(ids)), ranges
        return [], {}

    def publish(self) -> None:
        """Make the new version on an object store the current one."""
        if self._upload is not None:
            self._upload.publish()

    def in_place(self) -> Store:
        """Open the new store after it was put in place."""
        return open_store(self.store if self._upload is None else self._upload.version)

    def manifests(self, store: Place | None = None) -> Place:
        """Return the folder of the records of a store that lies here, by default a new store."""
        version = None if self._remote is None else store
        return self._manifests or manifests_of(self.out if version is None else version)


def _replaceable(out: Path) -> Path:
    require_outside(out, to_replace=True)
    try:
        taken = out.exists() and not is_store(out) and not (out.is_dir() and not any(out.iterdir()))
    except OSError as error:
        raise StoreError(
            f"{out}: cannot be looked at ({error.strerror}); expected a path that may be read and "
            "written"
        ) from error
    if taken:
        raise ConfigError(
            f"{out} exists and is not a slatprep store; expected a store to replace, or a new path"
        )
    return out.resolve()


def _require_records(folder: Path, store: Path | None) -> None:
    """Raise if anything but records of builds would be overwritten in a folder."""
    if store is not None and folder.resolve().is_relative_to(store):
        raise StoreError(f"{folder}: lies in the store; expected a folder outside of it")
    require_outside(folder)
    require_free(folder / BUILD, *(stale_files(folder, ()) if folder.is_dir() else ()))


def require_free(*files: Path, mark: str = "", kind: type[SlatprepError] = StoreError) -> None:
    """Raise if any of these files exist and none of them is marked, see `is_marked`.

    If one file is damaged, another identifies their folder.
    """
    there = [file for file in files if os.path.lexists(file)]
    if there and not any(is_marked(file, mark) for file in there):
        raise kind(
            f"{there[0]} exists and is not slatprep's; expected such a file to replace, or none: "
            "move it away, or choose another path"
        )


def _require_own(folder: Path, store: Path) -> None:
    """Raise if a folder holds the records of another store that still exists.

    ``demo`` and ``demo.zarr`` share a folder by default. A store that was renamed with its records
    keeps them, even if a new store has the old name: the new store has another folder.
    """
    try:
        name = build_in(folder).store
        others = store.with_name(name), folder.with_name(name)
    except (StoreError, ValueError):
        return  # Missing or damaged records are written anew.
    for other in others:
        renamed = folder.name == manifests_of(store).name != manifests_of(other).name
        taken = not renamed and name != store.name and is_store(other)
        if taken and other.resolve() != store.resolve():
            raise StoreError(
                f"{folder}: holds the records of {other}; expected --manifests FOLDER, or another "
                f"name for {store}"
            )


def is_marked(file: Path, name: str = "") -> bool:
    """Return whether a file has the mark of a file called `name`, by default its own name."""
    try:
        return _MARKS.get(name or file.name, _MARKS[ASSETS]) in storage_of(file).read(_HEAD_BYTES)
    except OSError:
        return False
