"""What `slatprep info` counts, against the arrays themselves."""

import shutil

import numpy as np
import pytest
import zarr

from slatprep.inspect.check import choose_assets
from slatprep.inspect.overview import overview_of
from slatprep.store import open_store


def test_figures_are_medians_over_assets_and_shares_over_voxels(mixed_build, tmp_path):
    path = tmp_path / "copy.zarr"
    shutil.copytree(str(mixed_build.store), path)
    group = zarr.open_group(path, mode="r+")
    group["asset/fitness"][:] = [0.9, 0.1, 0.3, 0.7, 0.2]
    group["asset/ambiguity"][:] = [0.0, 0.2, 0.0, 0.01, 0.0]
    group["asset/valid_share"][:] = [1.0, 0.0, 0.5, 0.25, 1.0]
    group["asset/category"][:] = np.array(["b", "", "a", "b", "b"], dtype=object)

    overview = overview_of(open_store(path))

    voxels = np.diff(group["asset/offset"][:])
    assert overview.total.assets == 5
    assert overview.total.voxels == voxels.sum() == group["voxel/coords"].shape[0]
    assert overview.total.fitness == pytest.approx(0.3)
    assert overview.total.ambiguous == len(choose_assets(open_store(path), ambiguous=True)) == 1
    valid = voxels @ [1.0, 0.0, 0.5, 0.25, 1.0]
    assert overview.total.valid_share == pytest.approx(valid / voxels.sum())
    assert overview.total.verdicts == {"good": 5, "doubtful": 0, "failed": 0}
    assert [(one.name, one.assets) for one in overview.categories] == [
        ("(unknown)", 1), ("a", 1), ("b", 3),
    ]  # fmt: skip
    assert overview.categories[2].fitness == pytest.approx(0.7)
    files = [file for file in path.rglob("*") if file.is_file()]
    assert overview.files == len(files)
    assert overview.size == sum(file.stat().st_size for file in files)
