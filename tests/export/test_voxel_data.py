"""VoMP's npz is read back as its simulation scripts read it, and by the adapter for its data."""

from pathlib import Path

import numpy as np
import pytest
from support.commands import refused, run
from support.exports import index_of
from support.synthetic import JELLY, METAL

from slatprep.export import ExportOptions, export_store
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.readers import discover, read_field
from slatprep.records import MATERIAL_CLASSES, MaterialField

# What an asset's points may be: class to E, density, nu.
TRUTH = {MATERIAL_CLASSES[stuff[0]]: stuff[1:] for stuff in (JELLY, METAL)}


def load_materials(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions (N, 3) and E, nu, density (N, 3) with the steps of `load_material_data`.

    That is VoMP's loader for its warp.fem script; those for Newton and libuipc take the same.
    """
    voxels = np.load(path)["voxel_data"]
    where = np.stack([voxels[axis] for axis in ("x", "y", "z")], axis=1)
    what = [voxels[name] for name in ("youngs_modulus", "poissons_ratio", "density")]
    return where, np.stack(what, axis=1)


def field_at(root: Path, name: str) -> MaterialField:
    """Read a field as the adapter for VoMP's data does; a SLAT is made for it."""
    slat = root.parent / "slat"
    slat.mkdir()
    np.savez(slat / f"{name}.npz", coords=np.zeros((1, 3), np.uint8), feats=np.ones((1, 8)))
    source = PixieverseSource(root, adapter="vomp")
    (pair,) = discover(BuildParameters(source, SlatSource(slat)))
    return read_field(pair)


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
        assert names.dtype == "<U32" and set(names) == set(TRUTH)
        for name, (modulus, density, ratio) in TRUTH.items():
            expected = np.tile([modulus, ratio, density], (int((names == name).sum()), 1))
            np.testing.assert_allclose(materials[names == name], expected, rtol=1e-4)
        # Its scripts look up their own points; points of a voxel get that voxel's material.
        rng = np.random.default_rng(0)
        own = (asset.coords + rng.uniform(0.01, 0.99, asset.coords.shape)) / 64 - 0.5
        _, nearest = cKDTree(positions).query(own)
        np.testing.assert_array_equal(nearest, np.arange(len(own)))


def test_the_solid_is_read_back_by_the_adapter_for_vomp_s_data(store, mixed, tmp_path):
    words = (store, "--format", "voxel_data", "--points", "grid", "--asset", "cup")
    run("export", *words, "--out", tmp_path / "vomp")
    field = field_at(tmp_path / "vomp", "cup")
    grid = mixed.assets["cup"].grid
    solid = np.argwhere(grid[..., 3] != 7)
    # The frames differ by a quarter turn: (x, y, z) becomes (-y, x, z).
    turned = np.stack([63 - solid[:, 1], solid[:, 0], solid[:, 2]], axis=1)
    truth = {tuple(v): grid[tuple(s)] for v, s in zip(turned.tolist(), solid, strict=True)}
    assert {tuple(voxel) for voxel in field.voxels.tolist()} == set(truth)
    for voxel, values in zip(field.voxels.tolist(), field.properties, strict=True):
        density, modulus, ratio, _ = truth[tuple(voxel)]
        np.testing.assert_allclose(values, [modulus, density, ratio], rtol=1e-4)


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_the_adapter_takes_corners_of_the_dataset_and_centres_of_predictions(offset, tmp_path):
    voxels = np.arange(64)[:, None] * np.ones(3, int)
    names = ("x", "y", "z", "youngs_modulus", "poissons_ratio", "density")
    rows = np.zeros(64, dtype=[(name, "<f4") for name in names])
    for name, column in zip(names[:3], ((voxels + offset) / 64 - 0.5).T, strict=True):
        rows[name] = column
    rows["youngs_modulus"], rows["poissons_ratio"], rows["density"] = 1e6, 0.3, 1000 + voxels[:, 0]
    (tmp_path / "gvm").mkdir()
    np.savez(tmp_path / "gvm" / "a_with_materials.npz", voxel_data=rows)
    field = field_at(tmp_path / "gvm", "a")
    np.testing.assert_allclose(field.properties[:, 1], 1000.0 + field.voxels[:, 0])


def test_points_may_be_chosen_for_voxel_data_and_the_frame_may_not(store, tmp_path):
    words = (store, "--format", "voxel_data", "--frame", "slat", "--out", tmp_path / "o")
    assert "--frame is for --format ply, not voxel_data" in refused("export", *words)
    options = ExportOptions(points="slat")
    export_store(store, tmp_path / "o", "voxel_data", assets=["cup"], options=options)
