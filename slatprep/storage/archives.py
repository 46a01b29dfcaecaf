"""Read archives like the folder from which they were made, without unpacking them.

A `members.ArchivePlace` is a file of the tree that several archives make up. From an uncompressed
archive only headers and requested members are read. The cache keeps the index of members as long as
the archive is the same. For gzip archives, and archives on an object store, it keeps the members
too, so that each is read from there only once.
"""

from __future__ import annotations

import os
import re
import shutil
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import orjson

from slatprep.errors import InputError, first_of
from slatprep.storage.atomic import staged_apart
from slatprep.storage.cache import cache_folder, short
from slatprep.storage.files import LocalFile, open_digest, open_regular
from slatprep.storage.remote import RemoteFile, RemotePlace, stamp_of
from slatprep.storage.states import boot_id, lasting_state
from slatprep.storage.tar import BLOCK, ArchiveError, Entry, ReadAhead, entries, unpack

if TYPE_CHECKING:
    from slatprep.records import Place

SUFFIXES = (".tar", ".tar.gz", ".tgz")
"""Endings of the names of archives."""

_FORMAT, _INDEX = 4, "index.z"

_COMMIT = re.compile(r"(?<=[^/])@[0-9a-f]{40}(?=/|$)")
_SAVE_S = 20.0
"""Interval [s] at which an unfinished index is saved, so that a killed build loses little."""


def is_archive(name: str) -> bool:
    """Return whether a file is an archive, by its name."""
    return name.lower().endswith(SUFFIXES)


@dataclass(frozen=True)
class Archive:
    """An archive in the state in which it was found; on the hub, at one commit.

    `stamp` distinguishes it from earlier and later archives at the same place. The archive is
    `trusted` if any later change is sure to change the stamp. `size` is in bytes. `wanted` are
    patterns of the members that may be requested, see `is_wanted`.
    """

    place: Place
    stamp: str
    size: int
    trusted: bool = True
    wanted: tuple[str, ...] = ()

    @classmethod
    def on_disk(cls, path: Path, wanted: tuple[str, ...]) -> Archive:
        """Return an archive on the disk; OSError if it cannot be read."""
        with open_regular(path) as file:
            # The members of a gzip archive are kept, so its digest is worth its time.
            packed = _is_packed(path.name)
            more = lasting_state(file.fileno()) or (open_digest(file) if packed else "")
            stamp = f"{_stamp_of(file)};{boot_id()} {more}"
            return cls(path, stamp, file.size(), bool(more), wanted)

    @classmethod
    def of_object(
        cls, place: RemotePlace, entry: Mapping[str, Any], wanted: tuple[str, ...]
    ) -> Archive:
        """Return an archive from the listing of an object store."""
        return cls(place, stamp_of(entry), int(entry["size"]), True, wanted)

    @property
    def packed(self) -> bool:
        """Whether the archive is compressed, so that it can only be read from its beginning."""
        return _is_packed(self.place.name)

    @property
    def keeps(self) -> bool:
        """Whether the cache keeps the archive's members."""
        return self.packed or isinstance(self.place, RemotePlace)

    @property
    def folder(self) -> Path:
        """Folder of the cache for the archive in this state."""
        own = f"-{short(' '.join(self.wanted))}" if self.packed else ""
        return self.home / f"{short(self.stamp)}{own}"

    @property
    def home(self) -> Path:
        """Folder of the cache for any archive at this place."""
        return cache_folder() / f"{self.place.name}-{short(shown(self.place))}"

    def is_wanted(self, name: str) -> bool:
        """Return whether a member may be requested, by its name."""
        return any(_like(pattern).fullmatch(name) for pattern in self.wanted)

    def may_hold(self, folder: str) -> bool:
        """Return whether a folder, or a folder below it, may have a wanted member."""
        depth = folder.count("/") + 1
        parts = (pattern.split("/") for pattern in self.wanted)
        heads = ("/".join(one[:depth]) for one in parts if len(one) > depth)
        return not folder or any(_like(head).fullmatch(folder) for head in heads)

    def read(self, entry: Entry) -> bytes:
        """Read a member; InputError if the archive was replaced."""
        data = self._kept(entry) if self.keeps else None
        if data is None and self.packed:
            _extend(self, Index())
            if (data := self._kept(entry)) is None:
                raise self.replaced()
        if data is None:
            data = self.checked(entry, self.range(entry.size + BLOCK, entry.offset - BLOCK))
            if self.keeps:
                self.keep(entry, data)
        return data

    def checked(self, entry: Entry, data: bytes) -> bytes:
        """Return the data of a member from its header and data; InputError as `read`."""
        if zlib.crc32(data[:BLOCK]) != entry.check:
            (self.folder / _INDEX).unlink(missing_ok=True)
            raise self.replaced()
        return data[BLOCK:]

    def range(self, length: int, offset: int) -> bytes:
        """Read a range of bytes; InputError as `read`."""
        with self.open_ranges() as file:
            data = file.pread(length, offset)
        if len(data) != length:
            raise self.replaced()
        return data

    def open_ranges(self) -> LocalFile | RemoteFile:
        """Open the archive for reading by ranges; InputError as `read`."""
        if isinstance(self.place, RemotePlace):
            return RemoteFile(self.place, self.size)
        file = open_regular(Path(str(self.place)))
        if _stamp_of(file) != self.stamp.partition(";")[0]:
            file.close()
            raise self.replaced()
        return file

    def replaced(self) -> InputError:
        """Return the error for an archive that was replaced."""
        return InputError(
            shown(self.place), "was replaced after it was looked at", "the same archive; run again"
        )

    def keep(self, entry: Entry, data: bytes) -> None:
        """Write a member into the cache."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with staged_apart(self._file(entry), self.folder) as partial:
            partial.write_bytes(zlib.compress(data, 1))

    def holds(self, entry: Entry) -> bool:
        """Return whether a member need not be fetched."""
        return not self.keeps or self._file(entry).exists()

    def _kept(self, entry: Entry) -> bytes | None:
        try:
            data = zlib.decompress(self._file(entry).read_bytes())
        except (FileNotFoundError, zlib.error):
            return None
        return data if len(data) == entry.size else None

    def _file(self, entry: Entry) -> Path:
        return self.folder / f"{entry.offset}.z"  # A name may occur twice; links share an offset.

    def index(self, progress: Callable[[int], None] = lambda _: None) -> Index:
        """Return the index of the archive, from the cache or by reading the headers.

        `progress` is called with the number of bytes that were scanned. OSError if the archive
        cannot be read; the members found by then are kept.
        """
        index = _read_index(self)
        if not index.complete:
            _extend(self, index, progress)
        return index


@dataclass
class Index:
    """The members of an archive by name, as far as it was read.

    `twice` counts names that occur again; their last member counts, as in unpacking. `next` is the
    offset of the next header, `complete` says that there is none, and `fault` why no more can be
    read. `strange` are names of members that lead out of the archive. All members that match
    `wanted` are there, or all members if it is empty.
    """

    members: dict[str, Entry] = field(default_factory=dict)
    next: int = 0
    complete: bool = False
    fault: str = ""
    strange: list[str] = field(default_factory=list)
    twice: int = 0
    wanted: list[str] = field(default_factory=list)

    def told(self) -> str:
        """Return what a user should know about the archive; empty if there is nothing."""
        lines = []
        if self.twice:
            names = "names occur" if self.twice > 1 else "name occurs"
            lines.append(f"{self.twice:,} {names} twice; the last one counts, as in unpacking")
        if self.strange:
            lines.append(f"left out, as no folder could hold them: {first_of(self.strange, 1)}")
        return "; ".join(lines)

    def add(self, entry: Entry) -> None:
        """Add a member."""
        if not entry.name:
            self.strange.append(entry.problem)
            return
        if entry.link:
            target = self.members.get(entry.link)
            problem = "" if target else f"is a link to {entry.link!r}, which is not before it"
            target = target or entry
            entry = target._replace(name=entry.name, problem=problem or target.problem)
        self.twice += entry.name in self.members
        self.members[entry.name] = entry


def _extend(
    archive: Archive, index: Index, progress: Callable[[int], None] = lambda _: None
) -> None:
    """Read the rest of an archive's headers; keep the members found, even after an error."""
    archive.folder.mkdir(parents=True, exist_ok=True)
    saved, remote = time.monotonic(), isinstance(archive.place, RemotePlace)
    index.wanted = list(archive.wanted) if remote else []
    try:
        with archive.open_ranges() as file:
            if archive.packed:
                found = unpack(file, archive.is_wanted, archive.keep)
            else:
                needed = archive.may_hold if remote else None
                found = entries(ReadAhead(file, remote), archive.size, index.next, needed)
            for member, passed in found:
                if member is not None:
                    index.add(member)
                index.next = passed
                progress(passed)
                if not archive.packed and time.monotonic() - saved > _SAVE_S:
                    _write_index(archive, index)
                    saved = time.monotonic()
        index.complete = True
    except ArchiveError as error:
        index.complete, index.fault = True, str(error)
        if error.all_of_it:
            index.members.clear()
    finally:
        if index.complete or not archive.packed:
            _write_index(archive, index)
    for older in archive.home.iterdir():
        if not older.name.startswith(archive.folder.name.partition("-")[0]):
            shutil.rmtree(older, ignore_errors=True)


def _write_index(archive: Archive, index: Index) -> None:
    text = orjson.dumps({"format": _FORMAT, "index": index}, default=tuple)
    with staged_apart(archive.folder / _INDEX, archive.folder) as partial:
        partial.write_bytes(zlib.compress(text, 1))


def _read_index(archive: Archive) -> Index:
    """Return the index of an archive from the cache, or an empty index."""
    try:
        document = orjson.loads(zlib.decompress((archive.folder / _INDEX).read_bytes()))
        index = Index(**document["index"])
        index.members = {name: Entry(*entry) for name, entry in index.members.items()}
        if document["format"] == _FORMAT and index.wanted in ([], list(archive.wanted)):
            return index
    except (OSError, ValueError, TypeError, LookupError, AttributeError, zlib.error):
        pass
    return Index()  # The caller makes it anew.


def shown(place: Place) -> str:
    """Return the name of a place for messages, without a commit of the hub."""
    return _COMMIT.sub("", str(place))


@lru_cache(maxsize=64)
def _like(pattern: str) -> re.Pattern[str]:
    """Return a pattern as an expression; ``*`` matches anything within a component of a name."""
    return re.compile("[^/]*".join(re.escape(part) for part in pattern.split("*")), re.DOTALL)


def _stamp_of(file: LocalFile) -> str:
    state = os.fstat(file.fileno())
    return f"{state.st_size} {state.st_mtime_ns} {state.st_ctime_ns} {state.st_ino}"


def _is_packed(name: str) -> bool:
    return not name.lower().endswith(".tar")
