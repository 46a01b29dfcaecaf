"""What an update writes: lines of records behind those that stand, and files of what changed."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from support.synthetic import Dataset
from support.trees import records_of, tree

from slatprep.inspect.verify import verify_store
from slatprep.pipeline import publish
from slatprep.pipeline.dataset import build_store
from slatprep.store import open_store
from slatprep.store.layout import ARRAYS

MakeDataset = Callable[..., Dataset]


pytestmark = pytest.mark.usefixtures("files_are_old", "few_are_new")


@pytest.fixture
def built(make_dataset: MakeDataset, tmp_path: Path) -> tuple[Dataset, Path]:
    """Three assets and one without a partner, and the file of their records."""
    dataset = make_dataset("a", "c", "e")
    dataset.add("lone", seed=4)
    (dataset.root / "slat" / "lone.npz").unlink()
    build_store(dataset.parameters(), tmp_path / "s.zarr")
    return dataset, tmp_path / "s.manifests" / "assets.jsonl"


def update(dataset: Dataset, lines: Path) -> list[str]:
    """Build, and return the ids of all lines, of which `verify` finds nothing wrong."""
    out = lines.parent.with_name("s.zarr")
    build_store(dataset.parameters(), out)
    assert verify_store(out).ok
    return list(records_of(lines))


def test_an_update_writes_what_is_new_and_the_last_shards(built: tuple[Dataset, Path]) -> None:
    dataset, lines = built
    out = lines.parent.with_name("s.zarr")
    before = {path: path.stat().st_ino for path in out.rglob("*") if path.is_file()}
    rows = open_store(out).offsets[-1]
    dataset.add("b", seed=1)
    update(dataset, lines)
    store = open_store(out)
    there = (path for path in out.rglob("*") if path.is_file())
    written = {path for path in there if before.get(path) != path.stat().st_ino}
    of_rows = set()
    for layout in ARRAYS:
        group = layout.name.partition("/")[0]
        if group == "asset":
            continue
        reader, first = store.reader(layout.name), rows if group == "voxel" else 3
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


def test_lines_that_stand_are_not_written_again(built: tuple[Dataset, Path]) -> None:
    dataset, lines = built
    before, inode = lines.read_bytes(), lines.stat().st_ino
    dataset.add("d", seed=2)
    dataset.add("b", seed=1)
    dataset.add("alone", seed=4)
    (dataset.root / "slat" / "alone.npz").unlink()
    assert update(dataset, lines) == ["a", "c", "e", "lone", "alone", "b", "d"]
    after = lines.read_bytes()
    assert after.startswith(before) and after.count(b"\n") == 7
    assert lines.stat().st_ino == inode
    dataset.add("f", seed=3)
    assert update(dataset, lines)[-1] == "f"
    assert lines.read_bytes().startswith(after)


@pytest.mark.parametrize("how", ["gone", "changed", "found", "renamed", "touched", "named twice"])
def test_lines_of_which_one_falls_are_written_anew(
    built: tuple[Dataset, Path], tmp_path: Path, how: str
) -> None:
    dataset, lines = built
    dataset.add("b", seed=1)
    if how == "gone":
        shutil.rmtree(dataset.root / "pixieverse" / "c")
        (dataset.root / "slat" / "c.npz").unlink()
    elif how == "changed":
        dataset.add("c", seed=3)
    elif how == "found":
        dataset.add("lone", seed=4)
    elif how == "renamed":
        shutil.rmtree(dataset.root / "pixieverse" / "lone")
        dataset.add("alone", seed=4)
        (dataset.root / "slat" / "alone.npz").unlink()
    elif how == "touched":
        os.utime(lines, ns=(1, 1))
    else:
        os.link(lines, tmp_path / "theirs")
    before, inode = lines.read_bytes(), lines.stat().st_ino
    ids = update(dataset, lines)
    assert ids == sorted(ids)
    assert "b" in ids
    assert lines.stat().st_ino != inode
    if how == "named twice":
        assert (tmp_path / "theirs").read_bytes() == before


def test_lines_that_a_kill_cut_are_found_and_mended(
    built: tuple[Dataset, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, lines = built

    class KilledError(Exception):
        pass

    def cut(source: Path, target: Path, size: int) -> None:
        with target.open("ab") as file:
            file.write(source.read_bytes()[:-500])
        raise KilledError

    dataset.add("b", seed=1)
    with monkeypatch.context() as context:
        context.setattr(publish, "append_file", cut)
        with pytest.raises(KilledError):
            update(dataset, lines)
    assert not verify_store(lines.parent.with_name("s.zarr")).ok
    dataset.add("d", seed=2)
    assert update(dataset, lines) == ["a", "b", "c", "d", "e", "lone"]


def test_a_full_disk_leaves_the_lines_as_they_were(
    built: tuple[Dataset, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, lines = built
    before = lines.read_bytes()
    dataset.add("b", seed=1)

    def full(source: object, target: object) -> None:
        target.write(b"{")  # type: ignore[attr-defined]
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as context:
        context.setattr("slatprep.storage.atomic.shutil.copyfileobj", full)
        with pytest.raises(Exception, match="No space left"):
            update(dataset, lines)
    assert lines.read_bytes() == before
    assert sorted(update(dataset, lines)) == ["a", "b", "c", "e", "lone"]


def test_the_store_and_its_id_do_not_depend_on_the_order_of_lines(
    built: tuple[Dataset, Path], tmp_path: Path
) -> None:
    dataset, lines = built
    dataset.add("b", seed=1)
    update(dataset, lines)
    out = lines.parent.with_name("s.zarr")
    build_id = open_store(out).attributes["manifest"]
    summary = build_store(dataset.parameters(), tmp_path / "anew" / "s.zarr")
    assert summary.build_id == build_id
    build_store(dataset.parameters(), out, compact=True)
    assert tree(out) == tree(tmp_path / "anew" / "s.zarr")
