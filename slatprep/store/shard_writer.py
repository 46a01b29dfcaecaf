"""Write a shard chunk by chunk, so that a shard may be far larger than memory.

The file is the one that zarr-python writes, byte for byte, given all rows at
once: chunks one after the other, then their index (see `slatprep.store.shard_reader`).
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slatprep.storage.codecs import single_threaded_blosc
from slatprep.storage.files import LocalFolder
from slatprep.store.contract import read_metadata
from slatprep.store.shard_reader import MISSING, RowReader

_SHUFFLES = {"noshuffle": 0, "shuffle": 1, "bitshuffle": 2}


class ShardWriter:
    """Writes the rows of one shard of one array, in order.

    Parameters
    ----------
    store : Path
        The store, with the array created.
    name : str
        Name of the array, such as ``voxel/feats``.
    start : int
        Its first row.
    """

    def __init__(self, store: Path, name: str, start: int) -> None:
        metadata = read_metadata(store / name / "zarr.json")
        layout = RowReader.of(LocalFolder(store), name, metadata)
        if layout is None or not layout.sharded:
            raise ValueError(f"{name} is not laid out as slatprep lays arrays out")
        self._encode = _encoder(metadata["codecs"][0]["configuration"]["codecs"])
        self._index = np.full((layout.chunks_per_shard, 2), MISSING, "<u8")
        self._chunk = np.empty(layout.decoder.shape, layout.dtype)
        self._fill_value = layout.fill_value
        self._rows = self._chunks = self._bytes = 0
        self._path = store / layout.key(start // layout.shard_rows)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        # Beside the store, where what a killed worker leaves is no part of it; with a name of
        # its own, as a worker that a cluster has given up may still be writing the same shard.
        partials = store.with_name(f"{store.name}.partial")
        partials.mkdir(exist_ok=True)
        self._partial = partials / uuid.uuid4().hex
        self._file = self._partial.open("wb")

    def append(self, rows: NDArray[Any]) -> None:
        """Take the next rows."""
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
        """Take so many rows of the array's fill value."""
        shape = (rows, *self._chunk.shape[1:])
        self.append(np.full(shape, self._fill_value, self._chunk.dtype))

    def append_packed(self, data: bytes, lengths: Iterable[int]) -> None:
        """Take the next chunks as `RowReader.packed` gives them; the last rows filled one."""
        if self._rows:
            raise ValueError(f"{self._rows} rows of a chunk are waiting; expected none")
        self._file.write(data)
        for length in lengths:
            self._index[self._chunks] = self._bytes, length
            self._chunks, self._bytes = self._chunks + 1, self._bytes + length

    def finish(self) -> None:
        """Write the last chunk, filled up, and the index; on exit the shard gets its name."""
        if self._rows:
            self._chunk[self._rows :] = self._fill_value
            self._flush(self._chunk)
        self._file.write(_with_checksum(self._index.tobytes()))

    def __enter__(self) -> ShardWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            with self._file:
                if kind is None:
                    self.finish()
            if kind is None:
                self._partial.replace(self._path)
        finally:
            self._partial.unlink(missing_ok=True)

    def _flush(self, chunk: NDArray[Any]) -> None:
        data = self._encode(chunk)
        self._file.write(data)
        self._index[self._chunks] = self._bytes, len(data)
        self._chunks, self._bytes, self._rows = self._chunks + 1, self._bytes + len(data), 0


def _encoder(codecs: list[Mapping[str, Any]]) -> Callable[[NDArray[Any]], bytes]:
    """Return what packs a chunk as the codecs of a ``zarr.json`` say."""
    from numcodecs import Blosc, Zstd

    _, packer, checksum = codecs
    settings = packer["configuration"]
    if checksum["name"] != "crc32c":
        raise ValueError(f"expected a checksum, not {checksum['name']}")
    if packer["name"] == "zstd":
        zstd = Zstd(settings["level"], settings["checksum"])
        return lambda chunk: _with_checksum(zstd.encode(chunk))
    single_threaded_blosc()
    blosc = Blosc(
        settings["cname"],
        settings["clevel"],
        _SHUFFLES[settings["shuffle"]],
        settings["blocksize"],
    )
    # Blosc shuffles by the size of an item; that of a row of three bytes is three.
    item = np.dtype(f"V{settings['typesize']}")
    return lambda chunk: _with_checksum(blosc.encode(chunk.reshape(-1).view(item)))


def _with_checksum(data: bytes) -> bytes:
    import google_crc32c

    data = bytes(data)
    return data + int(google_crc32c.value(data)).to_bytes(4, "little")
