"""Stores made of stores are those that a build of their assets would have made."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from support.synthetic import Dataset, Made
from support.trees import records_of, tree

from slatprep.cli.commands import slatprep
from slatprep.errors import ConfigError, StoreError
from slatprep.inspect.verify import verify_store
from slatprep.parameters import AlignParameters
from slatprep.pipeline.dataset import build_store
from slatprep.pipeline.join import concat_stores, subset_store
from slatprep.store import open_store


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Return a dataset of five rows, built with Pixie's ranges: whole, and in two parts."""
    folder = tmp_path_factory.mktemp("parts")
    whole = Dataset(folder / "whole")
    named = {"a": 0, "b": 1, "c": 2, "d": 3}
    for object_id, seed in named.items():
        whole.add(object_id, seed, views=("front", "side") if object_id == "b" else ("",))
    build_store(whole.parameters("pixie"), folder / "whole.zarr")
    for part in ("ac", "bd"):
        some = Dataset(folder / part)
        for object_id in part:
            some.add(
                object_id, named[object_id], views=("front", "side") if object_id == "b" else ("",)
            )
        build_store(some.parameters("pixie"), folder / f"{part}.zarr")
    return whole, folder


def test_a_subset_is_the_build_of_its_assets(parts, tmp_path):
    _, folder = parts
    summary = subset_store(folder / "whole.zarr", tmp_path / "s.zarr", ["d", "b.s", "b.front"])
    assert summary.statuses == {"ok": 3, "failed": 0, "skipped": 0}
    assert tree(tmp_path / "s.zarr") == tree(folder / "bd.zarr")
    assert verify_store(tmp_path / "s.zarr", sources=True).ok
    built = records_of(folder / "bd.manifests" / "assets.jsonl")
    assert records_of(tmp_path / "s.manifests" / "assets.jsonl") == built


def test_joined_stores_are_the_build_of_all_their_assets(parts, tmp_path):
    _, folder = parts
    concat_stores([folder / "bd.zarr", folder / "ac.zarr"], tmp_path / "all.zarr")
    assert tree(tmp_path / "all.zarr") == tree(folder / "whole.zarr")
    assert verify_store(tmp_path / "all.zarr").ok


def test_stores_with_ranges_of_their_own_get_those_of_all(make_dataset, tmp_path):
    whole = make_dataset("a", "b")
    build_store(whole.parameters(), tmp_path / "whole.zarr")
    for number, object_id in enumerate("ab"):
        part = Dataset(tmp_path / object_id)
        asset = replace(whole.assets[object_id])
        asset.grid = asset.grid.copy()
        asset.grid[..., 1] *= 1.0 + number  # Else all assets have the same ranges.
        part.write_grid(object_id, asset.grid)
        part.write_slat(f"{object_id}.npz", asset.coords, asset.feats)
        whole.write_grid(object_id, asset.grid)
        build_store(part.parameters(), tmp_path / f"{object_id}.zarr")
    build_store(whole.parameters(), tmp_path / "whole.zarr")
    ours = [open_store(tmp_path / f"{name}.zarr").normalization for name in "ab"]
    assert ours[0] != ours[1]

    concat_stores([tmp_path / "a.zarr", tmp_path / "b.zarr"], tmp_path / "all.zarr")
    assert verify_store(tmp_path / "all.zarr").ok
    joined, built = open_store(tmp_path / "all.zarr"), open_store(tmp_path / "whole.zarr")
    assert joined.normalization == built.normalization
    for one, other in zip(joined, built, strict=True):
        for name in ("coords", "feats", "material", "valid", "distance", "place", "confidence"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("properties", "grid_properties"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-6)


def test_what_does_not_go_together_is_refused(parts, make_dataset, tmp_path):
    _, folder = parts
    out = tmp_path / "out.zarr"
    with pytest.raises(ConfigError, match=r"2 ids are in more than one store, such as a, c"):
        concat_stores([folder / "whole.zarr", folder / "ac.zarr"], out)
    with pytest.raises(ConfigError, match="expected two or more"):
        concat_stores([folder / "ac.zarr"], out)
    other = make_dataset("x")
    build_store(other.parameters(), tmp_path / "x.zarr")
    with pytest.raises(ConfigError, match="not those of the others"):
        concat_stores([folder / "ac.zarr", tmp_path / "x.zarr"], out)
    rigid = replace(other.parameters("pixie"), align=AlignParameters(model="rigid"))
    build_store(rigid, tmp_path / "rigid.zarr")
    with pytest.raises(ConfigError, match=r"rigid\.zarr was built with \[align\]"):
        concat_stores([folder / "ac.zarr", tmp_path / "rigid.zarr"], out)
    with pytest.raises(StoreError, match="has no asset 'z'"):
        subset_store(folder / "ac.zarr", out, ["z"])
    with pytest.raises(ConfigError, match="expected one at least"):
        subset_store(folder / "ac.zarr", out, [])
    with pytest.raises(ConfigError, match="choose another path"):
        subset_store(folder / "ac.zarr", folder / "ac.zarr", ["a"])
    assert not out.exists()


def test_commands_choose_and_join(mixed_build, tmp_path):
    store = tmp_path / "mixed.zarr"
    shutil.copytree(str(mixed_build.store), store)  # without the records beside it
    parts = []
    for name, options in (
        ("one", ["--asset", "an"]),
        ("two", ["--asset", "bear.s", "--asset", "d"]),
    ):
        parts.append(str(tmp_path / f"{name}.zarr"))
        made = CliRunner().invoke(slatprep, ["subset", str(store), "--out", parts[-1], *options])
        assert made.exit_code == 0, made.output
    both = tmp_path / "both.zarr"
    made = CliRunner().invoke(slatprep, ["concat", *parts, "--out", str(both), "--json"])
    assert made.exit_code == 0, made.output
    assert open_store(both).ids == ["ant", "bear.side", "dog"]
    assert verify_store(both).ok
    good = CliRunner().invoke(
        slatprep, ["subset", str(store), "--verdict", "good", "--out", str(tmp_path / "all.zarr")]
    )
    assert good.exit_code == 0, good.output
    assert len(open_store(tmp_path / "all.zarr")) == 5
    assert CliRunner().invoke(slatprep, ["subset", str(store), "--out", "x.zarr"]).exit_code == 2


def test_a_source_is_never_replaced_whatever_path_leads_there(parts, tmp_path, monkeypatch):
    _, folder = parts
    shutil.copytree(folder / "ac.zarr", tmp_path / "own.zarr")
    before = tree(tmp_path / "own.zarr")
    (tmp_path / "link.zarr").symlink_to("own.zarr")
    monkeypatch.chdir(tmp_path)
    for source, out in (
        ("own.zarr", "own.zarr"),
        ("own.zarr", tmp_path / "own.zarr"),
        ("link.zarr", "own.zarr"),
        ("own.zarr", "link.zarr"),
        ("./own.zarr", "../" + tmp_path.name + "/own.zarr"),
    ):
        with pytest.raises(ConfigError, match="is a store to take assets from"):
            subset_store(source, out, ["a"])
        with pytest.raises(ConfigError, match="is a store to take assets from"):
            concat_stores([source, folder / "bd.zarr"], out)
    assert tree(tmp_path / "own.zarr") == before


def test_records_beside_a_store_are_taken_only_if_they_are_of_its_build(parts, tmp_path):
    _, folder = parts
    for name, change in (
        ("none", lambda file: file.unlink()),
        ("broken", lambda file: file.write_text("[" * 100_000)),
        ("stale", lambda file: shutil.copy(folder / "bd.manifests" / "build.json", file)),
    ):
        shutil.copytree(folder / "ac.zarr", tmp_path / f"{name}.zarr")
        shutil.copytree(folder / "ac.manifests", tmp_path / f"{name}.manifests")
        change(tmp_path / f"{name}.manifests" / "build.json")
        summary = subset_store(tmp_path / f"{name}.zarr", tmp_path / f"{name}-a.zarr", ["a"])
        told = json.loads((summary.records.parent / "build.json").read_text())  # type: ignore[union-attr]
        assert told["parameters"]["pixieverse"]["root"] == "unknown"


def test_a_store_whose_attributes_do_not_say_how_it_was_built_is_refused(parts, tmp_path):
    _, folder = parts
    shutil.copytree(folder / "ac.zarr", tmp_path / "odd.zarr")
    file = tmp_path / "odd.zarr" / "zarr.json"
    document = json.loads(file.read_text())
    document["attributes"]["build"]["parameters"]["align"]["unheard_of"] = 1
    file.write_text(json.dumps(document))
    with pytest.raises(StoreError, match="does not say how it was built"):
        subset_store(tmp_path / "odd.zarr", tmp_path / "out.zarr", ["a"])
