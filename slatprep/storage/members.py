"""Places within archives: the tree that several archives make up, and how to fetch its members."""

from __future__ import annotations

import errno
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import cached_property
from typing import IO, Self

from slatprep.errors import ConfigError, InputError
from slatprep.storage.archives import Archive, Index, shown
from slatprep.storage.files import RemoteListing
from slatprep.storage.remote import PlaceByText, RemotePlace
from slatprep.storage.states import Noted
from slatprep.storage.tar import BLOCK, MAX_KEPT, Entry

_AT_ONCE = 8
"""Number of requests for archives that run at the same time."""


class ArchiveTree:
    """The folder from which archives were made.

    `text` is its name: the folder that holds the archives, or the only archive. `progress` is
    called with the number of bytes of archives that were scanned, and of all archives.
    """

    def __init__(
        self,
        text: str,
        archives: Sequence[Archive],
        progress: Callable[[int, int], None] = lambda *_: None,
    ) -> None:
        self.text, self.archives, self._progress = text, tuple(archives), progress

    def __reduce__(self) -> tuple[type, tuple[str, tuple[Archive, ...]]]:
        return ArchiveTree, (self.text, self.archives)  # Indexes stay in the cache.

    @cached_property
    def indexes(self) -> dict[Archive, Index]:
        """Index of each archive; archives of an object store are read at the same time.

        OSError if an archive cannot be read. The members found by then are kept.
        """
        passed, total = dict[Archive, int](), sum(archive.size for archive in self.archives)

        def index(archive: Archive) -> Index:
            def tell(at: int) -> None:
                passed[archive] = at
                self._progress(sum(list(passed.values())), total)

            return archive.index(tell)

        # Local archives are read one by one in this thread, so stopping a scan waits for none.
        remote = [archive for archive in self.archives if isinstance(archive.place, RemotePlace)]
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            coming = {archive: pool.submit(index, archive) for archive in remote}
            return {
                archive: coming[archive].result() if archive in coming else index(archive)
                for archive in self.archives
            }

    @cached_property
    def members(self) -> dict[str, tuple[Archive, Entry]]:
        """Archive and entry of each wanted member, by name."""
        members: dict[str, tuple[Archive, Entry]] = {}
        for archive, index in self.indexes.items():
            for name, entry in index.members.items():
                if not archive.is_wanted(name):
                    continue
                if name in members:
                    other = shown(members[name][0].place)
                    entry = entry._replace(problem=f"{name} lies in {other} as well")
                members[name] = archive, entry
        return members

    def listing(self) -> MemberListing:
        """Return a listing of the wanted members and the damaged archives."""
        faults = {a.place.name: index.fault for a, index in self.indexes.items() if index.fault}
        return MemberListing(self.members, faults)


class ArchivePlace(PlaceByText):
    """A tree of archives, if `path` is empty, or a file in it.

    `archive` and `entry` say where the file lies; they are None if there is no such file.
    """

    def __init__(
        self,
        tree: ArchiveTree,
        path: str = "",
        archive: Archive | None = None,
        entry: Entry | None = None,
    ) -> None:
        self.tree, self.path, self.archive, self.entry = tree, path, archive, entry

    def __eq__(self, other: object) -> bool:
        if type(other) is not ArchivePlace:
            return False
        return (self.tree.archives, self.path) == (other.tree.archives, other.path)

    __hash__ = PlaceByText.__hash__

    def __str__(self) -> str:
        base = self.tree.text if self.archive is None else shown(self.archive.place)
        return f"{base}/{self.path}" if self.path else base

    @property
    def size(self) -> int:
        """Size of the file [byte]; 0 if there is none."""
        return 0 if self.entry is None else self.entry.size

    @property
    def parent(self) -> Self:
        """The folder that holds it."""
        return self._below(self.path.rpartition("/")[0])

    def __truediv__(self, key: str) -> Self:
        return self._below(f"{self.path}/{key}" if self.path else key)

    def exists(self) -> bool:
        """Return whether there is a file, or this is the tree."""
        return self.is_dir() or self.is_file()

    def is_dir(self) -> bool:
        """Return whether this is the tree; other folders do not count."""
        return not self.path

    def is_file(self) -> bool:
        """Return whether there is a file."""
        return self.entry is not None

    def _opened(self) -> IO[bytes]:
        return io.BytesIO(self.read_bytes())

    def read_bytes(self) -> bytes:
        """Read a whole file.

        FileNotFoundError if there is none. InputError if it is not a plain file, or the archive was
        replaced.
        """
        if self.archive is None or self.entry is None:
            raise FileNotFoundError(errno.ENOENT, "is in no archive", str(self))
        if self.entry.problem:
            raise InputError(self, self.entry.problem, "a plain file that lies there once")
        return self.archive.read(self.entry)

    def state(self) -> Noted:
        """Return values by which a later change is found; None if it cannot be."""
        if self.archive is None or self.entry is None or not self.archive.trusted:
            return None
        return (str(self), self.archive.stamp, *self.entry)

    def _below(self, path: str) -> Self:
        archive, entry = self.tree.members.get(path, (None, None))
        return type(self)(self.tree, path, archive, entry)


class MemberListing(RemoteListing):
    """Names in archives; a damaged one looks like a folder anywhere that cannot be listed."""

    def __init__(self, files: Iterable[str], faults: dict[str, str]) -> None:
        super().__init__(files)
        self._faults = faults

    def of_folder(self, folder: str, *, folders: bool) -> Iterable[str]:
        """See `slatprep.storage.files.Listing`."""
        name = folder.rstrip("/").rpartition("/")[2]
        if fault := self._faults.get(name):
            raise OSError(errno.EIO, fault, name)
        found = list(super().of_folder(folder, folders=folders))
        return [*found, *self._faults] if folders else found


_GAP, _MOST = 2**18, 2**24
"""Largest gap between members of one request, and largest request for several members [byte]."""

Members = list[Entry]


def fetch(wanted: Iterable[tuple[Archive, Entry]], progress: Callable[[int, int], None]) -> None:
    """Fetch members that the cache lacks, except those of gzip archives.

    `progress` is called with the number of bytes fetched, and the total. ConfigError if an archive
    cannot be read. A replaced archive raises no error here, only when its members are read.
    """
    requests = list(_requests(wanted))
    total, done = sum(_span(members)[1] for _, members in requests), 0
    if not requests:
        return
    progress(0, total)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        coming = {pool.submit(_bring, *request): request for request in requests}
        try:
            for future in as_completed(coming):
                archive, members = coming[future]
                try:
                    future.result()
                except InputError:
                    pass
                except OSError as error:
                    raise ConfigError(
                        f"{shown(archive.place)}: cannot be read ({error.strerror or error}); run "
                        "again: what was fetched is kept"
                    ) from None
                done += _span(members)[1]
                progress(done, total)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _requests(wanted: Iterable[tuple[Archive, Entry]]) -> Iterator[tuple[Archive, Members]]:
    """Yield groups of missing members for one request each: near each other in one archive."""
    missing: dict[Archive, Members] = {}
    for archive, entry in wanted:
        unusable = archive.packed or entry.problem or entry.size > MAX_KEPT
        if not (unusable or archive.holds(entry)):
            missing.setdefault(archive, []).append(entry)
    for archive, members in missing.items():
        near: Members = []
        for entry in sorted(set(members), key=lambda one: one.offset):
            _, length = _span([*near, entry])
            last = near[-1].offset + near[-1].size if near else 0
            if near and (entry.offset - last > _GAP or length > _MOST):
                yield archive, near
                near = []
            near.append(entry)
        if near:
            yield archive, near


def _span(members: Members) -> tuple[int, int]:
    """Return the offset of the first member's header, and the bytes to the last member's end."""
    begin = members[0].offset - BLOCK
    return begin, members[-1].offset + members[-1].size - begin


def _bring(archive: Archive, members: Members) -> None:
    begin, length = _span(members)
    data = archive.range(length, begin)
    for entry in members:
        at = entry.offset - BLOCK - begin
        archive.keep(entry, archive.checked(entry, data[at : at + BLOCK + entry.size]))
