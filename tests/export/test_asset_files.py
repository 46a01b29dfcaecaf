"""Files of an asset are read as their users read them: TRELLIS's data set, VoMP, Pixie, Open3D."""

import json
from pathlib import Path

import numpy as np
import pandas
import plyfile
import pytest
from support.commands import refused, run
from support.exports import hold_colours, hold_truth, index_of
from support.made_store import edit_attributes, edit_record, rewrite
from support.raw_sources import field_at
from support.synthetic import JELLY, METAL, QUARTER_TURN, MakeDataset

from slatprep.errors import ConfigError, StoreError
from slatprep.export import ExportOptions, export_store
from slatprep.export.ply import VERTEX, write_points
from slatprep.learn.evaluate import evaluate_store
from slatprep.learn.metrics import OURS
from slatprep.parameters import SampleParameters
from slatprep.pipeline.dataset import build_store
from slatprep.records import MATERIAL_CLASSES
from slatprep.store import open_store

ENCODER = "dinov2_vitl14_reg_slat_enc_swin8_B_64l8_fp16"  # latent_model of TRELLIS's configurations


class StructuredLatents:
    """What TRELLIS's data set does with a root, by the documentation of its columns."""

    def __init__(self, root: Path, model: str, score: float = 5.0, most: int = 32768) -> None:
        table = pandas.read_csv(root / "metadata.csv")
        table = table[table[f"latent_{model}"]]
        table = table[(table["aesthetic_score"] >= score) & (table["num_voxels"] <= most)]
        self.names = list(table["sha256"])
        self.loads = [table.set_index("sha256").loc[name, "num_voxels"] for name in self.names]
        self.folder = root / "latents" / model

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        with np.load(self.folder / f"{self.names[index]}.npz") as data:
            return data["coords"].astype(np.int32), data["feats"].astype(np.float32)


@pytest.mark.parametrize("model", ["", "my_encoder.v2"])
def test_an_npz_export_is_what_trellis_loads(model, store, mixed, tmp_path):
    options = ExportOptions(latent_model=model) if model else ExportOptions()
    export_store(open_store(store), tmp_path / "root", "npz", options=options)
    loaded = StructuredLatents(tmp_path / "root", model or ENCODER)
    assert loaded.names == sorted(mixed.assets)
    for index, name in enumerate(loaded.names):
        coords, feats = loaded[index]
        np.testing.assert_array_equal(coords, mixed.assets[name].coords)
        np.testing.assert_array_equal(feats, mixed.assets[name].feats)
        assert loaded.loads[index] == len(coords)
        # The targets lie beside them.
        with np.load(loaded.folder / f"{name}.npz") as data:
            names = "classes columns confidence coords feats material properties ranges valid"
            assert sorted(data) == names.split()
            assert data["coords"].dtype == np.uint8 and data["feats"].dtype == np.float32
            # Two materials in the dataset: they are the two ends of both log scales.
            for material, ends in ((JELLY[0], (-1, -1, 1)), (METAL[0], (1, 1, -1))):
                here = data["material"] == material
                np.testing.assert_allclose(data["properties"][here], [ends] * here.sum())
    table, stored = pandas.read_csv(tmp_path / "root" / "metadata.csv"), open_store(store)
    for name in ("confidence", "expected_accuracy"):
        np.testing.assert_allclose(table[name], stored.column(name))
    most = sorted(loaded.loads)[2]
    few = StructuredLatents(tmp_path / "root", model or ENCODER, 9.0, most).names
    assert len(few) == sum(load <= most for load in loaded.loads)


@pytest.mark.parametrize("form", ["npz", "hdf5"])
def test_exported_labels_are_right_in_a_store_of_other_ranges(form, make_dataset, tmp_path):
    dataset = make_dataset("cup")
    build_store(dataset.parameters(), tmp_path / "first.zarr")
    export_store(tmp_path / "first.zarr", out := tmp_path / f"out.{form}", form)
    dataset.add("dog", seed=1)
    dataset.write_grid("dog", dataset.assets["dog"].grid * [2.0, 0.1, 0.9, 1.0])
    build_store(dataset.parameters(), tmp_path / "second.zarr")
    said = out / "latents" / ENCODER if form == "npz" else out
    report = evaluate_store(said, tmp_path / "second.zarr", None)
    assert report.converted == 1
    assert report.methods[OURS].means["mean"] == pytest.approx(0.0, abs=1e-9)


def test_names_that_pandas_takes_for_numbers_or_nothing_are_found(copy, tmp_path):
    root = tmp_path / "root"
    for names in (
        ["007", "1e5", "12", "0x1", "9" * 25], ["NA", "nan", "None", "null", "inf"],
        ["0", "1", "2", "3", "10"], ["true", "False", "TRUE", "false", "True"],
    ):  # fmt: skip
        rewrite(copy, "asset/id", slice(None), np.array(names, dtype=object))
        export_store(copy, root, "npz")
        loaded = StructuredLatents(root, ENCODER)
        assert len(loaded.names) == len(names)
        assert all(len(loaded[index][0]) == loaded.loads[index] for index in range(len(names)))
        files = {entry["asset_id"]: entry["file"] for entry in index_of(root)}
        assert sorted(files) == sorted(names)
        assert all((root / file).is_file() for file in files.values())


def test_another_model_takes_the_place_of_the_first(store, tmp_path):
    root = tmp_path / "root"
    export_store(store, root, "npz")
    (root / "notes.txt").write_text("mine")
    export_store(store, root, "npz", assets=["cup"], options=ExportOptions(latent_model="other"))
    files = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    assert files == {"index.json", "metadata.csv", "notes.txt", "latents/other/cup.npz"}
    assert json.loads((root / "index.json").read_text())["files"] == ["metadata.csv"]


def test_latents_of_another_encoder_have_its_name(copy, tmp_path):
    latents = open_store(copy).attributes["latents"] | {"encoder": "other"}
    edit_attributes(copy, latents=latents)
    export_store(copy, tmp_path / "root", "npz", assets=["cup"])
    assert [path.name for path in (tmp_path / "root/latents").iterdir()] == ["other"]
    assert "latent_other" in (tmp_path / "root/metadata.csv").read_text()


@pytest.mark.parametrize("name", ["", "..", "a/b", "../up", "a b", "-x"])
def test_a_model_that_names_no_folder_is_refused(name, store, tmp_path):
    with pytest.raises(ConfigError, match=r"latent_model is .* expected an encoder's name"):
        export_store(store, tmp_path / "root", "npz", options=ExportOptions(latent_model=name))
    assert not (tmp_path / "root").exists()


def load_materials(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions (N, 3) and E, nu, density (N, 3) as VoMP's `load_material_data` does."""
    voxels = np.load(path)["voxel_data"]
    where = np.stack([voxels[axis] for axis in ("x", "y", "z")], axis=1)
    what = [voxels[name] for name in ("youngs_modulus", "poissons_ratio", "density")]
    return where, np.stack(what, axis=1)


def test_names_of_classes_are_not_cut(copy, tmp_path):
    names = [f"{'wood that is hard ' * 3}{k}" for k in range(7)]
    edit_attributes(copy, material_classes=names)
    export_store(copy, tmp_path / "vomp", "voxel_data", assets=["cup"])
    (path,) = (tmp_path / "vomp").rglob("*.npz")
    asset = open_store(copy)["cup"]
    written = np.load(path)["voxel_data"]["segment_id"]
    np.testing.assert_array_equal(written, np.array(names)[asset.material[asset.valid]])


def test_classes_that_physgaussian_does_not_have_are_no_material_id(copy, tmp_path):
    edit_attributes(copy, material_classes=["oak", *"bcdefg"])
    export_store(copy, tmp_path / "ply", "ply", assets=["cup"])
    (path,) = (tmp_path / "ply").rglob("*.ply")
    read, asset = plyfile.PlyData.read(path), open_store(copy)["cup"]
    assert (read["vertex"]["material_id"] == -1).all()
    np.testing.assert_array_equal(read["vertex"]["part_label"], asset.material[asset.valid])
    assert {"part_label 0 is oak", "part_label 1 is b"} <= set(read.comments)


def test_a_property_named_as_a_field_of_pixie_s_has_another_name_in_a_ply(tmp_path):
    made = np.ones((3, 3), np.float32)
    more = {(name, "1/K"): np.arange(3, dtype=np.float32) for name in ("property_alpha", "alpha")}
    write_points(tmp_path / "a.ply", made, np.ones(3, np.uint8), made, np.ones(3), "any", more)
    read = plyfile.PlyData.read(tmp_path / "a.ply")
    assert read["vertex"]["property_property_alpha"].tolist() == [0.0, 1.0, 2.0]
    assert (read["vertex"]["alpha"] == 255).all()
    assert any("property_property_alpha 1/K" in comment for comment in read.comments)


def test_the_loader_of_vomp_finds_every_voxel_and_its_material(store, mixed, tmp_path):
    from scipy.spatial import cKDTree

    export_store(store, tmp_path / "vomp", "voxel_data")
    for entry in index_of(tmp_path / "vomp"):
        path = tmp_path / "vomp" / entry["file"]
        assert path.name == f"{entry['asset_id']}_with_materials.npz"
        positions, materials = load_materials(path)
        asset = mixed.assets[entry["asset_id"]]
        assert positions.dtype == materials.dtype == np.float32
        np.testing.assert_allclose((positions + 0.5) * 64 - 0.5, asset.coords, atol=1e-5)
        names = np.load(path)["voxel_data"]["segment_id"]
        assert names.dtype == "<U32"
        modulus, ratio, density = materials.T
        hold_truth([MATERIAL_CLASSES.index(name) for name in names], modulus, density, ratio)
        # Its scripts look up their own points; points of a voxel get that voxel's material.
        rng = np.random.default_rng(0)
        own = (asset.coords + rng.uniform(0.01, 0.99, asset.coords.shape)) / 64 - 0.5
        _, nearest = cKDTree(positions).query(own)
        np.testing.assert_array_equal(nearest, np.arange(len(own)))


def test_the_solid_is_read_back_by_the_adapter_for_vomp_s_data(store, mixed, tmp_path):
    words = (store, "--format", "voxel_data", "--points", "grid", "--asset", "cup")
    run("export", *words, "--out", tmp_path / "vomp")
    field = field_at(tmp_path / "vomp", "vomp", "cup")
    grid = mixed.assets["cup"].grid
    solid = np.argwhere(grid[..., 3] != 7)
    # The frames differ by a quarter turn: (x, y, z) becomes (-y, x, z).
    turned = np.stack([63 - solid[:, 1], solid[:, 0], solid[:, 2]], axis=1)
    truth = {tuple(v): grid[tuple(s)] for v, s in zip(turned.tolist(), solid, strict=True)}
    assert {tuple(voxel) for voxel in field.voxels.tolist()} == set(truth)
    for voxel, values in zip(field.voxels.tolist(), field.properties, strict=True):
        density, modulus, ratio, _ = truth[tuple(voxel)]
        np.testing.assert_allclose(values, [modulus, density, ratio], rtol=1e-4)


def test_points_may_be_chosen_for_voxel_data_and_the_frame_may_not(store, tmp_path):
    words = (store, "--format", "voxel_data", "--frame", "slat", "--out", tmp_path / "o")
    assert "--frame is for --format ply, not voxel_data" in refused("export", *words)
    options = ExportOptions(points="slat")
    export_store(store, tmp_path / "o", "voxel_data", assets=["cup"], options=options)


# As `map_pred_to_coords.py` of Pixie declares the rows of its files.
PIXIE_VERTEX = [
    *((axis, "f4") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue", "alpha")),
    ("part_label", "i4"), ("density", "f4"), ("E", "f4"), ("nu", "f4"), ("material_id", "i4"),
    ("conf", "f4"),
]  # fmt: skip


def positions_of(vertex: plyfile.PlyElement) -> np.ndarray:
    return np.column_stack([vertex[axis] for axis in "xyz"])


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
        positions = positions_of(vertex)
        np.testing.assert_allclose((positions + 0.5) * 64 - 0.5, asset.coords, atol=1e-5)
        assert (vertex["part_label"] == vertex["material_id"]).all()
        hold_truth(*(vertex[name] for name in ("material_id", "E", "density", "nu")))
        shown = np.column_stack([vertex[name] for name in ("red", "green", "blue")])
        hold_colours(vertex["material_id"], shown)
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
        done = export_store(store, tmp_path / frame, "ply", options=options)
    assert "5 assets have no world bounds" in done.notes[0]
    assert json.loads((tmp_path / frame / "index.json").read_text())["notes"] == list(done.notes)
    files = (tmp_path / frame / "cup.ply" for frame in ("pixieverse", "slat"))
    world, slat = (plyfile.PlyData.read(file)["vertex"] for file in files)
    # Where Pixie's `map_pred_to_coords.py` puts voxels of a field without bounds of its own.
    expected = np.linspace(-0.5, 0.5, 64)[voxels]
    turned = ((voxels + 0.5) / 64 - 0.5) @ QUARTER_TURN[:3, :3].T
    for vertex, places, off in ((world, expected, 1e-6), (slat, turned, 2e-3)):
        np.testing.assert_allclose(positions_of(vertex), places, atol=off)
    truth = grid[tuple(voxels.T)]
    for vertex in (world, slat):
        np.testing.assert_array_equal(vertex["material_id"], truth[:, 3])
        np.testing.assert_allclose(vertex["density"], truth[:, 0], rtol=1e-4)


def test_slat_points_lie_where_they_were_looked_up_and_count_less_from_afar(copy, tmp_path):
    rewrite(copy, "voxel/distance", slice(None), 0.5)
    rewrite(copy, "voxel/place", (slice(None), 0), 0.25)
    export_store(copy, tmp_path / "ply", "ply", options=ExportOptions(frame="pixieverse"))
    vertex = plyfile.PlyData.read(tmp_path / "ply" / "cup.ply")["vertex"]
    # The bounds, -0.5 and 0.5, are the centres of the first and the last voxel.
    np.testing.assert_allclose(vertex["x"], 0.25 * 64 / 63, rtol=1e-6)
    np.testing.assert_allclose(vertex["conf"], 1 - 0.5 / SampleParameters().max_distance)


def test_world_bounds_of_the_records_are_used(make_dataset: MakeDataset, tmp_path):
    dataset = make_dataset("cup")
    lo, hi = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 7.0])
    file = tmp_path / "sources" / "pixieverse" / "cup" / "clip_features.npz"
    np.savez(file, min_bounds=lo, max_bounds=hi, grid_shape=(64, 64, 64))
    summary = build_store(dataset.parameters(), tmp_path / "s.zarr")
    options = ExportOptions(points="grid", frame="pixieverse")
    assert export_store(summary.store, tmp_path / "ply", "ply", options=options).notes == ()
    vertex = plyfile.PlyData.read(tmp_path / "ply" / "cup.ply")["vertex"]
    voxels = np.argwhere(dataset.assets["cup"].grid[..., 3] != 7)
    expected = np.take_along_axis(np.linspace(lo, hi, 64), voxels, axis=0)
    np.testing.assert_allclose(positions_of(vertex), expected, atol=1e-5)


def test_bounds_that_make_no_sense_are_refused(copy, tmp_path):
    said = r"expected min_bounds and max_bounds of three numbers|bounds: Input should be"
    for bounds in (
        {"min_bounds": [0, 0, 0]},
        {"min_bounds": [0, 0, 0], "max_bounds": [1, 1, 0]},
        {"min_bounds": [0, 0], "max_bounds": [1, 1]},
        {"min_bounds": "low", "max_bounds": "high"},
        [1, 2],
    ):
        edit_record(copy, 0, lambda record, bounds=bounds: record.update(bounds=bounds))
        options = ExportOptions(frame="pixieverse")
        with pytest.raises(StoreError, match=said):
            export_store(copy, tmp_path / "ply", "ply", options=options)
        assert not (tmp_path / "ply").exists()
