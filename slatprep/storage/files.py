"""Files of the local disk: reading by ranges, listing, and digests."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import stat
import sys
from contextlib import suppress
from io import BufferedWriter, BytesIO, FileIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, cast

if TYPE_CHECKING:
    from slatprep.records import Place


_AT = os.open in os.supports_dir_fd
_NO_WAITING = getattr(os, "O_NONBLOCK", 0)  # a pipe's reader would wait for a writer
_NO_LINK = getattr(os, "O_NOFOLLOW", 0)

OWN_FILE = os.O_CREAT | getattr(os, "O_CLOEXEC", 0) | _NO_LINK | _NO_WAITING
"""Flags to open or create our own file without following links or waiting for pipes."""


class LocalFile(FileIO):
    """An unbuffered file of the local disk; threads may share it."""

    def __del__(self) -> None:
        # A reader keeps its files open for its whole life, on purpose.
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

    def prefetch(self, length: int, offset: int) -> None:
        """Do nothing: the system reads ahead by itself."""


class LocalFolder:
    """An open directory: files read below it belong to one store, even if that is replaced.

    Errors call it `path`. `prefetch_bytes` is the longest range worth a `prefetch`; 0 for none.
    """

    prefetch_bytes = 0

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self._descriptor = os.open(self.path, os.O_RDONLY) if _AT else None

    def open(self, name: str) -> LocalFile:
        """Open a file for reading, without buffer."""
        if self._descriptor is None:
            return LocalFile(os.path.join(self.path, name))  # noqa: PTH118 - the hot path
        return LocalFile(name, opener=self._open_at)

    def _open_at(self, name: str, flags: int) -> int:
        return os.open(name, flags | _NO_WAITING, dir_fd=self._descriptor)

    def __del__(self) -> None:
        if getattr(self, "_descriptor", None) is not None:
            os.close(self._descriptor)  # type: ignore[arg-type]


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
    """Whether a regular file, by its state, belongs to us and has only one name."""
    user = getattr(os, "geteuid", lambda: state.st_uid)()
    return stat.S_ISREG(state.st_mode) and state.st_nlink == 1 and state.st_uid == user


def is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file is still the file at a path."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def locks_alone(descriptor: int) -> bool:
    """Lock an open file unless another process has locked it; return whether that worked.

    The lock ends with the process, however that ends. Windows has no such lock: always True.
    """
    if sys.platform == "win32":
        return True
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def take_file(source: Path, target: Path) -> None:
    """Give a file a second name, or copy it if it is not only ours or linking fails.

    A copy shares its blocks with the original where the file system can. OSError if the file cannot
    be read, or the disk refuses.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    if is_only_ours(source.lstat()):
        with suppress(OSError):
            os.link(source, target)
            return
    with open_regular(source) as old, target.open("xb") as new:
        left = old.size()
        with suppress(OSError, AttributeError):  # no such call, or none between these places
            while left and (done := os.copy_file_range(old.fileno(), new.fileno(), left)):
                left -= done
        new.seek(0, os.SEEK_END)
        shutil.copyfileobj(old, new)


LINK, OTHER = -1, -2
"""Stand for a size: a symbolic link; a pipe, device or socket."""


def local_files(path: Path) -> dict[str, int]:
    """Return every file below a folder and its size in bytes.

    Names have forward slashes and are sorted by folder. Links are not followed; their size is
    `LINK`. The size of other irregular files is `OTHER`.
    """
    found = {}
    for folder, folders, files in os.walk(path):
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


def file_digest(place: Place) -> str:
    """Return the SHA-256 of a file, in hex."""
    with open_regular(place) if isinstance(place, Path) else place.open("rb") as file:
        return open_digest(file)


def open_digest(file: IO[bytes] | LocalFile) -> str:
    """Return the SHA-256 of an open file that has not been read, in hex."""
    return hashlib.file_digest(cast(BytesIO, file), "sha256").hexdigest()
