"""What `slatprep check-alignment` and `slatprep info` say of a store, against its arrays."""

import numpy as np
import pytest
import zarr
from support.made_store import rewrite
from support.synthetic import MakeDataset

from slatprep.errors import StoreError
from slatprep.inspect.check import AlignmentCheck, check_alignment, choose_assets
from slatprep.inspect.overview import overview_of
from slatprep.pipeline.dataset import build_store
from slatprep.records import Verdict
from slatprep.store import open_store
from slatprep.store.records import StoredRecords


def wrong(check: AlignmentCheck) -> set[str]:
    return {figure.name for figure in check.figures if not figure.ok}


def test_every_asset_of_a_fresh_store_passes(mixed_build):
    store = open_store(mixed_build.store)
    for asset_id in store.ids:
        check = check_alignment(store, asset_id)
        assert check.ok, wrong(check)
        assert check.verdict is Verdict.GOOD


def test_a_wrong_transform_is_found(copy):
    rewrite(copy, "asset/transform", (0, slice(3), 3), 0.4)
    check = check_alignment(open_store(copy), "ant")
    assert not check.ok and check.verdict is Verdict.FAILED and check.reasons
    assert {"fitness", "fitness_backward", "overlap"} <= wrong(check)
    assert check_alignment(open_store(copy), "cup").ok


def test_changed_voxels_a_changed_grid_and_a_changed_verdict_are_found(copy):
    figures = {
        "voxel/material": (5, "voxels with another material"),
        "voxel/valid": (False, "voxels with another valid"),
        "voxel/properties": (0.123, "largest difference of a property"),
        "voxel/distance": (9.0, "largest difference of a distance"),
    }
    for row, (array, (value, _)) in enumerate(figures.items()):
        rewrite(copy, array, row, value)
    rewrite(copy, "asset/verdict", 1, "doubtful")
    store = open_store(copy)
    assert wrong(check_alignment(store, "ant")) == {figure for _, figure in figures.values()}
    other = check_alignment(store, "bear.front")
    assert not wrong(other) and not other.consistent and not other.ok
    rewrite(copy, "voxel/properties", int(store.offsets[3]), np.nan)
    assert wrong(check_alignment(copy, "cup")) == {"largest difference of a property"}
    material = store.asset("dog").grid_material
    rewrite(copy, "grid/material", 4, np.where(material == 0, 6, material))
    assert wrong(check_alignment(copy, "dog")) == {"voxels with another material"}
    with pytest.raises(StoreError, match="no asset"):
        check_alignment(store, "nobody")


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
    valid = voxels @ [1.0, 0.0, 0.5, 0.25, 1.0]
    assert overview.total.valid_share == pytest.approx(valid / voxels.sum())
    assert overview.total.verdicts == {"good": 5, "doubtful": 0, "failed": 0}
    assert [(one.name, one.assets) for one in overview.categories] == [
        ("(unknown)", 1), ("a", 1), ("b", 3),
    ]  # fmt: skip
    assert overview.categories[2].fitness == pytest.approx(0.7)
    files = [file for file in copy.rglob("*") if file.is_file()]
    assert overview.files == len(files)
    assert overview.size == sum(file.stat().st_size for file in files)
