"""What an update writes: files of what changed, and the lines of their records."""

import os
from pathlib import Path

import pytest
from support.synthetic import Dataset, Made, MakeDataset, make_asset
from support.trees import inodes, records_of

from slatprep.inspect.verify import verify_store
from slatprep.pipeline import rows
from slatprep.pipeline.dataset import build_store, plan_build
from slatprep.store import layout, open_store, records
from slatprep.store.layout import ARRAYS

pytestmark = pytest.mark.usefixtures("files_are_old", "few_are_new")


@pytest.fixture
def built(make_dataset: MakeDataset, tmp_path: Path) -> Made:
    """Three assets and one without a partner, and the file of their records."""
    dataset = make_dataset("a", "c", "e")
    dataset.write_grid("lone", make_asset(4).grid)
    build_store(dataset.parameters(), tmp_path / "s.zarr")
    return dataset, tmp_path / "s.manifests" / "assets.jsonl"


def update(dataset: Dataset, lines: Path) -> list[str]:
    """Build, and return the ids of all lines, of which `verify` finds nothing wrong."""
    out = lines.parent.with_name("s.zarr")
    build_store(dataset.parameters(), out)
    assert verify_store(out).ok
    return list(records_of(lines))


def test_an_update_writes_what_is_new_and_the_last_shards(built):
    dataset, lines = built
    out = lines.parent.with_name("s.zarr")
    before = inodes(out)
    rows = open_store(out).offsets[-1]
    dataset.add("b", seed=1)
    update(dataset, lines)
    store = open_store(out)
    written = {out / name for name, number in inodes(out).items() if before.get(name) != number}
    of_rows = set()
    for array in ARRAYS:
        group = array.name.partition("/")[0]
        if group == "asset":
            continue
        reader, first = store.reader(array.name), rows if group == "voxel" else 3
        shards = range(first // reader.shard_rows, -(-reader.shape[0] // reader.shard_rows))
        of_rows |= {out / reader.key(shard) for shard in shards}
    assert of_rows <= written
    # What else is written are metadata, coordinates, digests and what is kept of assets.
    rest = [path.relative_to(out).as_posix() for path in written - of_rows]
    long = [f"{one.name}/c/" for one in ARRAYS if one.name.startswith(("voxel/", "grid/"))]
    assert not [name for name in rest if name.startswith(tuple(long))]
    new = sum(path.stat().st_size for path in of_rows)
    assert new < 0.5 * sum(path.stat().st_size for path in out.rglob("c/**/*") if path.is_file())
    assert sum((out / name).stat().st_size for name in rest) < 150_000


@pytest.fixture
def two_a_shard(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut records into shards of two rows."""
    for module in (layout, records, rows):
        monkeypatch.setattr(module, "RECORDS_IN_SHARD", 2)
    for module in (layout, records):
        monkeypatch.setattr(module, "RECORDS_IN_CHUNK", 2)


@pytest.mark.usefixtures("two_a_shard")
def test_lines_are_those_of_shards_and_stay_where_their_shard_does(make_dataset, tmp_path):
    dataset, out = make_dataset("a", "c"), tmp_path / "s.zarr"
    folder = tmp_path / "s.manifests"
    assert build_store(dataset.parameters(), out).records == folder / "assets.jsonl"

    def lines() -> dict[str, list[str]]:
        return {file.name: list(records_of(file)) for file in sorted(folder.glob("*.jsonl"))}

    for name, seed in (("e", 2), ("g", 3), ("b", 4)):
        dataset.add(name, seed)
    summary = build_store(dataset.parameters(), out)
    assert summary.records == folder / "assets-*.jsonl"
    assert lines() == {
        "assets-00000.jsonl": ["a", "b"],
        "assets-00001.jsonl": ["c", "e"],
        "assets-00002.jsonl": ["g"],
    }
    assert verify_store(out).ok
    before = {file.name: file.stat().st_ino for file in folder.glob("*.jsonl")}
    dataset.add("e", seed=7)
    dataset.add("d", seed=8)
    build_store(dataset.parameters(), out)
    assert lines()["assets-00002.jsonl"] == ["g", "d"]
    same = [name for name, ino in before.items() if (folder / name).stat().st_ino == ino]
    assert same == ["assets-00000.jsonl"]
    dataset.remove(*"cdefg")
    build_store(dataset.parameters(), out)
    assert lines() == {"assets.jsonl": ["a", "b"]}
    assert verify_store(out).ok


@pytest.mark.parametrize("how", ["cut", "longer", "another line", "gone", "named twice"])
def test_lines_that_are_not_those_of_the_store_are_found_and_mended(built, tmp_path, how):
    dataset, lines = built
    sound = lines.read_bytes()
    if how == "gone":
        lines.unlink()
    elif how == "named twice":
        os.link(lines, tmp_path / "theirs")
    else:
        changed = {
            "cut": sound[:-500],
            "longer": sound + b"{}\n",
            "another line": sound.replace(b'"voxel_count"', b"").replace(b"0.9", b"0.8", 1),
        }
        lines.write_bytes(changed[how])
    assert verify_store(lines.parent.with_name("s.zarr")).ok == (how == "named twice")
    dataset.add("b", seed=1)
    assert update(dataset, lines) == ["a", "c", "e", "b", "lone"]
    if how == "named twice":
        assert (tmp_path / "theirs").read_bytes() == sound
    else:
        assert lines.read_bytes().startswith(sound)


def test_an_asset_that_cannot_go_in_costs_build_json_alone(built, aligned):
    dataset, lines = built
    out = lines.parent.with_name("s.zarr")
    before, inode = inodes(out), lines.stat().st_ino
    dataset.write_grid("alone", make_asset(4).grid)
    refused = {one.asset_id: one.action for one in plan_build(dataset.parameters(), out).assets}
    assert refused["alone"] == "refuse"
    assert update(dataset, lines) == ["a", "c", "e", "alone", "lone"]
    again = build_store(dataset.parameters(), out)
    assert again.statuses == {"ok": 3, "failed": 0, "skipped": 2}
    assert "alone" in dict(again.problems) and aligned == []
    assert inodes(out) == before and lines.stat().st_ino == inode
    dataset.remove("alone", "lone")
    assert update(dataset, lines) == ["a", "c", "e"]
