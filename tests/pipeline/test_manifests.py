"""The lines of records beside a store, which an update writes where they changed."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support.synthetic import Dataset, Made, make_asset
from support.trees import inodes, records_of

from slatprep.inspect.verify import verify_store
from slatprep.pipeline import rows
from slatprep.pipeline.dataset import build_store, plan_build
from slatprep.store import layout, open_store, records
from slatprep.store.records import build_in

pytestmark = pytest.mark.usefixtures("files_are_old", "few_are_new")


@pytest.fixture(scope="module")
def ace(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Three assets, one without a partner and the store of them; nobody may change them."""
    dataset = Dataset(tmp_path_factory.mktemp("ace") / "sources").having(*"ace")
    dataset.write_grid("lone", make_asset(4).grid)
    build_store(dataset.parameters(), dataset.root.with_name("s.zarr"))
    return dataset


@pytest.fixture
def built(ace: Dataset, tmp_path: Path) -> Made:
    """Return a copy of them, and the file of their records."""
    shutil.copytree(ace.root.parent, tmp_path, dirs_exist_ok=True)
    dataset = Dataset(tmp_path / "sources", dict(ace.assets))
    return dataset, tmp_path / "s.manifests" / "assets.jsonl"


def update(dataset: Dataset, lines: Path) -> list[str]:
    """Build, and return the ids of all lines, of which `verify` finds nothing wrong."""
    out = lines.parent.with_name("s.zarr")
    build_store(dataset.parameters(), out)
    assert verify_store(out).ok
    return list(records_of(lines))


def test_lines_stay_where_their_shard_does(make_dataset, tmp_path, monkeypatch):
    for module in (layout, records, rows):
        monkeypatch.setattr(module, "RECORDS_IN_SHARD", 2)
    for module in (layout, records):
        monkeypatch.setattr(module, "RECORDS_IN_CHUNK", 2)
    dataset, out, folder = make_dataset("a", "c"), tmp_path / "s.zarr", tmp_path / "s.manifests"
    assert build_store(dataset.parameters(), out).records == folder / "assets.jsonl"

    def lines() -> dict[str, list[str]]:
        return {file.name: list(records_of(file)) for file in sorted(folder.glob("*.jsonl"))}

    for name, seed in (("e", 2), ("g", 3), ("b", 4)):
        dataset.add(name, seed)
    assert build_store(dataset.parameters(), out).records == folder / "assets-*.jsonl"
    assert lines() == {
        "assets-00000.jsonl": ["a", "b"],
        "assets-00001.jsonl": ["c", "e"],
        "assets-00002.jsonl": ["g"],
    }
    assert verify_store(out).ok
    before = {file.name: file.stat().st_ino for file in folder.glob("*.jsonl")}
    dataset.having("e", "d", seed=7)
    build_store(dataset.parameters(), out)
    assert lines()["assets-00002.jsonl"] == ["g", "d"]
    same = [name for name, ino in before.items() if (folder / name).stat().st_ino == ino]
    assert same == ["assets-00000.jsonl"]
    dataset.remove(*"cdefg")
    build_store(dataset.parameters(), out)
    assert lines() == {"assets.jsonl": ["a", "b"]}
    assert verify_store(out).ok


def digit(after: bytes) -> Callable[[bytes], bytes]:
    """Return what changes the first digit after a text."""

    def changed(text: bytes) -> bytes:
        at = text.index(after) + len(after)
        return b"%s%d%s" % (text[:at], (int(text[at : at + 1]) + 1) % 9 + 1, text[at + 1 :])

    return changed


@pytest.mark.parametrize(("file", "change"), [
    ("build.json", lambda text: b"[" * 100_000),
    ("build.json", lambda text: b"[1]"),
    ("build.json", lambda text: b'{"counts": [1]}'),
    ("build.json", lambda text: b'{"id": "of another build"}'),
    ("build.json", digit(b'"voxels": ')),
    ("assets.jsonl", lambda text: text[:-500]),
    ("assets.jsonl", lambda text: text + b"{}\n"),
    ("assets.jsonl", digit(b'"slat_voxels":')),
    ("assets.jsonl", None),
])  # fmt: skip
def test_records_that_are_not_those_of_the_store_are_found_and_written_again(built, file, change):
    dataset, lines = built
    out, path = lines.parent.with_name("s.zarr"), lines.with_name(file)
    sound = lines.read_bytes()
    for new in ((), ("b",)):
        before = path.read_bytes()
        path.unlink() if change is None else path.write_bytes(change(before))
        assert not verify_store(out).ok
        dataset.having(*new, seed=1)
        assert update(dataset, lines) == ["a", "c", "e", *new, "lone"]
        assert lines.read_bytes().startswith(sound)
        if not new:
            assert path.read_bytes() == before or file == "build.json"
            assert build_in(lines.parent).id == open_store(out).attributes["manifest"]


def test_lines_that_have_another_name_are_not_written_through_it(built, tmp_path):
    dataset, lines = built
    sound = lines.read_bytes()
    os.link(lines, tmp_path / "theirs")
    dataset.add("b", seed=1)
    assert update(dataset, lines) == ["a", "c", "e", "b", "lone"]
    assert (tmp_path / "theirs").read_bytes() == sound


def test_an_asset_that_cannot_go_in_costs_build_json_alone(built, aligned):
    dataset, lines = built
    out = lines.parent.with_name("s.zarr")
    before, inode = inodes(out), lines.stat().st_ino
    dataset.write_grid("alone", make_asset(4).grid)
    refused = {one.asset_id: one.action for one in plan_build(dataset.parameters(), out).assets}
    assert refused["alone"] == "skip"
    assert update(dataset, lines) == ["a", "c", "e", "alone", "lone"]
    again = build_store(dataset.parameters(), out)
    assert again.statuses == {"ok": 3, "failed": 0, "skipped": 2}
    assert "alone" in dict(again.problems) and aligned == []
    assert inodes(out) == before and lines.stat().st_ino == inode
    dataset.remove("alone", "lone")
    assert update(dataset, lines) == ["a", "c", "e"]
