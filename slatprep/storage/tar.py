"""Find the members of tar archives by reading only headers, with few requests and few bytes.

An archive has the files of a folder one after another, so a member between two of them lies in the
same folder. `Leaps` therefore skips files of a folder that nobody asks for: it searches for a later
header of that folder, about where the last folder of the same name had its last headers.
"""

from __future__ import annotations

import gzip
import io
import tarfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple, Protocol, Self


class Ranges(Protocol):
    """A file that is read by ranges, such as `slatprep.storage.place.RangeFile`."""

    def pread(self, length: int, offset: int) -> bytes:
        """Read up to `length` bytes from an offset on."""


MAX_READ = 2**20
"""Largest read [byte], because a header may claim any size."""

_LEAST, _MOST, _NEAR = 2**13, 2**22, 2**21
"""Bytes of a request after a jump, of the largest request, of a gap cheaper than a request."""

_SHARE, _SLACK = 0.015, 2**22
"""Share of the bytes before the position that may be read, and bytes that may be read besides."""


class ReadAhead(io.RawIOBase):
    """A file object over ranges, for reading headers that lie between members of any size.

    After a jump the request is small. As long as the next headers are near, each request is twice
    as large as the last. So one request brings many small members, and large members are skipped.
    If the file is not `remote`, all requests are small.
    """

    def __init__(self, file: Ranges, remote: bool) -> None:
        super().__init__()
        self._file, self._most = file, _MOST if remote else _LEAST
        self._begin, self._data, self._at = 0, b"", 0
        self._window, self._spent, self._allowed = _LEAST, 0, 0

    def tell(self) -> int:
        """Return the position."""
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Set the position, counted from the beginning."""
        if whence != io.SEEK_SET:
            raise io.UnsupportedOperation("seek from elsewhere than the beginning")
        self._at = offset
        return offset

    def read(self, length: int = -1) -> bytes:
        """Read the next bytes; fewer than `length` mean the end. ValueError above `MAX_READ`."""
        if not 0 <= length <= MAX_READ:
            raise ValueError(f"a header claims {length} bytes")
        data = self.held(length, self._at)
        self._at += len(data)
        return data

    def holds(self, length: int, offset: int) -> bool:
        """Return whether the buffer has a range."""
        return self._begin <= offset and offset + length <= self._begin + len(self._data)

    def affords(self, length: int) -> bool:
        """Return whether `length` bytes may be read; growing requests leave half for this."""
        return self._spent + length <= self._allowed

    def held(self, length: int, offset: int) -> bytes:
        """Return a range, from the buffer if it has it."""
        end = self._begin + len(self._data)
        if not self.holds(length, offset):
            near = 0 <= offset - end <= _NEAR or self._begin <= offset < end
            self._window = min(2 * self._window, self._most) if near else _LEAST
            self._allowed = int(_SHARE * offset) + _SLACK
            window = min(self._window, max(_LEAST, self._allowed // 2 - self._spent))
            self._begin, self._data = offset, self._file.pread(max(length, window), offset)
            self._spent += len(self._data)
        start = offset - self._begin
        return self._data[start : start + length]


_MAGIC_AT = 257

_NARROWEST, _WIDEST = 2**14, 2**19
"""Least and largest window [byte] in which a header is searched."""

_FIRST, _WIDER = 3, 8
"""Number of files from which the size of the next files is known; files in the first leap."""

_FARTHEST = 2**27
"""Longest leap [byte], so that no leap leads into another copy of the folder."""


class Leaps:
    """Leaps within a folder, planned by what is known of earlier folders."""

    def __init__(self, file: ReadAhead) -> None:
        self._file = file
        self._landed: dict[str, int] = {}
        self._folder, self._first = "", 0
        self._files, self._bytes, self._reach, self._beyond = 0, 0, 0, 0

    def after(self, folder: str, data: int, end: int) -> int:
        """Return where to go on after a file of a folder: `end`, or a later header of the folder.

        `data` and `end` are the offsets of the file's content and of the next header.
        """
        other = folder != self._folder
        if other:
            self._folder, self._first = folder, data
        if other or 0 < self._beyond <= end:  # The failed leap ended within a larger file.
            self._files = self._bytes = self._reach = self._beyond = 0
        self._files, self._bytes = self._files + 1, self._bytes + end - data
        size, name = self._bytes // self._files, folder.rpartition("/")[2]
        window = min(max(2 * size, _NARROWEST), _WIDEST)
        expected = self._first + self._landed.get(name, 0)
        while not self._file.holds(BLOCK, end) and self._file.affords(2 * window):
            if self._beyond:
                leap = (self._beyond - end) * (7 if expected > end else 4) // 8
            elif expected > end:
                leap = expected - end - window // 2
            elif self._files >= _FIRST:
                leap = self._reach = 2 * self._reach or _WIDER * size
            else:
                break
            leap = min(leap, _FARTHEST) // BLOCK * BLOCK
            if leap < window:
                self._file.held(2 * window, end - BLOCK)
                break
            if found := self._sought(end + leap, window):
                self._landed[name] = found - self._first
                return found
            self._beyond = end + leap
        return end

    def _sought(self, at: int, window: int) -> int:
        """Return the offset of a header of the folder in a window; 0 if there is none."""
        data, found = self._file.held(window, at), -1
        while (found := data.find(b"ustar", found + 1)) >= 0:
            begin = found - _MAGIC_AT
            if begin <= 0 or begin % BLOCK:
                continue
            try:
                member = tarfile.TarInfo.frombuf(
                    data[begin : begin + BLOCK], "utf-8", "surrogateescape"
                )
            except tarfile.HeaderError:
                continue
            if plain_name(member.name).rpartition("/")[0] == self._folder:
                return at + begin
        return 0


BLOCK = tarfile.BLOCKSIZE
"""Size of a header [byte]; members are padded to a multiple of it."""

MAX_KEPT = 2**27
"""Largest member [byte] that is kept; no reader takes a larger file."""

_EXTENSIONS = (tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE,
               tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK)  # fmt: skip
"""Types of members that hold the name or other attributes of the next member."""

_STREAMED = 2**23
"""Bytes per read of a gzip archive."""

INCOMPLETE = "download it again"


class Entry(NamedTuple):
    """A member: offset and size of its data [byte], and `check`, the CRC-32 of its header.

    `problem` says why it cannot be read; `link` is the member whose data it shares.
    """

    name: str
    offset: int
    size: int
    check: int
    problem: str = ""
    link: str = ""


class _Header(tarfile.TarInfo):
    """A header that is refused if it is damaged, or claims a size that no header has.

    tarfile would take a damaged header for the end, and read a name of any length.
    """

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        try:
            header = super().frombuf(buf, encoding, errors)
        except tarfile.HeaderError as error:
            if any(buf):
                raise tarfile.ReadError(str(error)) from None
            raise
        most = MAX_READ if header.type in _EXTENSIONS else 2**63
        if not 0 <= header.size <= most:
            raise tarfile.ReadError(f"a header claims {header.size:,} bytes")
        return header


class ArchiveError(Exception):
    """An archive that is damaged from some byte on, or perhaps `all_of_it`; its text says how."""

    def __init__(self, text: str, all_of_it: bool = False) -> None:
        super().__init__(text)
        self.all_of_it = all_of_it


def entries(
    file: ReadAhead, size: int, begin: int = 0, needed: Callable[[str], bool] | None = None
) -> Iterator[tuple[Entry | None, int]]:
    """Yield the members of an archive from a header on, each with the offset of the next header.

    Folders are None; a name that leads out of the archive is empty. `begin` is 0, or an offset that
    was yielded before. `Leaps` may skip files of folders that are not `needed`. ArchiveError if the
    archive, of `size` bytes, is damaged or ends too early.
    """
    leaps = Leaps(file)
    file.seek(begin)
    with _told():
        archive = tarfile.TarFile(fileobj=file, mode="r", errors="surrogateescape", tarinfo=_Header)
    while True:
        with _told(f"is damaged at byte {archive.offset:,}"):
            member = archive.next()
        if member is None:
            break
        archive.members.clear()  # type: ignore[attr-defined]
        if member.offset_data + member.size > size and member.isreg():
            raise ArchiveError(f"ends within {member.name!r}; {INCOMPLETE}")
        check = zlib.crc32(file.held(BLOCK, member.offset_data - BLOCK))
        yield _entry(member, check), archive.offset
        folder = plain_name(member.name).rpartition("/")[0]
        if needed and member.isreg() and not needed(folder):
            archive.offset = leaps.after(folder, member.offset_data, archive.offset)
    end = file.held(BLOCK, archive.offset) if archive.offset < size else b""
    if not end:
        raise ArchiveError(f"has no end: it was cut off at byte {size:,}; {INCOMPLETE}")
    if any(end):
        raise ArchiveError(f"is damaged at byte {archive.offset:,}; {INCOMPLETE}")


def unpack(
    file: io.RawIOBase, wanted: Callable[[str], bool], keep: Callable[[Entry, bytes], None]
) -> Iterator[tuple[Entry | None, int]]:
    """Yield the members of a gzip archive, which is read once from its beginning.

    Each comes with the number of bytes read from the file. `keep` gets the data of members that
    are `wanted` and not larger than `MAX_KEPT`.
    """
    plain = _Unpacked(fileobj=io.BufferedReader(file, _STREAMED))
    try:
        with (
            _told(),
            tarfile.open(
                fileobj=plain, mode="r|", bufsize=2**16, errors="surrogateescape", tarinfo=_Header
            ) as archive,
        ):
            for member in archive:
                entry = _entry(member, 0)
                archive.members.clear()  # type: ignore[attr-defined]
                if entry is None:
                    continue
                if not entry.problem and not entry.link and not wanted(entry.name):
                    # Only a link to it is ever asked for.
                    problem = f"shares the data of {entry.name}, which is not kept"
                    entry = entry._replace(problem=problem)
                if member.isreg() and member.size <= MAX_KEPT and not entry.problem:
                    data = archive.extractfile(member)
                    assert data is not None
                    keep(entry, data.read())
                yield entry, file.tell()
            plain.check()
    except ArchiveError as error:
        if not error.all_of_it:
            with _told():
                plain.check()
        raise


class _Unpacked(gzip.GzipFile):
    """The content of a gzip file. A tar archive says where it ends, so no read goes beyond."""

    def read(self, size: int | None = -1) -> bytes:
        data = b""
        try:
            data = self.read1(-1 if size is None else size)
        except gzip.BadGzipFile as error:
            # Other programs also ignore bytes behind the last part.
            if not (self.tell() and str(error).startswith("Not a gzipped file")):
                raise
        if not data:
            raise EOFError("it has no end")
        return data

    def check(self) -> None:
        """Read the rest and its checksum; errors of gzip and zlib if the content is damaged."""
        with suppress(EOFError):
            while self.read(_STREAMED):
                pass


def _entry(member: tarfile.TarInfo, check: int) -> Entry | None:
    """Return the entry of a member, None for a folder; ArchiveError if its size is negative."""
    if member.size < 0:  # A header before its own may claim any size.
        raise ArchiveError(f"has a header that claims {member.size:,} bytes; {INCOMPLETE}")
    if member.isdir():
        return None
    name, problem, link = plain_name(member.name), "", ""
    if not name:
        problem = repr(member.name)  # It leads out of the archive.
    elif member.islnk():
        link = plain_name(member.linkname)  # It must come before, in the same archive.
        problem = "" if link else f"is a link to {member.linkname!r}"
    elif member.issym():
        problem = "is a symbolic link"
    elif member.issparse():
        problem = "is stored as a sparse file"
    elif not member.isreg():
        problem = "is a device or a pipe"
    return Entry(name, member.offset_data, member.size, check, problem, link)


_DAMAGED = (tarfile.TarError, EOFError, ValueError, RecursionError, zlib.error, gzip.BadGzipFile)


@contextmanager
def _told(fault: str = "is no intact tar archive") -> Iterator[None]:
    """Turn errors of tarfile for damaged bytes into `ArchiveError`."""
    try:
        yield
    except _DAMAGED as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        # A wrong checksum does not say where the damage is, and a stream fails behind it.
        anywhere = isinstance(error, gzip.BadGzipFile | zlib.error)
        raise ArchiveError(f"{fault} ({reason}); {INCOMPLETE}", all_of_it=anywhere) from None


def plain_name(name: str) -> str:
    """Return the name of a member as a path below a folder; empty if it leads elsewhere."""
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if name.startswith("/") or ".." in parts or "\\" in name or "\0" in name:
        return ""
    return "/".join(parts)
