"""What `slatprep check-alignment` and `slatprep info` say of a store, against its arrays."""

import numpy as np
import pytest
import zarr
from support.synthetic import QUARTER_TURN, Dataset

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
    group = zarr.open_group(copy, mode="r+")
    transform = QUARTER_TURN.copy()
    transform[:3, 3] = 0.4
    group["asset/transform"][0] = transform
    check = check_alignment(open_store(copy), "ant")
    assert not check.ok
    assert check.verdict is Verdict.FAILED
    assert check.reasons
    assert {"fitness", "fitness_backward", "overlap"} <= wrong(check)
    assert check_alignment(open_store(copy), "cup").ok


@pytest.mark.parametrize(
    ("array", "value", "figure"),
    [
        ("voxel/material", 5, "voxels with another material"),
        ("voxel/valid", False, "voxels with another valid"),
        ("voxel/properties", 0.123, "largest difference of a property"),
        ("voxel/properties", np.nan, "largest difference of a property"),
        ("voxel/distance", 9.0, "largest difference of a distance"),
    ],
)
def test_a_changed_voxel_is_found(copy, array, value, figure):
    zarr.open_group(copy, mode="r+")[array][3] = value
    check = check_alignment(open_store(copy), "ant")
    assert not check.ok
    assert figure in wrong(check)


def test_a_changed_grid_and_a_changed_verdict_are_found(copy):
    group = zarr.open_group(copy, mode="r+")
    group["asset/verdict"][1] = "doubtful"
    check = check_alignment(open_store(copy), "bear.front")
    assert not check.consistent
    assert not check.ok
    material = group["grid/material"][0]
    group["grid/material"][0] = np.where(material == 0, 6, material)
    assert "voxels with another material" in wrong(check_alignment(open_store(copy), "ant"))
    with pytest.raises(StoreError, match="no asset"):
        check_alignment(open_store(copy), "nobody")


def test_ground_does_not_count_now_either(tmp_path):
    dataset = Dataset(tmp_path)
    dataset.add("ant", seed=0)
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
