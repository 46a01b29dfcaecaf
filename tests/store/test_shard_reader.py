"""Rows read straight from shards, against zarr-python, from threads and processes, and hostile."""

import json
import multiprocessing
import os
import pickle
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from slatprep.errors import StoreError
from slatprep.pipeline.dataset import BuildSummary
from slatprep.store import Store, open_store
from slatprep.store.layout import ARRAYS


@pytest.fixture(scope="module")
def store(mixed_build: BuildSummary) -> Store:
    return open_store(mixed_build.store)


def digest(store: Store, index: int) -> list[bytes]:
    return [array.tobytes() for array in store.read(index).values()]


def test_threads_share_a_store(store):
    expected = [digest(store, index) for index in range(5)]
    fresh = open_store(store.path)
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(lambda k: digest(fresh, k % 5), range(200))) == expected * 40


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_processes_share_a_store(store, method):
    expected = [digest(store, index) for index in range(5)]
    assert len(pickle.dumps(store)) < 500  # Whatever has been read stays behind.
    with multiprocessing.get_context(method).Pool(2) as pool:
        rows = pool.starmap(Store.read, [(store, index % 5) for index in range(20)])
    assert [[array.tobytes() for array in one.values()] for one in rows] == expected * 4


def test_a_replaced_store_is_not_mixed_with_the_new_one(copy):
    old = open_store(copy)
    assert len(old) == 5
    copy.rename(copy.with_name("gone"))
    shutil.copytree(copy.with_name("gone"), copy)
    shutil.rmtree(copy.with_name("gone"))
    with pytest.raises(StoreError, match="was the store replaced"):
        old.read(0)


def test_opening_reads_one_file_needs_no_other_library_and_closes_quietly(store):
    code = f"""
import sys
opened = []
sys.addaudithook(lambda event, args: event == "open" and opened.append(str(args[0])))
from slatprep.store import open_store
store = open_store({str(store.path)!r})
# The folder itself is opened, too, so that what is read stays of one store.
files = [name for name in opened if name != {str(store.path)!r} and {str(store.path)!r} in name]
assert files == [{str(store.path / "zarr.json")!r}], files
assert store.read(2)["feats"].shape[1] == 8
store.asset("cup").grid_properties, store.column("verdict")
assert "zarr" not in sys.modules
import slatprep.cli.commands, slatprep.storage.remote
assert not {{"fsspec", "s3fs"}} & set(sys.modules)
del store
"""
    told = subprocess.run(
        [sys.executable, "-X", "dev", "-c", code], capture_output=True, text=True, check=True
    )
    assert "ResourceWarning" not in told.stderr


def edited(text: str, change: dict[str, object]) -> str:
    document = json.loads(text)
    for place, value in change.items():
        target = document
        *keys, last = place.split("|")
        for key in keys:
            target = target[int(key) if key.isdigit() else key]
        target[int(last) if last.isdigit() else last] = value
    return json.dumps(document)


META = "consolidated_metadata|metadata|"
COORDS, ID, FEATS = META + "voxel/coords|", META + "asset/id|", META + "voxel/feats|"
SHARDING = "codecs|0|configuration|"

HOSTILE = {
    "more voxels than files": {COORDS + "shape": [10**9, 3]},
    "a number of rows beyond reason": {COORDS + "shape": [10**15, 3]},
    "more assets than files": {
        META + f"{layout.name}|shape|0": 10**7 + (layout.name == "asset/offset")
        for layout in ARRAYS
        if layout.name.startswith("asset/")
    },
    "huge chunks": {
        FEATS + SHARDING + "chunk_shape": [2**40, 8],
        FEATS + "chunk_grid|configuration|chunk_shape": [2**40, 8],
    },
    "huge shards": {FEATS + "chunk_grid|configuration|chunk_shape": [2**50, 8]},
    "chunks of nothing": {FEATS + SHARDING + "chunk_shape": [0, 8]},
    "negative chunks": {FEATS + SHARDING + "chunk_shape": [-128, 8]},
    "wide rows": {FEATS + "shape": [10, 10**9]},
    "no shape": {FEATS + "shape": None},
    "no codecs": {FEATS + "codecs": []},
    "other metadata": {META + "voxel/feats": "feats"},
}


HOSTILE_READER = """
import json, resource, sys
from pathlib import Path
from slatprep.errors import StoreError
from slatprep.store import open_store
import numpy, numcodecs, google_crc32c, slatprep.inspect.check

def grown():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024

place, before = Path(sys.argv[1]), grown()
for case, document in json.loads(sys.stdin.read()).items():
    (place / "zarr.json").write_text(document)
    try:
        store = open_store(str(place))
        store.read(0)
        store.asset(store.ids[0])
        said = "read"
    except StoreError as error:
        said = str(error)
    print(json.dumps([case, said, grown() - before]), flush=True)
"""


def test_hostile_metadata_cost_neither_memory_nor_sense(copy):
    sound = (copy / "zarr.json").read_text()
    documents = {case: edited(sound, change) for case, change in HOSTILE.items()}
    done = subprocess.run(
        [sys.executable, "-c", HOSTILE_READER, str(copy)],
        input=json.dumps(documents), capture_output=True, text=True, check=True,
    )  # fmt: skip
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert [case for case, _, _ in answers] == list(HOSTILE)
    for case, message, grown in answers:
        assert str(copy) in message, case
        assert grown < 100, case


def test_a_chunk_that_claims_to_be_huge_is_not_unpacked(copy):
    """A store of bombs: every checksum is right, each chunk unpacks to a gigabyte."""
    from google_crc32c import value as crc32c
    from numcodecs import Zstd

    bomb = Zstd(1).encode(bytes(2**30))
    bomb += crc32c(bytes(bomb)).to_bytes(4, "little")
    (copy / "asset/id/c/0").write_bytes(bomb)
    (copy / "asset/fitness/c/0").write_bytes(bomb)
    store = open_store(copy)
    for name in ("id", "fitness"):
        with pytest.raises(StoreError, match="it holds 1073741824 bytes; expected"):
            store.column(name)


def test_a_shard_that_is_a_pipe_or_a_folder_does_not_hang(copy):
    shard = copy / "voxel/coords/c/0/0"
    shard.unlink()
    shard.mkdir()
    with pytest.raises(StoreError, match="voxel/coords/c/0/0: "):
        open_store(copy).read(0)
    shard.rmdir()
    os.mkfifo(shard)
    with pytest.raises(StoreError, match="no regular file"):
        open_store(copy).read(0)
