"""A shard in rows, in fill values, in packed chunks: one file, and one that zarr reads."""

import hashlib
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zarr
from support.trees import tree

from slatprep.parameters import StoreParameters
from slatprep.storage.place import storage_of
from slatprep.store.contract import read_metadata
from slatprep.store.layout import ARRAYS
from slatprep.store.shard_reader import RowReader
from slatprep.store.shard_writer import ShardWriter
from slatprep.store.writer import create_store

ROWS = 150  # of shards of 64 rows in chunks of 16: two whole shards, a whole chunk and six rows
ASSETS = 5  # in shards of 2
NAMES = [layout.name for layout in ARRAYS if not layout.name.startswith("asset/")]
FILLED = {"voxel": (16, 40), "grid": (1, 2)}
"""Rows of fill values: a whole chunk and half of the next."""

# A part ends before, at and after the end of a chunk, and spans several chunks.
CUTS = {
    "voxel": ([0, 5, 16, 40, 64], [64, 81, 128], [128, 129, 150]),
    "grid": ([0, 1, 2], [2, 4], [4, 5]),
}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store that zarr has written."""
    path = tmp_path_factory.mktemp("packing") / "s"
    parameters = StoreParameters(
        voxel_chunk=16, voxel_chunks_per_shard=4, grid_assets_per_shard=2, compression_level=3
    )
    create_store(path, ASSETS, ROWS, parameters)
    rng = np.random.default_rng(0)
    root = zarr.open_group(path, mode="r+", use_consolidated=False)
    with zarr.config.set({"array.write_empty_chunks": True}):
        for name in NAMES:
            array = root[name]
            values = rng.integers(0, 2, array.shape).astype(array.dtype)
            values[slice(*FILLED[name.split("/")[0]])] = array.fill_value
            array[:] = values
    return path


def emptied(store: Path, name: str, folder: Path) -> Path:
    """Return a store with one array that has no file yet."""
    target = folder / "s" / name
    target.mkdir(parents=True)
    (target / "zarr.json").write_bytes((store / name / "zarr.json").read_bytes())
    return folder / "s"


@pytest.mark.parametrize("name", NAMES)
def test_rows_in_any_parts_make_the_shards_that_zarr_makes(store, tmp_path, name):
    ours, kind = emptied(store, name, tmp_path), name.split("/")[0]
    values = zarr.open_group(store, mode="r", use_consolidated=False)[name][:]
    for cuts in CUTS[kind]:
        with ShardWriter(ours, name, cuts[0]) as writer:
            for first, last in pairwise(cuts):
                if (first, last) == FILLED[kind]:
                    writer.append_fill(last - first)
                else:
                    writer.append(values[first:last])
            # Not a part of it is in the store, should this process be killed now.
            assert not (ours / writer.file).exists()
            assert len(list((tmp_path / "s.partial").rglob("*"))) == 1
        content = (ours / writer.file).read_bytes()
        assert content == (store / writer.file).read_bytes()
        assert writer.written() == (len(content), hashlib.sha256(content).hexdigest())
    assert tree(ours / name) == tree(store / name)
    assert not list(tmp_path.rglob("*.partial/*"))


@pytest.mark.parametrize("name", ["voxel/feats", "voxel/coords", "voxel/valid"])
def test_packed_chunks_are_taken_as_they_are(store, tmp_path, name):
    ours = emptied(store, name, tmp_path)
    values = zarr.open_group(store, mode="r", use_consolidated=False)[name][:]
    reader = RowReader.of(
        storage_of(store).folder(), name, read_metadata(store / name / "zarr.json")
    )
    with ShardWriter(ours, name, 64) as writer:
        for data, lengths in reader.packed(4, 6):
            writer.append_packed(data, lengths)
        writer.append(values[96:112])
        for data, lengths in reader.packed(7, 8):
            writer.append_packed(data, lengths)
    (written,) = (path for path in (ours / name / "c").rglob("*") if path.is_file())
    assert written.relative_to(ours / name).parts[:2] == ("c", "1")
    assert written.read_bytes() == (store / written.relative_to(ours)).read_bytes()


def test_packed_chunks_come_after_whole_ones_alone(store, tmp_path):
    ours = emptied(store, "voxel/valid", tmp_path)
    with (
        pytest.raises(ValueError, match="3 rows of a chunk are waiting"),
        ShardWriter(ours, "voxel/valid", 0) as writer,
    ):
        writer.append(np.ones(3, bool))
        writer.append_packed(b"chunk", [5])
    assert not any(path.is_file() for path in (ours / "voxel/valid/c").rglob("*"))


def test_a_writer_that_was_given_up_leaves_a_finished_shard_alone(store, tmp_path):
    ours = emptied(store, "voxel/valid", tmp_path)
    with ShardWriter(ours, "voxel/valid", 0) as writer:
        writer.append(np.ones(64, bool))
    shard = ours / writer.file
    finished = shard.read_bytes()
    with ShardWriter(ours, "voxel/valid", 0) as late:
        late.append(np.ones(64, bool))
        assert shard.read_bytes() == finished
    assert [path.read_bytes() for path in shard.parent.iterdir()] == [finished]


def test_an_array_without_shards_is_refused(store, tmp_path):
    ours = emptied(store, "voxel/valid", tmp_path)
    path = ours / "voxel/valid/zarr.json"
    document = json.loads(path.read_text())
    inner = document["codecs"][0]["configuration"]
    document["chunk_grid"]["configuration"]["chunk_shape"] = inner["chunk_shape"]
    document["codecs"] = inner["codecs"]
    path.write_text(json.dumps(document))
    with pytest.raises(ValueError, match="voxel/valid is not laid out as slatprep"):
        ShardWriter(ours, "voxel/valid", 0)
