"""Read, list, hash and name files of the local disk.

A listing of a disk asks for names one by one. An object store has no folders: one request lists a
thousand names, and a request for a single name costs as much.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import stat
from collections.abc import Iterable
from contextlib import suppress
from functools import cached_property
from io import BufferedWriter, BytesIO, FileIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, cast
from urllib.parse import quote

if TYPE_CHECKING:
    from slatprep.records import Place

_NO_WAITING = getattr(os, "O_NONBLOCK", 0)  # a pipe's reader would wait for a writer

OWN_FILE = os.O_CREAT | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOFOLLOW", 0) | _NO_WAITING
"""Flags to open or create our own file without following links or waiting for pipes."""


class LocalFile(FileIO):
    """An unbuffered file of the local disk; threads may share it."""

    def __del__(self) -> None:
        # A reader keeps its files open for its whole life, so no warning is given.
        self.close()

    def size(self) -> int:
        """Return its length in bytes; OSError if it is a folder, pipe or device."""
        state = os.fstat(self.fileno())
        if not stat.S_ISREG(state.st_mode):
            raise OSError(errno.EINVAL, "it is no regular file")
        return state.st_size

    def pread(self, length: int, offset: int) -> bytes:
        """Read up to `length` bytes from an offset."""
        return os.pread(self.fileno(), length, offset)

    def upto(self, limit: int) -> bytes:
        """Read at most `limit` + 1 bytes; the last one shows that the file is too large."""
        # read() would allocate all that it is allowed to return.
        return self.pread(min(self.size(), limit + 1), 0)


class LocalFolder:
    """An open directory: files read below it belong to one store, even if the store is replaced.

    Errors call it `path`. `prefetch_bytes` is the longest range to read ahead; 0 means none,
    because the system reads ahead by itself.
    """

    prefetch_bytes = 0
    _close = staticmethod(os.close)  # When the interpreter ends, `os` may be gone before a folder.

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self._descriptor = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)

    def open(self, name: str) -> LocalFile:
        """Open a file for reading, without buffer."""
        return LocalFile(name, opener=self._open_at)

    def _open_at(self, name: str, flags: int) -> int:
        return os.open(name, flags | _NO_WAITING, dir_fd=self._descriptor)

    def __del__(self) -> None:
        if hasattr(self, "_descriptor"):  # else it could not be opened
            self._close(self._descriptor)


def open_regular(path: Path) -> LocalFile:
    """Open a regular file for unbuffered reading, without waiting for pipes.

    Raises OSError if it does not exist, or is a folder, pipe or device.
    """
    file = LocalFile(os.open(path, os.O_RDONLY | _NO_WAITING))
    try:
        file.size()
    except OSError:
        file.close()
        raise
    return file


def private_file(path: Path) -> BufferedWriter:
    """Open our own file for writing in place; it is emptied, and nobody else may read it.

    Raises OSError if it cannot be written, is a link, has other names, or another owner.
    """
    file = LocalFile(os.open(path, os.O_WRONLY | OWN_FILE, 0o600), "wb")
    try:
        file.size()
        if not is_only_ours(os.fstat(file.fileno())):
            raise OSError(errno.EPERM, "it is not ours alone")
        file.truncate(0)
    except OSError:
        file.close()
        raise
    return BufferedWriter(file)


def is_only_ours(state: os.stat_result) -> bool:
    """Return whether a regular file, by its state, belongs to us and has only one name."""
    return stat.S_ISREG(state.st_mode) and state.st_nlink == 1 and state.st_uid == os.geteuid()


def is_at(descriptor: int, path: Path) -> bool:
    """Return whether an open file is still the file at a path."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def locks_alone(descriptor: int) -> bool:
    """Lock an open file unless another process has locked it; return whether that worked.

    The lock ends with the process, however the process ends.
    """
    import fcntl  # Windows has none; `slatprep.storage.atomic.take_lock` says so.

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def take_file(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it if it is not only ours or linking fails.

    A copy shares its blocks with the original if the file system can. OSError if the file cannot
    be read, or the copy cannot be written.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    if is_only_ours(source.lstat()):
        with suppress(OSError):
            os.link(source, target)
            return
    with open_regular(source) as old, target.open("xb") as new:
        left = old.size()
        with suppress(OSError, AttributeError):  # The call may be missing or not work here.
            while left and (done := os.copy_file_range(old.fileno(), new.fileno(), left)):
                left -= done
        new.seek(0, os.SEEK_END)
        shutil.copyfileobj(old, new)


LINK, OTHER = -1, -2
"""Values in place of a size: for a symbolic link, and for a pipe, device or socket."""


def local_files(path: Path) -> dict[str, int]:
    """Return every file below a folder and its size in bytes.

    Names have forward slashes and are sorted by folder. Links are not followed; their size is
    `LINK`. The size of other irregular files is `OTHER`. PermissionError if a folder cannot be
    listed.
    """
    found = {}
    for folder, folders, files in os.walk(path, onerror=_raise_denied):
        folders.sort()
        below = Path(folder).relative_to(path).as_posix()
        prefix = "" if below == "." else f"{below}/"
        states = {name: os.lstat(f"{folder}/{name}") for name in [*folders, *files]}
        for name, state in sorted(states.items()):
            if stat.S_ISDIR(state.st_mode):
                continue
            size = state.st_size if stat.S_ISREG(state.st_mode) else OTHER
            found[prefix + name] = LINK if stat.S_ISLNK(state.st_mode) else size
    return found


def _raise_denied(error: OSError) -> None:
    if isinstance(error, PermissionError):
        raise error


def file_digest(place: Place) -> str:
    """Return the SHA-256 of a file, in hex."""
    with open_regular(place) if isinstance(place, Path) else place.open("rb") as file:
        return open_digest(file)


def open_digest(file: IO[bytes] | LocalFile) -> str:
    """Return the SHA-256 of an open file that has not been read, in hex."""
    return hashlib.file_digest(cast(BytesIO, file), "sha256").hexdigest()


class Listing:
    """Names below a folder of the local disk, up to date except that its top is listed only once.

    Names are relative to the folder, with forward slashes.
    """

    def __init__(self, root: Path) -> None:
        self._root = str(root)  # os.path.join is slower with a Path.

    def of_folder(self, folder: str, *, folders: bool) -> Iterable[str]:
        """Return the names of a folder's files, or of its folders; none if it does not exist.

        `folder` ends with a slash, or is empty for the root. OSError if it cannot be listed.
        """
        return (self._scan(folder) if folder else self._top)[folders]

    def is_file(self, path: str) -> bool:
        """Return whether this name exists and is not a folder; broken links count."""
        full = os.path.join(self._root, path)  # noqa: PTH118 - half a million times
        link = False
        try:
            mode = os.lstat(full).st_mode
            if link := stat.S_ISLNK(mode):
                mode = os.stat(full).st_mode  # noqa: PTH116
        except (OSError, ValueError):
            return link
        return not stat.S_ISDIR(mode)

    @cached_property
    def _top(self) -> tuple[list[str], list[str]]:
        return self._scan("")  # Every pattern begins at the root.

    def _scan(self, folder: str) -> tuple[list[str], list[str]]:
        """Return the names in a folder: of files and other entries, and of folders."""
        found: tuple[list[str], list[str]] = ([], [])
        try:
            with os.scandir(os.path.join(self._root, folder)) as entries:  # noqa: PTH118
                for entry in entries:
                    found[_is_folder(entry)].append(entry.name)
        except (FileNotFoundError, NotADirectoryError):
            pass
        return found


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # A link loop.
        return False


class RemoteListing(Listing):
    """Names below a place on an object store at the time of its listing, relative to the place."""

    def __init__(self, files: Iterable[str]) -> None:
        self.files = frozenset(files)
        self._folders: dict[str, dict[str, None]] = {}
        for file in self.files:
            while file:
                folder, _, name = file.rpartition("/")
                self._folders.setdefault(folder + "/" if folder else "", {})[name] = None
                file = folder

    def of_folder(self, folder: str, *, folders: bool) -> Iterable[str]:
        """See `Listing`."""
        names = self._folders.get(folder, ())
        if folders:
            return [name for name in names if f"{folder}{name}/" in self._folders]
        return [name for name in names if folder + name in self.files]

    def is_file(self, path: str) -> bool:
        """See `Listing`."""
        return path in self.files


_LONGEST_NAME = 180


def file_name(asset_id: str, *, dots: bool = True) -> str:
    """Return a file name for an asset of any id, without suffix.

    Plain ids stay unchanged. Characters with a meaning to a shell, an archive or a file system are
    percent-encoded, as are a leading sign and, without `dots`, dots. A name that is too long is cut
    and ends in a hash.

    >>> file_name("0a1b2c.front"), file_name("0a1b2c.front", dots=False)
    ('0a1b2c.front', '0a1b2c%2Efront')
    >>> file_name("../a b"), file_name("-rf")
    ('%2E.%2Fa%20b', '%2Drf')
    """
    name = quote(asset_id, safe="") or "%"
    if not dots:
        name = name.replace(".", "%2E")
    if name.startswith((".", "_", "-", "~")):
        name = f"%{ord(name[0]):02X}{name[1:]}"
    if len(name) > _LONGEST_NAME:
        digest = hashlib.sha256(asset_id.encode()).hexdigest()[:32]
        name = f"{name[:_LONGEST_NAME]}~{digest}"
    return name
