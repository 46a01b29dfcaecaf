"""Places on object stores: URLs that stand where a path of the local disk may stand.

A `RemotePath` is a path, so it goes wherever paths go: into parameters,
records, messages and to workers. What asks it something asks the object store
through fsspec. Nothing can be changed at one but by `RemotePath.upload`;
what else pathlib offers is refused, with the place named.

Credentials and endpoints are the libraries' own matter: those of S3, for
instance, come from ``AWS_*`` variables or ``~/.aws``.
"""

from __future__ import annotations

import errno
import io
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from os import stat_result
from pathlib import Path, PosixPath
from typing import TYPE_CHECKING, Any, NoReturn

from slatprep.errors import ConfigError

if TYPE_CHECKING:
    from typing import Self

BUFFER_BYTES = 8 * 2**20
"""What one request of a file that is read from its beginning asks for."""

# pathlib makes one slash of two, and one letter is a drive.
_URL = re.compile(r"([a-z][a-z0-9+.-]+):/+(.*)", re.DOTALL)

_LOCAL = ("file", "local")


def as_path(place: str | Path) -> Path:
    """Return a path, a `RemotePath` where it is the URL of an object store.

    Parameters
    ----------
    place : str or Path
        A path, a URL, or a URL that was made a path.

    Examples
    --------
    >>> print(as_path("s3://bucket/demo.zarr") / "zarr.json")
    s3://bucket/demo.zarr/zarr.json
    >>> print(as_path("file:///data/demo.zarr"))
    /data/demo.zarr
    """
    if isinstance(place, RemotePath):
        return place
    url = _URL.fullmatch(str(place))
    if url is None:
        return Path(place)
    protocol, rest = url.groups()
    return Path("/", rest) if protocol in _LOCAL else RemotePath(f"{protocol}:", rest)


class RemotePath(PosixPath):
    """A URL of an object, or of all objects below it; `as_path` makes one.

    Raises
    ------
    OSError
        By every method that asks the object store, which may refuse or not
        answer; libraries' own errors are told as one.
    ConfigError
        By the same, if a library is missing or the protocol is unknown.
    """

    def __str__(self) -> str:
        parts = self.parts
        if self.is_absolute():
            return f"{parts[0]}//{'/'.join(parts[1:])}"
        return "/".join(parts) or "."

    def resolve(self, strict: bool = False) -> Self:
        """Return the same: an object store has no links."""
        return self

    def absolute(self) -> Self:
        """Return the same."""
        return self

    def is_absolute(self) -> bool:
        """Whether it is a URL, and not the rest of one."""
        return self.parts[:1] != () and self.parts[0].endswith(":")

    def expanduser(self) -> Self:
        """Return the same."""
        return self

    def is_symlink(self) -> bool:
        """Return False: an object store has no links."""
        return False

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        """Whether there is an object, or any below."""
        return self._kind() != ""

    def is_dir(self, *, follow_symlinks: bool = True) -> bool:
        """Whether there is any object below, but none of this name."""
        return self._kind() == "directory"

    def is_file(self, *, follow_symlinks: bool = True) -> bool:
        """Whether there is an object."""
        return self._kind() == "file"

    def stat(self, *, follow_symlinks: bool = True) -> stat_result:
        """Return the size of an object; times are not told."""
        return stat_result((stat.S_IFREG, 0, 0, 1, 0, 0, RemoteFile(self).size(), 0, 0, 0))

    def open(
        self, mode: str = "r", buffering: int = -1, encoding: str | None = None,
        errors: str | None = None, newline: str | None = None,
    ) -> Any:  # fmt: skip
        """Open an object for reading, from its beginning."""
        if mode not in ("r", "rt", "rb"):
            self._refuse()
        file = io.BufferedReader(RemoteFile(self), BUFFER_BYTES)
        return file if mode == "rb" else io.TextIOWrapper(file, encoding, errors, newline)

    def read_bytes(self) -> bytes:
        """Read an object whole."""
        with self.open("rb") as file:
            return bytes(file.read())

    def read_text(
        self, encoding: str | None = None, errors: str | None = None, newline: str | None = None
    ) -> str:
        """Read an object whole, as text."""
        with self.open("r", -1, encoding, errors, newline) as file:
            return str(file.read())

    def upload(self, local: Path) -> None:
        """Put a file of the local disk here; it is seen whole or not at all."""
        system, name = reach(self)
        with telling(self):
            system.put_file(str(local), name, **in_parts(system))

    def _kind(self) -> str:
        # Not by isdir, which lists all that is below.
        system, name = reach(self)
        try:
            with telling(self):
                return str(system.info(name)["type"])
        except FileNotFoundError:
            return ""

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise OSError(errno.ENOTSUP, "this is possible at a local path only", str(self))

    chmod = glob = hardlink_to = iterdir = lstat = mkdir = _refuse
    rename = replace = rglob = rmdir = symlink_to = touch = unlink = _refuse
    write_bytes = write_text = _refuse


class RemoteFile(io.RawIOBase):
    """An object open for reading; may be shared between threads by those who use `pread` alone."""

    def __init__(self, path: RemotePath) -> None:
        super().__init__()
        self.path = path
        self._position, self._ended = 0, False
        self._held = (0, b"")

    def size(self) -> int:
        """Return its length in bytes."""
        return self._size

    def pread(self, length: int, offset: int) -> bytes:
        """Read up to `length` bytes from a place on, with one request if they are not held."""
        begin, held = self._held
        if begin <= offset and offset + length <= begin + len(held):
            return held[offset - begin : offset - begin + length]
        # Asked for anew: a connection does not survive a fork, and fsspec keeps one a process.
        system, name = reach(self.path)
        try:
            with telling(self.path):
                return bytes(system.cat_file(name, start=offset, end=offset + length))
        except (FileNotFoundError, PermissionError):
            raise
        except OSError:
            if offset < self._size:
                raise
            return b""  # Servers refuse a range that begins behind the end.

    def hold(self, length: int, offset: int) -> None:
        """Read bytes that will be asked for piece by piece; they are held until the next."""
        self._held = (offset, self.pread(length, offset))

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read on, as `io.BufferedReader` asks it."""
        if self._ended:
            return 0
        data = self.pread(len(buffer), self._position)
        buffer[: len(data)] = data
        self._position += len(data)
        self._ended = len(data) < len(buffer)
        return len(data)

    @cached_property
    def _size(self) -> int:
        system, name = reach(self.path)
        with telling(self.path):
            entry = system.info(name)
        if entry["type"] != "file":
            raise OSError(errno.EISDIR, "is no object, but a folder of them", str(self.path))
        return int(entry["size"])


def list_objects(path: RemotePath) -> dict[str, dict[str, Any]]:
    """Return what fsspec says of every object below a place, by its name relative to that.

    Objects are left out whose names no path could have: with empty parts, or
    with ``.`` or ``..`` for one. There may be none at all.
    """
    system, name = reach(path)
    with telling(path):
        found = system.find(name, detail=True)
    base = name.rstrip("/") + "/"
    below = {
        key[len(base) :]: entry
        for key, entry in found.items()
        if key.startswith(base) and entry["type"] == "file"
    }
    return {key: entry for key, entry in sorted(below.items()) if _is_plain(key)}


def _is_plain(name: str) -> bool:
    return not {"", ".", ".."} & set(name.split("/")) and "\\" not in name and "\0" not in name


def reach(path: RemotePath) -> tuple[Any, str]:
    """Return the fsspec file system of a place, and what the place is called there.

    Raises
    ------
    ConfigError
        If a library is missing or the protocol is unknown.
    """
    try:
        from fsspec.core import url_to_fs

        # Without the cache of listings: what others write must be seen.
        system, name = url_to_fs(str(path), use_listings_cache=False)
    except (ImportError, ValueError) as error:
        raise ConfigError(
            f"{path}: cannot be reached ({error}); pip install 'slatprep[remote]' brings s3://, "
            "and gcsfs gs://"
        ) from None
    return system, str(name)


def in_parts(system: Any) -> dict[str, int]:
    """Return options that bound what a transfer of one file holds in memory, to 64 MiB on S3.

    S3 takes 10,000 parts, and so 160 GiB a file.
    """
    return {"chunksize": 2**24, "max_concurrency": 4} if "s3" in system.protocol else {}


@contextmanager
def telling(path: RemotePath) -> Iterator[None]:
    """Turn whatever a file system raises into an `OSError` that names the place.

    Raises
    ------
    OSError
        Of the same kind (`FileNotFoundError`, `PermissionError`), with its words.
    """
    try:
        yield
    except OSError as error:
        number = error.errno or errno.EIO
        if isinstance(error, FileNotFoundError):
            number = errno.ENOENT
        elif isinstance(error, PermissionError):
            number = errno.EACCES
        raise OSError(number, _words(error.strerror or error), str(path)) from error
    except Exception as error:
        # botocore, aiohttp and google.auth have errors of their own, with no base in common.
        if type(error).__module__ == "builtins":
            raise
        raise OSError(errno.EIO, _words(error), str(path)) from error


def _words(error: object) -> str:
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__
