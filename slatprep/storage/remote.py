"""Places on object stores, reached through fsspec.

A `RemotePlace` has the methods of `slatprep.records.Place` and few others. Only
`RemotePlace.upload`, `put_objects`, `copy_objects` and `remove_objects` change objects.

The libraries find credentials and endpoints; for S3, for instance, in ``AWS_*`` variables or
``~/.aws``.
"""

from __future__ import annotations

import errno
import io
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import IO, Any, Self

from slatprep.errors import ConfigError
from slatprep.storage.ranges import range_reader

PART_BYTES = 2**24
"""Bytes per request in the upload or download of a large object."""

_TAGS = ("ETag", "etag", "LastModified", "mtime", "blob_id", "lfs", "xet_hash")

BUFFER_BYTES = 8 * 2**20
"""Bytes per request when a file is read from its beginning."""


class PlaceByText:
    """Base of places that are not paths; the text of a place identifies it."""

    # Not a dataclass, because JSON writers would write a table of its fields.
    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def __hash__(self) -> int:
        return hash(str(self))

    @property
    def name(self) -> str:
        """Its last component."""
        return PurePosixPath(str(self)).name

    @property
    def suffix(self) -> str:
        """The extension of its name, with the dot."""
        return PurePosixPath(str(self)).suffix

    def absolute(self) -> Self:
        """Return the place itself."""
        return self

    def open(
        self, mode: str = "r", *, encoding: str | None = None, newline: str | None = None
    ) -> IO[Any]:
        """Open a file for reading."""
        if mode not in ("r", "rt", "rb"):
            raise io.UnsupportedOperation(f"{self}: mode {mode!r}; expected 'r' or 'rb'")
        file = self._opened()
        return file if mode == "rb" else io.TextIOWrapper(file, encoding, newline=newline)

    def read_text(self, encoding: str | None = None) -> str:
        """Read a whole file as text."""
        with self.open("r", encoding=encoding) as file:
            return str(file.read())

    def _opened(self) -> IO[bytes]:
        raise NotImplementedError


class RemotePlace(PlaceByText):
    """The URL of an object or of all objects below it; see `slatprep.storage.place.place_of`.

    `protocol` is ``s3``, for instance, and `path` is bucket and key. Names join as in a path. Every
    method that asks the object store turns the libraries' errors into OSError. It raises
    ConfigError if a library is missing or the protocol is unknown.
    """

    def __init__(self, protocol: str, path: PurePosixPath) -> None:
        self.protocol, self.path = protocol, path

    def __eq__(self, other: object) -> bool:
        return type(other) is RemotePlace and str(self) == str(other)

    __hash__ = PlaceByText.__hash__

    def __str__(self) -> str:
        return f"{self.protocol}://{'/'.join(self.path.parts)}"

    @property
    def parent(self) -> RemotePlace:
        """The place that holds this place."""
        return RemotePlace(self.protocol, self.path.parent)

    def __truediv__(self, key: str) -> RemotePlace:
        # Unlike in pathlib, a key with a leading slash must not replace the path.
        return RemotePlace(self.protocol, PurePosixPath(f"{self.path}/{key}"))

    def exists(self) -> bool:
        """Return whether it is an object, or there are objects below it."""
        return bool(self.entry())

    def is_dir(self) -> bool:
        """Return whether there are objects below it, and none of this name."""
        return self.entry().get("type") == "directory"

    def is_file(self) -> bool:
        """Return whether it is an object."""
        return self.entry().get("type") == "file"

    def _opened(self) -> IO[bytes]:
        return io.BufferedReader(RemoteFile(self), BUFFER_BYTES)

    def read_bytes(self) -> bytes:
        """Read a whole object."""
        with self.open("rb") as file:
            return bytes(file.read())

    def upload(self, local: Path) -> None:
        """Put a file of the local disk here; readers see it complete or not at all."""
        with connected(self) as (system, name):
            system.put_file(str(local), name, **multipart_options(system))

    def entry(self) -> Mapping[str, Any]:
        """Return fsspec's entry of the place; empty if there is nothing."""
        # Not by `isdir`, which lists everything below.
        try:
            with connected(self) as (system, name):
                return dict(system.info(name))
        except FileNotFoundError:
            return {}


class RemoteFile(io.RawIOBase):
    """An object open for reading; threads may share it if they use only `pread`.

    If `size` is not given, the object store is asked for it when it is needed.
    """

    def __init__(self, place: RemotePlace, size: int | None = None) -> None:
        super().__init__()
        self.place, self._size = place, size
        self._position, self._ended = 0, False

    def size(self) -> int:
        """Return its length in bytes."""
        if self._size is None:
            with connected(self.place) as (system, name):
                entry = system.info(name)
            if entry["type"] != "file":
                raise OSError(errno.EISDIR, "is no object, but a folder of them", str(self.place))
            self._size = int(entry["size"])
        return self._size

    def pread(self, length: int, offset: int) -> bytes:
        """Read up to `length` bytes from an offset, with one request."""
        # Connect each time: connections do not survive a fork; fsspec caches one per process.
        try:
            with connected(self.place, fresh=False) as (system, name):
                if "s3" in system.protocol:
                    bucket, _, key = name.partition("/")
                    if read := range_reader(bucket):
                        return read(key, offset, offset + length)
                options: dict[str, Any] = {}
                if "hf" in system.protocol:  # Otherwise it reads ahead, and asks for the size.
                    options = {"cache_type": "none", "size": self.size()}
                return bytes(system.cat_file(name, start=offset, end=offset + length, **options))
        except (FileNotFoundError, PermissionError):
            raise
        except OSError:
            if offset < self.size():
                raise
            return b""  # Servers refuse a range that begins after the end.

    def upto(self, limit: int) -> bytes:
        """Read at most `limit` + 1 bytes; the last one shows that the file is too large."""
        return self.pread(limit + 1, 0)

    def readall(self) -> bytes:
        """Read to the end in blocks of `BUFFER_BYTES`, because Python's own have 8 kB."""
        return b"".join(iter(lambda: self.read(BUFFER_BYTES) or b"", b""))

    def tell(self) -> int:
        """Return the number of bytes read from the beginning."""
        return self._position

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read the next bytes, for `io.BufferedReader`."""
        if self._ended:
            return 0
        data = self.pread(len(buffer), self._position)
        buffer[: len(data)] = data
        self._position += len(data)
        self._ended = len(data) < len(buffer)
        return len(data)


class RemoteFolder:
    """A version of a store on an object store; it never changes, so its files belong together."""

    prefetch_bytes = 64 * 2**20

    def __init__(self, place: RemotePlace) -> None:
        self.path = str(place)
        self._place = place

    def open(self, name: str) -> RemoteFile:
        """Open a file for reading, without a request yet."""
        return RemoteFile(self._place / name)


def stamp_of(entry: Mapping[str, Any]) -> str:
    """Return the size, tags and time in fsspec's entry of an object, which tell its content."""
    return " ".join(str(entry[key]) for key in ("size", *_TAGS) if entry.get(key))


def list_objects(place: RemotePlace) -> dict[str, dict[str, Any]]:
    """Return fsspec's entry of every object below a place, by its name relative to the place.

    Objects are left out if no path could have their name, such as one with empty parts, ``.`` or
    ``..``. The result may be empty.
    """
    with connected(place) as (system, name):
        found = system.find(name, detail=True)
    base = name.rstrip("/") + "/"
    below = {
        key[len(base) :]: entry
        for key, entry in found.items()
        if key.startswith(base) and entry["type"] == "file"
    }
    return {key: entry for key, entry in sorted(below.items()) if _is_plain(key)}


def list_folder(place: RemotePlace) -> dict[str, dict[str, Any]]:
    """Return fsspec's entry of everything directly below a place, by name; it may be empty."""
    with connected(place) as (system, name):
        try:
            found = system.ls(name, detail=True)
        except (FileNotFoundError, NotADirectoryError):
            return {}
    entries = {str(entry["name"]).rstrip("/").rpartition("/")[2]: entry for entry in found}
    return {key: entry for key, entry in entries.items() if _is_plain(key)}


def pinned(place: RemotePlace) -> RemotePlace:
    """Return a place of the hub at its current commit, so that nothing can replace it.

    Other places have no commits, and are returned as they are.
    """
    if place.protocol != "hf":
        return place
    with connected(place) as (system, name):
        from huggingface_hub import HfApi

        at = system.resolve_path(name)
        if not hasattr(at, "repo_id"):
            return place  # A bucket has no commits.
        api = HfApi(endpoint=system.endpoint, token=system.token)
        sha = api.repo_info(at.repo_id, repo_type=at.repo_type, revision=at.revision).sha
        base = f"{at.repo_type}s/{at.repo_id}@{sha}"
        return RemotePlace("hf", PurePosixPath(base, at.path_in_repo))


def put_objects(folder: Path, place: RemotePlace, names: Iterable[str]) -> None:
    """Put small files of a folder below a place, under the same names, several at a time."""
    with connected(place) as (system, root):

        def put(name: str) -> None:
            system.put_file(str(folder / name), f"{root}/{name}", **multipart_options(system))

        _for_each(system, put, names, _FILES_AT_ONCE)


def get_objects(place: RemotePlace, folder: Path, names: Iterable[str]) -> None:
    """Get objects below a place into a folder, under the same names, a few at a time."""
    with connected(place) as (system, root):

        def get(name: str) -> None:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            system.get_file(f"{root}/{name}", str(folder / name), **multipart_options(system))

        _for_each(system, get, names, _LARGE_AT_ONCE)


def copy_objects(source: RemotePlace, target: RemotePlace, names: Iterable[str]) -> None:
    """Have the server copy objects below a place to another, under the same names."""
    with connected(source) as (system, root), connected(target) as (_, other):

        def copy(name: str) -> None:
            system.cp_file(f"{root}/{name}", f"{other}/{name}")

        _for_each(system, copy, names, _FILES_AT_ONCE)


def remove_objects(place: RemotePlace, names: Iterable[str]) -> None:
    """Remove objects below a place by their names; missing ones are no error."""
    # Not by fsspec's `rm`, which lists folders to find out what a name with ``*`` or ``[`` means.
    with connected(place) as (system, root):
        bucket, _, above = root.partition("/")

        def remove(name: str) -> None:
            with suppress(FileNotFoundError):
                system.rm_file(f"{root}/{name}")

        if "s3" not in system.protocol:
            _for_each(system, remove, names, _FILES_AT_ONCE)
            return
        keys = [{"Key": f"{above}/{name}".lstrip("/")} for name in names]
        for start in range(0, len(keys), _REMOVED_AT_ONCE):
            some = {"Objects": keys[start : start + _REMOVED_AT_ONCE], "Quiet": True}
            answer = system.call_s3("delete_objects", Bucket=bucket, Delete=some)
            for kept in answer.get("Errors", ()):
                number = errno.EACCES if kept.get("Code") == "AccessDenied" else errno.EIO
                raise OSError(number, kept.get("Message") or kept.get("Code"), kept.get("Key"))


def _for_each(system: Any, do: Callable[[str], None], names: Iterable[str], at_once: int) -> None:
    """Call a function for each name, several at a time, and raise the first error."""
    # Not by fsspec's calls for many files, which leave warnings behind if one of them fails. The
    # hub makes a commit of each call, and commits of one branch exclude each other.
    with ThreadPoolExecutor(at_once if "hf" not in system.protocol else 1) as pool:
        list(pool.map(do, names))


_FILES_AT_ONCE, _LARGE_AT_ONCE, _REMOVED_AT_ONCE = 16, 4, 1000
"""Numbers of small and of large files at a time, and of objects that S3 removes in a request."""

_CREDENTIALS = "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE"
"""Advice if S3 finds no credentials."""


def _is_plain(name: str) -> bool:
    return not {"", ".", ".."} & set(name.split("/")) and "\\" not in name and "\0" not in name


def multipart_options(system: Any) -> dict[str, int]:
    """Return options that limit the memory of a transfer, to 64 MiB per file on S3.

    S3 takes 10,000 parts, so 160 GiB per file.
    """
    return {"chunksize": PART_BYTES, "max_concurrency": 4} if "s3" in system.protocol else {}


@contextmanager
def connected(place: RemotePlace, *, fresh: bool = True) -> Iterator[tuple[Any, str]]:
    """Yield the fsspec file system of a place, and the place's name in it.

    With `fresh`, the file system forgets its listings of folders.

    Errors of the file system become OSErrors of the same kind (`FileNotFoundError`,
    `PermissionError`) that name the place. ConfigError if a library is missing or the protocol is
    unknown.
    """
    try:
        from fsspec.core import url_to_fs

        # Without the cache of listings, because changes by others must be seen.
        system, name = url_to_fs(str(place), use_listings_cache=False)
    except (ImportError, ValueError) as error:
        raise ConfigError(
            f"{place}: cannot be reached ({error}); pip install 'slatprep[remote]' brings s3://, "
            "'slatprep[hub]' hf://, and gcsfs gs://"
        ) from None
    if fresh and "hf" in system.protocol:
        system.dircache.clear()  # The hub's file system keeps listings in spite of the option.
    try:
        yield system, str(name)
    except OSError as error:
        number, cause = error.errno or errno.EIO, error.__cause__
        status = getattr(cause, "status", 0)
        if place.protocol.startswith("http") and cause and status not in (404, 410):
            # Its file system calls a file missing whatever went wrong.
            number = errno.EACCES if status == 403 else errno.EIO
            raise OSError(number, _words(cause), str(place)) from error
        if isinstance(error, FileNotFoundError):
            number = errno.ENOENT
        elif isinstance(error, PermissionError):
            number = errno.EACCES
        raise OSError(number, _words(error.strerror or error), str(place)) from error
    except Exception as error:
        # botocore, aiohttp and google.auth have errors of their own, without a common base.
        if type(error).__module__ == "builtins":
            raise
        raise OSError(errno.EIO, _words(error), str(place)) from error


def _words(error: object) -> str:
    told = str(error).partition("\n\nDebug source:")[0]  # obstore adds many lines.
    words = " ".join(told.split()).rstrip(".") or type(error).__name__
    return f"{words}; {_CREDENTIALS}" if "locate credentials" in words else words
