"""The members of tar archives: where they lie, found by reading headers alone."""

from __future__ import annotations

import gzip
import tarfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, NamedTuple

from slatprep.storage.ahead import ReadAhead
from slatprep.storage.leaps import Leaps
from slatprep.storage.names import plain_name

BLOCK = tarfile.BLOCKSIZE
"""Bytes of a header, to a multiple of which members are filled up."""

MAX_KEPT = 2**27
"""Bytes of a member that is kept; no reader takes a larger file."""

INCOMPLETE = "download it again"


class Entry(NamedTuple):
    """A member: where its data lies, and the CRC-32 of the header in front of that.

    `problem` says why it cannot be read; `link` is the member whose data it shares.
    """

    name: str
    offset: int
    size: int
    check: int
    problem: str = ""
    link: str = ""


class ArchiveError(Exception):
    """An archive that is damaged from some byte on; its text says how."""


def entries(
    file: ReadAhead, size: int, begin: int = 0, needed: Callable[[str], bool] | None = None
) -> Iterator[tuple[Entry | None, int]]:
    """Yield the members of an archive from a header on, each with where the next one begins.

    Folders are None; a name that leads out of the archive is empty. `begin` is 0, or where a
    member said that the next one begins. Files of folders that are not `needed` may be left out
    by `Leaps`. ArchiveError where the archive, of `size` bytes, is damaged or ends too early.
    """
    leaps = Leaps(file)
    file.seek(begin)
    with _told():
        archive = tarfile.TarFile(fileobj=file, mode="r", errors="surrogateescape")
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
    stream: IO[bytes], wanted: Callable[[str], bool], keep: Callable[[Entry, bytes], None]
) -> Iterator[Entry]:
    """Yield the members of an archive with gzip, read once from its beginning.

    `keep` gets the data of names that are `wanted`, but for those larger than `MAX_KEPT`.
    ArchiveError where the archive is damaged or ends too early.
    """
    with _told(), tarfile.open(fileobj=stream, mode="r|gz", errors="surrogateescape") as archive:
        for member in archive:
            entry = _entry(member, 0)
            archive.members.clear()  # type: ignore[attr-defined]
            if entry is None:
                continue
            small = member.isreg() and member.size <= MAX_KEPT
            if small and not entry.problem and wanted(entry.name):
                data = archive.extractfile(member)
                assert data is not None
                content = data.read()
                if len(content) != member.size:
                    raise ArchiveError(f"ends within {member.name!r}; {INCOMPLETE}")
                keep(entry, content)
            yield entry


def _entry(member: tarfile.TarInfo, check: int) -> Entry | None:
    if member.isdir():
        return None
    name, problem, link = plain_name(member.name), "", ""
    if not name:
        problem = repr(member.name)  # It leads out of the archive.
    elif member.islnk():
        link = plain_name(member.linkname)  # Of the same archive, and before.
        problem = "" if link else f"is a link to {member.linkname!r}"
    elif member.issym():
        problem = "is a symbolic link"
    elif member.issparse():
        problem = "is stored as a sparse file"
    elif not member.isreg():
        problem = "is a device or a pipe"
    return Entry(name, member.offset_data, member.size, check, problem, link)


@contextmanager
def _told(fault: str = "is no intact tar archive") -> Iterator[None]:
    """Turn what tarfile raises for damaged bytes into `ArchiveError`."""
    try:
        yield
    except (tarfile.TarError, EOFError, ValueError, zlib.error, gzip.BadGzipFile) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ArchiveError(f"{fault} ({reason}); {INCOMPLETE}") from None
