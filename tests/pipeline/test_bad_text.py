"""What a source can say, UTF-8 or not, costs its own asset at most, and no traceback."""

import json
import os
import shutil

import numpy as np
import pytest
from support.commands import run
from support.trees import records_of, tree

from slatprep import ConfigError, StoreError, build_store, load_parameters, open_store
from slatprep.inspect.verify import verify_store
from slatprep.store.record import MAX_WARNINGS
from slatprep.store.records import StoredRecords

BAD = os.fsdecode(b"b\xff")


def test_names_that_are_not_utf_8_cost_their_assets_alone(make_dataset, tmp_path):
    dataset = make_dataset("a", "c", "d")
    shutil.copy(dataset.root / "slat/a.npz", dataset.root / "slat" / f"{BAD}.npz")
    grids = dataset.root / "pixieverse"
    (grids / "c").rename(grids / os.fsdecode(b"c\xff"))
    (grids / "d/sample_0").rename(grids / "d" / os.fsdecode(b"sample_d\xff"))
    summary = build_store(dataset.parameters(), tmp_path / "s.zarr", jobs=2)
    assert "a" in open_store(summary.store).ids
    told = " ".join(reason for _, reason in summary.problems)
    assert all(f"{name}\\udcff" in told for name in ("b", "c", "sample_d"))
    json.dumps(summary.problems).encode()
    assert len(records_of(summary.records)) == sum(summary.statuses.values())
    assert build_store(dataset.parameters(), tmp_path / "s.zarr").build_id == summary.build_id


# Half a pair of surrogates, and what lies beyond Unicode.
NO_TEXT = {"half": np.array(["\ud800"]), "beyond": np.array([2**31 - 1], np.uint32).view("<U1")}


def test_what_is_no_text_is_written_out_or_left_out(make_dataset, tmp_path):
    dataset, categories = make_dataset(*NO_TEXT), tmp_path / "categories.json"
    categories.write_text('{"half": {"obj_class": "x\\ud800y"}}')
    bounds = {"min_bounds": np.full(3, -0.5, np.longdouble), "max_bounds": np.full(3, 0.5, ">f8")}
    for name, model in NO_TEXT.items():
        np.savez(dataset.root / f"pixieverse/{name}/clip_features.npz", model=model, **bounds)
    parameters = dataset.parameters(pairing={"categories": categories})
    summary = build_store(parameters, tmp_path / "s.zarr")
    store = open_store(summary.store)
    assert store.ids == ["beyond", "half"]
    assert store.column("category").tolist() == ["", "x\\ud800y"]
    for record in records_of(summary.records).values():
        assert record["bounds"] == {"min_bounds": [-0.5] * 3, "max_bounds": [0.5] * 3}
        assert "[model] is no text; left out" in record["warnings"][0]


def test_a_store_cannot_have_a_name_that_is_not_utf_8(make_dataset, tmp_path):
    dataset = make_dataset("a")
    with pytest.raises(StoreError, match=r"b\\udcff: .*UTF-8"):
        build_store(dataset.parameters(), tmp_path / BAD)
    assert not (tmp_path / BAD).exists()
    assert "UTF-8" in run("build-store", *dataset.sides, "--out", tmp_path / BAD, code=2).output
    assert not [path for path in tmp_path.iterdir() if path != dataset.root]


def test_a_root_that_is_not_utf_8_is_named(tmp_path):
    folder = tmp_path / BAD
    (folder / "slat").mkdir(parents=True)
    config = folder / "d.toml"
    config.write_text('[pixieverse]\nroot = "slat"\n[slat]\nroot = "slat"\n')
    with pytest.raises(ConfigError, match=r"pixieverse\.root: .*b\\udcff/slat.*UTF-8"):
        load_parameters(config)


def test_bad_names_of_annotations_are_left_out_and_too_many_refused(make_dataset, tmp_path):
    dataset = make_dataset("a", "b", "c")
    grids = dataset.root / "pixieverse"
    for name in ("a", "b"):
        for sample in [BAD] if name == "b" else range(1, 256):
            (grids / name / f"sample_{sample}").mkdir()
            grid = f"sample_{sample}/material_grid.npy"
            os.link(grids / name / "sample_0/material_grid.npy", grids / name / grid)
    parameters = dataset.parameters("pixie", pixieverse={"samples": "merge"})
    summary = build_store(parameters, tmp_path / "s.zarr")
    assert summary.statuses == {"ok": 2, "failed": 1, "skipped": 0}
    assert "256 annotations in 257 files" in dict(summary.problems)["a"]
    used, left_out = StoredRecords(open_store(summary.store)).of("b").merged
    assert (used.sample, used.left_out, left_out.sample) == ("0", "", "b\\udcff")
    assert "is no UTF-8" in left_out.left_out
    assert verify_store(tmp_path / "s.zarr").ok


def test_more_warnings_than_a_record_holds_are_counted(make_dataset, tmp_path):
    dataset = make_dataset("a")
    grid = dataset.assets["a"].grid
    grid[tuple(np.argwhere(grid[..., 3] != 7)[0])] = (np.nan, np.nan, np.nan, -1)
    dataset.write_grid("a", grid)
    nowhere = {f"bounds_{k}": np.full(3, np.nan) for k in range(256)}
    np.savez(dataset.root / "pixieverse/a/clip_features.npz", **nowhere)
    out = tmp_path / "s.zarr"
    build_store(dataset.parameters("pixie"), out)
    warnings = StoredRecords(open_store(out)).of("a").warnings
    assert len(warnings) == MAX_WARNINGS and warnings[-1].endswith("more warnings")
    assert verify_store(out).ok
    before = tree(out)
    build_store(dataset.parameters("pixie"), out)
    assert tree(out) == before


def test_a_record_that_nobody_could_read_costs_its_asset_alone(make_dataset, tmp_path, monkeypatch):
    """Texts of the bounds are taken into the record as they are."""
    dataset = make_dataset("a", "b")
    beside = dataset.root / "pixieverse/a/clip_features.npz"
    np.savez(beside, **{f"names_{k}": np.array(["x" * 60] * 60) for k in range(40)})
    monkeypatch.setattr("slatprep.store.record_json.MAX_RECORD_BYTES", 2 * 100_000)
    out = tmp_path / "s.zarr"
    summary = build_store(dataset.parameters("pixie"), out)
    assert (summary.statuses["ok"], summary.statuses["failed"]) == (1, 1)
    assert "more than a record may hold (1" in dict(summary.problems)["a"]
    assert verify_store(out).ok
