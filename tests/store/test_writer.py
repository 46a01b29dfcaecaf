"""How a new store is cut, packed and ended, whose shards are the bytes that zarr makes."""

import hashlib
import json
import shutil
import warnings
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zarr
from support.memory import less_than
from support.trees import tree

from slatprep import Normalization, PropertyRange, StoreError
from slatprep.parameters import StoreParameters
from slatprep.storage.place import storage_of
from slatprep.store.contract import read_metadata
from slatprep.store.integrity import write_digests
from slatprep.store.layout import ARRAYS
from slatprep.store.runs import Run, runs_of
from slatprep.store.shard_reader import RowReader
from slatprep.store.shard_writer import ShardWriter
from slatprep.store.writer import Shard, create_store, finish_store, shards


def arrays_of(store: Path) -> dict[str, zarr.Array]:
    root = zarr.open_group(store, mode="r", use_consolidated=False)
    return {name: part for name, part in root.members(None) if isinstance(part, zarr.Array)}


def test_arrays_are_cut_as_parameters_say(tmp_path):
    parameters = StoreParameters(voxel_chunk=4, voxel_chunks_per_shard=2, grid_assets_per_shard=3)
    create_store(tmp_path / "s", 5, 41, parameters)
    arrays = arrays_of(tmp_path / "s")
    cuts = {name: (a.shape, a.chunks, a.shards) for name, a in arrays.items()}
    assert cuts["voxel/material"] == ((41,), (4,), (8,))
    assert cuts["voxel/coords"] == ((41, 3), (4, 3), (8, 3))
    assert cuts["voxel/feats"] == ((41, 8), (4, 8), (8, 8))
    cube = (64, 64, 64)
    assert cuts["grid/material"] == ((5, *cube), (1, *cube), (3, *cube))
    assert cuts["grid/properties"] == ((5, 3, *cube), (1, 3, *cube), (3, 3, *cube))
    # One file has a whole column of assets, and no more rows than there are.
    assert cuts["asset/id"] == cuts["asset/fitness"] == ((5,), (5,), None)
    assert cuts["asset/offset"] == ((6,), (6,), None)
    assert cuts["asset/transform"] == ((5, 4, 4), (5, 4, 4), None)
    for name, (_, chunks, outer) in cuts.items():
        if (group := name.partition("/")[0]) != "asset":
            assert (chunks[0], outer[0]) == {"voxel": (4, 8), "grid": (1, 3)}[group], name


def test_columns_of_many_assets_are_cut(tmp_path):
    create_store(tmp_path / "s", 100_000, 1, StoreParameters(voxel_chunk=4))
    arrays = arrays_of(tmp_path / "s")
    for name in ("asset/id", "asset/offset", "asset/transform"):
        assert arrays[name].chunks[0] == 65_536, name
        assert arrays[name].shards is None


def test_bytes_that_recur_in_a_column_take_no_room(tmp_path):
    rng = np.random.default_rng(0)
    coords = np.full((4096, 3), [9, 30, 0], np.uint8)
    coords[:, 2] = rng.integers(0, 256, 4096)  # one byte of three is not known beforehand
    feats = rng.uniform(1.0, 2.0, (4096, 8)).astype(np.float32)  # three of four: one exponent
    create_store(tmp_path / "s", 1, 4096, StoreParameters(voxel_chunks_per_shard=1))
    root = zarr.open_group(tmp_path / "s", mode="r+", use_consolidated=False)
    for name, rows, unknown in (("coords", coords, 1 / 3), ("feats", feats, 3 / 4)):
        root[f"voxel/{name}"][:] = rows
        packed = (tmp_path / "s" / "voxel" / name / "c" / "0" / "0").stat().st_size
        assert packed < 1.05 * unknown * rows.nbytes + 100, name


def test_shards_of_tasks_are_those_of_the_arrays(tmp_path):
    """Where the number of voxels decides how large they are."""
    parameters = StoreParameters(voxel_chunk=1, grid_assets_per_shard=2)
    offsets = [0, 2048, 2049]  # 32 shards of 64 chunks, and one row more than they take
    create_store(tmp_path / "s", 2, offsets[-1], parameters)
    assert arrays_of(tmp_path / "s")["voxel/coords"].shards == (128, 3)
    every = shards(["a", "b"], offsets, parameters)
    found = [(shard.start, shard.stop) for shard in every if shard.group != "record"]
    assert found == [*((128 * n, 128 * n + 128) for n in range(16)), (2048, 2049), (0, 2)]


def test_a_shard_says_where_the_arrays_of_just_those_assets_lie_that_have_rows_in_it():
    parameters = StoreParameters(voxel_chunk=4, voxel_chunks_per_shard=2, grid_assets_per_shard=2)
    where, run = ["a", (0, 7), (1, 3)], Run(1, 3, 0, 6)
    grids = {"grid": runs_of([run], 3, (9,))}
    assert list(shards(where, [0, 5, 12, 20], parameters, grids, {("voxel", 1)})) == [
        Shard("voxel", 0, 8, 0, where[:2], (0, 5, 12), ((None, 0, 8),)),
        Shard("voxel", 16, 20, 2, where[2:], (12, 20), ((None, 16, 20),)),
        Shard("grid", 0, 2, 0, where[:2], (0, 1, 2), ((None, 0, 1), (run, 1, 2))),
        Shard("grid", 2, 3, 2, where[2:], (2, 3), ((run, 2, 3),)),
        Shard("record", 0, 3, 0, where, (0, 1, 2, 3), ((None, 0, 3),)),
    ]


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of one asset and 40 voxels, all of whose rows are written."""
    store = tmp_path_factory.mktemp("filled") / "s"
    create_store(store, 1, 40, StoreParameters(voxel_chunk=4, voxel_chunks_per_shard=2))
    root = zarr.open_group(store, mode="r+", use_consolidated=False)
    with zarr.config.set({"array.write_empty_chunks": True}):
        for _, array in root.members(max_depth=None):
            if isinstance(array, zarr.Array):
                array[...] = np.full(array.shape, array.fill_value, array.dtype)
    return store


@pytest.fixture
def written(filled: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(filled, tmp_path / "s"))


def test_a_store_has_the_files_that_were_meant_and_no_others(written):
    stray = written / "voxel" / "feats" / "c" / "0" / ".0.c196bb58.partial"
    stray.write_bytes(b"what a killed worker left")
    write_digests(written)
    assert not stray.exists()
    names = zarr.open_group(written, mode="r", use_consolidated=False)["file/name"][:]
    assert "voxel/feats/c/4/0" in names
    assert not any("partial" in name for name in names)
    # And what was meant to be there and is not ends the build.
    (written / "voxel" / "feats" / "c" / "1" / "0").unlink()
    with pytest.raises(StoreError, match="voxel/feats/c/1/0: was not written"):
        write_digests(written)


def test_a_finished_store_says_what_it_holds_in_one_file(written):
    root = zarr.open_group(written, mode="r+", use_consolidated=False)
    root["asset/id"][:] = np.array(["cup"], object)
    ranges = tuple(
        PropertyRange(name, log10, 2.0, 5.0)
        for name, log10 in (("youngs_modulus", True), ("density", True), ("poissons_ratio", False))
    )
    feats = "voxel/feats/c/0/0"
    normalization = Normalization(ranges, "pixie")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        finish_store(written, normalization, "ab" * 32, {"name": "x"}, known={feats: "seen"})
    done = zarr.open_group(written, mode="r", use_consolidated=True)
    assert (done.attrs["manifest"], done.attrs["build"]) == ("ab" * 32, {"name": "x"})
    assert done.attrs["segments"] == [0]
    density = {"log10": True, "lo": 2.0, "hi": 5.0, "source": "pixie"}
    assert done.attrs["normalization"]["density"] == density
    in_one_file = {name for name, _ in done.members(max_depth=None)}
    assert {"voxel/feats", "asset/record", "grid/x", "voxel/property", "file/sha256"} <= in_one_file
    digests = dict(zip(done["file/name"][:], done["file/sha256"][:], strict=True))
    for name in ("grid/material/c/0/0/0/0", "asset/id/c/0", "grid/x/zarr.json"):
        assert digests[name] == hashlib.sha256((written / name).read_bytes()).hexdigest()
    assert digests[feats] == "seen"  # digests that are known are not worked out again


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


def test_a_shard_of_fill_values_takes_no_memory_of_its_rows(tmp_path):
    create_store(tmp_path / "s", 1, 2**22, StoreParameters(voxel_chunks_per_shard=1024))
    with ShardWriter(tmp_path / "s", "voxel/valid", 0) as writer, less_than(2**20):
        writer.append_fill(2**22)
    assert not arrays_of(tmp_path / "s")["voxel/valid"][:].any()


@pytest.mark.parametrize("name", ["voxel/feats", "voxel/coords", "voxel/valid"])
def test_packed_chunks_are_taken_as_they_are(store, tmp_path, name):
    ours = emptied(store, name, tmp_path)
    values = zarr.open_group(store, mode="r", use_consolidated=False)[name][:]
    metadata = read_metadata(store / name / "zarr.json")
    reader = RowReader.of(storage_of(store).folder(), name, metadata)
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
