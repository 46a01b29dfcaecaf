"""Which assets have rows in which shard."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr

from slatprep.errors import StoreError
from slatprep.parameters import StoreParameters
from slatprep.store.digests import write_digests
from slatprep.store.writer import Shard, create_store, shards


def test_a_shard_has_the_keys_of_just_those_assets_with_rows_in_it() -> None:
    parameters = StoreParameters(voxel_chunk=4, voxel_chunks_per_shard=2, grid_assets_per_shard=2)
    assert list(shards(["a", "b", "c"], [0, 5, 12, 20], parameters)) == [
        Shard("voxel", (0, 8), 0, ["a", "b"], [0, 5, 12]),
        Shard("voxel", (8, 16), 1, ["b", "c"], [5, 12, 20]),
        Shard("voxel", (16, 20), 2, ["c"], [12, 20]),
        Shard("grid", (0, 2), 0, ["a", "b"]),
        Shard("grid", (2, 3), 2, ["c"]),
    ]


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """A store of one asset and 40 voxels, all of whose rows are written."""
    store = tmp_path / "s"
    create_store(store, 1, 40, StoreParameters(voxel_chunk=4, voxel_chunks_per_shard=2))
    root = zarr.open_group(store, mode="r+", use_consolidated=False)
    with zarr.config.set({"array.write_empty_chunks": True}):
        for _, array in root.members(max_depth=None):
            if isinstance(array, zarr.Array):
                array[...] = np.full(array.shape, array.fill_value, array.dtype)
    return store


def test_what_nobody_meant_to_write_is_not_in_a_store(written: Path) -> None:
    stray = written / "voxel" / "feats" / "c" / "0" / ".0.c196bb58.partial"
    stray.write_bytes(b"what a killed worker left")
    write_digests(written)
    assert not stray.exists()
    names = zarr.open_group(written, mode="r", use_consolidated=False)["file/name"][:]
    assert "voxel/feats/c/4/0" in names
    assert not any("partial" in name for name in names)


def test_a_shard_that_was_not_written_ends_the_build(written: Path) -> None:
    (written / "voxel" / "feats" / "c" / "1" / "0").unlink()
    with pytest.raises(StoreError, match="voxel/feats/c/1/0: was not written"):
        write_digests(written)
