"""Places within archives: the tree of folders that several archives make up."""

from __future__ import annotations

import errno
import io
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import PurePosixPath
from typing import IO, Self

from slatprep.errors import InputError
from slatprep.storage.archives import Archive, Index, shown
from slatprep.storage.listing import RemoteListing
from slatprep.storage.remote import PlaceByText, RemotePlace
from slatprep.storage.states import Noted
from slatprep.storage.tar import Entry

_AT_ONCE = 8
"""Archives of an object store that are read at the same time."""


class ArchiveTree:
    """The folder that archives were made of.

    `text` is what it is called: the folder that holds the archives, or the only one. `progress`
    is called with the bytes of archives that were looked through, and those of all.
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
        """What each archive holds; those of an object store are read at the same time.

        OSError if one cannot be read. What was found by then is kept.
        """
        passed, total = dict[Archive, int](), sum(archive.size for archive in self.archives)

        def index(archive: Archive) -> Index:
            def tell(at: int) -> None:
                passed[archive] = at
                self._progress(sum(list(passed.values())), total)

            return archive.index(tell)

        remote = [archive for archive in self.archives if isinstance(archive.place, RemotePlace)]
        with ThreadPoolExecutor(max(1, min(len(remote), _AT_ONCE))) as pool:
            coming = {archive: pool.submit(index, archive) for archive in remote}
            return {
                archive: coming[archive].result() if archive in coming else index(archive)
                for archive in self.archives
            }

    @cached_property
    def members(self) -> dict[str, tuple[Archive, Entry]]:
        """Where the members lie that may be asked for, by name."""
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
        """Return the names that may be asked for, and what is damaged."""
        faults = {a.place.name: index.fault for a, index in self.indexes.items() if index.fault}
        return MemberListing(self.members, faults)


class ArchivePlace(PlaceByText):
    """The tree of archives, with an empty `path`, or a file in it.

    `archive` and `entry` tell where it lies; without them there is no such file.
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
    def name(self) -> str:
        """Its last component."""
        return PurePosixPath(str(self)).name

    @property
    def suffix(self) -> str:
        """The extension of its name, with the dot."""
        return PurePosixPath(self.path).suffix

    @property
    def size(self) -> int:
        """Its bytes; 0 where there is none."""
        return 0 if self.entry is None else self.entry.size

    @property
    def parent(self) -> Self:
        """The folder that holds it."""
        return self._below(self.path.rpartition("/")[0])

    def __truediv__(self, key: str) -> Self:
        return self._below(f"{self.path}/{key}" if self.path else key)

    def exists(self) -> bool:
        """Whether there is a file, or this is the tree."""
        return self.is_dir() or self.is_file()

    def is_dir(self) -> bool:
        """Whether this is the tree; other folders are not looked for."""
        return not self.path

    def is_file(self) -> bool:
        """Whether there is a file."""
        return self.entry is not None

    def _opened(self) -> IO[bytes]:
        return io.BytesIO(self.read_bytes())

    def read_bytes(self) -> bytes:
        """Read a file whole.

        FileNotFoundError if there is none, InputError if it is no plain file or the archive is
        another one by now.
        """
        if self.archive is None or self.entry is None:
            raise FileNotFoundError(errno.ENOENT, "is in no archive", str(self))
        if self.entry.problem:
            raise InputError(self, self.entry.problem, "a plain file that lies there once")
        return self.archive.read(self.entry)

    def state(self) -> Noted:
        """Return what tells whether it was changed since; None where that cannot be told."""
        if self.archive is None or self.entry is None or not self.archive.trusted:
            return None
        return (str(self), self.archive.stamp, *self.entry)

    def _below(self, path: str) -> Self:
        archive, entry = self.tree.members.get(path, (None, None))
        return type(self)(self.tree, path, archive, entry)


class MemberListing(RemoteListing):
    """Names in archives; those that are damaged look like folders that cannot be listed."""

    def __init__(self, files: Iterable[str], faults: dict[str, str]) -> None:
        super().__init__(files)
        self._faults = faults

    def of_folder(self, folder: str, *, folders: bool) -> Iterable[str]:
        """See `slatprep.storage.listing.Listing`."""
        if fault := self._faults.get(folder.rstrip("/")):
            raise OSError(errno.EIO, fault, folder.rstrip("/"))
        found = list(super().of_folder(folder, folders=folders))
        return [*found, *self._faults] if folders and not folder else found
