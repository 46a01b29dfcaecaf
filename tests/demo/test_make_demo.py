"""Demo datasets: layouts, annotations that err, the same bytes again; every source is built."""

import csv
import json
import re
import shlex
import tomllib
from functools import cache
from typing import get_args

import h5py
import numpy as np
import pytest
from support import commands
from support.trees import tree

from slatprep import open_store
from slatprep.demo import make_asset, make_demo
from slatprep.demo.latents import SPACES, Encoder
from slatprep.demo.sources import CLASSES, ONE_FRAME, TABLE, Source, columns_of
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


_made_once = cache(make_asset)


@pytest.fixture
def made_once(monkeypatch):
    """Write the same assets in many forms; each is made for the first."""
    monkeypatch.setattr("slatprep.demo.make_asset", _made_once)


def test_layout_is_that_of_the_real_data(demo):
    root = demo.path
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
            assert ("places" in truth) == (entry["level"] == 4)
        is_good = {"vlm_filtering": {"is_appropriate": True}}
        assert metadata[uid] == {"obj_class": entry["category"]} | is_good


def test_definition_names_the_roots(demo):
    assert tomllib.loads(demo.config.read_text()) == {
        "name": "demo-7", "pixieverse": {"root": "pixieverse"}, "slat": {"root": "slat"},
        "pairing": {"categories": "obj_ids_metadata.json"},
    }  # fmt: skip


def test_same_bytes_again_with_any_number_of_jobs_and_of_assets(demo, tmp_path):
    make_demo(tmp_path / "again", 5, 7, jobs=2)
    assert tree(tmp_path / "again") == tree(demo.path)
    for _ in range(2):  # the second time over itself
        make_demo(tmp_path / "fewer", 2, 7)
        for folder in ("pixieverse", "slat", "truth"):
            fewer, all_of = (tree(one / folder) for one in (tmp_path / "fewer", demo.path))
            assert fewer.items() <= all_of.items()


@pytest.mark.usefixtures("made_once")
@pytest.mark.parametrize("form", ["pixie-predictions", "pixie-prediction-ids"])
def test_predictions_hold_the_grid_normalised(tmp_path, form):
    make_demo(tmp_path, 1, 7, levels=(2,), source=form)
    made = _made_once(7, 0, levels=(2,))
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


@pytest.mark.usefixtures("made_once")
def test_slat_forms_hold_the_same_voxels(tmp_path):
    made = _made_once(7, 0)
    (view,), uid = made.views, made.object_id
    for form in ("npz-batch", "hdf5", "hdf5-groups"):
        make_demo(tmp_path / form, 2, 7, slat_form=form)
    with np.load(tmp_path / "npz-batch" / "slat" / f"{uid}.npz") as slat:
        assert slat["coords"].dtype == np.int32
        assert not slat["coords"][:, 0].any()
        assert np.array_equal(slat["coords"][:, 1:], view.coords)
    with h5py.File(tmp_path / "hdf5" / "slat" / f"{uid}.h5") as file:
        assert np.array_equal(file["coords"], view.coords)
        assert np.array_equal(file["feats"], view.feats)
    root = tmp_path / "hdf5-groups"
    with h5py.File(root / "slat" / "latents.h5") as file:
        assert len(file) == 2
        assert np.array_equal(file[uid]["coords"], view.coords)
    first = tree(root)
    assert tomllib.loads((root / "dataset.toml").read_text())["slat"]["root"] == "slat/latents.h5"
    make_demo(root, 2, 7, slat_form="hdf5-groups")
    assert tree(root) == first


def test_truth_files_name_places_where_shapes_differ(tmp_path):
    make_demo(tmp_path, 2, 3, levels=(6, 7))
    for path in (tmp_path / "truth").glob("*.npz"):
        with np.load(path) as truth:
            assert truth["places"].dtype == np.float64
            assert truth["places"].shape == (len(truth["material"]), 3)
            assert np.abs(truth["places"]).max() <= 0.5


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


@pytest.mark.usefixtures("made_once")
def test_results_are_predictions_that_err(tmp_path):
    make_demo(tmp_path / "demo", 1, 7, levels=(2,), results=True)
    made = _made_once(7, 0, levels=(2,))
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


NAMES = [str(one["name"]) for one in TABLE]
HELD = {
    "physxnet": ["density"],
    **dict.fromkeys(("voxels-npz", "voxels-hdf5", "voxels-zarr", "voxels-ply"), NAMES),
}


def run_printed(output: str, word: str, *more: str) -> str:
    """Run the command that a line of an output tells; return what it prints."""
    (line,) = (line for line in output.splitlines() if line.startswith(word))
    return commands.run(*shlex.split(line.partition(" slatprep ")[2]), *more).output


@pytest.mark.usefixtures("made_once")
@pytest.mark.parametrize("source", get_args(Source))
def test_two_commands_show_a_source_and_a_third_its_truth(tmp_path, source):
    words = ("--assets", 2, "--level", 0, "--source", source)
    said = commands.run("make-demo", tmp_path / "demo", *words).output
    run_printed(said, "a store of it:")
    score = json.loads(run_printed(said, "its score:", "--json"))
    assert len(score["assets"]) == 2
    for asset in score["assets"]:
        assert asset["displacement"] < 0.1
        assert min(asset["label_accuracy"], asset["valid_share"]) > 0.98
    store = open_store(tmp_path / "demo.zarr")
    held = HELD.get(source, ["youngs_modulus", "density", "poissons_ratio"])
    assert store.attributes["property_columns"] == held
    named = store.attributes["material_classes"]
    if source in (*ONE_FRAME, "voxels-hdf5"):
        assert named == []
        assert set(store.column("engine")) == {"field" if source == "voxels-hdf5" else "known"}
    else:
        assert named[:2] == (list(CLASSES[:2]) if source in HELD else ["jelly", "metal"])
    # Values, against the truth that was written beside them, where the labels are right.
    for asset in store:
        with np.load(tmp_path / "demo" / "truth" / f"{asset.asset_id}.npz") as truth:
            columns, values = truth["columns"].tolist(), truth["properties"]
        assert sorted(columns) == sorted(held)
        own = asset.properties_si[:, [held.index(name) for name in columns]]
        right = np.isclose(own, values, rtol=2e-3, atol=1e-3).all(axis=1)
        assert right.mean() > 0.97


def test_properties_of_plain_voxels_are_what_a_material_can_have():
    material = np.arange(7)
    properties = np.stack([np.full(7, 1e6), np.full(7, 900.0), np.linspace(0.2, 0.5, 7)], axis=1)
    columns = columns_of("voxels-npz", material, properties.astype(np.float32))
    assert list(columns) == NAMES
    for one in TABLE:
        values = columns[str(one["name"])]
        assert np.isfinite(values).all()
        assert (values > 0).all() or one["scale"] == "linear"
        assert values.min() >= one.get("least", -np.inf)
        assert values.max() <= one.get("most", np.inf)


@pytest.mark.parametrize("encoder", [name for name in get_args(Encoder) if name != "trellis"])
def test_latents_of_every_encoder_are_carried(tmp_path, encoder):
    words = ("--assets", 1, "--level", 0, "--encoder", encoder, "--latents", "material")
    run_printed(commands.run("make-demo", tmp_path / "demo", *words).output, "a store of it:")
    store = open_store(tmp_path / "demo.zarr")
    assert store.contents.latents.encoder == encoder
    assert store.contents.latents.channels == SPACES[encoder].channels
    assert not store.contents.latents.standardised
    (asset,) = store
    (file,) = (tmp_path / "demo" / "slat").rglob("*.npz")
    with np.load(file) as latents:
        np.testing.assert_array_equal(asset.feats, latents["feats"])


TURN = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@pytest.mark.usefixtures("made_once")
@pytest.mark.parametrize("source", ["pixieverse", "physxnet", "voxels-npz"])
def test_a_wrong_frame_of_any_source_is_caught(tmp_path, source):
    made = make_demo(tmp_path / "demo", 2, 0, levels=(0,), source=source)
    text = made.config.read_text()
    if "[align]" not in text:
        text += '\n[align]\nengine = "known"\n'
    root = made.path / re.findall(r'^root = "(\w+)"$', text, re.M)[0]
    made.config.write_text(text.replace("[slat]", 'transform = "{id}.frame.npy"\n\n[slat]'))
    truths = sorted((made.path / "truth").iterdir())
    for truth, error in zip(truths, (np.eye(4), TURN), strict=True):
        with np.load(truth) as file:
            np.save(root / f"{truth.stem}.frame.npy", error @ file["transform"])
    commands.run("build-store", "--config", made.config, "--out", tmp_path / "s.zarr")
    store = open_store(tmp_path / "s.zarr")
    assert store.ids == [truth.stem for truth in truths]
    assert set(store.column("engine")) == {"known"}
    assert store.column("verdict").tolist() == ["good", "failed"]


@pytest.mark.parametrize(("given", "said"), [
    ({"source": "vomps"}, "source is 'vomps'; expected one of pixieverse, "),
    ({"latents": "noise"}, "latents is 'noise'; expected one of placeholder, material"),
    ({"encoder": "dino"}, "encoder is 'dino'; expected one of trellis, "),
    ({"slat_form": "zip"}, "slat_form is 'zip'; expected one of npz, "),
    ({"slat_names": "sha"}, "slat_names is 'sha'; expected one of id, sha256"),
])  # fmt: skip
def test_words_that_name_nothing_are_refused(given, said, tmp_path):
    with pytest.raises(ConfigError, match=said):
        make_demo(tmp_path / "demo", 1, 0, **given)
    assert not any(tmp_path.iterdir())


def test_numbers_of_numpy_make_the_same_demo(tmp_path):
    given = {"levels": np.array([1]), "habitual_share": np.float32(0.5)}
    make_demo(tmp_path / "a", np.int64(1), np.int64(2), **given)
    make_demo(tmp_path / "b", 1, 2, levels=(1,), habitual_share=0.5)
    assert tree(tmp_path / "a") == tree(tmp_path / "b")


def test_a_demo_at_a_url_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="s3://bucket/x: expected a path of the local disk"):
        make_demo("s3://bucket/x", 1, 0)
    assert not any(tmp_path.iterdir())
