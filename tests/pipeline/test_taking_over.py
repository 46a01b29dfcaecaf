"""What did not change is taken over: files, chunks and rows, checked, and only then."""

import gc
import json
import os
import pickle
import random
import shutil
import weakref
from dataclasses import replace
from pathlib import Path
from string import ascii_lowercase

import numpy as np
import pytest
from support.faults import flip, inject
from support.first_builds import tree_from_nothing
from support.synthetic import Dataset, Made
from support.trees import inodes, records_of, tree

from slatprep.inspect.verify import verify_store
from slatprep.parameters import StoreParameters
from slatprep.pipeline import recipe, rows
from slatprep.pipeline.dataset import build_store, plan_build
from slatprep.pipeline.rows import SourceStore
from slatprep.storage import states
from slatprep.store import layout, open_store
from slatprep.store.layout import ARRAYS
from slatprep.store.shard_reader import RowReader

pytestmark = pytest.mark.usefixtures("files_are_old", "few_are_new")


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Four assets, and a store of them in some ten shards an array; nobody may change them."""
    folder = tmp_path_factory.mktemp("four")
    dataset = Dataset(folder / "sources").having(*"aceg")
    build_store(dataset.parameters(), folder / "s.zarr")
    return dataset, folder / "s.zarr"


@pytest.fixture
def built(four: Made, tmp_path: Path) -> Made:
    """Return copies of both, of which a build knows every file by its state."""
    shutil.copytree(four[1].parent, tmp_path, dirs_exist_ok=True)
    dataset, out = Dataset(tmp_path / "sources", dict(four[0].assets)), tmp_path / "s.zarr"
    build_store(dataset.parameters(), out)
    return dataset, out


OF_ROWS = (
    "coords", "feats", "properties", "material", "valid", "distance", "place", "confidence",
    "grid_properties", "grid_material",
)  # fmt: skip


def same_files(before: dict[str, int], after: dict[str, int], below: str) -> int:
    return sum(after.get(name) == ino for name, ino in before.items() if name.startswith(below))


def names(steps: list[tuple[str, str]], step: str) -> list[str]:
    return [name for found, name in steps if found == step]


def test_new_assets_come_behind_and_the_rest_stays_where_it_is(built, steps):
    dataset, out = built
    before, files = inodes(out), tree(out)
    dataset.having("d", "b", seed=1)
    summary = build_store(dataset.parameters(), out)
    assert names(steps, "asset read") == ["b", "d"]
    store = open_store(out)
    assert store.ids == ["a", "c", "e", "g", "b", "d"]
    assert store.attributes["segments"] == [0, 4]
    table = store.to_pandas()
    held = {one.asset_id: {name: getattr(one, name) for name in OF_ROWS} for one in store}
    assert verify_store(out, sources=True).ok
    # Of the shards of each array the last alone had room; what else is written is small.
    written = {name for name, number in inodes(out).items() if before.get(name) != number}
    long = [one.name for one in ARRAYS if one.name.startswith(("voxel/", "grid/"))]
    of_rows = set()
    for array in long:
        reader = store.reader(array)
        first = (store.offsets[4] if array.startswith("voxel/") else 4) // reader.shard_rows
        shards = -(-reader.shape[0] // reader.shard_rows)
        of_rows |= {reader.key(shard) for shard in range(first, shards)}
    assert of_rows == {name for name in written if name.rpartition("/c/")[0] in long}
    assert sum((out / name).stat().st_size for name in written - of_rows) < 150_000
    assert names(steps, "asset aligned") == ["b", "d"]
    # ...and what is new in it is as a first build writes it.
    built_anew = tree_from_nothing(dataset.parameters())
    assert tree(out) != built_anew
    assert list(records_of(out.with_name("s.manifests") / "assets.jsonl")) == list("acegbd")
    compacted = build_store(dataset.parameters(), out, compact=True)
    assert names(steps, "asset aligned") == []
    assert compacted.build_id == summary.build_id
    assert tree(out) == built_anew
    assert files.keys() <= built_anew.keys()
    # Each asset had the rows of a first build before, too.
    reference = open_store(out)
    assert table.loc[reference.ids].equals(reference.to_pandas())
    for asset in reference:
        for name, values in held[asset.asset_id].items():
            np.testing.assert_array_equal(values, getattr(asset, name))


def test_larger_shards_are_made_of_chunks_as_they_are(make_dataset, monkeypatch, steps, tmp_path):
    monkeypatch.setattr(layout, "MOST_SHARDS", 4)
    monkeypatch.setattr(layout, "_CHUNKS_IN_SHARD", (1, 4096))
    dataset, out = make_dataset("a", "c"), tmp_path / "s.zarr"
    by_size = replace(dataset.parameters(), store=StoreParameters(voxel_chunk=128))
    build_store(by_size, out)
    before = open_store(out).reader("voxel/feats").shard_rows
    dataset.add("h", seed=1)
    build_store(by_size, out)
    assert open_store(out).reader("voxel/feats").shard_rows == 2 * before
    assert names(steps, "asset read") == ["h"]
    assert tree(out) == tree_from_nothing(by_size, "few shards")


def stiffer(dataset: Dataset) -> None:
    dataset.add("h", seed=2)
    dataset.write_grid("h", dataset.assets["h"].grid * [1, 10, 1, 1])


UPDATES = {
    "new and last": (lambda dataset: dataset.add("h", 1), {"h": "not in the store"}, "", 9),
    "other latents": (lambda data: data.change_slat("c"), {"c": "sources changed: slat"}, "", 4),
    "removed": (lambda dataset: dataset.remove("e"), {"e": "no longer in the dataset"}, "", 4),
    "other ranges": (stiffer, {"h": "not in the store"}, "aceg", 0),
}
"""By name: a change, what is said of it, the assets that are reused, the least shards that stay."""


@pytest.mark.parametrize("case", UPDATES)
def test_an_update_costs_what_changed_and_gives_the_bytes_of_a_first_build(built, steps, case):
    dataset, out = built
    change, why, reused, least = UPDATES[case]
    before = inodes(out)
    change(dataset)
    plan = plan_build(dataset.parameters(), out)
    assert {one.asset_id: one.reason for one in plan.assets if one.action != "reuse"} == why
    aligned = [one.asset_id for one in plan.assets if one.action == "align"]
    build_store(dataset.parameters(), out)
    assert names(steps, "asset aligned") == aligned
    assert sorted(names(steps, "asset reused")) == list(reused)
    assert sorted(names(steps, "asset read")) == sorted([*aligned, *reused])
    shards = {name for name in before if name.startswith("voxel/feats/c/")}
    assert least <= same_files(before, inodes(out), "voxel/feats/c/") < len(shards)
    assert tree(out) == tree_from_nothing(dataset.parameters())


def test_where_much_is_new_all_rows_are_ordered_by_id(built, monkeypatch):
    dataset, out = built
    monkeypatch.setattr(rows, "MOST_BEHIND", 0.2)
    dataset.add("b", seed=2)
    build_store(dataset.parameters(), out, jobs=2)
    assert tree(out) == tree_from_nothing(dataset.parameters())


def test_grids_that_move_are_not_unpacked(built, monkeypatch):
    dataset, out = built
    dataset.remove("a")
    dataset.add("h", seed=1)
    read, unpacked = RowReader.read, []

    def reading(self: RowReader, start: int, stop: int) -> object:
        unpacked.append(self.name)
        return read(self, start, stop)

    with monkeypatch.context() as context:
        context.setattr(RowReader, "read", reading)
        build_store(dataset.parameters(), out)
    assert "voxel/feats" in unpacked
    assert not [name for name in unpacked if name.startswith("grid/")]
    assert tree(out) == tree_from_nothing(dataset.parameters())


def test_another_name_costs_a_record(built, steps, tmp_path):
    dataset, out = built
    before, categories = inodes(out), tmp_path / "categories.json"
    categories.write_text(json.dumps({"c": {"obj_class": "tree"}}))
    named = dataset.parameters(pairing={"categories": categories})
    build_store(named, out)
    assert names(steps, "asset read") == []
    after = inodes(out)
    for group in ("voxel/feats/c/", "grid/material/c/"):
        assert same_files(before, after, group) == sum(name.startswith(group) for name in before)
    assert open_store(out).column("category").tolist() == ["", "tree", "", ""]
    assert tree(out) == tree_from_nothing(named)


def test_any_sequence_of_updates_comes_to_the_same_when_compacted(make_dataset, tmp_path):
    rng = random.Random(5)
    dataset, out = make_dataset("m", "n"), tmp_path / "s.zarr"
    there = ["m", "n"]
    build_store(dataset.parameters(), out)
    for _ in range(5):
        for _ in range(rng.randrange(1, 4)):
            what = rng.choice(["add", "add", "change", "remove"])
            name = rng.choice(there)
            if what == "add":
                name = rng.choice(sorted({*ascii_lowercase} - {*there}))
                there.append(name)
            if what == "remove" and len(there) > 1:
                there.remove(name)
                dataset.remove(name)
            else:
                dataset.add(name, seed=rng.randrange(8))
        build_store(dataset.parameters(), out)
        assert sorted(open_store(out).ids) == sorted(there)
    assert verify_store(out, sources=True).ok
    build_store(dataset.parameters(), out, compact=True)
    assert tree(out) == tree_from_nothing(dataset.parameters())


@pytest.mark.parametrize("step", ["shard filled", "store replaced"])
def test_an_update_that_fails_leaves_one_whole_store(built, monkeypatch, step):
    dataset, out = built
    before = tree(out)
    dataset.add("h", seed=1)

    class StopError(Exception):
        pass

    def fail(found: str, name: str) -> None:
        if found == step:
            raise StopError

    with monkeypatch.context() as context:
        inject(context, fail)
        with pytest.raises(StopError):
            build_store(dataset.parameters(), out)
    assert (tree(out) == before) is (step == "shard filled")
    of_records = str(out.with_name("s.manifests"))  # which may still be the old ones
    assert not [f for f in verify_store(out).findings if not f.file.startswith(of_records)]
    build_store(dataset.parameters(), out)
    assert verify_store(out, sources=True).ok
    assert tree(out) == tree_from_nothing(dataset.parameters())


def test_a_store_with_other_names_shares_no_file_with_the_next(built, tmp_path):
    """Whoever writes into a snapshot made of hard links must not change the store."""
    dataset, out = built
    shutil.copytree(out, tmp_path / "snapshot", copy_function=os.link)
    held = set(inodes(tmp_path / "snapshot").values())
    dataset.add("h", seed=1)
    build_store(dataset.parameters(), out)
    assert not held & set(inodes(out).values())
    assert tree(out) == tree_from_nothing(dataset.parameters())


def test_sources_that_are_as_they_were_are_not_read(built, steps):
    dataset, out = built
    build_store(dataset.parameters(), out)
    assert steps == []
    (dataset.root / "slat" / "c.npz").touch()
    build_store(dataset.parameters(), out)
    assert names(steps, "asset compared") == ["c"]
    build_store(dataset.parameters(), out)
    assert steps == []
    build_store(dataset.parameters(), out, rehash=True)
    assert names(steps, "asset compared") == list("aceg")
    steps.clear()
    plan_build(dataset.parameters(), out)
    assert steps == []
    plan_build(dataset.parameters(), out, rehash=True)
    assert names(steps, "asset compared") == list("aceg")


SEEN = {
    "gone": None,
    "flipped": lambda data: data[:200] + bytes([data[200] ^ 1]) + data[201:],
    "cut": lambda data: data[:-7],
    "empty": lambda data: b"",
    "link": lambda data: b"theirs",
    "machine": lambda data: data,
    "young": lambda data: data,
}


def test_what_was_seen_is_not_trusted_without_reason(built, steps, monkeypatch, tmp_path):
    dataset, out = built
    path, theirs, before = out.with_name("s.manifests") / "sources.seen", tmp_path / "o", tree(out)
    for how, change in SEEN.items():
        data = path.read_bytes()
        path.unlink()
        if change is not None:
            path.write_bytes(change(data))
        with monkeypatch.context() as context:
            if how == "link":
                path.rename(theirs)
                path.symlink_to(theirs)
            elif how == "machine":
                context.setattr("platform.node", lambda: "another")
            elif how == "young":
                context.setattr(states, "FINE_NS", 10**15)
                context.setattr(states, "COARSE_NS", 10**15)
                context.setattr("time.sleep", lambda seconds: None)
                build_store(dataset.parameters(), out, rehash=True)  # sees them as they are read
            build_store(dataset.parameters(), out)
        assert names(steps, "asset compared") == list("aceg"), how
        assert names(steps, "asset read") == []
        assert tree(out) == before
        if how == "link":
            assert theirs.read_bytes() == b"theirs"


def test_what_was_seen_of_one_store_is_nothing_to_another(built, tmp_path, steps):
    dataset, out = built
    shutil.copytree(out, tmp_path / "kept")
    dataset.change_slat("c")
    build_store(dataset.parameters(), out)
    shutil.rmtree(out)
    (tmp_path / "kept").rename(out)
    build_store(dataset.parameters(), out)
    assert names(steps, "asset compared") == list("aceg")
    assert names(steps, "asset aligned") == ["c"]


def test_a_file_that_changed_under_an_unchanged_dataset_is_found(built):
    dataset, out = built
    flip(out / "voxel/feats/c/0/0", 100)
    assert not verify_store(out).ok
    build_store(dataset.parameters(), out)
    assert verify_store(out).ok


def test_rows_that_other_code_packed_are_packed_anew_and_not_aligned(built, steps, monkeypatch):
    dataset, out = built
    dataset.add("h", seed=1)
    with monkeypatch.context() as context:
        context.setattr(recipe, "packing_fingerprint", lambda: "0" * 16)
        assert plan_build(dataset.parameters(), out).actions["reuse"] == 4
        build_store(dataset.parameters(), out)
        assert names(steps, "asset aligned") == ["h"]
        assert sorted(names(steps, "asset reused")) == ["a", "c", "e", "g"]
        assert tree(out) == tree_from_nothing(dataset.parameters(), "other packing code")
    build_store(dataset.parameters(), out)
    assert names(steps, "asset aligned") == []
    assert tree(out) == tree_from_nothing(dataset.parameters())


def test_files_of_a_store_that_nobody_needs_are_closed_at_once(built):
    source = SourceStore(open_store(built[1]))
    assert source.record("a") is not None
    there = weakref.ref(source)
    gc.disable()
    try:
        del source
        assert there() is None
    finally:
        gc.enable()


def test_a_worker_that_lives_on_reads_the_store_of_today(built):
    """A cluster's workers outlive builds, and rows in another order have the same build id."""
    dataset, out = built
    dataset.add("b", seed=5)
    build_store(dataset.parameters(), out)

    def in_the_worker() -> list[str]:
        worker = pickle.loads(pickle.dumps(SourceStore(open_store(out))))
        ids = worker.ids
        assert [worker.asset(one).asset_id for one in ids] == list(ids)
        return list(ids)

    assert in_the_worker() == ["a", "c", "e", "g", "b"]
    build_store(dataset.parameters(), out, compact=True)
    assert in_the_worker() == ["a", "b", "c", "e", "g"]
