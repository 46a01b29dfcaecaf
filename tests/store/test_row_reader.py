"""Rows of one array, whatever its cut: against zarr, and against the index at a shard's end."""

import errno
import json
import os
import struct
import weakref
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from google_crc32c import value as crc32c
from zarr.codecs import Crc32cCodec, ZstdCodec

from slatprep.errors import StoreError
from slatprep.parameters import MAX_SHARD_CHUNKS
from slatprep.storage.files import LocalFile, LocalFolder
from slatprep.store import shard_reader
from slatprep.store.shard_reader import MAX_CHUNK_BYTES, DamagedFileError, RowReader

NOT_THERE = 2**64 - 1


def make(
    folder: Path, name: str, values: np.ndarray, chunk: int, shard: int | None, fill: Any = 0
) -> None:
    """Write an array by zarr alone, in shards of so many rows; chunks of fill values are none."""
    rest = values.shape[1:]
    array = zarr.open_group(folder, mode="a", zarr_format=3).create_array(
        name,
        shape=values.shape,
        dtype=str if values.dtype.hasobject else values.dtype,
        chunks=(chunk, *rest),
        shards=None if shard is None else (shard, *rest),
        compressors=(ZstdCodec(level=1), Crc32cCodec()),
        fill_value=fill,
    )
    array[...] = values


def metadata_of(folder: Path, name: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / name / "zarr.json").read_text())
    return document


def reader_of(place: Path | LocalFolder, name: str) -> RowReader:
    folder = LocalFolder(place) if isinstance(place, Path) else place
    return RowReader.of(folder, name, metadata_of(Path(folder.path), name))


def index_of(shard: Path, chunks: int) -> list[tuple[int, int]]:
    """Return offset and length of each chunk, by the Zarr specification's words."""
    tail = shard.read_bytes()[-(16 * chunks + 4) :]
    assert struct.unpack("<I", tail[-4:])[0] == crc32c(tail[:-4])
    return list(struct.iter_unpack("<QQ", tail[:-4]))


def write_index(shard: Path, index: list[tuple[int, int]]) -> None:
    """Write another index, with a checksum that holds."""
    content = shard.read_bytes()[: -(16 * len(index) + 4)]
    packed = b"".join(struct.pack("<QQ", *entry) for entry in index)
    shard.write_bytes(content + packed + struct.pack("<I", crc32c(packed)))


RNG = np.random.default_rng(5)
CUTS: dict[str, tuple[np.ndarray, int, int | None]] = {
    "voxel/material": (RNG.integers(1, 9, 23).astype(np.uint8), 3, 6),
    "voxel/feats": (RNG.normal(size=(23, 2)).astype(np.float32), 3, 9),
    "grid/properties": (RNG.normal(size=(5, 3, 2, 2, 2)).astype(np.float32), 1, 2),
    "asset/transform": (RNG.normal(size=(7, 4, 4)), 7, None),
    "asset/offset": (RNG.integers(1, 2**40, 8), 3, None),
    "asset/contradicted": (RNG.integers(0, 2, 9).astype(bool), 4, None),
    "asset/record": (np.array([f"{n} \N{GREEK SMALL LETTER NU}" for n in range(11)], object), 2, 4),
}


@pytest.mark.parametrize("name", CUTS)
def test_every_range_of_rows_is_the_one_that_was_written(tmp_path, name):
    values, chunk, shard = CUTS[name]
    make(tmp_path, name, values, chunk, shard, "" if values.dtype.hasobject else 0)
    reader = reader_of(tmp_path, name)
    assert reader.shape == values.shape
    for start in range(len(values) + 1):
        for stop in range(start, len(values) + 1):
            rows = reader.read(start, stop)
            assert rows.shape == values[start:stop].shape and rows.dtype == values.dtype
            assert rows.tolist() == values[start:stop].tolist()
    for start, stop in ((-1, 1), (2, 1), (0, len(values) + 1)):
        with pytest.raises(StoreError, match=f"{len(values)} rows, not {start} to {stop}"):
            reader.read(start, stop)


def test_a_chunk_that_was_never_written_holds_the_fill_value(tmp_path):
    values = np.arange(24, dtype=np.float32)
    values[3:9] = -2.5  # the second chunk of the first shard, and the first of the next
    make(tmp_path, "voxel/distance", values, 3, 6, -2.5)
    assert index_of(tmp_path / "voxel/distance/c/0", 2)[1] == (NOT_THERE, NOT_THERE)
    reader = reader_of(tmp_path, "voxel/distance")
    assert reader.read(0, 24).tolist() == values.tolist()
    assert reader.read(5, 10).tolist() == values[5:10].tolist()


@pytest.mark.parametrize("shard", [None, 6])
def test_a_column_of_fill_values_alone_needs_no_file(tmp_path, shard, monkeypatch):
    """As zarr leaves out what nobody wrote, if the names of the files that were written say so."""
    make(tmp_path, "asset/category", np.array([""] * 9, object), 3, shard, "")
    assert not (tmp_path / "asset/category/c").exists()
    reader = reader_of(folder := WatchedFolder(tmp_path), "asset/category")
    told = r"asset/category/c/0: is missing \(was the store replaced"
    with pytest.raises(StoreError, match=told):
        reader.read(0, 2)
    reader.listed = {"asset/category/c/1"}
    assert reader.read(1, 3).tolist() == [""] * 2
    with pytest.raises(StoreError, match="asset/category/c/1: is missing"):
        reader.read(0, 9)
    reader.listed = ()
    monkeypatch.setattr(folder, "open", None)  # What was not written is not asked for.
    assert reader.read(1, 9).tolist() == [""] * 8
    with pytest.raises(StoreError, match="do not follow one another"):
        list(reader.packed(0, 1))
    assert folder.asked == []


EDITS: dict[str, Callable[[dict[str, Any]], object]] = {
    "an index without checksum": lambda d: sharding(d)["index_codecs"].pop(),
    "an index at the beginning": lambda d: sharding(d).update(index_location="start"),
    "shards that are packed again": lambda d: d["codecs"].append({"name": "crc32c"}),
    "chunks of half rows": lambda d: sharding(d).update(chunk_shape=[3, 1]),
    "shards of half rows": lambda d: outer(d).update(chunk_shape=[9, 1]),
    "half chunks at a shard's end": lambda d: outer(d).update(chunk_shape=[10, 2]),
    "chunks of nothing": lambda d: sharding(d).update(chunk_shape=[0, 2]),
    "files named by dots": lambda d: d.update(
        chunk_key_encoding={"name": "default", "configuration": {"separator": "."}}
    ),
    "too many chunks": lambda d: outer(d).update(chunk_shape=[3 * (MAX_SHARD_CHUNKS + 1), 2]),
    "too large a chunk": lambda d: (
        sharding(d).update(chunk_shape=[MAX_CHUNK_BYTES // 8 + 1, 2]),
        outer(d).update(chunk_shape=[MAX_CHUNK_BYTES // 8 + 1, 2]),
    ),
}


def sharding(metadata: dict[str, Any]) -> dict[str, Any]:
    configuration: dict[str, Any] = metadata["codecs"][0]["configuration"]
    return configuration


def outer(metadata: dict[str, Any]) -> dict[str, Any]:
    configuration: dict[str, Any] = metadata["chunk_grid"]["configuration"]
    return configuration


@pytest.mark.parametrize("case", EDITS)
def test_arrays_cut_in_another_way_are_refused(tmp_path, case):
    make(tmp_path, "voxel/feats", CUTS["voxel/feats"][0], 3, 9)
    metadata = metadata_of(tmp_path, "voxel/feats")
    EDITS[case](metadata)
    with pytest.raises(StoreError, match="voxel/feats: bad metadata"):
        RowReader.of(LocalFolder(tmp_path), "voxel/feats", metadata)


def test_the_largest_chunks_and_the_most_of_a_shard_are_taken(tmp_path):
    make(tmp_path, "voxel/feats", CUTS["voxel/feats"][0], 3, 9)
    metadata = metadata_of(tmp_path, "voxel/feats")
    outer(metadata)["chunk_shape"] = [3 * MAX_SHARD_CHUNKS, 2]
    folder = LocalFolder(tmp_path)
    assert RowReader.of(folder, "voxel/feats", metadata).chunks_per_shard == MAX_SHARD_CHUNKS
    rows = MAX_CHUNK_BYTES // 8
    outer(metadata)["chunk_shape"] = sharding(metadata)["chunk_shape"] = [rows, 2]
    assert RowReader.of(folder, "voxel/feats", metadata).chunk_rows == rows


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    """The one shard of an array of four chunks of eight bytes that do not repeat."""
    values = np.random.default_rng(1).integers(1, 256, 32).astype(np.uint8)
    make(tmp_path, "voxel/material", values, 8, 32)
    return tmp_path / "voxel/material/c/0"


def refused(folder: Path, start: int, stop: int, told: str) -> None:
    with pytest.raises(StoreError, match=told):
        reader_of(folder, "voxel/material").read(start, stop)


def test_an_index_that_leads_out_of_its_file_is_refused(tmp_path, shard):
    index, end = index_of(shard, 4), shard.stat().st_size - 68
    assert sum(index[-1]) == end  # The index itself begins there.
    for wrong in ((end + 1, 1), (0, end + 1), (NOT_THERE, 1), (0, NOT_THERE)):
        write_index(shard, [*index[:3], wrong])
        refused(tmp_path, 0, 8, "c/0: its index leads out of it")


def test_an_entry_much_longer_than_its_chunk_is_refused(tmp_path, shard):
    """Nobody reads a file of any length for eight bytes."""
    index = index_of(shard, 4)
    shard.write_bytes(bytes(70_000) + shard.read_bytes())
    moved = [(70_000 + offset, length) for offset, length in index]
    write_index(shard, moved)
    assert len(reader_of(tmp_path, "voxel/material").read(0, 32)) == 32
    write_index(shard, [(0, 65_536 + 17), *moved[1:]])
    refused(tmp_path, 8, 16, "its index leads out of it")


def test_a_file_without_a_whole_index_is_refused(tmp_path, shard):
    content = shard.read_bytes()
    for torn in (b"", content[-67:], content[:-1]):
        shard.write_bytes(torn)
        refused(tmp_path, 0, 8, "has no sound index; it is damaged or cut short")
    shard.write_bytes(content[-68:])  # an index of chunks that are not there
    refused(tmp_path, 0, 8, "its index leads out of it")


def test_an_index_of_fill_values_alone_is_a_shard(tmp_path, shard):
    """Shorter than it is no file, and as long one is."""
    shard.write_bytes(bytes(68))
    write_index(shard, [(NOT_THERE, NOT_THERE)] * 4)
    assert shard.stat().st_size == 68
    assert reader_of(tmp_path, "voxel/material").read(0, 32).tolist() == [0] * 32


def test_a_file_that_is_cut_short_while_it_is_read_is_refused(tmp_path, shard):
    reader = reader_of(tmp_path, "voxel/material")
    reader.read(0, 8)
    os.truncate(shard, sum(index_of(shard, 4)[2]) - 1)
    assert len(reader.read(8, 16)) == 8
    with pytest.raises(StoreError, match="chunk 2 is damaged: the file ends before it does"):
        reader.read(16, 24)


class Watched(LocalFile):
    """A file that tells which ranges it was asked for, but for its end, the index."""

    def __init__(self, name: str, asked: list[tuple[str, int, int]]) -> None:
        super().__init__(name)
        self.of, self.asked = name, asked

    def pread(self, length: int, offset: int) -> bytes:
        if offset + length < self.size():
            self.asked.append((self.of, offset, offset + length))
        return super().pread(length, offset)


class WatchedFolder(LocalFolder):
    """As one on an object store, where a range that is fetched at once saves requests."""

    prefetch_bytes = 2**20

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.asked: list[tuple[str, int, int]] = []
        self.files: list[weakref.ref[LocalFile]] = []

    def open(self, name: str) -> LocalFile:
        file = Watched(f"{self.path}/{name}", self.asked)
        self.files.append(weakref.ref(file))
        return file


def test_chunks_that_lie_side_by_side_are_asked_for_at_once(tmp_path):
    values = np.random.default_rng(2).integers(1, 256, (60, 40)).astype(np.uint8)
    values[[*range(12, 16), *range(44, 48)]] = 0  # chunks 3 and 11, which are not there
    make(tmp_path, "voxel/feats", values, 4, 24)
    files = [str(tmp_path / f"voxel/feats/c/{n}/0") for n in range(3)]
    indices = [index_of(Path(file), 6) for file in files]
    assert indices[0][3] == indices[1][5] == (NOT_THERE, NOT_THERE)
    folder = WatchedFolder(tmp_path)
    reader = reader_of(folder, "voxel/feats")

    def asked(start: int, stop: int) -> list[tuple[str, int, int]]:
        folder.asked.clear()
        assert np.array_equal(reader.read(start, stop), values[start:stop])
        return list(folder.asked)

    def span(file: int, first: int, last: int) -> tuple[str, int, int]:
        return files[file], indices[file][first][0], sum(indices[file][last])

    assert asked(5, 19) == [span(0, 1, 4)]
    assert asked(1, 50) == [span(0, 0, 5), span(1, 0, 4), span(2, 0, 0)]
    assert (asked(4, 8), asked(9, 16)) == ([span(0, 1, 1)], [span(0, 2, 2)])

    folder.prefetch_bytes = sum(indices[1][2]) - indices[1][1][0]
    assert asked(28, 36) == [span(1, 1, 2)]
    folder.prefetch_bytes -= 1  # more than is worth it
    assert asked(28, 36) == [span(1, 1, 1), span(1, 2, 2)]


def test_the_shards_read_last_stay_open_and_no_others(tmp_path, monkeypatch):
    """Of all stores of the process together."""
    monkeypatch.setattr(shard_reader, "OPEN_SHARDS", 20)
    values = np.arange(1, 17, dtype=np.uint8)
    for name in "ab":
        make(tmp_path / name, "voxel/material", values, 1, 1)
    folders = [WatchedFolder(tmp_path / name) for name in "ab"]
    readers = [reader_of(folder, "voxel/material") for folder in folders]
    for row in range(len(values)):
        for reader in readers:
            assert reader.read(row, row + 1).tolist() == [row + 1]

    def opened() -> int:
        return sum(len(folder.files) for folder in folders)

    files = [file for folder in folders for file in folder.files]
    assert opened() == 32 and sum(file() is not None for file in files) == 20
    for reader in readers:
        reader.read(6, 16)
    assert opened() == 32
    readers[0].read(5, 6)
    assert opened() == 33
    del reader, readers
    assert not any(file() for folder in folders for file in folder.files)


def test_few_files_that_a_process_may_open_are_no_damage(tmp_path, monkeypatch):
    make(tmp_path, "voxel/material", np.arange(1, 17, dtype=np.uint8), 1, 1)
    reader = reader_of(tmp_path, "voxel/material")

    def refusing(name: str) -> LocalFile:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(reader.folder, "open", refusing)
    with pytest.raises(StoreError, match=r"c/0: cannot be opened .*; raise the limit") as caught:
        reader.read(0, 1)
    assert not isinstance(caught.value, DamagedFileError)
    monkeypatch.undo()
    resource = pytest.importorskip("resource")
    with monkeypatch.context() as few:
        few.setattr(resource, "getrlimit", lambda _: (16, 4096))
        assert reader.read(0, 16).tolist() == [*range(1, 17)]
    assert len(reader._shards) == 8


@pytest.mark.parametrize("index_bytes", [0, 68], ids=["with the index", "behind the index"])
@pytest.mark.parametrize("prefetch_bytes", [0, 2**20])
def test_what_cannot_be_read_is_named(shard, tmp_path, monkeypatch, prefetch_bytes, index_bytes):
    """On a disk, or of a server that cuts a body short: size answers, reading does not."""
    pread = LocalFile.pread

    def failing(file: LocalFile, length: int, offset: int) -> bytes:
        if offset < file.size() - index_bytes:
            raise OSError(errno.EIO, "the disk gave up")
        return pread(file, length, offset)

    monkeypatch.setattr(LocalFile, "pread", failing)
    monkeypatch.setattr(LocalFolder, "prefetch_bytes", prefetch_bytes)
    reader = reader_of(tmp_path, "voxel/material")
    what = r"voxel/material/c/0: cannot be read \(the disk gave up\)"
    with pytest.raises(StoreError, match=what):
        reader.read(0, 32)
    with pytest.raises(StoreError, match=what):
        list(reader.packed(0, 4))


def test_packed_chunks_are_the_bytes_of_the_files_a_few_at_a_time(tmp_path, monkeypatch):
    values = np.random.default_rng(3).integers(1, 256, (70, 100)).astype(np.uint8)
    make(tmp_path, "voxel/feats", values, 4, 40)  # 10 chunks of 400 bytes, and 8
    monkeypatch.setattr(shard_reader, "_COPIED_BYTES", 1000)
    reader = reader_of(LocalFolder(tmp_path), "voxel/feats")
    chunks = [
        file.read_bytes()[offset : offset + length]
        for file in [tmp_path / f"voxel/feats/c/{n}/0" for n in range(2)]
        for offset, length in index_of(file, 10)
        if offset != NOT_THERE
    ]
    assert len(chunks) == 18
    for first, last in ((0, 18), (3, 12), (9, 10), (4, 4), (10, 18)):
        found = []
        for data, lengths in reader.packed(first, last):
            assert len(data) == sum(lengths) < 1000 + 500
            found += [data[a:b] for a, b in pairwise(np.cumsum([0, *lengths]).tolist())]
        assert found == chunks[first:last]


def test_packed_chunks_that_are_not_side_by_side_or_damaged_are_refused(tmp_path, shard):
    index, content = index_of(shard, 4), shard.read_bytes()
    write_index(shard, [index[0], index[2], index[1], index[3]])
    reader = reader_of(tmp_path, "voxel/material")
    (one,) = reader.packed(1, 2)
    assert one == (content[index[2][0] : sum(index[2])], [index[2][1]])
    for first, last in ((0, 2), (1, 3), (0, 4), (2, 4)):
        with pytest.raises(StoreError, match="its chunks do not follow one another"):
            list(reader_of(tmp_path, "voxel/material").packed(first, last))
    write_index(shard, [*index[:3], (NOT_THERE, NOT_THERE)])
    with pytest.raises(StoreError, match="its chunks do not follow one another"):
        list(reader_of(tmp_path, "voxel/material").packed(2, 4))
    for at in (index[2][0], sum(index[2]) - 1):
        flipped = bytearray(content)
        flipped[at] ^= 1
        shard.write_bytes(flipped)
        reader = reader_of(tmp_path, "voxel/material")
        assert sum(lengths == [n for _, n in index[:2]] for _, lengths in reader.packed(0, 2)) == 1
        with pytest.raises(StoreError, match="c/0: a chunk is damaged"):
            list(reader.packed(0, 4))
