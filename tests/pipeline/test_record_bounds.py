"""What a source can say is never more than the readers of a store take back."""

import os

import numpy as np
from support.trees import tree

from slatprep.inspect.verify import verify_store
from slatprep.pipeline.dataset import build_store
from slatprep.store import open_store
from slatprep.store.record import MAX_WARNINGS
from slatprep.store.records import StoredRecords


def test_more_annotations_than_a_record_holds_cost_their_asset_alone(make_dataset, tmp_path):
    dataset = make_dataset("a", "b")
    folder = dataset.root / "pixieverse" / "a"
    for sample in range(1, 256):
        (folder / f"sample_{sample}").mkdir()
        grid = f"sample_{sample}/material_grid.npy"
        os.link(folder / "sample_0/material_grid.npy", folder / grid)
    parameters = dataset.parameters("pixie", pixieverse={"samples": "merge"})
    summary = build_store(parameters, tmp_path / "s.zarr")
    assert (summary.statuses["ok"], summary.statuses["failed"]) == (1, 1)
    assert "256 annotations in 257 files" in dict(summary.problems)["a"]
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
