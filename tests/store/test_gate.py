"""Rows read by many at once; and a stranger's store names nothing huge, nothing that waits."""

import json
import multiprocessing
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import zarr
from google_crc32c import value as crc32c
from support.commands import refused, run
from support.made_store import edit_attributes, edit_json, placed, rewrite
from support.memory import less_than
from support.trees import copied

from slatprep import Store, StoreError, build_store, open_store
from slatprep.inspect.verify import verify_store
from slatprep.parameters import MAX_GRID_SHARD, MAX_VOXEL_CHUNK, MAX_VOXEL_SHARD, StoreParameters
from slatprep.pipeline.rows import SourceStore
from slatprep.storage.files import LocalFolder
from slatprep.store.assets import ASSET_COLUMNS
from slatprep.store.contract import gate_findings
from slatprep.store.layout import ARRAYS

META = "consolidated_metadata"


def edit_root(store: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    """Change the metadata of arrays that the root repeats."""
    edit_json(store / "zarr.json", lambda document: edit(document[META]["metadata"]))


def commands_refuse(store: Path, folder: Path) -> None:
    """Run commands that read all of a store; each must end in words."""
    refused("check-alignment", "--asset", "cup", "--store", store, code=1)
    refused("export", store, "--format", "ply", "--frame", "pixieverse", "--out", folder / "e",
            code=1)  # fmt: skip
    refused("describe", store, "--out", folder / "d.json", code=1)
    refused("verify", store, code=1)


def no_zarr_sees(store: Path, told: str) -> None:
    with pytest.raises(StoreError, match=told):
        open_store(store).group  # noqa: B018


class Touch:
    """Unpickled, it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def test_a_pickle_in_format_two_is_never_read(copy, tmp_path, monkeypatch):
    """An array of format 2 that is unpickled is among the consolidated metadata."""
    # As numcodecs had it up to 0.16.5, which unpickles.
    monkeypatch.setattr(numcodecs.Pickle, "decode", lambda self, data, out=None: pickle.loads(data))
    ran, record = tmp_path / "ran", copy / "asset/record"
    shutil.rmtree(record)
    record.mkdir()
    (record / "0").write_bytes(pickle.dumps([Touch(ran)] * 5))
    of_two = {
        "shape": [5], "chunks": [64], "dtype": "|O", "fill_value": "", "order": "C",
        "filters": [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 5}],
        "dimension_separator": ".", "compressor": None, "zarr_format": 2, "attributes": {},
        "node_type": "array",
    }  # fmt: skip
    edit_root(copy, lambda arrays: arrays.update({"asset/record": of_two}))
    commands_refuse(copy, tmp_path)
    assert not ran.exists()
    no_zarr_sees(copy, "zarr_format is 2; expected 3")


def test_the_largest_chunks_and_shards_that_may_be_asked_for_are_read(make_dataset, tmp_path):
    largest = StoreParameters(
        voxel_chunk=MAX_VOXEL_CHUNK,
        voxel_chunks_per_shard=MAX_VOXEL_SHARD // MAX_VOXEL_CHUNK,
        grid_assets_per_shard=MAX_GRID_SHARD,
    )
    build_store(replace(make_dataset("a").parameters(), store=largest), tmp_path / "large.zarr")
    assert verify_store(tmp_path / "large.zarr").ok


WITHIN = {"name": "sharding_indexed", "configuration": {"codecs": [{"name": "x"}]}}
EDITS: list[tuple[str, Any, str]] = [
    ("codecs", [{"name": "bytes"}, {"name": "gzip"}], "has the codec 'gzip'"),
    ("codecs", [{"name": "numcodecs.pickle"}], "the codec 'numcodecs.pickle'"),
    ("codecs", [WITHIN], "has the codec 'x'"),
    ("codecs", [5], "has the codec None"),
    ("data_type", "complex64", "data_type is 'complex64'"),
    ("data_type", {"name": "struct"}, "data_type is"),
    ("zarr_format", 2, "zarr_format is 2"),
    ("dimension_names", 5, "dimension_names is 5"),
    ("dimension_names", [5], r"dimension_names is \[5\]"),
    ("node_type", "other", "is no array or group"),
    ("attributes", 5, "attributes is 5"),
    ("attributes", None, "attributes is None"),
    ("storage_transformers", [{"name": "x"}], "storage_transformers is"),
]


def test_what_is_not_on_the_lists_is_refused_and_found(copy):
    name = "asset/property"  # A coordinate, which the contract says nothing of.
    sound = (copy / "zarr.json").read_bytes()
    for key, value, what in EDITS:
        edit_root(copy, lambda arrays, key=key, value=value: arrays[name].update({key: value}))
        no_zarr_sees(copy, what)
        findings = [f.what for f in verify_store(copy).findings if f.file == f"{name}/zarr.json"]
        assert any(what.replace("\\", "") in found for found in findings), what
        (copy / "zarr.json").write_bytes(sound)


def test_a_group_has_no_consolidated_metadata_of_its_own():
    group: dict[str, Any] = {"zarr_format": 3, "node_type": "group", "attributes": {}}
    frame = {"kind": "inline", "must_understand": False}
    for allowed in (None, {**frame, "metadata": {}}):
        assert not list(gate_findings("voxel", {**group, META: allowed}))
    for nested in (5, frame, {**frame, "metadata": {"feats": {"zarr_format": 2}}}):
        (finding,) = gate_findings("voxel", {**group, META: nested})
        assert finding.what == "has consolidated metadata of its own"


def test_a_fill_value_beyond_its_data_type_is_told(copy, tmp_path):
    edit_root(copy, lambda arrays: arrays["voxel/material"].update(fill_value=300))
    commands_refuse(copy, tmp_path)


def test_an_array_of_another_name_is_refused(copy):
    edit_root(copy, lambda arrays: arrays.update({"voxel/../../x": {"node_type": "array"}}))
    no_zarr_sees(copy, r"voxel/\.\./\.\./x/zarr.json: is no array")
    with pytest.raises(StoreError, match="is no array"):
        open_store(copy).read_rows("voxel/../../x", 0, 1)


@pytest.mark.parametrize(
    "pipe", ["zarr.json", "asset/id/zarr.json", "asset/record/c/0", "voxel/feats/c/0/0"]
)
def test_no_command_waits_for_a_pipe(copy, tmp_path, pipe):
    (copy / pipe).unlink()
    os.mkfifo(copy / pipe)
    for words in (("info", copy), ("report", copy, "--out", tmp_path / "r.html")):
        run(*words, code=None)
    told = run("verify", copy, code=1)
    if pipe == "zarr.json":
        assert "is not a slatprep store" in told.stderr
    else:
        assert f"{pipe}: is no regular file" in told.stdout


def test_metadata_are_bounded_in_depth_and_are_unicode(copy):
    good = (copy / "zarr.json").read_text()
    for value in ("[" * 100_000, "[" * 500 + "]" * 500, '"\\ud800"'):
        text = good.replace('"attributes": {', '"attributes": {"x": ' + value + ",", 1)
        (copy / "zarr.json").write_text(text)
        with pytest.raises(StoreError):
            open_store(copy)
        assert [finding.file for finding in verify_store(copy).findings] == ["zarr.json"]


def test_strings_are_bounded_by_how_many_there_are(copy):
    """Chunks of one row each, every one of which unpacks to megabytes."""
    root = zarr.open_group(copy, mode="r+", use_consolidated=False)
    for name, size in (("asset/category", 10_000), ("asset/record", 2**21)):
        del root[name]
        array = root.create_array(
            name, shape=(5,), dtype=str, chunks=(1,), dimension_names=("asset",)
        )
        array[:] = np.array(["x" * size] * 5, object)
    with pytest.warns(UserWarning, match="Consolidated metadata"):
        zarr.consolidate_metadata(str(copy), zarr_format=3)
    opened = open_store(copy)
    for name in ("asset/category", "asset/record"):
        with pytest.raises(StoreError, match="expected at most"):
            opened.read_rows(name, 0, 5)


def test_many_assets_must_have_bytes(copy):
    claimed = 2**24

    def claim(arrays: dict[str, Any]) -> None:
        for metadata in arrays.values():
            if metadata.get("dimension_names", [""])[0] == "asset":
                metadata["shape"][0] = claimed
        arrays["asset/offset"]["shape"] = [claimed + 1]

    edit_root(copy, claim)
    with pytest.raises(StoreError, match=r"has 16777216 assets in \d+ bytes"):
        len(open_store(copy))


def digest(row: dict[str, np.ndarray]) -> list[bytes]:
    return [array.tobytes() for array in row.values()]


@pytest.mark.parametrize("method", ["threads", "fork", "spawn"])
def test_threads_and_processes_share_a_store(store, method):
    opened = open_store(store)
    expected = [digest(opened.read(index)) for index in range(5)]
    assert len(pickle.dumps(opened)) < 500  # Whatever has been read stays behind.
    context = multiprocessing.get_context(None if method == "threads" else method)
    with ThreadPool(8) if method == "threads" else context.Pool(2) as pool:
        fresh = open_store(store)
        rows = pool.starmap(Store.read, [(fresh, index % 5) for index in range(100)])
    assert [digest(row) for row in rows] == expected * 20


def test_a_replaced_store_is_not_mixed_with_the_new_one(copy):
    old = open_store(copy)
    assert len(old) == 5
    copy.rename(copy.with_name("gone"))
    shutil.copytree(copy.with_name("gone"), copy)
    shutil.rmtree(copy.with_name("gone"))
    reads: list[Callable[[], object]] = [lambda: old.read(0), old.to_pandas]
    reads += [partial(old.column, name) for name in ("id", "transform", *ASSET_COLUMNS)]
    for read in reads:
        with pytest.raises(StoreError, match="was the store replaced"):
            read()


@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_store_replaced_while_it_is_opened_is_one_of_the_two(copy, monkeypatch, moment):
    newer, opens = copied(copy, copy.with_name("newer")), LocalFolder.__init__
    edit_attributes(newer, manifest="0" * 64)
    rewrite(newer, "asset/category", 0, "newer")

    def open_and_replace(folder: LocalFolder, path: Path) -> None:
        if moment == "after":
            opens(folder, path)
        if newer.exists():
            copy.rename(copy.with_name("older"))
            newer.rename(copy)
        if moment == "before":
            opens(folder, path)

    monkeypatch.setattr(LocalFolder, "__init__", open_and_replace)
    opened = open_store(copy)
    parts = opened.about.manifest == "0" * 64, opened.column("category")[0] == "newer"
    assert parts == (moment == "before",) * 2


def test_zarr_opens_the_store_that_was_opened_or_none(copy):
    opened = open_store(copy)
    edit_attributes(copy, manifest="0" * 64)
    with pytest.raises(StoreError, match=r"was the store replaced\?\); open it again"):
        opened.group  # noqa: B018


def test_a_store_that_was_sent_to_a_process_is_that_store_or_none(copy):
    """Of another build or another order of the same rows, or gone; each use says so."""
    opened = open_store(copy)
    # A process opens a `SourceStore` once.
    sent = [pickle.dumps(one) for _ in range(3) for one in (opened, SourceStore(opened))]
    for one in map(pickle.loads, sent[:2]):
        assert one.ids == opened.ids and digest(one.read(0)) == digest(opened.read(0))
    edit_attributes(copy, manifest="0" * 64)
    lost = [pickle.loads(one) for one in sent[2:4]]
    edit_attributes(copy, manifest=opened.about.manifest)
    assert pickle.loads(sent[3]).ids == opened.ids  # A fault that has passed is forgotten.
    rewrite(copy, "asset/id", slice(2), opened.ids[1::-1])
    lost += [pickle.loads(one) for one in sent[4:]]
    for one in lost:
        for use in (len, iter, lambda one: one.read(0), lambda one: one["ant"], pickle.dumps):
            with pytest.raises(StoreError, match=r"was the store replaced\?\); open it again"):
                use(one)
        depths = set[int]()
        for _ in range(2):
            with pytest.raises(StoreError) as told:
                len(one)
            depths.add(len(told.traceback))
        assert len(depths) == 1
    shutil.rmtree(copy)
    gone = pickle.loads(sent[0])
    with pytest.raises(StoreError, match="is not a slatprep store"):
        gone.read(0)


def test_opening_reads_one_file_needs_no_other_library_and_closes_quietly(store):
    code = f"""
import sys
opened = []
sys.addaudithook(lambda event, args: event == "open" and opened.append(str(args[0])))
from slatprep.store import open_store
store = open_store({str(store)!r})
# The folder itself is opened, too, and files below it, so that what is read stays of one store.
below = {str(store / "x")[:-1]!r}
files = [name for name in opened if name.startswith(below) or not name.startswith("/")]
assert files == ["zarr.json", "zarr.json"], files  # Python tells of a file and of its opener.
assert store.read(2)["feats"].shape[1] == 8
store.asset("cup").grid_properties, store.column("verdict")
assert "zarr" not in sys.modules
import slatprep.cli.commands, slatprep.storage.remote
assert not {{"fsspec", "s3fs"}} & set(sys.modules)
del store
"""
    command = [sys.executable, "-X", "dev", "-c", code]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=store.parent)
    assert "ResourceWarning" not in told.stderr


FEATS = "voxel/feats|"
SHARDING = "codecs|0|configuration|"

HOSTILE = {
    "more voxels than files": {"voxel/coords|shape": [10**9, 3]},
    "a number of rows beyond reason": {"voxel/coords|shape": [10**15, 3]},
    "more assets than files": {
        f"{layout.name}|shape|0": 10**7 + (layout.name == "asset/offset")
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
    "other metadata": {"voxel/feats": "feats"},
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_metadata_cost_neither_memory_nor_sense(copy, case):
    document = json.loads((copy / "zarr.json").read_text())
    for place, value in HOSTILE[case].items():
        document = placed(document, f"{META}|metadata|{place}", value, by="|")
    (copy / "zarr.json").write_text(json.dumps(document))
    with less_than(100 * 2**20), pytest.raises(StoreError, match=str(copy)):
        store = open_store(copy)
        store.read(0)
        store.asset(store.ids[0])


def test_a_chunk_that_claims_to_be_huge_is_not_unpacked(copy):
    """A store of bombs: every checksum is right, each chunk unpacks to a gigabyte."""
    bomb = numcodecs.Zstd(1).encode(bytes(2**30))
    bomb += crc32c(bytes(bomb)).to_bytes(4, "little")
    (copy / "asset/id/c/0").write_bytes(bomb)
    (copy / "asset/fitness/c/0").write_bytes(bomb)
    store = open_store(copy)
    for name in ("id", "fitness"):
        with pytest.raises(StoreError, match="it holds 1073741824 bytes; expected"):
            store.column(name)
