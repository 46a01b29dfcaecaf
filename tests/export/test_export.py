"""Every export is read back by the library that its users use."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from support.commands import refused, run
from support.exports import bytes_of, hold_truth, index_of
from support.made_store import rewrite
from support.synthetic import JELLY, METAL, QUARTER_TURN
from support.trees import tree

from slatprep.errors import ConfigError, SlatprepError, StoreError
from slatprep.export import FORMATS, ExportOptions, export_store, target
from slatprep.export.target import directory
from slatprep.learn.predictions import open_predictions
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.readers import discover, read_latents
from slatprep.readers.hdf5 import find_groups
from slatprep.readers.splits import Shares, split_objects
from slatprep.records import PROPERTY_COLUMNS
from slatprep.storage import atomic
from slatprep.storage.files import file_name
from slatprep.store import Store, open_store

KINDS = ("hdf5", "npz")
"""A format of one file, and one of a folder."""


@pytest.mark.parametrize(("format", "points", "column"), [
    ("ply", "slat", "clipped"), ("ply", "grid", "clipped_grid"), ("hdf5", None, "clipped"),
])  # fmt: skip
def test_values_that_the_build_clipped_are_told(format, points, column, copy, tmp_path):
    for row, counts in enumerate([(4, 4, 4), (1000, 0, 2)]):
        rewrite(copy, f"asset/{column}", row, counts)
    ids, options = open_store(copy).ids, ExportOptions(points=points)
    notes = [
        export_store(copy, tmp_path / str(first), format, assets=ids[first:], options=options).notes
        for first in (1, 2)
    ]
    beyond = "values beyond the store's ranges are taken as the end of the range"
    assert notes == [(f"{beyond}: 1,000 of youngs_modulus, 2 of poissons_ratio",), ()]


def test_hdf5_is_read_by_h5py(store, mixed, tmp_path):
    out, stored = tmp_path / "all.h5", open_store(store)
    export_store(store, out, "hdf5")
    with h5py.File(out) as file:
        assert sorted(file) == sorted(mixed.assets)
        assert json.loads(file.attrs["normalization"])["density"]["log10"] is True
        for asset_id, asset in mixed.assets.items():
            group = file[asset_id]
            assert group.attrs["asset_id"] == asset_id and group.attrs["verdict"] == "good"
            np.testing.assert_array_equal(group["coords"][:], asset.coords)
            np.testing.assert_array_equal(group["feats"][:], asset.feats)
            np.testing.assert_allclose(group["transform"][:], QUARTER_TURN, atol=2e-3)
            own = stored.asset(asset_id)
            np.testing.assert_array_equal(group["confidence"][:], own.confidence)
            for name in ("confidence", "expected_accuracy"):
                assert group.attrs[name] == own.columns[name]
            assert group["valid"][:].all() and (group["distance"][:] < 0.01).all()
            assert list(group["properties_si"].attrs["units"]) == ["Pa", "kg/m^3", "1"]
            assert group["distance"].attrs["units"] == "voxel"
            hold_truth(group["material"][:], *group["properties_si"][:].T)
            assert (np.abs(group["properties"][:]) <= 1).all()


@pytest.mark.parametrize(("format", "name"), [("hdf5", "slat.h5"), ("npz", "root")])
def test_an_export_is_itself_a_source_of_latents(format, name, store, mixed, tmp_path):
    export_store(store, tmp_path / name, format, assets=["cup", "ant"])
    source = PixieverseSource(mixed.root / "pixieverse")
    found = discover(BuildParameters(source, SlatSource(tmp_path / name)))
    pairs = {pair.asset_id: pair for pair in found if not pair.problem}
    assert sorted(pairs) == ["ant", "cup"]
    np.testing.assert_array_equal(read_latents(pairs["cup"]).feats, mixed.assets["cup"].feats)


def test_groups_of_hdf5_have_the_ids_that_readers_expect(copy, tmp_path):
    names = ["-1", "_x", "__a.b", "x" * 255, "a.-"]
    rewrite(copy, "asset/id", slice(None), np.array(names, dtype=object))
    export_store(copy, tmp_path / "slat.h5", "hdf5")
    groups = find_groups(tmp_path / "slat.h5", tmp_path, "{id}", {})
    assert sorted(fields["id"] for fields, _ in groups) == sorted(names)
    with open_predictions(tmp_path / "slat.h5") as read:
        assert all(tuple(read(name)["columns"]) == PROPERTY_COLUMNS for name in names)


def samples_of(folder: Path) -> list[dict[str, Any]]:
    """Return what users of WebDataset get of its shards."""
    import webdataset

    shards = sorted(map(str, folder.glob("*.tar")))
    return list(webdataset.WebDataset(shards, shardshuffle=False).decode())


def test_shards_are_read_by_webdataset(store, mixed, tmp_path):
    out, stored = tmp_path / "shards", open_store(store)
    export_store(store, out, "webdataset", options=ExportOptions(shard_size=2))
    assert len(list(out.glob("*.tar"))) == 3
    samples = samples_of(out)
    assert [sample["json"]["asset_id"] for sample in samples] == sorted(mixed.assets)
    for sample in samples:
        asset = mixed.assets[sample["json"]["asset_id"]]
        arrays = sample["npz"]
        np.testing.assert_array_equal(arrays["coords"], asset.coords)
        np.testing.assert_array_equal(arrays["feats"], asset.feats)
        own = stored.asset(sample["json"]["asset_id"])
        np.testing.assert_array_equal(arrays["confidence"], own.confidence)
        assert sample["json"]["expected_accuracy"] == own.columns["expected_accuracy"]
        assert arrays["properties"].shape == (len(asset.coords), 3)
        assert set(np.unique(arrays["material"])) == {JELLY[0], METAL[0]}
        np.testing.assert_allclose(sample["json"]["transform"], QUARTER_TURN, atol=2e-3)


@pytest.mark.parametrize("format", FORMATS)
def test_bytes_repeat_whatever_the_jobs(format, store, tmp_path):
    options = ExportOptions(shard_size=2)
    progress: list[tuple[int, int]] = []
    for name, jobs in (("one", 1), ("two", 2)):
        how = {"options": options, "jobs": jobs, "progress": lambda *at: progress.append(at)}
        export_store(store, tmp_path / name / "export", format, **how)
        assert progress[-1] == (5, 5)
    one, two = bytes_of(tmp_path / "one" / "export"), bytes_of(tmp_path / "two" / "export")
    assert one == two and len(one) >= 1
    # And once more over what is there.
    export_store(store, tmp_path / "one" / "export", format, options=options)
    assert bytes_of(tmp_path / "one" / "export") == one
    assert [path.name for path in (tmp_path / "one").iterdir()] == ["export"]
    with pytest.raises(ConfigError, match="jobs is 0; expected an int from 1"):
        export_store(store, tmp_path / "one" / "export", format, jobs=0)


@pytest.mark.parametrize("format", KINDS)
def test_what_is_no_export_is_never_replaced(format, store, tmp_path):
    folder, file = tmp_path / "mine", tmp_path / "mine.txt"
    folder.mkdir()
    (folder / "thesis.txt").write_text("years of work")
    file.write_text("years of work")
    wanted = "file" if format == "hdf5" else "folder"
    for out, there in ((folder, "folder"), (file, "file")):
        other = f"is a {there}, but this format writes a {wanted}"
        said = "is not an export" if there == wanted else other
        with pytest.raises(ConfigError, match=f"exists and {said}"):
            export_store(store, out, format)
    assert (folder / "thesis.txt").read_text() == file.read_text() == "years of work"


@pytest.mark.parametrize("format", ["webdataset", "npz"])
def test_what_lies_beside_an_export_stays(format, store, tmp_path):
    out, fresh = tmp_path / "export", tmp_path / "fresh"
    export_store(store, out, format, assets=["cup", "dog"])
    shutil.copytree(store, out / "s.zarr")
    (out / "notes.txt").write_text("mine")
    (out / "empty").mkdir()
    (out / "link").symlink_to(tmp_path)
    index = json.loads((out / "index.json").read_text())
    index["assets"] += [{"asset_id": "x", "file": "../outside.txt"}, {"file": "\ud800"}]
    (out / "index.json").write_text(json.dumps(index))
    (tmp_path / "outside.txt").write_text("mine")
    before = tree(store)

    written = export_store(out / "s.zarr", out, format, assets=["dog"])
    assert tree(out / "s.zarr") == before
    assert (out / "notes.txt").read_text() == (tmp_path / "outside.txt").read_text() == "mine"
    assert (out / "link").is_symlink()
    export_store(out / "s.zarr", fresh, format, assets=["dog"])
    assert written.files == len(bytes_of(fresh))
    assert written.size == sum(map(len, bytes_of(fresh).values()))
    kept = {"s.zarr", "notes.txt", "empty", "link"}
    assert {path.name for path in out.iterdir()} - kept == {path.name for path in fresh.iterdir()}
    for name, content in bytes_of(fresh).items():
        assert (out / name).read_bytes() == content


def test_an_export_in_another_format_is_not_replaced(store, tmp_path):
    export_store(store, tmp_path / "out", "npz")
    before = bytes_of(tmp_path / "out")
    for words in ("export --format ply", "publish --data webdataset --pictures 0"):
        command, *options = words.split()
        said = refused(command, store, *options, "--out", tmp_path / "out")
        assert "has an export in another format, npz" in said
    assert bytes_of(tmp_path / "out") == before


def test_a_file_of_another_origin_is_not_replaced(store, tmp_path):
    out = tmp_path / "export"
    export_store(store, out, "npz", assets=["cup"])
    before = (out / "index.json").read_bytes()
    folder = (out / index_of(out)[0]["file"]).parent
    (folder / "dog.npz").write_text("mine")
    with pytest.raises(ConfigError, match=r"dog\.npz is of no export of slatprep"):
        export_store(store, out, "npz", assets=["dog"])
    assert (folder / "dog.npz").read_text() == "mine"
    assert (out / "index.json").read_bytes() == before
    (folder / "cup.npz").unlink()
    (folder / "cup.npz").mkdir()  # A folder where the old export had a file.
    with pytest.raises(ConfigError, match=r"cup\.npz is of no export of slatprep"):
        export_store(store, out, "npz", assets=["cup"])
    assert (out / "index.json").read_bytes() == before
    (folder / "cup.npz").rmdir()
    (folder / "cup.npz").touch()
    assert sorted(path.name for path in folder.iterdir()) == ["cup.npz", "dog.npz"]
    assert sorted(path.name for path in out.iterdir()) == ["index.json", "latents", "metadata.csv"]


def made(out: Path, *names: str) -> None:
    """Export files of these names, which also are their content."""
    with directory(out, "ply") as new:
        for name in names:
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            (new / name).write_text(name)
        about = {"format": target.FORMAT, "kind": "ply", "files": names}
        target.write_index(new, about, [])


def test_folders_of_an_export_come_and_go_beside_other_files(tmp_path):
    out = tmp_path / "out"
    made(out, "a/b/x", "a/c/y", "d")
    (out / "a" / "mine").touch()
    made(out, "e", "d/x")
    assert set(bytes_of(out)) == {"a/mine", "e", "d/x", "index.json"}
    assert {path.name for path in out.rglob("*") if path.is_dir()} == {"a", "d"}
    made(out, "a/b/x", "a/c/y")
    assert set(bytes_of(out)) == {"a/mine", "a/b/x", "a/c/y", "index.json"}
    (tmp_path / "elsewhere").mkdir()
    (out / "f").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match=r"out/f is of no export of slatprep"):
        made(out, "f/x")
    assert not any((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(5, "Input/output error")])
@pytest.mark.parametrize("moves", range(5))
def test_an_export_stopped_beside_other_files_keeps_the_old_ones_and_is_made_again(
    moves, error, tmp_path, monkeypatch
):
    out, move, left = tmp_path / "out", Path.replace, [moves]
    made(out, "a/x", "b", "c/y")
    (out / "mine").touch()

    def stopped(path: Path, to: Path) -> Path:
        if "export" in path.parts:
            left[0] -= 1
        if left[0] < 0:
            raise error
        return move(path, to)

    monkeypatch.setattr(Path, "replace", stopped)
    new = ("a/z", "b", "d/y", "e")
    with pytest.raises((KeyboardInterrupt, StoreError), match="files of the old export, the new"):
        made(out, *new)
    monkeypatch.undo()
    old = {"a/x", "c/y"} if moves < len(new) else set()
    assert set(bytes_of(out)) >= {"mine", "b", "index.json", *old, *new[:moves]}
    assert json.loads((out / "index.json").read_text())["assets"] == [], "none is whole yet"
    made(out, *new)
    assert bytes_of(out).keys() == {"mine", "index.json", *new}
    made(out, "g")
    assert bytes_of(out).keys() == {"mine", "index.json", "g"}


@pytest.mark.parametrize("format", ["hdf5", "npz"])
def test_a_stopped_export_says_whether_it_replaced_anything(format, store, tmp_path, monkeypatch):
    def stopped(**how: Any) -> str:
        with pytest.raises(KeyboardInterrupt) as raised:
            export_store(store, tmp_path / "out", format, assets=["cup"], **how)
        return str(raised.value)

    def flush_and_stop(path: Path, flush: Callable[[Path], None] = atomic.flush) -> None:
        flush(path)
        if path == tmp_path:  # It is flushed as soon as the new export is in place.
            raise KeyboardInterrupt

    assert stopped(progress=Mock(side_effect=KeyboardInterrupt)) == ""
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(atomic, "flush", flush_and_stop)
    assert stopped().endswith("is the new export, whole, or not there; run it again")
    assert (tmp_path / "out").exists()
    assert stopped().endswith("is the new export, whole, or the old one; run it again")


def test_a_stop_within_a_publication_names_no_folder_that_is_gone(store, tmp_path, monkeypatch):
    monkeypatch.setattr(atomic, "flush_tree", Mock(side_effect=KeyboardInterrupt))
    words = ("--data", "webdataset", "--pictures", 0, "--out", tmp_path / "out")
    assert "stopped; nothing was replaced" in refused("publish", store, *words, code=130)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("format", ["hdf5", "usd"])
def test_a_disk_that_is_full_ends_no_process(format, store, tmp_path):
    """A limit on the size of files refuses writes as a full disk does; HDF5 crashes of either."""
    code = (
        "import os, resource, signal, sys\n"
        "from slatprep.errors import SlatprepError\n"
        "from slatprep.export import export_store\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]\n"
        "for allowed in (1, 3000, 40_000, 100_000):\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (allowed, hard))\n"
        "    try: export_store(sys.argv[1], sys.argv[2] + '/e', sys.argv[3])\n"
        "    except SlatprepError as error: print(error, os.listdir(sys.argv[2]))\n"
    )
    command = [sys.executable, "-c", code, str(store), str(tmp_path), format]
    lines = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(lines) == 4
    for line in lines:
        assert f"cannot be written to {tmp_path} (File too large); nothing was replaced" in line
        assert line.endswith(" []")


def test_workers_that_are_ended_leave_no_warning_of_semaphores(store, tmp_path):
    command = [sys.executable, "-m", "slatprep", "export", store, "--format", "ply", "--jobs", "2"]
    limited = f"ulimit -f 40; {shlex.join(map(str, command))} --out {tmp_path}/e"
    done = subprocess.run(["bash", "-c", limited], capture_output=True, text=True)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "(File too large); nothing was replaced" in line


@pytest.mark.parametrize("format", KINDS)
def test_a_link_stays_and_a_failed_export_leaves_the_old_one(format, store, tmp_path, monkeypatch):
    there, link = tmp_path / "disk" / "export", tmp_path / "link"
    export_store(store, there, format, assets=["cup"])
    link.symlink_to(there)
    export_store(store, link, format, assets=["dog"])
    assert link.is_symlink() and not there.is_symlink()
    fresh = tmp_path / "fresh" / "export"
    export_store(store, fresh, format, assets=["dog"])
    before = bytes_of(fresh)
    assert bytes_of(there) == before
    with pytest.raises(ConfigError, match="lies inside the store"):
        export_store(store, store / "voxel" / "export", format)
    assert not (store / "voxel" / "export").exists()

    monkeypatch.setattr(Store, "asset", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(SlatprepError, match=r"cannot be written to .* \(No space left"):
        export_store(store, fresh, format)
    assert bytes_of(fresh) == before
    assert list(fresh.parent.iterdir()) == [fresh]


def test_assets_are_chosen_by_id_and_verdict(store, tmp_path):
    for arguments, chosen in (
        ({"assets": ["dog", "cup", "dog"], "verdicts": ["good"]}, ["cup", "dog"]),
        ({"assets": "bear.front"}, ["bear.front"]),  # A text is one asset, or one verdict.
        ({"verdicts": "good"}, open_store(store).ids),
        ({"verdicts": "all"}, open_store(store).ids),  # As on the command line.
        ({"assets": np.array([3, 0]), "verdicts": np.array(["good", "failed"])}, ["ant", "cup"]),
        ({"verdicts": (verdict for verdict in ["good"])}, open_store(store).ids),
    ):
        export_store(store, tmp_path / "some", "npz", **arguments)
        assert [entry["asset_id"] for entry in index_of(tmp_path / "some")] == chosen
    for arguments, said in (
        ({"assets": ["cuo"]}, r"did you mean cup\?"),
        ({"assets": "23"}, "no asset 23;"),
        ({"verdicts": ["failed"]}, r"no asset has the verdict failed; .* are 5 good"),
        ({"assets": ["cup"], "verdicts": ["failed"]}, "failed among those named; .* are 1 good"),
        ({"verdicts": ["fine"]}, r"'fine'; expected one of good, doubtful, failed, all"),
    ):
        with pytest.raises(ConfigError, match=said):
            export_store(store, tmp_path / "none", "npz", **arguments)


def test_splits_go_out_apart_and_together_they_are_all(store, tmp_path):
    def export(*options: object, code: int = 0) -> str:
        return run("export", store, "--format", "npz", *options, code=code).output

    expected = split_objects(["ant", "bear", "cup", "dog"], Shares(0.4, 0.3, 0.3))
    ids = []
    for split in ("train", "val", "test"):
        out = tmp_path / split
        told = export("--out", out, "--split", split, "--shares", "0.4,0.3,0.3")
        assert f"split:   {split}, by hash: " in told
        own = [entry["asset_id"] for entry in index_of(out)]
        assert {expected[one.partition(".")[0]] for one in own} == {split}
        ids += own
    assert sorted(ids) == ["ant", "bear.front", "bear.side", "cup", "dog"]
    listed = tmp_path / "test.txt"
    listed.write_text("bear.front\n")  # an object by one of its views
    export("--out", tmp_path / "f", "--split", "test", "--split-by", listed)
    assert [entry["asset_id"] for entry in index_of(tmp_path / "f")] == ["bear.front", "bear.side"]
    none = ("--out", tmp_path / "none")
    empty = export(*none, "--split", "test", "--shares", "1,0,0", code=2)
    assert "no asset is in the split test" in empty
    assert "both choose" in export(*none, "--split", "test", "--asset", "cup", code=2)
    assert "choose one with --split" in export(*none, "--split-by", "pixie", code=2)
    assert not (tmp_path / "none").exists()


@example({"..", "../../etc/passwd", "a b", "-rf", "~", "__key__", "a/b", ".", "a.b", "a%2Eb"}, True)
@example({"x" * 300, "häß", "a.b", "a%2Eb"}, False)
@given(
    ids=st.sets(st.text(st.characters(codec="utf-8"), min_size=1, max_size=300), max_size=8),
    dots=st.booleans(),
)
def test_any_ids_become_distinct_plain_names(ids, dots):
    names = {file_name(asset_id, dots=dots) for asset_id in ids}
    assert len(names) == len(ids)
    for name in names:
        assert re.fullmatch(r"[A-Za-z0-9%][A-Za-z0-9%._~-]*", name) and len(name) < 250
        assert dots or "." not in name


@pytest.mark.parametrize("format", FORMATS)
def test_hostile_ids_stay_inside_every_export(format, copy, tmp_path):
    names = np.array(["x" * 300, "../../up", ".", "a/b.c", "__meta__"], dtype=object)
    rewrite(copy, "asset/id", slice(None), names)
    out = tmp_path / "deep" / "export"
    export_store(copy, out, format)
    there = {path.name for path in tmp_path.iterdir()}
    assert there == {"deep", copy.name, f"{copy.stem}.manifests"}
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["export"]
    if format == "hdf5":
        with h5py.File(out) as file:
            assert {group.attrs["asset_id"] for group in file.values()} == set(names)
    else:
        assert {entry["asset_id"] for entry in index_of(out)} == set(names)
    if format == "webdataset":
        with tarfile.open(next(out.glob("*.tar"))) as tar:
            assert all("/" not in name for name in tar.getnames())
        assert {sample["json"]["asset_id"] for sample in samples_of(out)} == set(names)


def test_an_export_removes_what_a_killed_one_left_and_nothing_else(tmp_path):
    out, work = tmp_path / "o.npz", tmp_path / ".o.npz.work"
    killed = (
        "import os, pathlib\nfrom slatprep.export.target import directory\n"
        f"with directory(pathlib.Path({str(out)!r}), 'ply') as new:\n"
        "    (new / 'half').write_text('done')\n    os.kill(os.getpid(), 9)\n"
    )
    for _ in range(2):
        assert subprocess.run([sys.executable, "-c", killed]).returncode == -9
    assert len(list(work.glob("*/export/half"))) == 1  # The second removed the first one's.
    finished, other = work / "spool" / "ab" / "abc.arrays", tmp_path / ".p.npz.work" / "mine"
    finished.parent.mkdir(parents=True)
    finished.write_bytes(b"an interrupted build's")
    other.mkdir(parents=True)
    told = rf"o\.npz: another export is writing it \(process {os.getpid()} on"
    with directory(out, "ply") as new:
        (new / "a").write_text("a")
        with pytest.raises(StoreError, match=told), directory(out, "ply"):
            pass
        assert new.is_dir()
    assert [path.name for path in out.iterdir()] == ["a"]
    assert finished.is_file() and not list(work.glob("*/export"))
    finished.unlink()
    shutil.rmtree(out)
    with directory(out, "ply") as new:
        (new / "b").write_text("b")
    assert {path.name for path in tmp_path.iterdir()} == {"o.npz", ".p.npz.work"}
    assert other.is_dir()


def test_an_export_looks_what_it_replaces_once_it_has_the_lock(tmp_path, monkeypatch):
    out, locked = tmp_path / "o", target.scratch_beside

    def export(name: str) -> None:
        with directory(out, "ply") as new:
            (new / name).touch()
            target.write_index(new, {"format": target.FORMAT, "kind": "ply"}, [{"file": name}])

    @contextmanager
    def late(place: Path, who: str) -> Iterator[Path]:
        monkeypatch.undo()
        export("a")  # Another one that ends just before.
        with locked(place, who) as scratch:
            yield scratch

    monkeypatch.setattr(target, "scratch_beside", late)
    export("b")
    assert sorted(path.name for path in out.iterdir()) == ["b", "index.json"]


@pytest.mark.parametrize(("given", "said"), [
    ({"points": "grids"}, "points is 'grids'; expected one of slat, grid"),
    ({"frame": "world"}, "frame is 'world'; expected one of slat, pixieverse"),
    ({"shard_size": 0}, "shard_size is 0; expected a whole number from 1"),
    ({"shard_size": -1}, "shard_size is -1; expected a whole number from 1"),
    ({"shard_size": 2.5}, "shard_size is 2.5; expected a whole number from 1"),
])  # fmt: skip
def test_options_that_make_no_sense_are_refused(given, said):
    with pytest.raises(ConfigError, match=said):
        ExportOptions(**given)


def test_options_of_another_kind_are_refused(store, tmp_path):
    with pytest.raises(ConfigError, match=r"\{'points': 'grid'\}; expected .*ExportOptions"):
        export_store(store, tmp_path / "x", "ply", options={"points": "grid"})


@pytest.mark.parametrize("none", [(), np.array([], int), iter([])])
def test_a_choice_of_no_asset_is_not_all(store, tmp_path, none):
    with pytest.raises(ConfigError, match="assets is empty; expected one at least, or None"):
        export_store(store, tmp_path / "x", "npz", assets=none)


def test_verdicts_may_come_from_a_generator(store, tmp_path):
    with pytest.raises(ConfigError, match="no asset has the verdict failed"):
        export_store(store, tmp_path / "x", "npz", verdicts=(one for one in ["failed"]))


def test_an_export_to_a_url_is_refused(store, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="s3://bucket/x: expected a path of the local disk"):
        export_store(store, "s3://bucket/x", "npz")
    assert export_store(store, f"file://{tmp_path}/x", "npz").path == tmp_path / "x"
    assert [path.name for path in tmp_path.iterdir()] == ["x"]
