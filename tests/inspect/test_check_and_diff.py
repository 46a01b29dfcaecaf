"""What `slatprep diff`, `check-alignment` and `info` say, of changes made by hand."""

import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr
from support.commands import document, run
from support.made_store import rewrite
from support.synthetic import Dataset, MakeDataset, make_asset

from slatprep import ConfigError, StoreError, compare_stores, open_store, subset_store
from slatprep.geometry.frames import displacement, make_transform
from slatprep.inspect.check import AlignmentCheck, check_alignment, choose_assets
from slatprep.inspect.overview import overview_of
from slatprep.normalize import denormalize_properties
from slatprep.pipeline.dataset import build_store
from slatprep.records import Verdict
from slatprep.store.layout import ARRAYS
from slatprep.store.records import StoredRecords


def change(path: Path, name: str, edit: Callable[[np.ndarray], np.ndarray], asset: int) -> None:
    """Replace an asset's rows of an array by what a function makes of them."""
    store = open_store(path)
    own = slice(*store.rows(asset)) if name.startswith("voxel/") else slice(asset, asset + 1)
    rewrite(path, name, own, edit(store.read_rows(name, own.start, own.stop)))


def test_a_copy_is_the_same(mixed_build, copy):
    found = compare_stores(mixed_build.store, copy)
    assert found.same and (found.assets, found.changed, found.worst) == (5, 0, ())
    assert found.voxels == open_store(copy).offsets[-1] and math.isnan(found.moved)
    assert "hold the same" in run("diff", mixed_build.store, copy).stdout


def test_every_change_is_counted_where_it_was_made(mixed_build, copy):
    before = open_store(mixed_build.store)
    softer = np.zeros((before.rows(3)[1] - before.rows(3)[0], 3), np.float32)
    softer[:4, 0] = 0.25
    first = np.arange(before.rows(0)[1]) < 7
    change(copy, "voxel/material", lambda old: np.where(first, (old + 1) % 7, old), 0)
    change(copy, "voxel/properties", lambda values: values - softer, 3)
    change(copy, "voxel/place", lambda places: places + np.float32([0, 3 / 64, 0]), 4)
    change(copy, "voxel/feats", lambda feats: feats * 2, 1)
    rewrite(copy, "asset/verdict", 4, "failed")
    rewrite(copy, "asset/fitness", 2, 0.5)
    found = compare_stores(mixed_build.store, copy)
    assert found == compare_stores(mixed_build.store, copy, jobs=2)
    assert not found.same and not found.settings and not found.only_a + found.only_b
    kinds = ("labels", "properties", "placement", "latents", "verdict", "columns")
    assert found.what == dict.fromkeys(kinds, 1)
    assert found.verdicts == {"good > failed": 1} and found.labels == 7
    assert found.moved == found.moved_most == pytest.approx(3, rel=1e-5)
    of = {one.asset_id: one for one in found.worst}
    assert list(of) == ["ant", "dog", "cup", "bear.front", "bear.side"]
    assert of["ant"].what == ("labels",) and of["ant"].labels == 7
    assert of["dog"].what == ("placement", "verdict") and of["dog"].verdicts == ("good", "failed")
    assert of["bear.front"].what == ("latents",)
    assert (of["bear.side"].what, of["bear.side"].columns) == (("columns",), ("asset/fitness",))

    # Of Young's modulus, as the ranges have it: a quarter of [-1, 1] is an eighth of the range.
    span = before.normalization.ranges[0]
    own = of["cup"].properties["youngs_modulus"]
    valid = int(np.isfinite(before.read(3)["properties"][:, 0]).sum())
    assert (own.voxels, own.changed) == (valid, 4)
    assert own.log10 == pytest.approx(4 / valid * (span.hi - span.lo) / 8, rel=1e-5)
    here = before.asset("cup").properties[:4]
    both = np.stack([here, here - np.float32([0.25, 0, 0])]).reshape(-1, 3)
    moduli = denormalize_properties(both, before.normalization)[:, 0].astype(float)
    apart = np.abs(moduli[4:] - moduli[:4])
    assert own.most == pytest.approx(apart.max(), rel=1e-5)
    assert own.mean == pytest.approx(apart.sum() / valid, rel=1e-5)
    whole = found.properties["youngs_modulus"]
    assert whole.changed == 4 and whole.most == own.most
    assert whole.mean == pytest.approx(apart.sum() / whole.voxels, rel=1e-5)
    assert found.properties["density"].changed == 0


def test_voxels_are_matched_wherever_they_lie(mixed_build, copy):
    """The same voxels in another order, and one voxel that is another."""
    before = open_store(mixed_build.store)
    for layout in (one for one in ARRAYS if one.name.startswith("voxel/")):
        change(copy, layout.name, lambda values: values[::-1], 0)
    rewrite(copy, "voxel/coords", before.rows(4)[0] + 5, [0, 0, 0])
    turned = make_transform(np.eye(3), (2 / 64, 0, 0)) @ before.asset("dog").transform
    rewrite(copy, "asset/transform", 4, turned)
    found = compare_stores(mixed_build.store, copy)
    of = {one.asset_id: one for one in found.worst}
    assert of.keys() == {"ant", "dog"}
    assert of["ant"].what == ("voxels",) and of["ant"].unmatched == 0
    dog_before = before.asset("dog")
    assert of["dog"].unmatched == 2 and of["dog"].voxels == len(dog_before.latents.centres) - 1
    assert of["dog"].moved == displacement(turned, dog_before.transform, dog_before.latents.centres)
    assert of["dog"].moved == pytest.approx(2)
    assert set(of["dog"].what) == {"voxels", "placement", "columns"}


def test_other_sources_ranges_and_assets(tmp_path):
    dataset = Dataset(tmp_path / "sources").having("kept", "softer", "gone")
    build_store(dataset.parameters("pixie"), tmp_path / "a.zarr")
    dataset.remove("gone")
    dataset.add("new", 3)
    grid = make_asset(1).grid
    grid[..., 1] *= 10  # Young's modulus
    dataset.write_grid("softer", grid)
    build_store(dataset.parameters("dataset"), tmp_path / "b.zarr")
    a, b = open_store(tmp_path / "a.zarr"), open_store(tmp_path / "b.zarr")
    found = compare_stores(tmp_path / "a.zarr", str(tmp_path / "b.zarr"))
    assert (found.only_a, found.only_b, found.assets) == (("gone",), ("new",), 2)
    settings = {one.name: (one.a, one.b) for one in found.settings}
    assert settings["normalization.density.lo"][1] == b.normalization.ranges[1].lo
    assert settings["normalization.density.source"] == ("pixie", "dataset")
    of = {one.asset_id: one for one in found.worst}
    softer = of["softer"]
    assert softer.sources == ("grid",) and {"sources", "properties"} <= set(softer.what)
    # What is clipped by Pixie's range of E cannot be told; the others are ten times as much.
    jelly = a.asset("softer").material == 0
    assert softer.properties["youngs_modulus"].changed >= jelly.sum() > 0
    # The same values by other ranges differ by rounding alone, but where a range clipped them.
    kept = of["kept"].properties
    assert kept["density"].changed == (a.asset("kept").material == 1).sum()  # 8,000 kg/m^3
    assert kept["poissons_ratio"].changed == 0
    assert "sources" not in of["kept"].what
    with pytest.raises(StoreError, match="x is not a slatprep store"):
        compare_stores("x", b)

    subset_store(a.path, tmp_path / "gone.zarr", ["gone"])
    nothing = compare_stores(open_store(tmp_path / "gone.zarr"), b)
    assert (nothing.assets, nothing.only_a) == (0, ("gone",))
    assert nothing.only_b == ("kept", "new", "softer") and not nothing.same
    assert "only in A: gone" in run("diff", tmp_path / "gone.zarr", b.path, code=1).stdout


def test_the_command_tells_it_and_how_it_ended(mixed_build, copy):
    rewrite(copy, "asset/verdict", 4, "failed")
    rewrite(copy, "asset/fitness", slice(0, 4), 0.5)
    words = ("diff", mixed_build.store, copy)
    assert "1 good > failed" in run(*words, code=1).stdout
    found = document(*words, code=1)
    assert found["what"] == {"columns": 4, "verdict": 1} and len(found["worst"]) == 5
    assert found["moved"] is None
    assert document(*words, "--worst", 2, code=1) == found | {"worst": found["worst"][:2]}


def test_trouble_is_neither_the_same_nor_different(mixed_build, copy):
    os.truncate(copy / "voxel/place/c/0/0", 50)
    result = run("diff", mixed_build.store, copy, code=1)
    assert "voxel/place" in result.stderr and not result.stdout
    run("diff", mixed_build.store, copy.parent / "nothing", code=2)
    run("diff", mixed_build.store, copy.parent, code=1)


# -- checks and overviews --------------------------------------------------------


def wrong(check: AlignmentCheck) -> set[str]:
    return {figure.name for figure in check.figures if not figure.ok}


def test_a_wrong_transform_is_found(copy):
    rewrite(copy, "asset/transform", (0, slice(3), 3), 0.4)
    check = check_alignment(open_store(copy), "ant")
    assert not check.ok and check.verdict is Verdict.FAILED and check.reasons
    assert {"fitness", "fitness_backward", "overlap"} <= wrong(check)
    for asset_id in open_store(copy).ids[1:]:
        check = check_alignment(open_store(copy), asset_id)
        assert check.ok and check.verdict is Verdict.GOOD, wrong(check)


def test_changed_voxels_a_changed_grid_and_a_changed_verdict_are_found(copy):
    figures = {
        "voxel/material": (5, "voxels whose material changes"),
        "voxel/valid": (False, "voxels whose valid changes"),
        "voxel/properties": (0.123, "largest change of a property"),
        "voxel/distance": (9.0, "largest change of a distance"),
    }
    for row, (array, (value, _)) in enumerate(figures.items()):
        rewrite(copy, array, row, value)
    rewrite(copy, "asset/verdict", 1, "doubtful")
    store = open_store(copy)
    assert wrong(check_alignment(store, "ant")) == {figure for _, figure in figures.values()}
    other = check_alignment(store, "bear.front")
    assert not wrong(other) and not other.consistent and not other.ok
    rewrite(copy, "voxel/properties", int(store.offsets[3]), np.nan)
    assert wrong(check_alignment(copy, "cup")) == {"largest change of a property"}
    material = store.asset("dog").grid_material
    rewrite(copy, "grid/material", 4, np.where(material == 0, 6, material))
    assert wrong(check_alignment(copy, "dog")) == {"voxels whose material changes"}
    with pytest.raises(StoreError, match="no asset"):
        check_alignment(store, "nobody")


@pytest.mark.parametrize(("name", "value"), [
    ("same_object", 0.1), ("right_placement", 0.1), ("expected_accuracy", 0.2),
    ("contradicted", True), ("ambiguity", 0.9),
])  # fmt: skip
def test_a_verdict_that_its_columns_do_not_give_is_found(copy, name, value):
    assert check_alignment(copy, 0).consistent
    rewrite(copy, f"asset/{name}", 0, value)
    found = check_alignment(copy, 0)
    if name == "ambiguity":  # The record says that nothing ties.
        assert found.value("ambiguity") == value
    else:
        assert not found.consistent and found.verdict != "good"


def test_ground_does_not_count_now_either(make_dataset: MakeDataset, tmp_path):
    dataset = make_dataset("ant")
    grid = dataset.assets["ant"].grid
    grid[:, :, 23:26] = grid[20, 22, 26]
    dataset.write_grid("ant", grid)
    build_store(dataset.parameters(), tmp_path / "store.zarr")
    store = open_store(tmp_path / "store.zarr")
    check = check_alignment(store, "ant")
    assert check.ok, (check.reasons, wrong(check))
    assert check.value("fitness") > 0.9
    ground = StoredRecords(store).of("ant").alignment.ground
    np.testing.assert_allclose(ground.normal, [0, 0, 1], atol=0.01)


def test_figures_are_medians_over_assets_and_shares_over_voxels(copy):
    group = zarr.open_group(copy, mode="r+")
    group["asset/fitness"][:] = [0.9, 0.1, 0.3, 0.7, 0.2]
    group["asset/ambiguity"][:] = [0.0, 0.2, 0.0, 0.01, 0.0]
    group["asset/valid_share"][:] = [1.0, 0.0, 0.5, 0.25, 1.0]
    group["asset/category"][:] = np.array(["b", "", "a", "b", "b"], dtype=object)

    overview = overview_of(open_store(copy))

    voxels = np.diff(group["asset/offset"][:])
    assert overview.total.assets == 5
    assert overview.total.voxels == voxels.sum() == group["voxel/coords"].shape[0]
    assert overview.total.fitness == pytest.approx(0.3)
    assert overview.total.ambiguous == len(choose_assets(open_store(copy), ambiguous=True)) == 1
    said = run("info", copy).stdout
    assert "\nambiguous: 1 of 5: other placements fit about as well, and change labels" in said
    assert "5% of the voxels; 1 good, settled by consensus or latents\n" in said
    valid = voxels @ [1.0, 0.0, 0.5, 0.25, 1.0]
    assert overview.total.valid_share == pytest.approx(valid / voxels.sum())
    assert overview.total.verdicts == {"good": 5, "doubtful": 0, "failed": 0}
    counts = {one.name: one.assets for one in overview.categories}
    assert list(counts.items()) == [("(unknown)", 1), ("a", 1), ("b", 3)]
    assert overview.categories[2].fitness == pytest.approx(0.7)
    files = [file for file in copy.rglob("*") if file.is_file()]
    assert overview.files == len(files)
    assert overview.size == sum(file.stat().st_size for file in files)


def test_totals_do_not_depend_on_how_many_changes_are_listed(mixed_build, copy):
    rewrite(copy, "asset/fitness", 0, 0.25)
    every = compare_stores(mixed_build.store, copy)
    none = compare_stores(mixed_build.store, copy, worst=0)
    assert (none.changed, none.voxels, none.what) == (1, every.voxels, {"columns": 1})
    assert not none.worst and not none.same
    with pytest.raises(ConfigError, match="worst is -1; expected 0 or more"):
        compare_stores(mixed_build.store, copy, worst=-1)
