"""What others' readers make of a store: xarray, tensorstore, zarr-python."""

from pathlib import Path

import numpy as np
import pytest
import tensorstore
import xarray
import zarr

from slatprep.pipeline.dataset import BuildSummary
from slatprep.store.layout import ARRAYS


@pytest.fixture
def store(mixed_build: BuildSummary) -> Path:
    assert mixed_build.store is not None
    return mixed_build.store


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
