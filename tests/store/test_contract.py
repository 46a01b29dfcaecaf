"""The store as zarr-python, xarray and tensorstore read it, against numbers worked out here."""

import json
import warnings
from collections.abc import Iterator
from math import log10

import numpy as np
import pytest
import tensorstore
import xarray
import zarr
from support.synthetic import JELLY, METAL, QUARTER_TURN, SMALL_SHARDS

from slatprep.pipeline.dataset import BuildSummary
from slatprep.store.layout import ARRAYS

IDS = ["ant", "bear.front", "bear.side", "cup", "dog"]


@pytest.fixture
def root(mixed_build: BuildSummary) -> Iterator[zarr.Group]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # A reader must not be warned by what we wrote.
        yield zarr.open_group(mixed_build.store, mode="r")


def by_hand(stuff: tuple[float, ...]) -> list[float]:
    """Normalise E, density and nu by the range of the only two materials there are."""
    values = []
    for column, mapped in ((1, log10), (2, log10), (3, float)):
        lo, hi = sorted((mapped(JELLY[column]), mapped(METAL[column])))
        values.append(2 * (mapped(stuff[column]) - lo) / (hi - lo) - 1)
    return values


def test_ids_offsets_and_voxels_are_the_source_files(root, mixed):
    assert [str(i) for i in root["asset/id"][:]] == IDS
    assert [str(i) for i in root["asset/object_id"][:]] == ["ant", "bear", "bear", "cup", "dog"]
    assert [str(i) for i in root["asset/view"][:]] == ["", "front", "side", "", ""]

    offset = root["asset/offset"][:]
    assert offset.dtype == np.int64 and offset[0] == 0
    assert offset[-1] == root["voxel/coords"].shape[0]
    for row, asset_id in enumerate(IDS):
        rows = slice(offset[row], offset[row + 1])
        assert np.array_equal(root["voxel/coords"][rows], mixed.assets[asset_id].coords)
        assert np.array_equal(root["voxel/feats"][rows], mixed.assets[asset_id].feats)


def test_supervision_is_the_material_at_the_place_the_voxel_was_turned_from(root, mixed):
    offset = root["asset/offset"][:]
    for row, asset_id in enumerate(IDS):
        assert np.allclose(root["asset/transform"][row], QUARTER_TURN, atol=1e-3)
        rows = slice(offset[row], offset[row + 1])
        x, y, z = mixed.assets[asset_id].coords.astype(int).T
        true_material = mixed.assets[asset_id].grid[y, 63 - x, z, 3]
        assert np.array_equal(root["voxel/material"][rows], true_material)
        assert root["voxel/valid"][rows].all() and root["voxel/distance"][rows].max() < 0.1
        place = (np.stack([y, 63 - x, z], axis=1) + 0.5) / 64 - 0.5
        assert np.allclose(root["voxel/place"][rows], place, atol=0.1 / 64)
        expected = np.where((true_material == 0)[:, None], by_hand(JELLY), by_hand(METAL))
        assert np.allclose(root["voxel/properties"][rows], expected, atol=1e-6)


def test_grid_is_the_normalised_field(root, mixed):
    for row, asset_id in enumerate(IDS):
        material = mixed.assets[asset_id].grid[..., 3]
        stored = root["grid/properties"][row]
        assert np.array_equal(root["grid/material"][row], material)
        assert np.isnan(stored[:, material == 7]).all()
        assert np.allclose(stored[:, material == 0].T, by_hand(JELLY), atol=1e-6)
        assert np.allclose(stored[:, material == 1].T, by_hand(METAL), atol=1e-6)


def test_attributes_explain_the_store(root, mixed_build):
    said, ranges = dict(root.attrs), root.attrs["normalization"]
    assert (said["format"], said["format_version"]) == ("slatprep-store", 1)
    assert (said["resolution"], said["manifest"]) == (64, mixed_build.build_id)
    assert said["material_classes"][6:] == ["stationary", "background"]
    assert said["property_columns"] == ["youngs_modulus", "density", "poissons_ratio"]
    modulus = {"log10": True, "source": "dataset", "lo": 5.0, "hi": log10(2.0e11)}
    assert ranges["youngs_modulus"] == pytest.approx(modulus)
    assert ranges["poissons_ratio"]["log10"] is False


def test_every_chunk_of_every_array_ends_with_a_checksum(root):
    arrays = [part for _, part in root.members(max_depth=None) if isinstance(part, zarr.Array)]
    assert {array.name for array in arrays} >= {"/asset/record", "/asset/property", "/grid/x"}
    for array in arrays:
        codecs = array.metadata.to_dict()["codecs"]
        if codecs[0]["name"] == "sharding_indexed":
            codecs = codecs[0]["configuration"]["codecs"]
        assert codecs[-1]["name"] == "crc32c", array.name


def test_one_file_a_shard_and_one_read_to_open(root, mixed_build):
    store, n_voxels = mixed_build.store, root["voxel/coords"].shape[0]
    shards = -(-n_voxels // (SMALL_SHARDS.voxel_chunk * SMALL_SHARDS.voxel_chunks_per_shard))
    assert shards > len(IDS)  # Assets are cut by shards, or this would show little.
    for name, files in (("voxel/coords", shards), ("voxel/valid", shards), ("grid/material", 3)):
        assert sum(path.is_file() for path in (store / name / "c").rglob("*")) == files
    document = json.loads((store / "zarr.json").read_text())
    assert "voxel/coords" in document["consolidated_metadata"]["metadata"]


@pytest.mark.parametrize("group", ["asset", "voxel", "grid"])
def test_xarray_opens_every_group_with_named_dimensions(store, group):
    arrays = zarr.open_group(store, mode="r")[group]
    with xarray.open_zarr(store, group=group, chunks=None) as dataset:
        for layout in ARRAYS:
            where, _, name = layout.name.partition("/")
            if where == group:
                assert dataset[name].dims == layout.dimensions
                assert dataset[name].attrs["description"] == layout.description
                np.testing.assert_array_equal(dataset[name].values, arrays[name][:])


@pytest.mark.parametrize(
    "layout", [layout for layout in ARRAYS if layout.dtype != "str"], ids=lambda layout: layout.name
)
def test_tensorstore_reads_the_same_numbers(store, layout):
    name = layout.name  # type: ignore[attr-defined]
    spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{store / name}/"}}
    array = tensorstore.open(spec, read=True, open=True).result()
    ours = zarr.open_group(store, mode="r")[name]
    assert array.domain.labels == ours.metadata.dimension_names
    assert array.dtype.numpy_dtype == ours.dtype
    read = array.read().result()
    assert read.size > 0
    np.testing.assert_array_equal(read, ours[...])


def test_what_others_cannot_open_is_what_the_page_says(store):
    with xarray.open_zarr(store) as root:
        assert not root.variables
    with xarray.open_datatree(store, engine="zarr") as tree:
        assert {"asset", "voxel", "grid"} <= set(tree.children)
        assert tree["voxel/coords"].shape[1] == 3
    for layout in ARRAYS:
        if layout.dtype == "str":
            path = f"{store / layout.name}/"
            spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": path}}
            with pytest.raises(ValueError, match="data_type"):
                tensorstore.open(spec, read=True, open=True).result()


def test_coordinates_name_rows_columns_and_places(store):
    group = zarr.open_group(store, mode="r")
    with xarray.open_zarr(store, group="asset") as assets:
        assert set(assets.coords) == {"id", "object_id", "view", "category", "property"}
        row = int(np.flatnonzero(assets["id"].values == "dog")[0])
        assert assets["fitness"][row] == group["asset/fitness"][row]
    with xarray.open_zarr(store, group="voxel") as voxels:
        density = voxels["properties"].sel(property="density")
        np.testing.assert_array_equal(density.values, group["voxel/properties"][:, 1])
        assert list(voxels["axis"].values) == ["x", "y", "z"]
    with xarray.open_zarr(store, group="grid") as grids:
        assert set(grids.coords) == {"property", "x", "y", "z"}
        assert grids["x"].values[0] == -0.5 + 0.5 / 64
        there = grids["material"].sel(x=0.1, y=-0.1, z=0.02, method="nearest")
        np.testing.assert_array_equal(there.values, group["grid/material"][:, 38, 25, 33])
