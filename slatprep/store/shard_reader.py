"""Read rows of an array straight from its shards.

A shard is a file of chunks with an index at its end (Zarr format 3,
"sharding_indexed" codec): the offset and length of each chunk as
little-endian uint64, then a CRC32C of the index. The chunks of one asset are
adjacent, so this reader reads only them; zarr-python reads the same bytes with far more overhead.
"""

from __future__ import annotations

import errno
import weakref
from collections import deque
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import StoreError
from slatprep.parameters import MAX_SHARD_CHUNKS
from slatprep.records import MAX_NAME_BYTES
from slatprep.storage.cache import what_to_do
from slatprep.storage.chunks import (
    MAX_TEXT_BYTES,
    MISSING,
    ChunkDecoder,
    crc32c_holds,
    inner_chunks,
    whole_sizes,
)
from slatprep.storage.place import Folder, RangeFile
from slatprep.storage.remote import RemoteFolder, RemotePlace
from slatprep.store.layout import MAX_RECORD_BYTES, RECORD_ARRAY

OPEN_SHARDS = 512
"""Largest number of open shards of a process, unless the system allows it few open files."""

_OPENED: deque[tuple[weakref.ref[RowReader], int]] = deque()
"""Reader and number of each shard that was opened, oldest first."""

_COPIED_BYTES = 4 * 2**20

MAX_CHUNK_BYTES = 256 * 2**20
"""Largest size of an unpacked chunk; a chunk of ``grid/*`` takes 3 MiB."""

BAD_METADATA = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
"""Errors that Python, numpy and zarr-python raise for invalid metadata, such as ArithmeticError for
a fill value beyond its data type."""

MAX_TEXT = {RECORD_ARRAY: MAX_RECORD_BYTES}
"""Largest mean size of the texts of a chunk [byte], by array, if it is more than a name's."""


class DamagedFileError(StoreError):
    """A file of the store in `folder` that is missing, cut short or damaged."""

    def __init__(self, folder: str, file: str, fault: str, expected: str) -> None:
        super().__init__(f"{folder}/{file}: {fault}; expected {expected}. {what_to_do(folder)}")
        self.folder, self.file, self.fault, self.expected = folder, file, fault, expected

    def __reduce__(self) -> tuple[type, tuple[str, str, str, str]]:
        return (type(self), (self.folder, self.file, self.fault, self.expected))


class UnreachableError(StoreError):
    """A file of a store that could not be read; the `file` itself may be whole."""

    def __init__(self, folder: object, file: str, fault: str) -> None:
        network = "the network and " if "://" in str(folder) else ""
        check = f"check {network}your permissions, and run again"
        super().__init__(f"{folder}/{file}: cannot be read ({fault}); {check}")
        self.folder, self.file, self.fault = str(folder), file, fault

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        return (type(self), (self.folder, self.file, self.fault))


def is_out_of_reach(place: object, error: OSError) -> bool:
    """Return whether a file at a place, or in a folder, may be whole though it cannot be read."""
    if isinstance(error, FileNotFoundError):
        return False
    return isinstance(error, PermissionError) or isinstance(place, RemotePlace | RemoteFolder)


@dataclass(frozen=True, slots=True)
class _Shard:
    """An open shard and its index: offset and length of each chunk."""

    file: RangeFile | None
    index: NDArray[np.uint64]


@dataclass(eq=False)
class RowReader:
    """Reads rows of one array of a store; safe to share between threads and across a fork.

    A file has `shard_rows` rows. It has an index if it is `sharded`; otherwise it is one chunk. A
    chunk that was never written holds the `fill_value`, and so does a file that is not among the
    `listed` names. Without such a list, every file must exist.
    """

    folder: Folder
    name: str
    shape: tuple[int, ...]
    shard_rows: int
    sharded: bool
    decoder: ChunkDecoder
    fill_value: Any
    listed: Container[str] | None = field(default=None, init=False)
    _shards: dict[int, _Shard] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.dtype = self.decoder.dtype
        self.chunk_rows = self.decoder.shape[0]
        self.chunks_per_shard = self.shard_rows // self.chunk_rows

    @classmethod
    def of(cls, folder: Folder, name: str, metadata: Mapping[str, Any]) -> RowReader:
        """Return a reader for an array with this ``zarr.json``.

        StoreError if it is invalid, or the array has not the chunks and codecs of slatprep.
        """
        try:
            text = metadata["data_type"] == "string"
            dtype = np.dtype(object) if text else np.dtype(metadata["data_type"]).newbyteorder("<")
            shape = whole_sizes(metadata["shape"])
            outer = whole_sizes(metadata["chunk_grid"]["configuration"]["chunk_shape"])
            inner, codecs, sharded = inner_chunks(metadata["codecs"], outer)
            whole_rows = outer[1:] == inner[1:] == shape[1:] and inner[0] > 0 == outer[0] % inner[0]
            if not whole_rows or metadata["chunk_key_encoding"] not in _KEYS:
                raise ValueError("chunks that are no whole rows, or files with other names")
            fill_value = np.array(metadata["fill_value"], object).astype(dtype)
            decoder = ChunkDecoder.of(dtype, inner, codecs, MAX_TEXT.get(name, MAX_NAME_BYTES))
            if decoder.nbytes > MAX_CHUNK_BYTES or outer[0] // inner[0] > MAX_SHARD_CHUNKS:
                raise ValueError(f"chunks of {inner} in shards of {outer}")
        except BAD_METADATA as error:
            raise StoreError(f"{folder.path}/{name}: bad metadata ({error!r})") from None
        return cls(folder, name, shape, outer[0], sharded, decoder, fill_value)

    def key(self, shard: int) -> str:
        """Return the name of a shard's file below the store."""
        return f"{self.name}/c/{shard}" + "/0" * (len(self.shape) - 1)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read rows ``start:stop`` into fresh memory (stop - start, ...) in native byte order.

        StoreError if a file is missing, cut short or damaged; the message names it.
        """
        if not 0 <= start <= stop <= self.shape[0]:
            raise StoreError(f"{self.name} has {self.shape[0]} rows, not {start} to {stop}")
        out = np.empty((stop - start, *self.shape[1:]), self.dtype)
        rows = self.chunk_rows
        chunks = range(start // rows, -(-stop // rows))
        ahead = self._ahead(chunks) if self.folder.prefetch_bytes else {}
        for chunk in chunks:
            base = chunk * rows
            first, last = max(start, base), min(stop, base + rows)
            target = out[first - start : last - start]
            if last - first == rows:
                self._chunk(chunk, target, ahead)
            else:
                whole = np.empty(self.decoder.shape, self.dtype)
                self._chunk(chunk, whole, ahead)
                target[...] = whole[first - base : last - base]
        return out

    def packed(self, first: int, last: int) -> Iterator[tuple[bytes, list[int]]]:
        """Yield the packed bytes of chunks ``first`` to ``last - 1`` and their lengths.

        Each item has several chunks, whose checksums are verified. StoreError if a chunk is
        damaged, or the chunks of a shard do not follow one another.
        """
        for number, index in self._entries(range(first, last)):
            shard, ends = self._shard(number), index.sum(axis=1)
            if shard.file is None or (ends[:-1] != index[1:, 0]).any():
                raise self._damaged(number, "its chunks do not follow one another")
            # A few at a time: a shard may be larger than memory.
            cuts = np.flatnonzero(np.diff(index[:, 0] // _COPIED_BYTES)) + 1
            for own in np.split(index, cuts):
                begin, end = own[0, 0], own[-1].sum()
                data = self._range(number, shard.file, int(end - begin), int(begin))
                parts = [data[at - begin : at - begin + length] for at, length in own]
                if not all(map(crc32c_holds, parts)):
                    raise self._damaged(number, "a chunk is damaged")
                yield data, own[:, 1].tolist()

    def _entries(self, chunks: range) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Yield each shard's number, and offset and length of the given chunks in it (K, 2)."""
        for number, own in groupby(chunks, lambda chunk: chunk // self.chunks_per_shard):
            places = [chunk % self.chunks_per_shard for chunk in own]
            yield number, self._shard(number).index[places].astype(np.int64)

    def _ahead(self, chunks: range) -> dict[tuple[int, int], bytes]:
        """Read each shard's adjacent chunks in one request; return them by shard and offset."""
        held = {}
        for number, index in self._entries(chunks):
            there, file = index[index[:, 0] >= 0].tolist(), self._shard(number).file
            if len(there) > 1 and file is not None:
                begin, end = min(there)[0], max(map(sum, there))
                if end - begin <= self.folder.prefetch_bytes:
                    data = self._range(number, file, end - begin, begin)
                    for at, length in there:
                        held[number, at] = data[at - begin : at - begin + length]
        return held

    def _chunk(self, chunk: int, out: NDArray[Any], ahead: dict[tuple[int, int], bytes]) -> None:
        number, place = divmod(chunk, self.chunks_per_shard)
        shard = self._shard(number)
        offset, length = shard.index[place].tolist()
        if shard.file is None or offset == length == MISSING:
            out[...] = self.fill_value
            return
        data = ahead.get((number, offset)) or self._range(number, shard.file, length, offset)
        try:
            if len(data) != length:
                raise StoreError("the file ends before it does")
            self.decoder.decode(data, out)
        except StoreError as error:
            raise self._damaged(number, f"chunk {place} is damaged: {error}") from None

    def _range(self, number: int, file: RangeFile, length: int, offset: int) -> bytes:
        try:
            return file.pread(length, offset)
        except OSError as error:
            raise self._unread(number, error) from None

    def _shard(self, number: int) -> _Shard:
        if (known := self._shards.get(number)) is not None:
            return known
        if self.listed is not None and self.key(number) not in self.listed:
            index = np.full((self.chunks_per_shard, 2), MISSING, np.uint64)
            return self._shards.setdefault(number, _Shard(None, index))
        try:
            file = self.folder.open(self.key(number))
            shard = _Shard(file, self._index(number, file, file.size()))
        except OSError as error:
            raise self._unread(number, error) from None
        # Two threads may have opened the shard; either result may stay.
        self._shards[number] = shard
        _OPENED.append((weakref.ref(self), number))
        while len(_OPENED) > _most_open():
            of, oldest = _OPENED.popleft()
            if reader := of():
                reader._shards.pop(oldest, None)
        return shard

    def _index(self, number: int, file: RangeFile, size: int) -> NDArray[np.uint64]:
        # No packed chunk is much larger than its values; strings have their own bound.
        limit = MAX_TEXT_BYTES if self.decoder.text else 2 * self.decoder.nbytes + 65_536
        if not self.sharded:
            index = np.array([[0, size]], np.uint64)
        else:
            length = 16 * self.chunks_per_shard + 4
            data = file.pread(length, size - length) if size >= length else b""
            if not crc32c_holds(data):
                raise self._damaged(number, "has no sound index; it is damaged or cut short")
            index = np.frombuffer(data, "<u8", 2 * self.chunks_per_shard).reshape(-1, 2)
            size -= length
        there = index[~(index == MISSING).all(axis=1)]
        offset, length_of = there.T
        if (offset > size).any() or (length_of > np.minimum(size, limit)).any():
            raise self._damaged(number, "its index leads out of it")
        return index

    def _unread(self, number: int, error: OSError) -> StoreError:
        """Return the error for a file that cannot be opened or read."""
        file, fault = self.key(number), error.strerror or str(error)
        if isinstance(error, FileNotFoundError):
            return self._damaged(number, "is missing (was the store replaced? Open it again)")
        if error.errno in (errno.EMFILE, errno.ENFILE):
            return StoreError(
                f"{self.folder.path}/{file}: cannot be opened ({fault}); "
                "raise the limit (ulimit -n), or close other files"
            )
        if is_out_of_reach(self.folder, error):
            return UnreachableError(self.folder.path, file, fault)
        return self._damaged(number, f"cannot be read ({fault})")

    def _damaged(self, number: int, fault: str) -> DamagedFileError:
        return DamagedFileError(self.folder.path, self.key(number), fault, "the file as written")


_KEYS = ({"name": "default"}, {"name": "default", "configuration": {"separator": "/"}})


def _most_open() -> int:
    """Return how many shards may stay open: half of what the process may open at most."""
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return OPEN_SHARDS if limit == resource.RLIM_INFINITY else min(OPEN_SHARDS, limit // 2)
