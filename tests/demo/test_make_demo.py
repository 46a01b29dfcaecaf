"""Demo datasets on disk: layouts, annotations that err, the same bytes again."""

import csv
import json
import tomllib

import h5py
import numpy as np
import pytest
from support.trees import tree

from slatprep.demo import make_asset, make_demo
from slatprep.demo.write import MISTAKEN, SPREAD, sample_grids
from slatprep.errors import ConfigError
from slatprep.parameters.files import load_parameters


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    root = tmp_path_factory.mktemp("demo")
    seen = []
    summary = make_demo(root, 5, 7, progress=lambda done, of: seen.append((done, of)))
    assert seen == [(done, 5) for done in range(1, 6)]
    return summary


def test_layout_is_that_of_the_real_data(demo):
    root = demo.directory
    metadata = json.loads((root / "obj_ids_metadata.json").read_text())
    listed = json.loads((root / "demo.json").read_text())["assets"]
    assert len(metadata) == demo.assets == demo.rows == len(listed) == 5
    assert demo.levels == dict.fromkeys(range(5), 1)
    for entry in listed:
        uid = entry["id"]
        folder = root / "pixieverse" / uid
        grid = np.load(folder / "sample_0" / "material_grid.npy")
        mask = np.load(folder / "clip_features_mask.npy")
        assert grid.shape == (64, 64, 64, 4) and grid.dtype == mask.dtype == np.float32
        assert np.array_equal(mask > 0, grid[..., 3] != 7)
        assert grid[mask == 0].min(axis=0).tolist() == [0, 0, 0, 7]
        with np.load(folder / "clip_features.npz") as bounds:
            assert bounds["min_bounds"].tolist() == [-0.5] * 3
            assert bounds["grid_shape"].tolist() == [64] * 3
        with np.load(root / "slat" / f"{uid}.npz") as slat:
            coords, feats = slat["coords"], slat["feats"]
        assert len(np.unique(coords, axis=0)) == len(coords) <= 32_768 and coords.max() <= 63
        with np.load(root / "truth" / f"{uid}.npz") as truth:
            for array, kind, shape in (
                (coords, np.uint8, (len(coords), 3)),
                (feats, np.float32, (len(coords), 8)),
                (truth["transform"], np.float64, (4, 4)),
                (truth["material"], np.uint8, (len(coords),)),
                (truth["properties"], np.float32, (len(coords), 3)),
            ):
                assert (array.dtype, array.shape) == (kind, shape)
            assert np.array_equal(truth["transform"], entry["rows"][0]["transform"])
            for name in ("name", "level", "symmetric"):
                assert truth[name].item() == entry[name]
        is_good = {"vlm_filtering": {"is_appropriate": True}}
        assert metadata[uid] == {"obj_class": entry["category"]} | is_good


def test_definition_names_the_roots(demo):
    definition = tomllib.loads(demo.config.read_text())
    assert definition == {
        "name": "demo-7",
        "pixieverse": {"root": "pixieverse"},
        "slat": {"root": "slat"},
        "pairing": {"categories": "obj_ids_metadata.json"},
    }


def test_same_bytes_again_with_any_number_of_jobs_and_of_assets(demo, tmp_path):
    first = tree(demo.directory)
    make_demo(tmp_path / "again", 5, 7, jobs=2)
    assert tree(tmp_path / "again") == first
    make_demo(tmp_path / "again", 5, 7)  # over itself
    assert tree(tmp_path / "again") == first
    make_demo(tmp_path / "fewer", 2, 7)
    for folder in ("pixieverse", "slat", "truth"):
        assert tree(tmp_path / "fewer" / folder).items() <= tree(demo.directory / folder).items()


@pytest.mark.parametrize("form", ["pixie-predictions", "pixie-prediction-ids"])
def test_predictions_hold_the_grid_normalised(tmp_path, form):
    make_demo(tmp_path, 1, 7, levels=(2,), source=form)
    made = make_asset(7, 0, levels=(2,))
    folder = tmp_path / "pixieverse" / made.object_id
    prediction = np.load(folder / "sample_0_pred.npy")
    assert prediction.dtype == np.float32
    assert prediction.shape == ((11 if form == "pixie-predictions" else 4), 64, 64, 64)
    assert np.array_equal(np.load(folder / "sample_0_mask.npy") > 0, made.occupancy)
    ids = prediction[3:].argmax(axis=0) if form == "pixie-predictions" else prediction[3]
    known = (made.grid[..., 3] >= 0) & (made.grid[..., 3] < 7)
    assert np.array_equal(ids, np.where(known, made.grid[..., 3], 7))
    # By hand, for one voxel: (log10 v - lo) / (hi - lo), spread over -1..1.
    x, y, z = np.argwhere(known)[100]
    values = [*np.log10(made.grid[x, y, z, :2].astype(float)), made.grid[x, y, z, 2]]
    low = np.array([1.7031893730163574, 3.0183002948760986, 0.21027633547782898])
    high = np.array([3.871432304382324, 10.881680488586426, 0.4492689371109009])
    expected = 2 * (values - low) / (high - low) - 1
    assert prediction[:3, x, y, z] == pytest.approx(expected, abs=1e-6)
    assert np.abs(prediction[:3]).max() <= 1.0


def test_slat_forms_hold_the_same_voxels(tmp_path):
    view = make_asset(7, 0).views[0]
    uid = make_asset(7, 0).object_id
    for form in ("npz-batch", "hdf5", "hdf5-groups"):
        make_demo(tmp_path / form, 2, 7, slat_form=form)
    with np.load(tmp_path / "npz-batch" / "slat" / f"{uid}.npz") as slat:
        assert slat["coords"].dtype == np.int32
        assert not slat["coords"][:, 0].any()
        assert np.array_equal(slat["coords"][:, 1:], view.coords)
    with h5py.File(tmp_path / "hdf5" / "slat" / f"{uid}.h5") as file:
        assert np.array_equal(file["coords"], view.coords)
        assert np.array_equal(file["feats"], view.feats)
    with h5py.File(tmp_path / "hdf5-groups" / "slat" / "latents.h5") as file:
        assert len(file) == 2
        assert np.array_equal(file[uid]["coords"], view.coords)
    root = tmp_path / "hdf5-groups"
    first = tree(root)
    assert tomllib.loads((root / "dataset.toml").read_text())["slat"]["root"] == "slat/latents.h5"
    make_demo(root, 2, 7, slat_form="hdf5-groups")
    assert tree(root) == first


def test_several_views_are_several_rows_of_one_object(tmp_path):
    summary = make_demo(tmp_path, 1, 7, views=2)
    uid = make_asset(7, 0).object_id
    assert (summary.assets, summary.rows) == (1, 2)
    assert set(tree(tmp_path / "slat")) == {f"{uid}/view_0.npz", f"{uid}/view_1.npz"}
    assert set(tree(tmp_path / "truth")) == {f"{uid}.view_0.npz", f"{uid}.view_1.npz"}


def test_names_by_sha256_come_with_trellis_metadata(tmp_path):
    make_demo(tmp_path, 2, 7, slat_names="sha256")
    with (tmp_path / "metadata.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    files = {p.stem for p in (tmp_path / "slat").iterdir()}
    assert {row["sha256"] for row in rows} == files
    assert all(len(name) == 64 for name in files)
    ids = {row["file_identifier"].rsplit("/", 1)[1] for row in rows}
    assert ids == {p.name for p in (tmp_path / "pixieverse").iterdir()}
    assert tomllib.loads((tmp_path / "dataset.toml").read_text())["pairing"]["map"]


@pytest.mark.parametrize(("wrong", "said"), [
    ({"assets": 0}, "assets = 0"),
    ({"seed": -1}, "seed = -1"),
    ({"levels": ()}, r"levels = \(\)"),
    ({"levels": (0, 9)}, r"levels = \(0, 9\)"),
    ({"views": 0}, "views = 0"),
    ({"samples": 0}, "samples = 0"),
    ({"habitual_share": 1.5}, "habitual_share = 1.5"),
    ({"views": 2, "slat_form": "hdf5-groups"}, "'hdf5-groups' holds one view"),
    ({"source": "vomp", "levels": (1,)}, "source 'vomp'"),
    ({"source": "physxnet", "views": 2}, "source 'physxnet'"),
    ({"encoder": "trellis2", "slat_form": "hdf5"}, "encoder 'trellis2'"),
    ({"samples": 3, "source": "pixie-predictions"}, "source 'pixieverse'"),
])  # fmt: skip
def test_senseless_arguments_are_refused(tmp_path, wrong, said):
    with pytest.raises(ConfigError, match=said):
        make_demo(tmp_path / "demo", **{"assets": 1, "seed": 0} | wrong)
    assert not (tmp_path / "demo").exists()


def test_a_directory_with_other_content_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(ConfigError, match="empty directory"):
        make_demo(tmp_path, 1, 0)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]
    make_demo(tmp_path / "demo", 1, 0)
    with pytest.raises(ConfigError, match="empty directory"):
        make_demo(tmp_path / "demo", 1, 1)


def test_results_are_predictions_that_err(tmp_path):
    make_demo(tmp_path / "demo", 1, 7, levels=(2,), results=True)
    made = make_asset(7, 0, levels=(2,))
    prediction = np.load(tmp_path / "demo" / "results" / made.object_id / "sample_0_pred.npy")
    assert prediction.shape == (11, 64, 64, 64) and prediction.dtype == np.float32
    assert (prediction[3:].sum(axis=0) == 1).all()
    known = (made.grid[..., 3] >= 0) & (made.grid[..., 3] < 7)
    right = (prediction[3:].argmax(axis=0) == made.grid[..., 3])[known].mean()
    assert 0.5 < right < 0.999


def test_parts_err_as_said():
    asset = make_asset(3, 1, levels=(0,))
    known = (asset.grid[..., 3] >= 0) & (asset.grid[..., 3] != 7)
    grids = sample_grids(3, 1, asset, 36)
    assert np.array_equal(grids[:, ~known], np.repeat(asset.grid[~known][None], 36, axis=0))
    parts, first = np.unique(asset.grid[known], axis=0, return_index=True)
    drawn = grids[:, known][:, first].astype(float)
    apart = np.log10(drawn[..., :2] / parts[:, :2])
    # 36 draws of a part: their mean within 4 standard errors, their spread within a third.
    assert (np.abs(apart.mean(axis=0)) < 4 / 6 * SPREAD[:2]).all()
    assert (np.abs(apart.std(axis=0) / SPREAD[:2] - 1) < 1 / 3).all()
    others = (drawn[..., 3] != parts[:, 3]).mean()
    assert 0.5 * MISTAKEN < others < MISTAKEN
    assert np.array_equal(sample_grids(3, 1, asset, 2), grids[:2])


def test_a_demo_of_several_samples_asks_for_a_merge(tmp_path):
    summary = make_demo(tmp_path / "demo", 1, 0, samples=3)
    assert load_parameters(summary.config).pixieverse.samples == "merge"
    (folder,) = (tmp_path / "demo/pixieverse").iterdir()
    assert {path.name for path in folder.glob("sample_*")} == {f"sample_{k}" for k in range(3)}
