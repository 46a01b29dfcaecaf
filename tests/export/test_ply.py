"""PLY exports are read back by what simulates and draws, points and frames included."""

import json
import shutil

import numpy as np
import plyfile
import pytest
import zarr
from support.exports import hold_truth, index_of
from support.synthetic import JELLY, METAL, QUARTER_TURN, Dataset

from slatprep.errors import StoreError
from slatprep.export import ExportOptions, export_store
from slatprep.export.ply import VERTEX
from slatprep.pipeline.dataset import build_store

# As `map_pred_to_coords.py` of Pixie declares the rows of its files.
PIXIE_VERTEX = [
    ("x", "f4"), ("y", "f4"), ("z", "f4"),
    ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1"),
    ("part_label", "i4"), ("density", "f4"), ("E", "f4"), ("nu", "f4"),
    ("material_id", "i4"),
    ("conf", "f4"),
]  # fmt: skip


def test_ply_is_read_by_plyfile_as_pixie_writes_it(store, mixed, tmp_path):
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


def test_ply_is_read_by_open3d(store, mixed, tmp_path):
    import open3d

    export_store(store, tmp_path / "ply", "ply", assets=["ant"])
    cloud = open3d.t.io.read_point_cloud(str(tmp_path / "ply" / "ant.ply"))
    assert cloud.point.positions.shape == (len(mixed.assets["ant"].coords), 3)
    modulus = np.unique(np.round(np.log10(cloud.point["E"].numpy()), 3))
    np.testing.assert_allclose(modulus, np.log10([JELLY[1], METAL[1]]), atol=2e-3)


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
    np.testing.assert_allclose(
        np.column_stack([world[axis] for axis in "xyz"]), expected, atol=1e-6
    )
    centres = (voxels + 0.5) / 64 - 0.5
    np.testing.assert_allclose(
        np.column_stack([slat[axis] for axis in "xyz"]), centres @ QUARTER_TURN[:3, :3].T, atol=2e-3
    )
    truth = grid[tuple(voxels.T)]
    for vertex in (world, slat):
        np.testing.assert_array_equal(vertex["material_id"], truth[:, 3])
        np.testing.assert_allclose(vertex["density"], truth[:, 0], rtol=1e-4)


def test_world_bounds_of_the_records_are_used(tmp_path):
    dataset = Dataset(tmp_path / "sources")
    dataset.add("cup", seed=0)
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


@pytest.mark.parametrize(
    "bounds",
    [
        {"min_bounds": [0, 0, 0]},
        {"min_bounds": [0, 0, 0], "max_bounds": [1, 1, 0]},
        {"min_bounds": [0, 0], "max_bounds": [1, 1]},
        {"min_bounds": "low", "max_bounds": "high"},
        [1, 2],
    ],
)
def test_bounds_that_make_no_sense_are_refused(bounds, store, tmp_path):
    shutil.copytree(store, tmp_path / "s.zarr")
    records = zarr.open_group(tmp_path / "s.zarr", mode="r+", use_consolidated=False)[
        "asset/record"
    ]
    texts = [json.dumps({**json.loads(text), "bounds": bounds}) for text in records[:]]
    records[:] = np.array(texts, dtype=object)
    options = ExportOptions(frame="pixieverse")
    with pytest.raises(
        StoreError,
        match=r"expected min_bounds and max_bounds of three numbers|bounds: Input should be",
    ):
        export_store(tmp_path / "s.zarr", tmp_path / "ply", "ply", options=options)
    assert not (tmp_path / "ply").exists()
