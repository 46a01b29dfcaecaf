"""A second build does what is new and nothing else, and writes what a first one would."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from support.commands import document, run
from support.faults import inject
from support.first_builds import tree_from_nothing
from support.trees import inodes, tree

from slatprep import StoreError, open_store
from slatprep.parameters import AlignParameters, BuildParameters
from slatprep.pipeline import recipe
from slatprep.pipeline.dataset import build_store, plan_build


def reasons(parameters: BuildParameters, out: Path) -> dict[str, tuple[str, str]]:
    plan = plan_build(parameters, out)
    return {asset.asset_id: (str(asset.action), asset.reason) for asset in plan.assets}


def test_no_change_writes_nothing_and_one_that_keeps_size_and_times_is_seen(built, aligned):
    dataset, out = built
    build_store(dataset.parameters(), out)  # and knows the states of files
    before = inodes(out.parent)
    summary = build_store(dataset.parameters(), out)
    assert aligned == []
    assert inodes(out.parent) == before
    told = json.loads((summary.records.parent / "build.json").read_text())
    assert told["id"] == summary.build_id == open_store(out).attributes["manifest"]
    assert (told["statuses"], told["verdicts"]) == (summary.statuses, summary.verdicts)
    counts = {"voxels": summary.n_voxels, "valid": summary.n_valid, "clipped": summary.clipped}
    assert told["counts"] == counts | {"unphysical": summary.n_unphysical}

    path = dataset.root / "slat" / "a.npz"
    state = path.stat()
    dataset.change_slat("a")
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert path.stat().st_size == state.st_size
    assert reasons(dataset.parameters(), out)["a"] == ("align", "sources changed: slat")


def test_what_leaves_a_store_is_counted_and_so_is_that_nothing_changed(built):
    dataset, out = built
    words = ("build-store", *dataset.sides, "--out", out, "--decoys", "0")
    assert "changed" not in run(*words).stdout
    again = run(*words, "--verbose").stdout
    assert "changed: nothing\n" in again and "removed" not in again
    assert "assets:  3 (0 aligned, 3 taken over, 0 not built, 0 skipped) in" in again
    rows = [line.split()[:2] for line in again.splitlines() if line[:2] in ("a ", "b ", "c ")]
    assert rows == [[name, "good"] for name in "abc"]
    (dataset.root / "slat" / "a.npz").unlink()
    less = run(*words, code=1)
    assert "removed: 1 asset of the store that was there: a (cannot be" in less.stderr
    assert "changed" not in less.stdout
    other = out.with_name("other.zarr")
    assert "removed" not in run("subset", out, "--asset", "b", "--out", other).output
    said = run("subset", out, "--asset", "c", "--out", other)
    assert "assets:  1 copied in" in said.stdout and "removed: 1 asset" in said.stderr
    quiet = run("subset", out, "--asset", "b", "--out", other, "--quiet")
    assert (quiet.stdout, quiet.stderr[:16]) == ("", "removed: 1 asset")
    fresh = document("build-store", *dataset.sides, "--out", other, "--fresh", code=1)
    assert (fresh["removed"], fresh["unchanged"]) == (0, False)


def test_ranges_that_move_are_told_and_what_follows(built, tmp_path):
    dataset, out = built
    words = ("build-store", *dataset.sides, "--out", out, "--decoys", "0")
    assert "ranges" not in run(*words).stderr
    dataset.add("d", seed=3)
    dataset.write_grid("d", dataset.assets["d"].grid * [2, 1, 1, 1])
    old = open_store(out).normalization.ranges[1]
    (told,) = [one for one in document(*words)["warnings"] if "ranges" in one]
    new = open_store(out).normalization.ranges[1]
    assert told == (
        "the ranges are not those of the store that was there: hi of density (log10) from "
        f"{old.hi:.8g} to {new.hi:.8g}. All of voxel/properties are on the new scale: train anew, "
        "or give fixed ranges with --ranges"
    )
    ahead = run(*words, "--ranges", "pixie", "--dry-run")
    assert "those of the store that is there: lo of youngs_modulus (log10) from" in ahead.stderr
    assert "ranges are not those" in run(*words, "--fresh", "--ranges", "pixie").stderr
    assert "ranges are not those" not in run(*words, "--fresh", "--ranges", "pixie").stderr


def test_a_dry_run_counts_what_the_build_removes_and_both_say_why(built):
    dataset, out = built
    words = ("build-store", *dataset.sides, "--out", out, "--decoys", "0")
    (dataset.root / "slat" / "a.npz").unlink()
    for path in dataset.root.rglob("b*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    gone = "b (no longer in the dataset)"
    said = f"there: a (cannot be used now), {gone}\n"
    dataset.add("e", seed=5)
    counted = "assets:  3 (1 aligned, 1 taken over, 0 not built, 1 skipped)"
    ahead = document(*words, "--dry-run", code=1)
    assert (ahead["ok"], ahead["removed"]) == (False, 2)
    for verb, more in (("is", ["--dry-run"]), ("was", [])):
        printed = run(*words, *more, code=1)
        assert counted in printed.stdout
        assert f"removed: 2 assets of the store that {verb} {said}" in printed.stderr
    grid = next(dataset.root.glob("pixieverse/**/c*/**/*.npy"))
    grid.write_bytes(grid.read_bytes()[:-100])
    dataset.add("d", seed=3)
    broken = document(*words, code=1)
    assert broken["taken_out"] == {"c": "cannot be used now"}
    assert (broken["aligned"], broken["taken_over"]) == (1, 1)
    assert any("truncated" in one[1] for one in broken["problems"] if one[0] == "c")


def test_other_shards_need_no_alignment(built, aligned):
    dataset, out = built
    other = dataset.parameters(store={"voxel_chunk": 256})
    assert {action for action, _ in reasons(other, out).values()} == {"reuse"}
    assert build_store(other, out).damaged == ()
    assert aligned == []
    assert tree(out) == tree_from_nothing(other)


def test_parameters_and_code_that_touch_an_asset_redo_it(built, aligned, monkeypatch):
    dataset, out = built
    nearer = dataset.parameters(sample={"max_distance": 2.0})
    why = "parameters changed: sample.max_distance was 3.0, is 2.0"
    assert reasons(nearer, out) == dict.fromkeys("abc", ("align", why))
    before = open_store(out).attributes["manifest"]
    assert build_store(nearer, out).build_id != before
    assert len(aligned) == 3
    assert tree(out) == tree_from_nothing(nearer)
    rigid = replace(nearer, align=AlignParameters(model="rigid"))
    assert reasons(rigid, out)["a"][1] == "parameters changed: align.model was auto, is rigid"
    monkeypatch.setattr(recipe, "code_fingerprint", lambda: "0" * 64)
    assert reasons(nearer, out)["a"] == ("align", "code changed")


def test_one_file_of_all_slats_may_grow(make_dataset, aligned, tmp_path):
    dataset, out = make_dataset("a", "b", "c"), tmp_path / "s.zarr"

    def write(*ids: str) -> None:
        with h5py.File(tmp_path / "all.h5", "a") as file:
            for one in ids:
                file[f"{one}/coords"] = dataset.assets[one].coords
                file[f"{one}/feats"] = dataset.assets[one].feats

    write("a", "b")
    parameters = dataset.parameters(slat={"root": tmp_path / "all.h5"})
    build_store(parameters, out)
    write("c")
    again = ("reuse", "unchanged, but for sources")
    assert reasons(parameters, out) == {"a": again, "b": again, "c": ("align", "not in the store")}
    build_store(parameters, out)
    assert aligned == ["a", "b", "c"]
    assert tree(out) == tree_from_nothing(parameters)


def test_fresh_does_everything(built, aligned):
    dataset, out = built
    before = tree(out)
    build_store(dataset.parameters(), out, fresh=True)
    assert len(aligned) == 3
    assert tree(out) == before


def test_kept_work_is_used_and_holds_no_more_than_the_store(built, aligned, monkeypatch):
    dataset, out = built
    build_store(dataset.parameters("pixie"), out, keep_work=True)
    kept = out.with_name(".s.zarr.work") / "spool"
    assert len(list(kept.rglob("*.arrays"))) == 3

    read: list[str] = []
    inject(monkeypatch, lambda step, name: step == "asset read" and read.append(name))
    dataset.remove("c")
    assert reasons(dataset.parameters(), out)["a"] == ("resume", "finished by an earlier build")
    build_store(dataset.parameters(), out, keep_work=True)
    assert open_store(out).ids == ["a", "b"]
    assert len(list(kept.rglob("*.arrays"))) == 2
    assert aligned == read == []


def test_work_is_kept_of_a_store_that_is_as_it_was_left(built, aligned):
    dataset, out = built
    build_store(dataset.parameters(), out)
    before = tree(out)
    build_store(dataset.parameters(), out, keep_work=True)
    assert len(list((out.with_name(".s.zarr.work") / "spool").rglob("*.arrays"))) == 3
    assert aligned == []
    assert tree(out) == before


def test_a_dry_run_looks_where_the_build_does(built, tmp_path):
    dataset, out = built
    shutil.copytree(out, tmp_path / "s")
    with pytest.raises(StoreError, match="expected --manifests FOLDER"):
        plan_build(dataset.parameters(), tmp_path / "s")
    own = tmp_path / "records"
    assert plan_build(dataset.parameters(), tmp_path / "s", manifests=own).actions["reuse"] == 3
    words = ("build-store", *dataset.sides, "--out", tmp_path / "s", "--manifests", own)
    assert "3 taken over" in run(*words, "--dry-run").output
    assert not own.exists()


def test_a_dry_run_tells_of_other_files_in_the_way_as_the_build_does(built, tmp_path):
    dataset, _ = built
    words = ("build-store", *dataset.sides, "--out")
    (tmp_path / "t.manifests").mkdir()
    (tmp_path / "t.manifests" / "decoys.json").write_text("mine")
    (tmp_path / ".u.zarr.work").mkdir()
    (tmp_path / ".u.zarr.work" / "mine").touch()
    (tmp_path / ".v.zarr.work").symlink_to(tmp_path)
    for name, said in (("t", "not slatprep's"), ("u", "holds mine"), ("v", "is no folder")):
        out = tmp_path / f"{name}.zarr"
        dry, wet = (run(*words, out, *more, code=1).output for more in (["--dry-run"], []))
        assert said in dry and dry == wet
    assert "taken over" not in run(*words, tmp_path / "t.zarr", "--decoys", 0, "--dry-run").output
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"cannot be written to .*file"):
        plan_build(dataset.parameters(), tmp_path / "file" / "x.zarr")


def test_a_build_through_a_link_minds_no_store_beside_the_link(built, tmp_path):
    """Names of records are those beside the store, not those beside a link to it."""
    dataset, out = built
    (tmp_path / "links").mkdir()
    shutil.copytree(out, tmp_path / "links" / out.name)
    link = tmp_path / "links" / "current.zarr"
    link.symlink_to(out)
    assert build_store(dataset.parameters(), link).unchanged


def test_a_dry_run_writes_nothing(built):
    dataset, out = built
    before = tree(out.parent)
    words = ("build-store", *dataset.sides, "--out", out, "--dry-run")
    plan = document(*words)
    others = ("align", "resume", "refuse", "skip", "remove")
    assert plan["actions"] == {"reuse": 3, **dict.fromkeys(others, 0)}
    assert all(asset["reason"] == "unchanged" for asset in plan["assets"])
    assert "nothing is written" in run(*words).stdout
    assert tree(out.parent) == before
    dataset.add("d", seed=3)
    added = tree(out.parent)
    for place in (out, out.with_name("other.zarr")):
        plan_build(dataset.parameters(), place)
    assert tree(out.parent) == added
    assert not [path for path in out.parent.iterdir() if path.name.startswith(".")]
