"""Leaping over the files of a folder that nobody asks for, without reading each header.

A walk writes the files of a folder one after another: what lies between two of them lies in that
folder. So a later header of it is sought, about where the last such folder had its last ones.
"""

from __future__ import annotations

import tarfile

from slatprep.storage.ahead import ReadAhead
from slatprep.storage.names import plain_name

_BLOCK, _MAGIC_AT = tarfile.BLOCKSIZE, 257

_LEAST, _MOST = 2**14, 2**19
"""Bytes that are read to find a header."""

_FIRST, _WIDER = 3, 8
"""Files that tell how large the next ones are; so many of these are leaped over first."""

_FARTHEST = 2**27
"""Bytes: no leap is wider, so that none leads into another copy of the folder."""


class Leaps:
    """What is known of the folders that were passed, for leaping within the next ones."""

    def __init__(self, file: ReadAhead) -> None:
        self._file = file
        self._landed: dict[str, int] = {}
        self._folder, self._first = "", 0
        self._files, self._bytes, self._reach, self._beyond = 0, 0, 0, 0

    def after(self, folder: str, data: int, end: int) -> int:
        """Return where to read on after a file of a folder: at `end`, or at a later header of it.

        `data` is where the file's content begins.
        """
        other = folder != self._folder
        if other:
            self._folder, self._first = folder, data
        if other or 0 < self._beyond <= end:  # It was within a larger file.
            self._files = self._bytes = self._reach = self._beyond = 0
        self._files, self._bytes = self._files + 1, self._bytes + end - data
        size, name = self._bytes // self._files, folder.rpartition("/")[2]
        window = min(max(2 * size, _LEAST), _MOST)
        expected = self._first + self._landed.get(name, 0)
        while not self._file.holds(_BLOCK, end) and self._file.affords(2 * window):
            if self._beyond:
                leap = (self._beyond - end) * (7 if expected > end else 4) // 8
            elif expected > end:
                leap = expected - end - window // 2
            elif self._files >= _FIRST:
                leap = self._reach = 2 * self._reach or _WIDER * size
            else:
                break
            leap = min(leap, _FARTHEST) // _BLOCK * _BLOCK
            if leap < window:
                self._file.held(2 * window, end - _BLOCK)
                break
            found = self._sought(end + leap, window)
            if found:
                self._landed[name] = found - self._first
                return found
            self._beyond = end + leap
        return end

    def _sought(self, at: int, window: int) -> int:
        """Return where a header of the folder lies in a window; 0 where none does."""
        data, found = self._file.held(window, at), -1
        while (found := data.find(b"ustar", found + 1)) >= 0:
            begin = found - _MAGIC_AT
            if begin <= 0 or begin % _BLOCK:
                continue
            try:
                member = tarfile.TarInfo.frombuf(
                    data[begin : begin + _BLOCK], "utf-8", "surrogateescape"
                )
            except tarfile.HeaderError:
                continue
            if plain_name(member.name).rpartition("/")[0] == self._folder:
                return at + begin
        return 0
