"""A deformation goes all the way: into the store, its record, and whatever looks things up."""

import json
import shutil
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import plyfile
import pytest
from scipy.spatial import cKDTree
from support.deformed import MOVES
from support.made_store import edit_record, rewrite

from slatprep import Store, open_store
from slatprep.export import ExportOptions, export_store
from slatprep.geometry.frames import VOXEL_SIZE, voxel_centres
from slatprep.inspect.check import check_alignment
from slatprep.inspect.verify import verify_store
from slatprep.particles.fields import stored_field
from slatprep.particles.transfer import transfer
from slatprep.pipeline.dataset import BuildSummary
from slatprep.store.record import AssetRecord
from slatprep.store.record_json import FOLDER, read_record, to_json
from slatprep.store.records import StoredRecords


@pytest.fixture
def store(deformed_build: BuildSummary) -> Store:
    return open_store(deformed_build.store)


def off(places: np.ndarray, true_places: np.ndarray) -> np.ndarray:
    """Return how far places lie from where they should, in voxels."""
    return np.linalg.norm(places - true_places, axis=1) / VOXEL_SIZE


def test_each_voxel_was_looked_up_where_it_lies(store):
    assert [str(model) for model in store.column("model")] == ["deformable", "affine"]
    for asset in store:
        true_places = MOVES[asset.asset_id](voxel_centres(asset.coords))
        assert asset.place.dtype == np.float32
        assert np.median(off(asset.place, true_places)) < 0.7
        voxels = np.argwhere(asset.grid_material < 7)
        distance, nearest = cKDTree(voxel_centres(voxels)).query(asset.place)
        # A voxel may take the values of one farther off whose class is voted for.
        farther = asset.distance - distance / VOXEL_SIZE
        assert farther.min() > -1e-5
        assert (farther < 1e-5).mean() > 0.95
        same = asset.material == asset.grid_material[tuple(voxels.T)][nearest]
        assert same[asset.valid & (farther < 1e-5)].all()


def test_the_record_holds_the_map_to_the_last_bit(store):
    schema = json.loads((FOLDER / "asset_record.schema.json").read_text())
    for asset in store:
        text = str(store.read_rows("asset/record", asset.index, asset.index + 1)[0])
        assert to_json(read_record(AssetRecord, text, "here")) == text.encode()
        jsonschema.Draft202012Validator(schema).validate(json.loads(text))
        way = StoredRecords(store).place_map(asset)
        assert way.deformation is not None
        assert way.places(asset.coords).astype(np.float32).tobytes() == asset.place.tobytes()


def test_a_sound_store_verifies_and_checks(store):
    assert verify_store(store.path).findings == ()
    for asset_id in store.ids:
        assert check_alignment(store, asset_id).consistent


@pytest.mark.parametrize("what", ["place", "coefficients", "model"])
def test_another_map_than_the_places_is_found(store, what, tmp_path):
    def bend(record: dict[str, Any]) -> None:
        record["alignment"]["deformation"]["coefficients"][2][2][2][0] += 2**-8

    out = Path(shutil.copytree(str(store.path), tmp_path / "s.zarr"))
    if what == "place":
        rewrite(out, "voxel/place", 3, store["bent"].place[3] + np.float32(2**-12))
    elif what == "model":
        edit_record(out, 0, lambda record: record["alignment"].update(deformation=None))
    else:
        edit_record(out, 0, bend)
    findings = verify_store(out).findings
    assert [f.asset for f in findings if f.file == "voxel/place"] == ["bent"]
    assert any("without a deformation" in f.what for f in findings) == (what == "model")


def test_particles_are_carried_by_the_same_map(store):
    for asset in store:
        field = stored_field(store, asset.asset_id, "grid")
        points = voxel_centres(asset.coords)
        true_places = MOVES[asset.asset_id](points)
        assert np.median(off(field.locate(points), true_places)) < 0.7
        found = transfer(points, field, far="nearest")
        truth = np.where(true_places[:, 2] > -4 / 64, 1, 0)
        clear = np.abs(true_places[:, 2] * 64 + 4) > 1.5
        assert (found.material == truth)[clear].mean() > 0.99


def test_the_grid_is_written_where_the_slat_has_it(store, tmp_path):
    export_store(store.path, tmp_path / "ply", "ply", options=ExportOptions(points="grid"))
    for asset in store:
        vertex = plyfile.PlyData.read(tmp_path / "ply" / f"{asset.asset_id}.ply")["vertex"]
        positions = np.column_stack([vertex[axis] for axis in "xyz"]).astype(np.float64)
        centres = voxel_centres(asset.field.voxels)
        assert np.median(off(MOVES[asset.asset_id](positions), centres)) < 0.7


def test_what_is_exported_says_where_voxels_were_looked_up(store, tmp_path):
    import h5py

    export_store(store.path, tmp_path / "all.h5", "hdf5")
    with h5py.File(tmp_path / "all.h5") as file:
        for asset in store:
            assert np.array_equal(file[asset.asset_id]["place"][()], asset.place)
