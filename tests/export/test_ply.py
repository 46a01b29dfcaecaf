"""PLY exports are read back by what simulates and draws, points and frames included."""

import json

import numpy as np
import plyfile
import pytest
from support.exports import hold_truth, index_of
from support.made_store import rewrite
from support.synthetic import QUARTER_TURN, MakeDataset

from slatprep.errors import StoreError
from slatprep.export import ExportOptions, export_store
from slatprep.export.ply import VERTEX
from slatprep.pipeline.dataset import build_store
from slatprep.store import open_store

# As `map_pred_to_coords.py` of Pixie declares the rows of its files.
PIXIE_VERTEX = [
    ("x", "f4"), ("y", "f4"), ("z", "f4"),
    ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1"),
    ("part_label", "i4"), ("density", "f4"), ("E", "f4"), ("nu", "f4"),
    ("material_id", "i4"),
    ("conf", "f4"),
]  # fmt: skip


def test_ply_is_read_by_plyfile_and_open3d_as_pixie_writes_it(store, mixed, tmp_path):
    import open3d

    export_store(store, tmp_path / "ply", "ply")
    assert np.dtype(PIXIE_VERTEX).newbyteorder("<") == VERTEX
    for entry in index_of(tmp_path / "ply"):
        asset = mixed.assets[entry["asset_id"]]
        vertex = plyfile.PlyData.read(tmp_path / "ply" / entry["file"])["vertex"]
        assert vertex.data.dtype == np.dtype(PIXIE_VERTEX)
        assert len(vertex.data) == entry["points"] == len(asset.coords)
        # TRELLIS's frame: voxel i is centred at (i + 0.5)/64 - 0.5.
        positions = np.column_stack([vertex[axis] for axis in "xyz"])
        np.testing.assert_allclose((positions + 0.5) * 64 - 0.5, asset.coords, atol=1e-5)
        assert (vertex["part_label"] == vertex["material_id"]).all()
        hold_truth(*(vertex[name] for name in ("material_id", "E", "density", "nu")))
        # These assets are placed exactly, so every annotation is the voxel's own.
        np.testing.assert_allclose(vertex["conf"], 1.0, atol=1e-3)
    cloud = open3d.t.io.read_point_cloud(str(tmp_path / "ply" / entry["file"]))
    assert np.array_equal(cloud.point.positions.numpy(), positions.astype(np.float32))
    assert np.array_equal(cloud.point["E"].numpy()[:, 0], vertex["E"])


def test_grid_points_are_the_field_itself_in_either_frame(store, mixed, tmp_path):
    grid = mixed.assets["cup"].grid
    voxels = np.argwhere(grid[..., 3] != 7)
    for frame in ("slat", "pixieverse"):
        options = ExportOptions(points="grid", frame=frame)
        export_store(store, tmp_path / frame, "ply", assets=["cup"], options=options)
    world, slat = (
        plyfile.PlyData.read(tmp_path / frame / "cup.ply")["vertex"]
        for frame in ("pixieverse", "slat")
    )
    # Where Pixie's `map_pred_to_coords.py` puts voxels of a field without bounds of its own.
    expected = np.linspace(-0.5, 0.5, 64)[voxels]
    turned = ((voxels + 0.5) / 64 - 0.5) @ QUARTER_TURN[:3, :3].T
    for vertex, places, off in ((world, expected, 1e-6), (slat, turned, 2e-3)):
        found = np.column_stack([vertex[axis] for axis in "xyz"])
        np.testing.assert_allclose(found, places, atol=off)
    truth = grid[tuple(voxels.T)]
    for vertex in (world, slat):
        np.testing.assert_array_equal(vertex["material_id"], truth[:, 3])
        np.testing.assert_allclose(vertex["density"], truth[:, 0], rtol=1e-4)


def test_world_bounds_of_the_records_are_used(make_dataset: MakeDataset, tmp_path):
    dataset = make_dataset("cup")
    lo, hi = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 7.0])
    np.savez(
        tmp_path / "sources" / "pixieverse" / "cup" / "clip_features.npz",
        min_bounds=lo, max_bounds=hi, grid_shape=(64, 64, 64),
    )  # fmt: skip
    summary = build_store(dataset.parameters(), tmp_path / "s.zarr")
    options = ExportOptions(points="grid", frame="pixieverse")
    done = export_store(summary.store, tmp_path / "ply", "ply", options=options)
    assert done.notes == ()
    vertex = plyfile.PlyData.read(tmp_path / "ply" / "cup.ply")["vertex"]
    voxels = np.argwhere(dataset.assets["cup"].grid[..., 3] != 7)
    for axis, name in enumerate("xyz"):
        expected = np.linspace(lo[axis], hi[axis], 64)[voxels[:, axis]]
        np.testing.assert_allclose(vertex[name], expected, atol=1e-5)


def test_a_field_without_bounds_is_told(store, tmp_path):
    done = export_store(store, tmp_path / "ply", "ply", options=ExportOptions(frame="pixieverse"))
    assert "5 assets have no world bounds" in done.notes[0]
    assert json.loads((tmp_path / "ply" / "index.json").read_text())["notes"] == list(done.notes)


def test_bounds_that_make_no_sense_are_refused(copy, tmp_path):
    record = json.loads(str(open_store(copy).read_rows("asset/record", 0, 1)[0]))
    said = r"expected min_bounds and max_bounds of three numbers|bounds: Input should be"
    for bounds in (
        {"min_bounds": [0, 0, 0]},
        {"min_bounds": [0, 0, 0], "max_bounds": [1, 1, 0]},
        {"min_bounds": [0, 0], "max_bounds": [1, 1]},
        {"min_bounds": "low", "max_bounds": "high"},
        [1, 2],
    ):
        rewrite(copy, "asset/record", 0, json.dumps(record | {"bounds": bounds}))
        options = ExportOptions(frame="pixieverse")
        with pytest.raises(StoreError, match=said):
            export_store(copy, tmp_path / "ply", "ply", options=options)
        assert not (tmp_path / "ply").exists()
