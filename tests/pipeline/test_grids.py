"""SLATs on other grids than the frames' 64^3: placed, looked up and used at their own voxels."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.commands import run
from support.tiny import TINY

from slatprep import build_store, compare_stores, concat_stores, export_store, open_store
from slatprep.demo import make_demo
from slatprep.demo.latents import Encoder
from slatprep.errors import ConfigError
from slatprep.inspect.check import check_alignment
from slatprep.inspect.pictures.scene import scene_of
from slatprep.inspect.report.drawn import COARSE, FULL, SIDE, encode_asset, thumbnail
from slatprep.inspect.score import score_against_truth
from slatprep.inspect.verify import verify_store
from slatprep.learn.augment import lattice_symmetries, move
from slatprep.learn.train import TrainParameters, train
from slatprep.parameters import WitnessParameters
from slatprep.parameters.files import load_parameters
from slatprep.particles.fields import predicted_field, stored_field
from slatprep.pipeline.join import subset_store
from slatprep.readers.splits import Shares
from slatprep.records import BACKGROUND
from slatprep.store.records import StoredRecords

FILES = ("shape_latents/*/{id}.npz", "{id}.npz")
ENCODERS: tuple[Encoder, ...] = ("trellis2-512", "plain-128")


@pytest.fixture(scope="module", params=ENCODERS)
def demo(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make and build two objects, turned, tilted and scaled by known amounts."""
    root = tmp_path_factory.mktemp(request.param)
    made = make_demo(root / "demo", 2, 0, levels=(0, 2), encoder=request.param, latents="material")
    build_store(load_parameters(made.config), root / "s.zarr")
    return root


def side_of(demo: Path) -> int:
    return open_store(demo / "s.zarr").contents.latents.resolution


def centres_of(coords: np.ndarray, side: int) -> np.ndarray:
    """The definition of a grid's voxels, written out."""
    return (2.0 * coords.astype(float) + 1.0) / (2.0 * side) - 0.5


def test_sides_are_placed_and_labels_are_right(demo):
    store = open_store(demo / "s.zarr")
    assert side_of(demo) in (32, 128)
    assert store.column("verdict").tolist() == ["good"] * len(store)
    scores = score_against_truth(demo / "s.zarr", demo / "demo" / "truth").assets
    assert len(scores) == len(store)
    # A face of a shell may lie anywhere in its voxels: by half of one a placement may be off.
    for score in scores:
        assert score.valid_share > 0.99 and score.label_accuracy > 0.97
        assert score.symmetric or score.displacement < 0.5 * 64 / side_of(demo)


def test_each_voxel_is_looked_up_at_its_own_centre(demo):
    for asset in open_store(demo / "s.zarr"):
        centres = centres_of(asset.coords, side_of(demo))
        np.testing.assert_allclose(asset.latents.centres, centres, atol=1e-15)
        inverse = np.linalg.inv(asset.transform)
        places = centres @ inverse[:3, :3].T + inverse[:3, 3]
        np.testing.assert_allclose(asset.place, places, atol=1e-6)
        annotated = np.argwhere(asset.grid_material < BACKGROUND)
        distance, _ = cKDTree(centres_of(annotated, 64)).query(asset.place)
        # A vote may take another voxel than the nearest.
        assert (asset.distance > distance * 64 - 1e-4).all()
        assert np.isclose(asset.distance, distance * 64, atol=1e-4).mean() > 0.8


def test_a_store_of_another_grid_is_sound_and_can_be_shown(demo, tmp_path):
    store = open_store(demo / "s.zarr")
    assert not verify_store(demo / "s.zarr", sources=True).findings
    asset = next(iter(store))
    assert check_alignment(store, asset.asset_id).ok
    scene = scene_of(asset)
    # Cells of the frame, each with the class of a voxel that covers it or lies in it.
    gap, _ = cKDTree(np.floor((asset.latents.centres + 0.5) * 64)).query(scene.slat)
    assert gap.max() <= np.sqrt(3)
    assert set(np.unique(scene.slat_material)) == set(np.unique(asset.material))
    assert thumbnail(asset).shape == (SIDE, 3 * SIDE)
    for level in (FULL, COARSE):
        assert len(encode_asset(asset, StoredRecords(store).place_map(asset), level)) > 100
    picture = ("--picture", tmp_path / "pictures")
    run("check-alignment", "--store", demo / "s.zarr", "--asset", asset.asset_id, *picture)


def test_its_points_are_the_voxels_centres(demo, tmp_path):
    store, side = open_store(demo / "s.zarr"), side_of(demo)
    asset = next(iter(store))
    export_store(demo / "s.zarr", tmp_path / "npz", format="npz")
    (file,) = (tmp_path / "npz").rglob(f"{asset.asset_id}.npz")
    with np.load(file) as arrays:
        assert arrays["resolution"] == side
        np.testing.assert_array_equal(arrays["coords"], asset.coords)
    field = stored_field(store, asset.asset_id)
    again = predicted_field(file, store.normalization)
    np.testing.assert_array_equal(again.voxels, field.voxels)
    np.testing.assert_array_equal(again.material, field.material)
    # A cell or voxel has the material of a voxel whose centre is no farther than half a voxel.
    tree = cKDTree(centres_of(asset.coords[asset.valid], side))
    reach = 0.5 / min(side, field.resolution) * np.sqrt(3) + 1e-9
    near = tree.query_ball_point(centres_of(field.voxels, field.resolution), reach)
    material = asset.material[asset.valid]
    assert all(field.material[k] in material[some] for k, some in enumerate(near))
    cells = centres_of(stored_field(store, asset.asset_id, "grid").surface, 64)
    assert tree.query(cells)[0].max() < 0.5 / min(side, 64) * np.sqrt(3) + 1e-9


def test_the_passes_over_a_dataset_know_the_grid(demo, tmp_path):
    parameters = load_parameters(demo / "demo" / "dataset.toml")
    consensus = replace(parameters.consensus, settle=True)
    parameters = replace(parameters, consensus=consensus, witness=WitnessParameters(settle=True))
    build_store(parameters, tmp_path / "s.zarr")
    assert not verify_store(tmp_path / "s.zarr").findings
    before = (tmp_path / "s.zarr" / "zarr.json").read_bytes()
    build_store(parameters, tmp_path / "s.zarr")  # an update that changes nothing
    assert (tmp_path / "s.zarr" / "zarr.json").read_bytes() == before


def test_stores_of_other_grids_are_not_joined_and_have_no_voxel_in_common(demo, tmp_path):
    store, side = open_store(demo / "s.zarr"), side_of(demo)
    space, other = store.contents.latents, 2 * side
    description, parameters = tmp_path / "d.json", load_parameters(demo / "demo" / "dataset.toml")
    about = {"encoder": space.encoder, "channels": space.channels, "resolution": other}
    description.write_text(json.dumps(about))
    slat = replace(parameters.slat, encoder=str(description), pattern=FILES)
    build_store(replace(parameters, slat=slat), tmp_path / "other.zarr")
    for number, path in enumerate((demo / "s.zarr", tmp_path / "other.zarr")):
        subset_store(path, tmp_path / f"{number}.zarr", [store.ids[number]])
    with pytest.raises(ConfigError, match=rf"{other}\^3 voxels.*{side}\^3 voxels"):
        concat_stores([tmp_path / "0.zarr", tmp_path / "1.zarr"], tmp_path / "both.zarr")
    difference = compare_stores(store, open_store(tmp_path / "other.zarr"))
    assert len(difference.worst) == len(store)
    for one in difference.worst:
        assert one.unmatched == 2 * len(store.asset(one.asset_id).coords)


def test_a_decoder_is_trained_and_used_on_its_grid(demo, tmp_path):
    trained = tmp_path / "run"
    chosen = TrainParameters(epochs=1, size=TINY, keep="last", shares=Shares(0.5, 0.0, 0.5))
    train(demo / "s.zarr", trained, chosen)
    out = tmp_path / "predictions"
    run("predict", demo / "s.zarr", "--checkpoint", trained, "--out", out)
    for asset_id in open_store(demo / "s.zarr").ids:
        with np.load(out / f"{asset_id}.npz") as arrays:
            assert arrays["resolution"] == side_of(demo)
        assert len(predicted_field(out / f"{asset_id}.npz", None).voxels) > 100
    run("evaluate", out, "--store", demo / "s.zarr", "--split", "all")


@pytest.mark.parametrize("side", [32, 64, 96])
def test_voxels_of_any_grid_turn_about_its_centre(side):
    coords = np.random.default_rng(0).integers(0, side, (50, 3)).astype(np.int32)
    for matrix in lattice_symmetries("all"):
        moved = move(coords, matrix, side)
        expected = centres_of(coords, side) @ matrix.T
        np.testing.assert_allclose(centres_of(moved, side), expected, atol=1e-12)


def test_merged_annotations_of_a_coarse_slat_are_sound(tmp_path):
    made = make_demo(tmp_path / "demo", 1, 0, levels=(0,), encoder="trellis2-512", samples=2)
    build_store(load_parameters(made.config), tmp_path / "s.zarr")
    assert next(iter(open_store(tmp_path / "s.zarr"))).merged
    assert not verify_store(tmp_path / "s.zarr", sources=True).findings
