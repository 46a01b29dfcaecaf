"""Stores made of stores are those that a build of their assets would have made."""

import json
import shutil
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.made_store import edit_attributes, rewrite
from support.synthetic import Dataset, make_asset
from support.trees import copied, records_of, tree

from slatprep import ConfigError, StoreError, build_store, concat_stores, open_store, subset_store
from slatprep.inspect.verify import verify_store
from slatprep.records import Units
from slatprep.store.records import build_in


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return where stores of two parts of a dataset and of the whole lie, with Pixie's ranges."""
    folder = tmp_path_factory.mktemp("parts")
    for name in ("ac", "bd", "abcd"):
        dataset = Dataset(folder / name)
        for object_id in name:
            views = ("front", "side") if object_id == "b" else ("",)
            dataset.add(object_id, "abcd".index(object_id), views=views)
        build_store(dataset.parameters("pixie"), folder / f"{name}.zarr")
    return folder


def test_a_subset_is_the_build_of_its_assets(folder, tmp_path):
    whole = open_store(folder / "abcd.zarr")
    summary = subset_store(whole, tmp_path / "s.zarr", ["d", "b.s", "b.front"])
    assert summary.statuses == {"ok": 3, "failed": 0, "skipped": 0}
    assert tree(tmp_path / "s.zarr") == tree(folder / "bd.zarr")
    assert verify_store(tmp_path / "s.zarr", sources=True).ok
    built = records_of(folder / "bd.manifests" / "assets.jsonl")
    assert records_of(tmp_path / "s.manifests" / "assets.jsonl") == built


def test_a_store_that_was_replaced_since_it_was_opened_is_refused(folder, tmp_path):
    """A number would mean another asset of the new store."""
    path = copied(folder / "abcd.zarr", tmp_path / "w.zarr")
    opened = open_store(path)
    assert opened.ids[0] == "a" and opened.columns_of(["density"])
    shutil.rmtree(path)
    shutil.copytree(folder / "bd.zarr", path)
    for make in (subset_store, lambda *given: concat_stores(given[0:1] * 2, given[1])):
        with pytest.raises(StoreError, match=r"was the store replaced\?\); open it again"):
            make(opened, tmp_path / "s.zarr", [0])


@pytest.mark.parametrize("ranges", ["dataset", "p1-p99", "dataset of train"])
def test_an_update_of_a_subset_has_the_ranges_of_its_own_dataset(make_dataset, tmp_path, ranges):
    dataset, out = make_dataset("a", "b"), tmp_path / "s.zarr"
    # Else all assets have the same ranges.
    dataset.write_grid("b", dataset.assets["b"].grid * [1, 2, 1, 1])
    named, _, trained = ranges.partition(" of ")
    (lists := tmp_path / "lists.json").write_text('{"train": ["a", "b"]}')
    how: dict[str, object] = {"objects": "train", "split_by": str(lists)} if trained else {}
    parameters = dataset.parameters(named, normalize=how)
    build_store(parameters, tmp_path / "all.zarr")
    subset_store(tmp_path / "all.zarr", out, ["a"])
    assert open_store(out).normalization == open_store(tmp_path / "all.zarr").normalization
    dataset.remove("b")
    build_store(parameters, out)
    build_store(parameters, tmp_path / "first.zarr")
    assert tree(out) == tree(tmp_path / "first.zarr")


def test_a_store_joined_in_two_ways_is_the_same(tmp_path):
    """Names, versions and roots are told once, also where a part was joined before."""
    stores = [tmp_path / f"{name}.zarr" for name in "abc"]
    for name, path in zip("xyy", stores, strict=True):
        dataset = Dataset(tmp_path / path.stem).having(path.stem)
        build_store(replace(dataset.parameters("pixie"), name=name), path)
    concat_stores(stores, tmp_path / "one.zarr")
    concat_stores(stores[:2], tmp_path / "ab.zarr")
    concat_stores([tmp_path / "ab.zarr", stores[2]], tmp_path / "two.zarr")
    assert open_store(tmp_path / "two.zarr").attributes["build"]["name"] == "x + y"
    assert tree(tmp_path / "one.zarr") == tree(tmp_path / "two.zarr")
    subset_store(tmp_path / "two.zarr", tmp_path / "c.part.zarr", ["c"])
    concat_stores([tmp_path / "ab.zarr", tmp_path / "c.part.zarr"], tmp_path / "three.zarr")
    one, three = (build_in(tmp_path / f"{name}.manifests") for name in ("one", "three"))
    assert three.parameters.slat.root == one.parameters.slat.root


def test_a_text_is_one_asset_and_nothing_is_no_place(folder, tmp_path):
    assert subset_store(folder / "abcd.zarr", tmp_path / "s.zarr", "b.front").statuses["ok"] == 1
    with pytest.raises(TypeError, match="None is no place; expected a path or a URL"):
        subset_store(folder / "abcd.zarr", None, ["d"])  # type: ignore[arg-type]


def test_a_subset_by_verdict_or_category_is_that_of_the_command(copy, tmp_path):
    rewrite(copy, "asset/verdict", slice(1, 3), np.array(["failed", "doubtful"], dtype=object))
    rewrite(copy, "asset/category", 0, "a kind")
    ids = open_store(copy).ids
    subset_store(copy, tmp_path / "s.zarr", verdicts="failed", categories=())
    assert open_store(tmp_path / "s.zarr").ids == ids[1:2]
    subset_store(copy, tmp_path / "s.zarr", [2], verdicts=["good"], categories="a kind")
    assert open_store(tmp_path / "s.zarr").ids == [ids[0], ids[2]]
    run("subset", copy, "--asset", ids[2], "--verdict", "good", "--category", "a kind",
        "--out", tmp_path / "t.zarr")  # fmt: skip
    assert tree(tmp_path / "t.zarr") == tree(tmp_path / "s.zarr")
    for wrong in ({"verdicts": "fine"}, {"categories": ["none"]}, {}):
        with pytest.raises(ConfigError, match="expected"):
            subset_store(copy, tmp_path / "s.zarr", **wrong)


def test_joined_stores_are_the_build_of_all_their_assets(folder, tmp_path):
    concat_stores([open_store(folder / "bd.zarr"), folder / "ac.zarr"], tmp_path / "all.zarr")
    assert tree(tmp_path / "all.zarr") == tree(folder / "abcd.zarr")
    assert verify_store(tmp_path / "all.zarr").ok


def build_parts_and_whole(folder: Path, *grids: np.ndarray) -> None:
    """Build a store of each of two assets with these grids, and one of both."""
    whole = Dataset(folder / "both").having(*"ab")
    for number, (name, grid) in enumerate(zip("ab", grids, strict=True)):
        part = Dataset(folder / name).having(name, seed=number)
        for dataset in (part, whole):
            dataset.write_grid(name, grid)
        build_store(part.parameters(), folder / f"{name}.zarr")
    build_store(whole.parameters(), folder / "whole.zarr")


def test_stores_with_ranges_of_their_own_get_those_of_all(tmp_path):
    # Else all assets have the same ranges.
    build_parts_and_whole(tmp_path, make_asset(0).grid, make_asset(1).grid * [1, 2, 1, 1])
    ours = [open_store(tmp_path / f"{name}.zarr").normalization for name in "ab"]
    assert ours[0] != ours[1]

    summary = concat_stores([tmp_path / "a.zarr", tmp_path / "b.zarr"], tmp_path / "all.zarr")
    (told,) = summary.warnings
    assert f"not those of {tmp_path / 'a.zarr'} (and 1 other store): hi of youngs_mod" in told
    assert verify_store(tmp_path / "all.zarr").ok
    joined, built = open_store(tmp_path / "all.zarr"), open_store(tmp_path / "whole.zarr")
    assert joined.normalization == built.normalization
    for one, other in zip(joined, built, strict=True):
        for name in ("coords", "feats", "material", "valid", "distance", "place", "confidence"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("properties", "grid_properties"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-6)
    for name in ("clipped", "clipped_grid"):
        lost = copied(tmp_path / "b.zarr", tmp_path / f"{name}.zarr")
        rewrite(lost, f"asset/{name}", 0, (0, 1, 0))
        told = "values of b were clipped to its ranges, so it cannot"
        with pytest.raises(StoreError, match=told):
            concat_stores([tmp_path / "a.zarr", lost], tmp_path / "all.zarr")


def test_what_ties_change_is_told_in_the_ranges_of_all(tmp_path):
    """A cube of two halves, whose turns give other properties."""
    grid = np.full((64, 64, 64, 4), (0, 0, 0, 7), np.float32)
    grid[24:40, 24:40, 24:40] = 1e3, 1e6, 0.3, 0
    grid[24:32, 24:40, 24:40] = 8e3, 2e11, 0.28, 1
    coords = np.argwhere(grid[..., 3] < 7).astype(np.uint8)
    feats = np.random.default_rng(0).normal(0.0, 3.0, (len(coords), 8)).astype(np.float32)
    for name, ids in (("a", "a"), ("b", "b"), ("all", "ab")):
        dataset = Dataset(tmp_path / name).having(*ids)
        if "a" in ids:
            dataset.write_grid("a", grid)
            dataset.write_slat("a.npz", coords, feats)
        build_store(dataset.parameters(), tmp_path / f"{name}.zarr")
    concat_stores([tmp_path / "a.zarr", tmp_path / "b.zarr"], tmp_path / "joined.zarr")
    stores = [open_store(tmp_path / f"{name}.zarr") for name in ("a", "all", "joined")]
    alone, built, joined = (store.column("property_ambiguity")[0] for store in stores)
    np.testing.assert_array_equal(joined, built)
    assert (built > 0).any() and not np.array_equal(alone, built)


def test_one_value_of_a_store_is_a_point_in_the_ranges_of_all(tmp_path):
    grids = make_asset(0).grid, make_asset(1).grid
    for grid, most in zip(grids, (0.3, 0.34), strict=True):
        occupied = grid[..., 3] != 7
        grid[occupied, 2] = np.linspace(0.3, most, occupied.sum())
    build_parts_and_whole(tmp_path, *grids)
    assert open_store(tmp_path / "a.zarr").normalization.ranges[2].hi == pytest.approx(0.8)
    concat_stores([tmp_path / "a.zarr", tmp_path / "b.zarr"], tmp_path / "all.zarr")
    joined, built = open_store(tmp_path / "all.zarr"), open_store(tmp_path / "whole.zarr")
    assert joined.normalization == built.normalization
    for one, other in zip(joined, built, strict=True):
        np.testing.assert_allclose(one.properties, other.properties, atol=1e-5)


def test_what_does_not_go_together_is_refused(folder, make_dataset, tmp_path):
    ac, out, other = folder / "ac.zarr", tmp_path / "out.zarr", make_dataset("x")
    build_store(other.parameters(), tmp_path / "x.zarr")
    build_store(other.parameters("pixie", align={"model": "rigid"}), tmp_path / "rigid.zarr")
    for stores, told in (
        ([folder / "abcd.zarr", ac], "the stores share 2 ids, such as a, c"),
        ([ac], "1 store to join; expected two or more"),
        (str(ac), "1 store to join"),
        ([ac, tmp_path / "x.zarr"], "not those of the others"),
        ([ac, tmp_path / "rigid.zarr"], r"rigid\.zarr was built with \[align\]"),
    ):
        with pytest.raises(ConfigError, match=told):
            concat_stores(stores, out)
    with pytest.raises(ConfigError, match="1 store to join"):
        concat_stores(open_store(ac), out)
    with pytest.raises(StoreError, match="has no asset 'z'"):
        subset_store(ac, out, ["z"])
    with pytest.raises(ConfigError, match="expected one at least"):
        subset_store(ac, out, verdicts=iter([]), categories=iter([]))
    with pytest.raises(ConfigError, match="expected one at least"):
        subset_store(ac, out, [])
    assert not out.exists()


def test_latents_that_were_standardised_by_other_moments_are_not_joined(folder, tmp_path):
    """Raw ones are, and their moments are pooled."""
    stores = [copied(folder / f"{name}.zarr", tmp_path / f"{name}.zarr") for name in ("ac", "bd")]
    for standardised in (False, True):
        for path, mean in zip(stores, (1.0, 2.0), strict=True):
            latents = open_store(path).attributes["latents"]
            of = {"mean": [mean] * 8, "std": [3.0] * 8, "standardised": standardised}
            edit_attributes(path, latents=latents | of)
        if standardised:
            with pytest.raises(ConfigError, match=r"standardised: True by mean \(2\.0, .*the same"):
                concat_stores(stores, tmp_path / "out.zarr")
        else:
            concat_stores(stores, tmp_path / "raw.zarr")
    pooled = open_store(tmp_path / "raw.zarr").contents.latents
    feats = np.concatenate([asset.feats for asset in open_store(tmp_path / "raw.zarr")])
    np.testing.assert_allclose(pooled.mean, feats.mean(axis=0, dtype=np.float64), atol=1e-5)


def test_equal_ranges_of_files_with_other_names_are_joined(make_dataset, tmp_path):
    for name in ("a", "b"):
        file = tmp_path / f"ranges of {name}.toml"
        spans = {"youngs_modulus": (3, 11), "density": (1, 4), "poissons_ratio": (0.1, 0.5)}
        file.write_text("".join(f"[{k}]\nlo = {lo}\nhi = {hi}\n" for k, (lo, hi) in spans.items()))
        build_store(
            Dataset(tmp_path / name).having(name).parameters(str(file)), tmp_path / f"{name}.zarr"
        )
    concat_stores([tmp_path / "a.zarr", tmp_path / "b.zarr"], tmp_path / "ab.zarr")
    joined = open_store(tmp_path / "ab.zarr")
    assert joined.normalization.source == "ranges of a.toml"
    for name in ("a", "b"):
        own = open_store(tmp_path / f"{name}.zarr")[name]
        np.testing.assert_array_equal(joined[name].properties, own.properties)


def test_a_source_is_never_replaced_whatever_path_leads_there(folder, tmp_path, monkeypatch):
    shutil.copytree(folder / "ac.zarr", tmp_path / "own.zarr")
    before = tree(tmp_path / "own.zarr")
    (tmp_path / "link.zarr").symlink_to("own.zarr")
    monkeypatch.chdir(tmp_path)
    names = "own.zarr", "link.zarr", f"../{tmp_path.name}/own.zarr", tmp_path / "own.zarr"
    for source, out in product(names, names):
        with pytest.raises(ConfigError, match="is a store to take assets from"):
            subset_store(source, out, ["a"])
        with pytest.raises(ConfigError, match="is a store to take assets from"):
            concat_stores([source, folder / "bd.zarr"], out)
    assert tree(tmp_path / "own.zarr") == before


@pytest.mark.parametrize("how", ["none", "broken", "stale"])
def test_records_beside_a_store_are_taken_only_if_they_are_of_its_build(folder, tmp_path, how):
    store = copied(folder / "ac.zarr", tmp_path / "s.zarr")
    file = tmp_path / "s.manifests" / "build.json"
    if how == "none":
        file.unlink()
    elif how == "broken":
        file.write_text("[" * 100_000)
    else:
        shutil.copy(folder / "bd.manifests" / "build.json", file)
    summary = subset_store(store, tmp_path / "a.zarr", ["a"])
    told = json.loads((summary.records.parent / "build.json").read_text())
    assert told["parameters"]["pixieverse"]["root"] == "unknown"


def test_a_joined_store_says_of_its_sources_what_is_true_of_all(tmp_path):
    for name, samples in (("a", "one"), ("b", "first")):
        dataset = Dataset(tmp_path / name).having(name)
        units = {"youngs_modulus": "kPa"}
        how = {"samples": samples, "units": units, "plausibility": "off"}
        parameters = dataset.parameters("pixie", pixieverse=how, slat={"encoder": "sam3d"})
        build_store(parameters, tmp_path / f"{name}.zarr")
    stores = tmp_path / "a.zarr", tmp_path / "b.zarr"
    joined = build_in(concat_stores(stores, tmp_path / "ab.zarr").records.parent).parameters
    assert joined.pixieverse.units == Units(youngs_modulus="kPa")
    assert (joined.pixieverse.samples, joined.slat.encoder) == ("one", "sam3d")
    assert str(joined.slat.root) == f"{tmp_path / 'a/slat'} | {tmp_path / 'b/slat'}"
    shutil.rmtree(tmp_path / "a.manifests")
    alone = build_in(subset_store(stores[0], tmp_path / "s.zarr", ["a"]).records.parent).parameters
    assert (str(alone.slat.root), alone.slat.encoder) == ("unknown", "sam3d")


def test_a_store_whose_attributes_do_not_say_how_it_was_built_is_refused(copy, tmp_path):
    build = json.loads((copy / "zarr.json").read_text())["attributes"]["build"]
    build["parameters"]["align"]["unheard_of"] = 1
    edit_attributes(copy, build=build)
    with pytest.raises(StoreError, match="does not say how it was built"):
        subset_store(copy, tmp_path / "out.zarr", ["ant"])
