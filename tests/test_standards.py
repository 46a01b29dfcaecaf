"""What others' tools make of a store: mlcroissant, xarray, tensorstore, zarr-python."""

from __future__ import annotations

import glob
import json
from pathlib import Path

import mlcroissant
import numpy as np
import pytest
import tensorstore
import xarray
import zarr
from click.testing import CliRunner

from slatprep.cli.commands import slatprep
from slatprep.export.croissant import describe, to_json
from slatprep.pipeline.dataset import BuildSummary
from slatprep.store import open_store
from slatprep.store.layout import ARRAYS

STATED = {
    "license": "https://creativecommons.org/licenses/by/4.0/",
    "url": "https://example.org/dataset",
    "cite_as": "Someone (2026)",
    "date_published": "2026-01-31",
}


@pytest.fixture
def store(mixed_build: BuildSummary) -> Path:
    assert mixed_build.store is not None
    return mixed_build.store


# -- Croissant --------------------------------------------------------------


def test_croissant_is_valid_without_a_warning(
    store: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "croissant.json"
    path.write_text(to_json(describe(open_store(store), **STATED)), encoding="utf-8")
    dataset = mlcroissant.Dataset(jsonld=path)  # raises where the description is invalid
    assert dataset.metadata.ctx.issues.report() == ""
    assert caplog.text == ""
    assert dataset.metadata.name == store.stem
    sets = {node.id for node in dataset.metadata.distribution}
    assert sets >= {layout.name for layout in ARRAYS}


def test_croissant_s_records_are_the_store_s(store: Path, tmp_path: Path) -> None:
    path = tmp_path / "croissant.json"
    path.write_text(to_json(describe(open_store(store))), encoding="utf-8")
    dataset = mlcroissant.Dataset(jsonld=path)
    group = zarr.open_group(store, mode="r")
    assets = list(dataset.records("assets"))
    assert [row["assets/id"] for row in assets] == list(group["asset/id"][:])
    np.testing.assert_array_equal(
        [row["assets/fitness"] for row in assets], group["asset/fitness"][:]
    )
    offsets = group["asset/offset"][:]
    assert [row["assets/first_row"] for row in assets] == offsets[:-1].tolist()
    assert [row["assets/end_row"] for row in assets] == offsets[1:].tolist()
    materials = {row["materials/id"]: row["materials/name"] for row in dataset.records("materials")}
    assert [materials[k] for k in range(8)] == group.attrs["material_classes"]
    for row in dataset.records("properties"):
        stated = group.attrs["normalization"][row["properties/name"]]
        assert (row["properties/lo"], row["properties/hi"]) == (stated["lo"], stated["hi"])


def test_croissant_describes_figures_that_are_not_numbers(store: Path, tmp_path: Path) -> None:
    opened = open_store(store)
    figures = opened.column("inlier_rmse").copy()
    figures[0] = np.nan
    read = opened.column
    opened.column = lambda name: figures if name == "inlier_rmse" else read(name)  # type: ignore[method-assign]
    path = tmp_path / "croissant.json"
    path.write_text(to_json(describe(opened)), encoding="utf-8")
    rows = list(mlcroissant.Dataset(jsonld=path).records("assets"))
    assert np.isnan(rows[0]["assets/inlier_rmse"]) and rows[1]["assets/inlier_rmse"] == figures[1]


def test_describe_writes_where_the_files_are_found(store: Path, tmp_path: Path) -> None:
    out = store.parent / "description" / "croissant.json"
    arguments = ["describe", str(store), "--out", str(out), "--name", "mine", "-q"]
    result = CliRunner().invoke(slatprep, arguments)
    assert result.exit_code == 0, result.output
    document = json.loads(out.read_text("utf-8"))
    assert document["name"] == "mine"
    for entry in document["distribution"]:
        if "contentUrl" in entry:
            assert (out.parent / entry["contentUrl"]).is_file()
        else:  # pathlib's own ** finds folders alone
            found = glob.glob(str(out.parent / entry["includes"]), recursive=True)  # noqa: PTH207
            files = [Path(path) for path in found if Path(path).is_file()]
            assert any(path.name == "zarr.json" for path in files)
            # Of an array of one value alone, its fill value, Zarr writes no chunk.
            assert len(files) >= (2 if entry["@id"].startswith("voxel/") else 1)
    printed = CliRunner().invoke(
        slatprep, ["describe", str(store), "--location", "https://example.org/s.zarr/"]
    )
    (root, *_) = json.loads(printed.stdout)["distribution"]
    assert root["contentUrl"] == "https://example.org/s.zarr/zarr.json"


# -- xarray, tensorstore, zarr-python ---------------------------------------


@pytest.mark.parametrize("group", ["asset", "voxel", "grid"])
def test_xarray_opens_every_group_with_named_dimensions(store: Path, group: str) -> None:
    with xarray.open_zarr(store, group=group) as dataset:
        for layout in ARRAYS:
            where, _, name = layout.name.partition("/")
            if where == group:
                assert dataset[name].dims == layout.dimensions
                assert dataset[name].attrs["description"] == layout.description
                np.testing.assert_array_equal(
                    dataset[name].values, zarr.open_group(store, mode="r")[layout.name][:]
                )


@pytest.mark.parametrize(
    "layout", [layout for layout in ARRAYS if layout.dtype != "str"], ids=lambda layout: layout.name
)
def test_tensorstore_reads_the_same_numbers(store: Path, layout: object) -> None:
    name = layout.name  # type: ignore[attr-defined]
    spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{store / name}/"}}
    array = tensorstore.open(spec, read=True, open=True).result()
    ours = zarr.open_group(store, mode="r")[name]
    assert array.domain.labels == ours.metadata.dimension_names
    assert array.dtype.numpy_dtype == ours.dtype
    read = array.read().result()
    assert read.size > 0
    np.testing.assert_array_equal(read, ours[...])


def test_coordinates_name_rows_columns_and_places(store: Path) -> None:
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
