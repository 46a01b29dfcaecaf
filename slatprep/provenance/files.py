"""The records beside a store, read from their files with bounds."""

from __future__ import annotations

from collections.abc import Iterator

from slatprep.errors import StoreError
from slatprep.provenance.record import BuildRecord
from slatprep.provenance.record_json import read_build_record
from slatprep.records import Place
from slatprep.storage.documents import read_bounded
from slatprep.storage.place import storage_of
from slatprep.store.records import MAX_RECORD_BYTES

BUILD, ASSETS = "build.json", "assets.jsonl"


def build_text(folder: Place) -> bytes:
    """Return the record of a build as it is in its file.

    Raises
    ------
    StoreError
        If it cannot be read, or is larger than any record.
    """
    try:
        return read_bounded(folder / BUILD, MAX_RECORD_BYTES)
    except (OSError, ValueError) as error:
        raise StoreError(f"{folder / BUILD}: cannot be read ({error})") from None


def build_in(folder: Place) -> BuildRecord:
    """Read the record of a build; StoreError where it cannot be."""
    return read_build_record(build_text(folder), str(folder / BUILD))


def lines_in(folder: Place) -> Iterator[tuple[str, bytes]]:
    """Yield the records of a build's assets one by one: where each is, and its text.

    A line that is longer than any record comes in pieces, none of which is a record.

    Raises
    ------
    StoreError
        If the file cannot be read.
    """
    path = folder / ASSETS
    try:
        with storage_of(path).open() as file:
            lines = iter(lambda: file.readline(MAX_RECORD_BYTES), b"")
            yield from ((f"{path}, line {number}", line) for number, line in enumerate(lines, 1))
    except OSError as error:
        raise StoreError(f"{path}: cannot be read ({error})") from None
