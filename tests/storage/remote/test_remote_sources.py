"""Builds whose sources lie on S3."""

import json
from dataclasses import replace

import h5py
import pytest
from support.faults import inject

from slatprep import ConfigError, discover, load_parameters, open_store
from slatprep.parameters import SlatSource
from slatprep.pipeline.dataset import build_store, plan_build


def test_each_place_is_listed_once_and_each_file_fetched_once(uploaded, tmp_path, requests):
    summary = build_store(uploaded, tmp_path / "s.zarr", progress=lambda done, total: None)
    fetched = requests.of("get_object")
    assert len(fetched) == len(set(fetched)) == 6
    whole = [listed for listed in requests.of("list_objects_v2") if listed.endswith("*")]
    assert sorted(whole) == ["data/pixieverse/*", "data/slat/*"]
    assert len(requests.made) < 6 + 2 + 20  # and some to see what the roots are
    build = json.loads(summary.records.with_name("build.json").read_text())
    assert build["parameters"]["slat"]["root"] == str(uploaded.slat.root)
    assert plan_build(uploaded, tmp_path / "s.zarr").actions["reuse"] == 3


def test_a_definition_may_name_urls(uploaded, s3, bucket, tmp_path):
    s3.pipe_file(f"{bucket}/map.csv", b"object_id,slat_id\na,b\n")
    categories = {name: {"obj_class": "cup"} for name in "abc"}
    s3.pipe_file(f"{bucket}/categories.json", json.dumps(categories).encode())
    (tmp_path / "dataset.toml").write_text(
        f"""
        [pixieverse]
        root = "{uploaded.pixieverse.root}"
        [slat]
        root = "{uploaded.slat.root}"
        [pairing]
        map = "s3://{bucket}/map.csv"
        categories = "s3://{bucket}/categories.json"
        """
    )
    pairs = {pair.asset_id: pair for pair in discover(load_parameters(tmp_path / "dataset.toml"))}
    assert str(pairs["a"].slat) == f"{uploaded.slat.root}/b.npz"
    assert pairs["a"].category == "cup"
    assert "no SLAT" in pairs["b"].problem


@pytest.mark.parametrize("place", ["s3://no-such-bucket/x", "s3://{bucket}/none"])
def test_a_root_that_is_not_there_is_named(uploaded, bucket, place, tmp_path):
    place = place.format(bucket=bucket)
    with pytest.raises(ConfigError, match=f"^{place}: does not exist"):
        build_store(replace(uploaded, slat=SlatSource(place)), tmp_path / "s.zarr")
    roots = {"pixieverse": {"root": str(uploaded.pixieverse.root)}, "slat": {"root": place}}
    with pytest.raises(ConfigError, match=f"slat.root: {place} does not exist"):
        load_parameters(None, roots)


def test_torn_and_lost_objects_cost_their_assets_alone(uploaded, s3, bucket, tmp_path, monkeypatch):
    s3.pipe_file(f"{bucket}/data/slat/b.npz", s3.cat_file(f"{bucket}/data/slat/b.npz")[:1000])
    grid = f"s3://{bucket}/data/pixieverse/c/sample_0/material_grid.npy"
    inject(monkeypatch, lambda step, name: (step, name) == ("asset begun", "c") and s3.rm(grid))
    problems = dict(build_store(uploaded, tmp_path / "s.zarr").problems)
    assert open_store(tmp_path / "s.zarr").ids == ["a"]
    assert f"s3://{bucket}/data/slat/b.npz: is no readable npz archive" in problems["b"]
    assert problems["c"].startswith(f"{grid}: does not exist")


def test_one_hdf5_file_of_all_is_copied_once(uploaded, undisturbed, s3, bucket, tmp_path, requests):
    dataset, expected = undisturbed
    with h5py.File(tmp_path / "all.h5", "w") as file:
        for asset_id, asset in dataset.assets.items():
            file[f"{asset_id}/coords"], file[f"{asset_id}/feats"] = asset.coords, asset.feats
    place = f"s3://{bucket}/all.h5"
    s3.put_file(str(tmp_path / "all.h5"), place)
    parameters = replace(uploaded, slat=SlatSource(place))
    requests.made.clear()
    build_store(parameters, tmp_path / "s.zarr")
    assert requests.of("get_object").count("all.h5") == 1
    built, known = open_store(tmp_path / "s.zarr"), open_store(expected)
    assert built.ids == known.ids
    for row in range(3):
        assert (built.read(row)["feats"] == known.read(row)["feats"]).all()
    assert plan_build(parameters, tmp_path / "s.zarr").actions["reuse"] == 3
