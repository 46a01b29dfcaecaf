"""A file that is read here and there, with as few requests and as few bytes as may be."""

from __future__ import annotations

import io
from typing import Protocol


class Ranges(Protocol):
    """What is read by ranges: `slatprep.storage.place.RangeFile` is one."""

    def pread(self, length: int, offset: int) -> bytes:
        """Read up to `length` bytes from an offset on."""


MAX_READ = 2**20
"""Most that one read may ask for: what a header claims is not believed."""

_LEAST, _MOST, _NEAR = 2**13, 2**22, 2**21
"""Bytes: a request after a jump; the largest request; a gap that costs less than a request."""

_SHARE, _SLACK = 0.015, 2**22
"""Requests grow as long as no more than this share of what lies before was read, and so much."""


class ReadAhead(io.RawIOBase):
    """A file object over ranges, for reading headers that lie between members of any size.

    After a jump it asks for little. As long as the next headers are near, each request is twice
    the last one: many small members come with one request, and large ones are passed over.
    Of a file that is not `remote` all requests are small.
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
        """Read on; fewer bytes than asked for mean the end. ValueError above `MAX_READ`."""
        if not 0 <= length <= MAX_READ:
            raise ValueError(f"a header claims {length} bytes")
        data = self.held(length, self._at)
        self._at += len(data)
        return data

    def holds(self, length: int, offset: int) -> bool:
        """Whether a range was read already."""
        return self._begin <= offset and offset + length <= self._begin + len(self._data)

    def affords(self, length: int) -> bool:
        """Whether so much may be read at once; growing requests leave half for it."""
        return self._spent + length <= self._allowed

    def held(self, length: int, offset: int) -> bytes:
        """Return a range, from what was read already if it can be."""
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
