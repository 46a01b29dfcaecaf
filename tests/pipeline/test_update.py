"""A second build does what is new and nothing else, and writes what a first one would."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.faults import inject
from support.first_builds import tree_from_nothing
from support.synthetic import Dataset, Made, make_asset
from support.trees import tree

from slatprep.parameters import AlignParameters, BuildParameters, SampleParameters
from slatprep.pipeline.dataset import build_store, plan_build
from slatprep.store import open_store


@pytest.fixture
def aligned(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Note the assets that are aligned."""
    seen: list[str] = []
    inject(monkeypatch, lambda step, name: step == "asset aligned" and seen.append(name))
    return seen


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("first")
    dataset = Dataset(folder / "sources").having(*"abc")
    build_store(dataset.parameters(), folder / "s.zarr")
    return dataset, folder / "s.zarr"


@pytest.fixture
def built(first: Made, tmp_path: Path) -> Made:
    """Three assets and the store of them, copied: a build knows no file of it by its state."""
    shutil.copytree(first[1].parent, tmp_path, dirs_exist_ok=True)
    return Dataset(tmp_path / "sources", dict(first[0].assets)), tmp_path / "s.zarr"


def reasons(parameters: BuildParameters, out: Path) -> dict[str, tuple[str, str]]:
    plan = plan_build(parameters, out)
    return {asset.asset_id: (str(asset.action), asset.reason) for asset in plan.assets}


def test_nothing_changed_writes_nothing(built, aligned):
    dataset, out = built
    build_store(dataset.parameters(), out)  # and knows the states of files
    inodes = {path: path.stat().st_ino for path in out.parent.rglob("*") if path.is_file()}
    summary = build_store(dataset.parameters(), out)
    assert aligned == []
    assert {p: p.stat().st_ino for p in out.parent.rglob("*") if p.is_file()} == inodes
    told = json.loads((summary.records.parent / "build.json").read_text())
    assert told["id"] == summary.build_id == open_store(out).attributes["manifest"]
    assert told["statuses"] == summary.statuses
    assert told["verdicts"] == summary.verdicts
    assert told["counts"] == {
        "voxels": summary.n_voxels,
        "valid": summary.n_valid,
        "clipped": summary.clipped,
        "unphysical": summary.n_unphysical,
    }


def test_new_changed_and_removed(built, aligned):
    dataset, out = built
    dataset.add("d", seed=3)
    made = make_asset(seed=6)
    dataset.write_slat("b.npz", made.coords, made.feats + 1)
    dataset.write_grid("b", made.grid)
    shutil.rmtree(dataset.root / "pixieverse" / "c")
    (dataset.root / "slat" / "c.npz").unlink()
    # Times say nothing: what is touched is not changed.
    for path in dataset.root.rglob("a*.npz"):
        path.touch()
    assert reasons(dataset.parameters(), out) == {
        "a": ("reuse", "unchanged"),
        "b": ("align", "sources changed: grid, slat"),
        "c": ("remove", "no longer among the sources"),
        "d": ("align", "not in the store"),
    }
    build_store(dataset.parameters(), out)
    assert len(aligned) == 2
    assert open_store(out).ids == ["a", "b", "d"]
    assert tree(out) == tree_from_nothing(dataset.parameters())


def test_a_change_that_keeps_size_and_times_is_seen(built):
    import os

    dataset, out = built
    build_store(dataset.parameters(), out)  # and knows the states of files
    path = dataset.root / "slat" / "a.npz"
    before = path.stat()
    made = make_asset(0)
    feats = made.feats.copy()
    feats[0, 0] += 1
    dataset.write_slat("a.npz", made.coords, feats)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
    assert reasons(dataset.parameters(), out)["a"] == ("align", "sources changed: slat")


def test_moved_ranges_renormalise_without_aligning(built, aligned):
    dataset, out = built
    pixie = dataset.parameters("pixie")
    assert {action for action, _ in reasons(pixie, out).values()} == {"reuse"}
    build_store(pixie, out)
    assert aligned == []
    assert tree(out) == tree_from_nothing(pixie)


def test_other_shards_need_no_alignment(built, aligned):
    dataset, out = built
    parameters = dataset.parameters()
    wider = replace(parameters, store=replace(parameters.store, voxel_chunk=256))
    build_store(wider, out)
    assert aligned == []
    assert tree(out) == tree_from_nothing(wider)


def test_parameters_that_touch_an_asset_redo_it(built, aligned):
    dataset, out = built
    nearer = replace(dataset.parameters(), sample=SampleParameters(max_distance=2.0))
    why = "parameters changed: sample.max_distance was 3.0, is 2.0"
    assert reasons(nearer, out) == dict.fromkeys("abc", ("align", why))
    build_store(nearer, out)
    assert len(aligned) == 3
    assert tree(out) == tree_from_nothing(nearer)
    rigid = replace(nearer, align=AlignParameters(model="rigid"))
    assert reasons(rigid, out)["a"][1] == "parameters changed: align.model was auto, is rigid"


def test_other_code_redoes_an_asset(built, monkeypatch):
    from slatprep.pipeline import recipe as reuse

    dataset, out = built
    monkeypatch.setattr(reuse, "code_fingerprint", lambda: "0" * 64)
    assert reasons(dataset.parameters(), out)["a"] == ("align", "code changed")


def test_a_category_is_no_part_of_the_work(built, aligned, tmp_path):
    dataset, out = built
    categories = tmp_path / "categories.json"
    categories.write_text(json.dumps({"a": {"obj_class": "tree"}}))
    parameters = dataset.parameters()
    named = replace(parameters, pairing=replace(parameters.pairing, categories=categories))
    build_store(named, out)
    assert aligned == []
    assert open_store(out).column("category").tolist() == ["tree", "", ""]


def test_one_file_of_all_slats_may_grow(make_dataset, aligned, tmp_path):
    dataset = make_dataset("a", "b")
    dataset.write_grid("c", make_asset(2).grid)
    file = tmp_path / "all.h5"

    def write(name: str, seed: int) -> None:
        made = make_asset(seed)
        with h5py.File(file, "a") as h5:
            h5[f"{name}/coords"], h5[f"{name}/feats"] = made.coords, made.feats

    write("a", 0)
    write("b", 1)
    parameters = dataset.parameters()
    parameters = replace(parameters, slat=replace(parameters.slat, root=file))
    build_store(parameters, tmp_path / "s.zarr")
    assert len(aligned) == 2
    write("c", 2)
    again = ("reuse", "unchanged, but for sources")
    new = ("align", "not in the store")
    assert reasons(parameters, tmp_path / "s.zarr") == {"a": again, "b": again, "c": new}
    build_store(parameters, tmp_path / "s.zarr")
    assert len(aligned) == 3
    assert tree(tmp_path / "s.zarr") == tree_from_nothing(parameters)


def test_an_asset_that_cannot_go_in_does_not_make_the_store_old(built, aligned):
    dataset, out = built
    dataset.write_grid("lone", make_asset(4).grid)
    assert reasons(dataset.parameters(), out)["lone"][0] == "refuse"
    assert build_store(dataset.parameters(), out).statuses["skipped"] == 1
    before = {path: path.stat().st_ino for path in out.rglob("*") if path.is_file()}
    summary = build_store(dataset.parameters(), out)
    assert summary.statuses == {"ok": 3, "failed": 0, "skipped": 1}
    assert "lone" in dict(summary.problems)
    assert {path: path.stat().st_ino for path in out.rglob("*") if path.is_file()} == before
    assert aligned == []


def test_missing_or_older_manifests_are_written_again(built):
    dataset, out = built
    manifests = out.with_name("s.manifests")
    before = (manifests / "assets.jsonl").read_text().splitlines()
    (manifests / "build.json").write_text('{"id": "of another build"}')
    (manifests / "assets.jsonl").unlink()
    summary = build_store(dataset.parameters(), out)
    after = (manifests / "assets.jsonl").read_text().splitlines()
    assert json.loads((manifests / "build.json").read_text())["id"] == summary.build_id
    for old, new in zip(map(json.loads, before), map(json.loads, after), strict=True):
        assert old == new


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
    shutil.rmtree(dataset.root / "pixieverse" / "c")
    (dataset.root / "slat" / "c.npz").unlink()
    assert reasons(dataset.parameters(), out)["a"] == ("resume", "finished by an earlier build")
    build_store(dataset.parameters(), out, keep_work=True)
    assert open_store(out).ids == ["a", "b"]
    assert len(list(kept.rglob("*.arrays"))) == 2
    assert aligned == read == []


def test_a_dry_run_writes_nothing(built):
    dataset, out = built
    before = tree(out.parent)
    dataset.add("d", seed=3)
    added = tree(out.parent)
    plan_build(dataset.parameters(), out)
    plan_build(dataset.parameters(), out.with_name("other.zarr"))
    assert tree(out.parent) == added
    assert before.items() <= added.items()
    assert np.all([not path.name.startswith(".") for path in out.parent.iterdir()])


def test_a_dry_run_at_the_shell(built):
    from click.testing import CliRunner

    from slatprep.cli.commands import slatprep

    dataset, out = built
    sources = ["--pixieverse", dataset.root / "pixieverse", "--slat", dataset.root / "slat"]
    command = [str(part) for part in ("build-store", *sources, "--out", out, "--dry-run")]
    told = CliRunner().invoke(slatprep, [*command, "--json"])
    assert told.exit_code == 0, told.output
    document = json.loads(told.stdout)
    assert document["actions"] == {"align": 0, "reuse": 3, "resume": 0, "refuse": 0, "remove": 0}
    assert all(asset["reason"] == "unchanged" for asset in document["assets"])
    shown = CliRunner().invoke(slatprep, command)
    assert "nothing is written" in shown.stdout
