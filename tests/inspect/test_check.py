from pathlib import Path

import numpy as np
import pytest
import zarr
from support.synthetic import QUARTER_TURN, Dataset

from slatprep.errors import StoreError
from slatprep.inspect.check import AlignmentCheck, check_alignment
from slatprep.pipeline.dataset import BuildSummary, build_store
from slatprep.records import Verdict
from slatprep.store import open_store
from slatprep.store.records import StoredRecords


def wrong(check: AlignmentCheck) -> set[str]:
    return {figure.name for figure in check.figures if not figure.ok}


def test_every_asset_of_a_fresh_store_passes(mixed_build: BuildSummary) -> None:
    store = open_store(mixed_build.store)
    for asset_id in store.ids:
        check = check_alignment(store, asset_id)
        assert check.ok, wrong(check)
        assert check.verdict is Verdict.GOOD


def test_a_wrong_transform_is_found(copy: Path) -> None:
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
def test_a_changed_voxel_is_found(copy: Path, array: str, value: float, figure: str) -> None:
    zarr.open_group(copy, mode="r+")[array][3] = value
    check = check_alignment(open_store(copy), "ant")
    assert not check.ok
    assert figure in wrong(check)


def test_a_changed_grid_is_found(copy: Path) -> None:
    group = zarr.open_group(copy, mode="r+")
    material = group["grid/material"][0]
    group["grid/material"][0] = np.where(material == 0, 6, material)
    assert "voxels with another material" in wrong(check_alignment(open_store(copy), "ant"))


def test_a_changed_verdict_is_found(copy: Path) -> None:
    group = zarr.open_group(copy, mode="r+")
    verdicts = group["asset/verdict"][:]
    verdicts[0] = "doubtful"
    group["asset/verdict"][:] = verdicts
    check = check_alignment(open_store(copy), "ant")
    assert not check.consistent
    assert not check.ok


def test_an_unknown_asset_is_refused(mixed_build: BuildSummary) -> None:
    with pytest.raises(StoreError, match="no asset"):
        check_alignment(open_store(mixed_build.store), "nobody")


def test_ground_does_not_count_now_either(tmp_path: Path) -> None:
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
    assert ground is not None
    np.testing.assert_allclose(ground.normal, [0, 0, 1], atol=0.01)
