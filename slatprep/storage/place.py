"""Places on the local disk and on object stores, behind one protocol.

`slatprep.records.Place` is enough to name a place or to read a whole file: `pathlib.Path` and
`RemotePlace` both implement it. Work that differs between the two is a method of `Storage`.
"""

from __future__ import annotations

import difflib
import io
import os
import re
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import IO, TYPE_CHECKING, TypeGuard

from slatprep.errors import ConfigError, InputError, StoreError
from slatprep.storage.archives import Archive
from slatprep.storage.atomic import staged, staged_apart
from slatprep.storage.cache import cached_file, copied_version, folder_for
from slatprep.storage.files import (
    Listing,
    LocalFile,
    LocalFolder,
    RemoteListing,
    local_files,
    open_regular,
)
from slatprep.storage.members import ArchivePlace
from slatprep.storage.remote import (
    RemoteFile,
    RemoteFolder,
    RemotePlace,
    list_folder,
    list_objects,
    pinned,
    remove_objects,
)
from slatprep.storage.states import Noted, States, note, reading
from slatprep.storage.versions import current_version

if TYPE_CHECKING:
    from slatprep.records import Place

# pathlib makes one slash of two, and one letter is a drive.
_URL = re.compile(r"([a-z][a-z0-9+.-]+):/+(.*)", re.DOTALL | re.IGNORECASE)

_LOCAL, _SAME = ("file", "local"), {"s3a": "s3", "gcs": "gs"}
"""Protocols of the local disk, and other names of protocols."""

RangeFile = LocalFile | RemoteFile
"""A file for reading ranges; threads may share it."""

Folder = LocalFolder | RemoteFolder
"""A folder for reading ranges of its files, which stay those of one store."""


def place_of(text: str | Place, folder: Path | None = None) -> Place:
    """Return a path of the local disk, or a `RemotePlace` for the URL of an object store.

    A relative path starts from `folder`, if given. Links in it are then resolved, and ``~`` stands
    for the user's folder. ``.`` and a path that ends in ``..`` become absolute. TypeError if it is
    neither a text nor a path, ConfigError for a URL without a bucket, or one that object stores
    take differently.

    >>> print(place_of("s3://bucket/demo.zarr") / "zarr.json")
    s3://bucket/demo.zarr/zarr.json
    >>> print(place_of("file:///data/demo.zarr"))
    /data/demo.zarr
    """
    if not (isinstance(text, str | os.PathLike) or is_place(text)):
        raise TypeError(f"{text!r} is no place; expected a path or a URL")
    url = _URL.fullmatch(str(text))
    protocol = url[1].lower() if url else ""
    if url and protocol not in _LOCAL:
        if not url[2].strip("/"):
            raise ConfigError(
                f"{url[0]!r} names no bucket; expected a URL such as s3://bucket/name"
            )
        if ".." in url[2].split("/") or "::" in url[2] or not url[2].isprintable():
            fault = "has '..', '::' or a control character"
            raise ConfigError(f"{url[0]!r} {fault}; expected a plain URL")
        return RemotePlace(_SAME.get(protocol, protocol), PurePosixPath(url[2]))
    if not url and "://" in str(text):
        raise ConfigError(f"{str(text)!r} is no URL; expected one such as s3://bucket/name")
    path = Path("/", url[2]) if url else Path(str(text))
    if folder is not None:
        return (folder / path.expanduser()).resolve()
    # "." and ".." do not tell the names of what lies beside them.
    return path.resolve() if path.name in ("", "..") else path


def local_path_of(text: str | Place) -> Path:
    """Return a path of the local disk, as `place_of` does; ConfigError for any other place."""
    place = place_of(text)
    if not isinstance(place, Path):
        raise ConfigError(f"{place}: expected a path of the local disk")
    return place


def is_place(value: object) -> TypeGuard[Path | RemotePlace | ArchivePlace]:
    """Return whether a value is a path, a URL from `place_of`, or a place in archives."""
    return isinstance(value, Path | RemotePlace | ArchivePlace)


def storage_of(place: Place) -> Storage:
    """Return the storage of a place."""
    if not is_place(place):
        raise TypeError(f"{place!r} is no place; expected what `place_of` returns")
    if isinstance(place, ArchivePlace):
        return _Archives(place)
    return Storage(place) if isinstance(place, Path) else _ObjectStore(place)


class Storage:
    """Operations at a place: here on the local disk, below on an object store.

    `local` is the place as a path, `remote` as that of an object store; one of them is None.
    """

    local: Path | None
    remote: RemotePlace | None = None

    def __init__(self, path: Path) -> None:
        self.local = self._path = path

    def files(self) -> dict[str, int]:
        """Return the names and sizes [byte] of all files below the place, as `local_files`.

        Raises StoreError if they cannot be listed.
        """
        try:
            return self._sizes()
        except OSError as error:
            where = self.remote or error.filename or self.local
            what = f"cannot be listed ({error.strerror}); check your permissions"
            raise StoreError(f"{where}: {what}") from None

    def _sizes(self) -> dict[str, int]:
        return local_files(self._path)

    def listing(self) -> Listing:
        """Return a listing of the place, which answers for names one by one."""
        return Listing(self._path)

    def names(self) -> tuple[list[str], list[str]]:
        """Return the names of files and of folders that lie directly in the place."""
        listing = self.listing()
        return list(listing.of_folder("", folders=False)), list(listing.of_folder("", folders=True))

    def absent(self, *, files: bool = True, folders: bool = True) -> str:
        """Words for a message if there is nothing at the place: how far the path leads.

        `files` and `folders` tell which of them the user may have meant.
        """
        try:
            path = self._path.absolute()
            first = next((one for one in reversed(path.parents) if not one.is_dir()), path)
            beside = sorted(islice(first.parent.iterdir(), 1000))
            if first.exists():
                return f"does not exist; {first} is no folder"
            if first.is_symlink():
                return f"does not exist; {first} is a link that leads nowhere ({first.readlink()})"
            seen = [one for one in beside if one.name[0] != "."]
            held = [one.name for one in seen if (one.is_dir() if folders else one.is_file())]
            meant = held + [one.name for one in seen if folders and files and one.is_file()]
        except OSError as error:
            return f"cannot be looked for: {error.filename or 'working folder'}: {error.strerror}"
        if close := difflib.get_close_matches(first.name, meant, n=1):
            return f"does not exist; did you mean {first.with_name(close[0])}?"
        # A count could be wrong: the listing may have been cut short.
        told = ", ".join(held[:5]) + " and others" * (len(held) > 5) or "(none)"
        kind = "folders" if folders else "files"
        return f"does not exist; {first.parent} does, and holds the {kind} {told}"

    def archives(self, names: Iterable[str], wanted: tuple[str, ...]) -> list[Archive]:
        """Return archives that lie in the place, by name; only members like `wanted` matter.

        OSError if one cannot be read, InputError if one is a link that leads out of the place.
        """
        found = []
        for name in names:
            try:
                self.locate(self._path / name)
            except InputError as error:
                way = "an archive in its folder, not a link; or point at the archive itself"
                raise InputError(error.path, error.fault, way) from None
            found.append(Archive.on_disk(self._path / name, wanted))
        return found

    def folder(self) -> Folder:
        """Return the place as a folder for reading ranges of its files."""
        return LocalFolder(self._path)

    def locate(self, file: Place) -> tuple[Place, str]:
        """Return a file below the place with links resolved, and its name relative to it.

        Raises InputError if it leads out of the place, does not exist, or is not a regular file.
        """
        path, root = Path(str(file)), self._path
        try:
            relative = path.relative_to(root)
            resolved = path.resolve(strict=True)
            inside = ".." not in relative.parts and _may_lead_to(root.resolve(), resolved)
            regular = stat.S_ISREG(resolved.stat().st_mode)
        except FileNotFoundError:
            fault = "is a link that leads nowhere" if path.is_symlink() else "does not exist"
            raise InputError(path, fault, "a readable file") from None
        except (OSError, RuntimeError, ValueError) as error:  # link loops, NUL, other roots
            raise InputError(path, f"cannot be opened ({error})", f"a file below {root}") from None
        if not inside:
            raise InputError(
                path,
                f"leads to {resolved}, out of its root",
                f"a file below {root.resolve()}; copy it there, or give a root that holds both, "
                f"{os.path.commonpath([root.resolve(), resolved])}, and patterns from there",
            )
        if not regular:
            raise InputError(path, "is not a regular file", "a readable file")
        return resolved, relative.as_posix()

    def open(self) -> IO[bytes]:
        """Open a file for reading; OSError if it does not exist, or is a folder, pipe or device."""
        return io.BufferedReader(open_regular(self._path))

    def read(self, limit: int, asked: Place | None = None) -> bytes:
        """Read at most `limit` + 1 bytes of a file; the last byte shows that it is too large.

        The file's state is noted under `asked`, or its own place; see `slatprep.storage.states`.
        """
        with open_regular(self._path) as file, reading(file.fileno(), str(asked or self._path)):
            return file.upto(limit)

    def open_scattered(self) -> IO[bytes]:
        """Open a file for random access; an object is fetched whole, at once. OSError as `open`."""
        return self.open()

    def size(self) -> int:
        """Return the size of a file in bytes."""
        return self._path.stat().st_size

    def on_disk(self) -> Path:
        """Return a path of the local disk with the file's content."""
        return self._path

    def state(self, states: States) -> Noted:
        """Return values by which a later change is found; None if it cannot be."""
        return states.of(str(self._path))

    def current_version(self) -> Place:
        """Return the current place of the store's files; StoreError if it cannot be reached."""
        return self._path

    def copied_version(self) -> Path:
        """Return a local path of the store; a remote version is copied."""
        return self._path

    def remove(self, names: Iterable[str]) -> None:
        """Remove files below the place; files that do not exist are no error."""
        for name in names:
            (self._path / name).unlink(missing_ok=True)

    def staged(self) -> AbstractContextManager[Path]:
        """Yield a local file that becomes the place's content, complete, unless an error occurs."""
        return staged(self._path)

    def staged_apart(self, folder: Place) -> AbstractContextManager[Path]:
        """As `staged`, for a worker: the file begins in `folder`, see `atomic.staged_apart`."""
        begun = Path(str(folder))
        begun.mkdir(exist_ok=True)  # Fails if the folder around it was removed.
        self._path.parent.mkdir(parents=True, exist_ok=True)
        return staged_apart(self._path, begun)

    def work_folder(self) -> Path:
        """Return the folder for work on the place: beside it, or in the cache of a remote one."""
        return self._path.with_name(f".{self._path.name}.work")


def _may_lead_to(root: Path, file: Path) -> bool:
    """Return whether a link below a root may lead to a file: below it, or in its hub cache."""
    if file.is_relative_to(root):
        return True
    # The hub's cache has snapshots/COMMIT/..., whose files are links into blobs.
    homes = (folder.parent for folder in (root, *root.parents) if folder.name == "snapshots")
    return any(file.is_relative_to(home / "blobs") for home in homes)


class _ObjectStore(Storage):
    """See `Storage`."""

    def __init__(self, place: RemotePlace) -> None:
        self.local, self.remote, self.place = None, place, place

    def _sizes(self) -> dict[str, int]:
        return {name: int(entry["size"]) for name, entry in list_objects(self.place).items()}

    def listing(self) -> Listing:
        return RemoteListing(list_objects(self.place))

    def absent(self, *, files: bool = True, folders: bool = True) -> str:
        if self.place.protocol != "hf":
            return "does not exist"
        return "is not on the hub, or not for everybody: check its name, and set HF_TOKEN"

    def names(self) -> tuple[list[str], list[str]]:
        found = list_folder(self.place)
        files = [name for name, entry in found.items() if entry["type"] == "file"]
        return files, [name for name in found if name not in files]

    def archives(self, names: Iterable[str], wanted: tuple[str, ...]) -> list[Archive]:
        place = pinned(self.place)
        found = list_folder(place)
        return [Archive.of_object(place / name, found[name], wanted) for name in names]

    def folder(self) -> Folder:
        return RemoteFolder(pinned(self.place))  # A commit may replace a store while it is read.

    def locate(self, file: Place) -> tuple[Place, str]:
        # An object store has no links that could lead out.
        name = str(file).removeprefix(f"{self.place}/")
        if name == str(file) or {".", ".."} & set(name.split("/")):
            raise InputError(file, "is no plain name below its root", "a name without '..'")
        return file, name

    def open(self) -> IO[bytes]:
        return self.place.open("rb")

    def read(self, limit: int, asked: Place | None = None) -> bytes:
        return RemoteFile(self.place).upto(limit)

    def state(self, states: States) -> Noted:
        return None

    def open_scattered(self) -> IO[bytes]:
        return io.BytesIO(self.place.read_bytes())

    def size(self) -> int:
        return RemoteFile(self.place).size()

    def on_disk(self) -> Path:
        return cached_file(self.place)

    def current_version(self) -> Place:
        return current_version(self.place)

    def copied_version(self) -> Path:
        return copied_version(self.place)

    def remove(self, names: Iterable[str]) -> None:
        remove_objects(self.place, names)

    @contextmanager
    def staged(self) -> Iterator[Path]:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, self.place.name)
            yield file
            self.place.upload(file)

    def staged_apart(self, folder: Place) -> AbstractContextManager[Path]:
        return self.staged()

    def work_folder(self) -> Path:
        return folder_for(self.place) / "work"


class _Archives(Storage):
    """See `Storage`; nothing can be written there."""

    def __init__(self, place: ArchivePlace) -> None:
        self.local, self.remote, self.place = None, None, place

    def _sizes(self) -> dict[str, int]:
        members = self.place.tree.members
        return {name: members[name][1].size for name in sorted(members)}

    def listing(self) -> Listing:
        return self.place.tree.listing()

    def locate(self, file: Place) -> tuple[Place, str]:
        if not isinstance(file, ArchivePlace) or file.entry is None:
            raise InputError(file, "does not exist", "a readable file")
        return file, file.path

    def open(self) -> IO[bytes]:
        return self.place.open("rb")

    def read(self, limit: int, asked: Place | None = None) -> bytes:
        # A file that is too large is not read: zeros stand for its content.
        data = bytes(limit + 1) if self.place.size > limit else self.place.read_bytes()
        note(str(asked or self.place), self.place.state())
        return data

    def size(self) -> int:
        return self.place.size

    def state(self, states: States) -> Noted:
        return self.place.state()
