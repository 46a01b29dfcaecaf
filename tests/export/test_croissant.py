"""What mlcroissant makes of a store's description, and where its files are found."""

import glob
import json
from pathlib import Path

import mlcroissant
import numpy as np
import zarr
from support.commands import run

from slatprep.export.croissant import Stated, describe, to_json
from slatprep.store import open_store
from slatprep.store.layout import ARRAYS

STATED = {
    "license": "https://creativecommons.org/licenses/by/4.0/",
    "url": "https://example.org/dataset",
    "cite_as": "Someone (2026)",
    "date_published": "2026-01-31",
}


def test_croissant_is_valid_without_a_warning(store, tmp_path, caplog):
    path = tmp_path / "croissant.json"
    path.write_text(to_json(describe(open_store(store), Stated(**STATED))), encoding="utf-8")
    dataset = mlcroissant.Dataset(jsonld=path)  # raises where the description is invalid
    assert dataset.metadata.ctx.issues.report() == ""
    assert caplog.text == ""
    assert dataset.metadata.name == store.stem
    sets = {node.id for node in dataset.metadata.distribution}
    assert sets >= {layout.name for layout in ARRAYS}


def test_croissant_s_records_are_the_store_s(store, tmp_path):
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


def test_croissant_describes_figures_that_are_not_numbers(store, tmp_path):
    opened = open_store(store)
    figures = opened.column("inlier_rmse").copy()
    figures[0] = np.nan
    read = opened.column
    opened.column = lambda name: figures if name == "inlier_rmse" else read(name)
    path = tmp_path / "croissant.json"
    path.write_text(to_json(describe(opened)), encoding="utf-8")
    rows = list(mlcroissant.Dataset(jsonld=path).records("assets"))
    assert np.isnan(rows[0]["assets/inlier_rmse"]) and rows[1]["assets/inlier_rmse"] == figures[1]


def test_describe_writes_where_the_files_are_found(store, tmp_path):
    out = store.parent / "description" / "croissant.json"
    run("describe", store, "--out", out, "--name", "mine", "-q")
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
    printed = run("describe", store, "--location", "https://example.org/s.zarr/")
    (root, *_) = json.loads(printed.stdout)["distribution"]
    assert root["contentUrl"] == "https://example.org/s.zarr/zarr.json"
