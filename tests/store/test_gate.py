"""What a stranger's store may name: nothing that runs code, nothing that waits, nothing huge."""

import json
import os
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import zarr
from click.testing import CliRunner

from slatprep.cli.commands import slatprep
from slatprep.errors import StoreError
from slatprep.inspect.verify import verify_store
from slatprep.parameters import MAX_GRID_SHARD, MAX_VOXEL_CHUNK, MAX_VOXEL_SHARD, StoreParameters
from slatprep.pipeline.dataset import build_store
from slatprep.store import open_store
from slatprep.store.contract import gate_findings


@pytest.fixture
def store(copy: Path) -> Path:
    return copy


def edit_root(store: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    document = json.loads((store / "zarr.json").read_text())
    edit(document)
    (store / "zarr.json").write_text(json.dumps(document))


def commands_refuse(store: Path, folder: Path) -> None:
    """Run commands that read all of a store; each must end in words."""
    for line in (
        ["check-alignment", "--asset", "cup", "--store", str(store)],
        ["export", str(store), "--format", "ply", "--frame", "pixieverse", "--out", f"{folder}/e"],
        ["describe", str(store), "--out", str(folder / "d.json")],
        ["verify", str(store)],
    ):
        done = CliRunner().invoke(slatprep, line)
        assert done.exit_code == 1, (line, done.output)
        assert isinstance(done.exception, SystemExit), (line, done.exception)


def no_zarr_sees(store: Path, told: str) -> None:
    with pytest.raises(StoreError, match=told):
        open_store(store).group  # noqa: B018


class Touch:
    """Unpickled, it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def hide_a_pickle(store: Path, ran: Path) -> None:
    """Put an array of format 2 that is unpickled into the consolidated metadata."""
    payload = pickle.dumps([Touch(ran)] * len(open_store(store)))
    shutil.rmtree(store / "asset/record")
    (store / "asset/record").mkdir()
    (store / "asset/record/0").write_bytes(payload)
    of_two = {
        "shape": [len(open_store(store))],
        "chunks": [64],
        "dtype": "|O",
        "fill_value": "",
        "order": "C",
        "filters": [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 5}],
        "dimension_separator": ".",
        "compressor": None,
        "zarr_format": 2,
        "attributes": {},
        "node_type": "array",
    }
    edit_root(
        store, lambda d: d["consolidated_metadata"]["metadata"].update({"asset/record": of_two})
    )


def test_a_pickle_in_format_two_is_never_read(store, tmp_path, monkeypatch):
    # As numcodecs had it up to 0.16.5, which unpickles.
    monkeypatch.setattr(numcodecs.Pickle, "decode", lambda self, data, out=None: pickle.loads(data))
    ran = tmp_path / "ran"
    hide_a_pickle(store, ran)
    commands_refuse(store, tmp_path)
    assert not ran.exists()
    no_zarr_sees(store, "zarr_format is 2; expected 3")


def test_the_largest_chunks_and_shards_that_may_be_asked_for_are_read(make_dataset, tmp_path):
    largest = StoreParameters(
        voxel_chunk=MAX_VOXEL_CHUNK,
        voxel_chunks_per_shard=MAX_VOXEL_SHARD // MAX_VOXEL_CHUNK,
        grid_assets_per_shard=MAX_GRID_SHARD,
    )
    parameters = replace(make_dataset("a").parameters(), store=largest)
    build_store(parameters, tmp_path / "large.zarr")
    assert verify_store(tmp_path / "large.zarr").ok


META = "consolidated_metadata"
EDITS: dict[str, tuple[dict[str, Any], str]] = {
    "gzip": ({"codecs": [{"name": "bytes"}, {"name": "gzip"}]}, "has the codec 'gzip'"),
    "numcodecs": ({"codecs": [{"name": "numcodecs.pickle"}]}, "the codec 'numcodecs.pickle'"),
    "within a shard": (
        {"codecs": [{"name": "sharding_indexed", "configuration": {"codecs": [{"name": "x"}]}}]},
        "has the codec 'x'",
    ),
    "no codec": ({"codecs": [5]}, "has the codec None"),
    "complex": ({"data_type": "complex64"}, "data_type is 'complex64'"),
    "named type": ({"data_type": {"name": "struct"}}, "data_type is"),
    "format 2": ({"zarr_format": 2}, "zarr_format is 2"),
    "no axes": ({"dimension_names": 5}, "dimension_names is 5"),
    "no array": ({"node_type": "other"}, "is no array or group"),
    "no table of attributes": ({"attributes": 5}, "attributes is 5"),
    "transformers": ({"storage_transformers": [{"name": "x"}]}, "storage_transformers is"),
}


@pytest.mark.parametrize("case", EDITS)
def test_what_is_not_on_the_lists_is_refused_and_found(store, case):
    change, what = EDITS[case]
    name = "asset/property"  # A coordinate, which the contract says nothing of.
    edit_root(store, lambda d: d[META]["metadata"][name].update(change))
    no_zarr_sees(store, what)
    findings = verify_store(store).findings
    assert any(f.file == f"{name}/zarr.json" and what in f.what for f in findings)


def test_a_group_has_no_consolidated_metadata_of_its_own():
    group: dict[str, Any] = {"zarr_format": 3, "node_type": "group", "attributes": {}}
    frame = {"kind": "inline", "must_understand": False}
    for allowed in (None, {**frame, "metadata": {}}):
        assert not list(gate_findings("voxel", {**group, META: allowed}))
    for nested in (5, frame, {**frame, "metadata": {"feats": {"zarr_format": 2}}}):
        (finding,) = gate_findings("voxel", {**group, META: nested})
        assert finding.what == "has consolidated metadata of its own"


def test_a_fill_value_beyond_its_data_type_is_told(store, tmp_path):
    edit_root(store, lambda d: d[META]["metadata"]["voxel/material"].update(fill_value=300))
    commands_refuse(store, tmp_path)


def test_an_array_of_another_name_is_refused(store):
    edit_root(
        store, lambda d: d[META]["metadata"].update({"voxel/../../x": {"node_type": "array"}})
    )
    no_zarr_sees(store, r"voxel/\.\./\.\./x/zarr.json: is no array")
    with pytest.raises(StoreError, match="is no array"):
        open_store(store).read_rows("voxel/../../x", 0, 1)


@pytest.mark.parametrize(
    "pipe", ["zarr.json", "asset/id/zarr.json", "asset/record/c/0", "voxel/feats/c/0/0"]
)
def test_no_command_waits_for_a_pipe(store, tmp_path, pipe):
    (store / pipe).unlink()
    os.mkfifo(store / pipe)
    for line in (["info"], ["verify"], ["report", "--out", str(tmp_path / "r.html")]):
        done = CliRunner().invoke(slatprep, [line[0], str(store), *line[1:]])
        assert done.exception is None or isinstance(done.exception, SystemExit)
    if pipe == "zarr.json":
        with pytest.raises(StoreError, match="is not a slatprep store"):
            verify_store(store)
    else:
        findings = verify_store(store).findings
        assert any(f.file == pipe and "no regular file" in f.what for f in findings)


def test_metadata_are_bounded_in_depth_and_are_unicode(store):
    good = (store / "zarr.json").read_text()
    for value in ("[" * 100_000, "[" * 500 + "]" * 500, '"\\ud800"'):
        (store / "zarr.json").write_text(
            good.replace('"attributes": {', '"attributes": {"x": ' + value + ",", 1)
        )
        with pytest.raises(StoreError):
            open_store(store)
        assert [finding.file for finding in verify_store(store).findings] == ["zarr.json"]


def test_strings_are_bounded_by_how_many_there_are(store):
    """Chunks of one row each, every one of which unpacks to megabytes."""
    root = zarr.open_group(store, mode="r+", use_consolidated=False)
    for name, size in (("asset/category", 10_000), ("asset/record", 2**21)):
        attributes = dict(root[name].attrs)
        del root[name]
        array = root.create_array(
            name,
            shape=(5,),
            dtype=str,
            chunks=(1,),
            dimension_names=("asset",),
            attributes=attributes,
        )
        array[:] = np.array(["x" * size] * 5, object)
    zarr.consolidate_metadata(str(store), zarr_format=3)
    opened = open_store(store)
    for name in ("asset/category", "asset/record"):
        with pytest.raises(StoreError, match="expected at most"):
            opened.read_rows(name, 0, 5)


def test_many_assets_must_have_bytes(store):
    claimed = 2**24

    def claim(document: dict[str, Any]) -> None:
        for metadata in document[META]["metadata"].values():
            if metadata.get("dimension_names", [""])[0] == "asset":
                metadata["shape"][0] = claimed
        offset = document[META]["metadata"]["asset/offset"]
        offset["shape"] = [claimed + 1]

    edit_root(store, claim)
    with pytest.raises(StoreError, match=r"has 16777216 assets in \d+ bytes"):
        len(open_store(store))
