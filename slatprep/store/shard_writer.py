"""Write a shard chunk by chunk, so that a shard may be far larger than memory.

The file has the same bytes as one that zarr-python writes from all rows at
once: chunks one after the other, then their index (see `slatprep.store.shard_reader`).
For an object store it is written to the worker's own disk first, in the folder for temporary files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slatprep.records import Place
from slatprep.storage.atomic import writing
from slatprep.storage.chunks import MISSING, crc32c, single_threaded_blosc
from slatprep.storage.place import storage_of
from slatprep.store.contract import read_metadata
from slatprep.store.shard_reader import RowReader

_SHUFFLES = {"noshuffle": 0, "shuffle": 1, "bitshuffle": 2}


class Written(NamedTuple):
    """Size of a written file [byte], and its SHA-256 in hex."""

    size: int
    sha256: str


class ShardWriter:
    """Writes the rows of one shard of one array, in order, from row `start` of the array on.

    The store must have the array. `file` is the name of the shard's file below the store.
    """

    def __init__(self, store: Place, name: str, start: int) -> None:
        metadata = read_metadata(store / name / "zarr.json")
        layout = RowReader.of(storage_of(store).folder(), name, metadata)
        if not layout.sharded:
            raise ValueError(f"{name} is not laid out as slatprep lays arrays out")
        self._encode = _encoder(metadata["codecs"][0]["configuration"]["codecs"])
        self._index = np.full((layout.chunks_per_shard, 2), MISSING, "<u8")
        self._chunk = np.empty(layout.decoder.shape, layout.dtype)
        self._fill_value = layout.fill_value
        self._rows = self._chunks = self._bytes = 0
        self.file = layout.key(start // layout.shard_rows)
        target = storage_of(store / self.file)
        with ExitStack() as stack:
            if target.local is None:
                stack.enter_context(writing(self.file, store))
            # Beside the store, so that leftovers of a killed worker are no part of it.
            partials = store.parent / f"{store.name}.partial"
            partial = stack.enter_context(target.staged_apart(partials))
            self._file = stack.enter_context(partial.open("wb"))
            self._stack = stack.pop_all()
        self._digest = hashlib.sha256()
        self._size = 0

    def append(self, rows: NDArray[Any]) -> None:
        """Write the next rows (K, ...), whose dtype casts to the array's."""
        while len(rows):
            room = len(self._chunk) - self._rows
            taken, rows = rows[:room], rows[room:]
            if len(taken) == len(self._chunk):  # A whole chunk needs no copy.
                self._flush(np.ascontiguousarray(taken, dtype=self._chunk.dtype))
                continue
            self._chunk[self._rows : self._rows + len(taken)] = taken
            self._rows += len(taken)
            if self._rows == len(self._chunk):
                self._flush(self._chunk)

    def append_fill(self, rows: int) -> None:
        """Write a number of rows of the array's fill value."""
        fill = np.full_like(self._chunk, self._fill_value)
        first = min(rows, -self._rows % len(fill))  # These end a chunk that has been begun.
        self.append(fill[:first])
        whole, last = divmod(rows - first, len(fill))
        data = self._encode(fill) if whole else b""
        for _ in range(whole):
            self.append_packed(data, [len(data)])
        self.append(fill[:last])

    def append_packed(self, data: bytes, lengths: Iterable[int]) -> None:
        """Write the next chunks, already packed, as `RowReader.packed` yields them.

        ValueError if the rows before them do not fill whole chunks.
        """
        if self._rows:
            raise ValueError(f"{self._rows} rows of a chunk are waiting; expected none")
        self._write(data)
        for length in lengths:
            self._index[self._chunks] = self._bytes, length
            self._chunks, self._bytes = self._chunks + 1, self._bytes + length

    def finish(self) -> None:
        """Write the last chunk, padded, and the index; on exit the file gets its name."""
        if self._rows:
            self._chunk[self._rows :] = self._fill_value
            self._flush(self._chunk)
        self._write(_with_checksum(self._index.tobytes()))

    def written(self) -> Written:
        """Return the size and digest of the file, after exit."""
        return Written(self._size, self._digest.hexdigest())

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(self, *error: Any) -> None:
        if any(error):
            self._stack.__exit__(*error)
            return
        with self._stack:
            self.finish()

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._digest.update(data)
        self._size += len(data)

    def _flush(self, chunk: NDArray[Any]) -> None:
        data, self._rows = self._encode(chunk), 0
        self.append_packed(data, [len(data)])


def _encoder(codecs: list[Mapping[str, Any]]) -> Callable[[NDArray[Any]], bytes]:
    """Return a function that packs a chunk by the codecs of a ``zarr.json``."""
    from numcodecs import Blosc, VLenUTF8, Zstd

    first, packer, _ = codecs  # `create_store` gives every array these two and a checksum.
    settings = packer["configuration"]
    if packer["name"] == "zstd":
        zstd = Zstd(settings["level"], settings["checksum"])
        if first["name"] == "vlen-utf8":
            return lambda chunk: _with_checksum(zstd.encode(VLenUTF8().encode(chunk)))
        return lambda chunk: _with_checksum(zstd.encode(chunk))
    single_threaded_blosc()
    blosc = Blosc(
        settings["cname"], settings["clevel"], _SHUFFLES[settings["shuffle"]], settings["blocksize"]
    )
    # Blosc shuffles by the item size, which is three for rows of three bytes.
    item = np.dtype(f"V{settings['typesize']}")
    return lambda chunk: _with_checksum(blosc.encode(chunk.reshape(-1).view(item)))


def _with_checksum(data: bytes) -> bytes:
    data = bytes(data)
    return data + crc32c(data).to_bytes(4, "little")
